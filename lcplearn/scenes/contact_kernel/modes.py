"""Coulomb's law at guessed modes: one linear system a step, where an LCP takes many pivots.

Each contact is open, sticks, or slips along an axis t with load lambda and friction f; s is across t:

    n v - target + compliance lambda = 0                            unless it is open,
    T v = 0                                                         where it sticks,
    f = -mu lambda t + f_s s,   f_s = -(mu lambda / |slip|) v_s     where it slips,

the last with load and slip of the step before, as in `friction_lcp`. The solution says which modes were wrong and turns
the axes. What satisfies the law is a solution, however it was found; what does not get there in a few steps, or has
loads that are not unique, is left to the LCPs. The first modes come from the free velocity, so from the state alone.
"""

from math import sqrt

import numpy as np

from lcplearn.scenes.contact_kernel.compiling import compiled, merged
from lcplearn.scenes.contact_kernel.dense import factorise, solve
from lcplearn.scenes.contact_kernel.memory import modes_memory
from lcplearn.scenes.friction_lcp import CREEP, HEAVY, ROUNDING, SETTLED

OPEN, SLIPS, STICKS = 0, 2, 3  # the number of unknowns
STEPS = 10
PROXIMAL = 1e-7  # of the mobility, on rows that stick: of the friction of redundant contacts the smallest is taken
NOISE = 1e-14  # a load below this share of the largest is none


@compiled
def _follow(i, x, y, floor, limit, axes, weight):
    """Axis of contact i along (x, y), and the weight across it for a slip of that size, or of the floor."""
    size = sqrt(x * x + y * y)
    axes[i, 0], axes[i, 1] = (x / size, y / size) if size > 0.0 else (1.0, 0.0)
    size = max(size, floor)
    weight[i] = limit / size if size > 0.0 else 0.0


@merged
def _guess(K, nv, rows, target, mu, free, mass, load, mobility, axes, weight, mode):
    """Every contact bears what would stop it alone, and slips freely unless friction could stop that."""
    for i in range(K):
        opening, x, y, mobility[i] = -target[i], 0.0, 0.0, 0.0
        for k in range(nv):
            opening += rows[i, k] * free[k]
            x += rows[K + i, k] * free[k]
            y += rows[2 * K + i, k] * free[k]
            mobility[i] += rows[i, k] * rows[i, k] / mass[k]
        load[i], size = max(-opening, 0.0) / mobility[i], sqrt(x * x + y * y)
        mode[i] = STICKS if size < mobility[i] * mu[i] * load[i] else SLIPS
        _follow(i, x, y, 0.0, mu[i] * load[i], axes, weight)


@merged
def _system(K, nv, rows, target, mu, compliance, free, mass, mobility, axes, weight, mode, A, left, right, b, soft):
    """The linear system of the modes, A = left right + diagonal; its size.

    right [nv, n] is what units of the unknowns do to the velocity: loads and friction where a contact sticks, load and
    f_s where it slips. soft is the proximal part of the diagonal.
    """
    n = 0
    for i in range(K):
        if mode[i] == OPEN:
            continue
        c, e = axes[i, 0], axes[i, 1]
        share = 1.0 / (1.0 + weight[i] * mobility[i])
        for k in range(nv):
            normal, x, y = rows[i, k], rows[K + i, k], rows[2 * K + i, k]
            left[n, k] = normal
            if mode[i] == STICKS:
                left[n + 1, k], left[n + 2, k] = x, y
                right[k, n], right[k, n + 1], right[k, n + 2] = normal / mass[k], x / mass[k], y / mass[k]
            else:
                across = c * y - e * x
                left[n + 1, k] = share * weight[i] * across
                right[k, n], right[k, n + 1] = (normal - mu[i] * (c * x + e * y)) / mass[k], across / mass[k]
        b[n], soft[n] = target[i], 0.0
        for k in range(1, mode[i]):
            b[n + k], soft[n + k] = 0.0, PROXIMAL * mobility[i] if mode[i] == STICKS else 0.0
        n += mode[i]
    for i in range(n):
        for j in range(n):
            A[i, j] = 0.0
        for k in range(nv):
            b[i] -= left[i, k] * free[k]
            for j in range(n):
                A[i, j] += left[i, k] * right[k, j]
        A[i, i] += soft[i]
    n = 0
    for i in range(K):
        if mode[i] != OPEN:
            A[n, n] += compliance[i]
        if mode[i] == SLIPS:
            A[n + 1, n + 1] += 1.0 / (1.0 + weight[i] * mobility[i])
        n += mode[i]
    return n


@merged
def _forces(A, right, b, soft, n, nv, free, scales, order, y, x, v):
    """Solve the system, and the velocity; whether it has one solution."""
    if not factorise(A, scales, order, n):
        return False
    redundant = 0.0
    for i in range(n):
        x[i] = 0.0
        redundant += soft[i]
    for _ in range(3 if redundant > 0.0 else 1):
        for i in range(n):
            y[i] = b[i] + soft[i] * x[i]
        solve(A, scales, order, n, y, x)
    for k in range(nv):
        v[k] = free[k]
        for i in range(n):
            v[k] += right[k, i] * x[i]
    return True


@merged
def _judge_slip(i, vx, vy, mobility, unit, mu, load, friction, slip, axes, weight, mode):
    """How wrong the law of a slipping contact is; its next axis, or mode."""
    c, e = axes[i, 0], axes[i, 1]
    along, across, limit = c * vx + e * vy, c * vy - e * vx, mu[i] * load[i]
    if weight[i] > 0.0:
        across = (e * friction[i, 0] - c * friction[i, 1]) / weight[i]  # exact where the weight makes it small
        if along <= 0.0:
            mode[i] = STICKS
            return np.inf
    slip[i, 0], slip[i, 1] = c * along - e * across, e * along + c * across
    _follow(i, slip[i, 0], slip[i, 1], 0.0, limit, axes, weight)
    x, y = friction[i, 0] - slip[i, 0] / mobility, friction[i, 1] - slip[i, 1] / mobility
    size = sqrt(x * x + y * y)
    factor = limit / size if size > limit else 1.0
    wrong = mobility * sqrt((friction[i, 0] - factor * x) ** 2 + (friction[i, 1] - factor * y) ** 2)
    return (wrong + abs(slip[i, 0] - vx) + abs(slip[i, 1] - vy)) / unit


@merged
def _judge(
    K, nv, rows, target, mu, compliance, scale, mobility, axes, weight, mode, x, v, load, friction, slip
):  # fmt: skip
    """Forces and slips of the contacts, their next modes and axes; by how much the law is violated.

    That is infinite if a mode changes.
    """
    largest, wrong, n = 0.0, 0.0, 0
    for i in range(K):
        load[i] = friction[i, 0] = friction[i, 1] = 0.0
        if mode[i] == STICKS:
            load[i], friction[i, 0], friction[i, 1] = x[n], x[n + 1], x[n + 2]
        elif mode[i] == SLIPS:
            load[i], c, e, t, s = x[n], axes[i, 0], axes[i, 1], -mu[i] * x[n], x[n + 1]
            friction[i, 0], friction[i, 1] = c * t - e * s, e * t + c * s
        largest, n = max(largest, load[i]), n + mode[i]
    for i in range(K):
        opening, vx, vy, a = -target[i], 0.0, 0.0, mobility[i]
        for k in range(nv):
            opening += rows[i, k] * v[k]
            vx += rows[K + i, k] * v[k]
            vy += rows[2 * K + i, k] * v[k]
        size, unit = sqrt(vx * vx + vy * vy), max(scale[i] + min(a * load[i], HEAVY * scale[i]), 1e-300)
        if mode[i] == OPEN:
            slip[i, 0], slip[i, 1] = vx, vy
            if opening < -ROUNDING * scale[i]:
                wrong, mode[i] = np.inf, SLIPS
                _follow(i, vx, vy, CREEP * scale[i], -mu[i] * opening / a, axes, weight)
            continue
        if not load[i] > NOISE * largest:
            wrong, mode[i] = np.inf, OPEN
            continue
        wrong = max(wrong, abs(opening + compliance[i] * load[i]) / unit)
        if mode[i] == SLIPS:
            wrong = max(wrong, _judge_slip(i, vx, vy, a, unit, mu, load, friction, slip, axes, weight, mode))
            continue
        slip[i, 0] = slip[i, 1] = 0.0
        wrong = max(wrong, size / unit)
        strength = sqrt(friction[i, 0] ** 2 + friction[i, 1] ** 2)
        if strength > mu[i] * load[i]:
            wrong, mode[i] = np.inf, SLIPS
            # the slip is still none
            _follow(i, -friction[i, 0], -friction[i, 1], 0.0, 0.0, axes, weight)
            weight[i] = mu[i] * load[i] / max(CREEP * scale[i], 1e-300)
    return wrong


@merged
def settle_modes(
    K, nv, rows, target, mu, compliance, free, mass, scale, at, v, load, friction, slip, sticks
):  # fmt: skip
    """Velocity and forces of K contacts, whose rows are normals, x, y; by how much they violate the law.

    The violation is that of `friction_lcp.law_violation` and of the equations; infinite where the modes do not settle.
    """
    A, left, right, b, soft, scales, x, y, order, mobility, axes, weight, mode = modes_memory(at, K, nv)
    _guess(K, nv, rows, target, mu, free, mass, load, mobility, axes, weight, mode)
    last = np.inf
    for _ in range(STEPS):
        n = _system(
            K, nv, rows, target, mu, compliance, free, mass, mobility, axes, weight, mode, A, left, right, b, soft
        )  # fmt: skip
        if not _forces(A, right, b, soft, n, nv, free, scales, order, y, x, v):
            return np.inf
        wrong = _judge(
            K, nv, rows, target, mu, compliance, scale, mobility, axes, weight, mode, x, v, load, friction, slip
        )  # fmt: skip
        if wrong <= SETTLED or (wrong < np.inf and not wrong < last):
            break
        last = wrong
    for i in range(K):
        sticks[i] = mode[i] == STICKS
    return wrong
