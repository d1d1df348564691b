"""Newton's iteration for the cones of the contacts of one element; as `contact_solve` has it in torch."""

from math import sqrt

import numpy as np

from lcplearn.scenes.contact_kernel.compiling import compiled
from lcplearn.scenes.contact_kernel.memory import cone_memory
from lcplearn.scenes.contact_kernel.rows import apply, condense, cone_rows, delassus, mass_norm, rotate, solve_lcp
from lcplearn.scenes.friction_lcp import (
    CRUDE,
    HEAVY,
    LAST_RESORT,
    MAX_ITERATIONS,
    PLAIN,
    SETTLED,
    STAYS,
    regularisation,
)

_regularisation = compiled(regularisation)


@compiled
def _choose_axes(slip, friction, load, sticks, mu, scale, creep, K, axes, root):
    """Facets along the slip or against the friction force, and the root of the weight across them."""
    for i in range(K):
        speed = sqrt(slip[i, 0] ** 2 + slip[i, 1] ** 2)
        still = creep * scale[i]
        x, y = slip[i, 0], slip[i, 1]
        if sticks[i] or speed <= 10.0 * still:
            x, y = -friction[i, 0], -friction[i, 1]
        length = sqrt(x * x + y * y)
        axes[i, 0], axes[i, 1] = (x / length, y / length) if length > 0.0 else (1.0, 0.0)
        floor = still if sticks[i] else max(speed, still)
        root[i] = sqrt(mu[i] * load[i] / floor) if floor > 0.0 else 0.0


@compiled
def _law_violation(slip, friction, load, mu, D, scale, K):
    """As in `friction_lcp`."""
    result = 0.0
    for i in range(K):
        a, limit = D[i, i], mu[i] * load[i]
        x, y = friction[i, 0] - slip[i, 0] / a, friction[i, 1] - slip[i, 1] / a
        size = sqrt(x * x + y * y)
        factor = limit / size if size > limit else 1.0
        wrong = sqrt((friction[i, 0] - factor * x) ** 2 + (friction[i, 1] - factor * y) ** 2)
        result = max(result, a * wrong / max(scale[i] + min(a * load[i], HEAVY * scale[i]), 1e-300))
    return result


@compiled
def _read(K, axes, root, X, D, u, mu, z, w, load, friction, slip, sticks, force, impulse):
    """Loads, friction forces and slips from a solution of the LCP."""
    for i in range(K):
        load[i] = z[i]
        force[i], force[K + i] = z[i], z[K + i] - mu[i] * z[i]
    for i in range(K):
        s = -X[i, 2 * K]
        for j in range(2 * K):
            s -= X[i, j] * force[j]
        t, along = force[K + i], w[K + i] - z[2 * K + i]
        c, e = axes[i, 0], axes[i, 1]
        friction[i, 0], friction[i, 1] = c * t - e * s, e * t + c * s
        sticks[i] = along == 0.0
        slip[i, 0], slip[i, 1] = along, -s / root[i] ** 2 if root[i] > 0.0 else 0.0
        impulse[i], impulse[K + i], impulse[2 * K + i] = load[i], friction[i, 0], friction[i, 1]
    for i in range(K):
        c, e = axes[i, 0], axes[i, 1]
        along, across = slip[i, 0], slip[i, 1]
        if not root[i] > 0.0:  # what has no load slips as it will
            across = c * u[2 * K + i] - e * u[K + i]
            for j in range(3 * K):
                across += (c * D[2 * K + i, j] - e * D[K + i, j]) * impulse[j]
            sticks[i] = sticks[i] and across == 0.0
        slip[i, 0], slip[i, 1] = c * along - e * across, e * along + c * across


@compiled
def solve_cone(
    address, K, nv, rows, target, mu, compliance, free, mass, scale, at, v, load, friction, slip, sticks
):  # fmt: skip
    """Iterate the cone of K contacts; whether it was solved, and whether it settled."""
    D, A, H, X, M, q, u, r, axes, root, impulse, v_new, force, old_load, old_friction, scratch, out, soft, goal = (
        cone_memory(at, K, nv)
    )
    n = 3 * K
    delassus(rows, mass, free, n, nv, D, u)
    for i in range(K):
        load[i] = max(0.0, target[i] - u[i]) / D[i, i]
        friction[i, 0] = friction[i, 1] = 0.0
        slip[i, 0], slip[i, 1] = u[K + i], u[2 * K + i]
        sticks[i] = False
    v[:] = free
    size, old, was_damped = mass_norm(mass, free, nv), np.inf, False
    solved = settled = False
    for iteration in range(MAX_ITERATIONS):
        proximal, creep = _regularisation(iteration)
        for i in range(K):
            soft[i] = compliance[i] + proximal * D[i, i]
            goal[i] = target[i] + proximal * D[i, i] * load[i]
            old_load[i], old_friction[i, 0], old_friction[i, 1] = load[i], friction[i, 0], friction[i, 1]
        _choose_axes(slip, friction, load, sticks, mu, scale, creep, K, axes, root)
        rotate(D, u, axes, K, A, r)
        condense(A, r, root, K, H, X)
        cone_rows(A, r, goal, mu, soft, K, M, q)
        solved = solve_lcp(address, n, M, q, scratch, out)
        _read(K, axes, root, X, D, u, mu, out[:n], out[n : 2 * n], load, friction, slip, sticks, force, impulse)
        apply(rows, mass, free, impulse, n, nv, v_new)
        wrong = _law_violation(slip, friction, load, mu, D, scale, K)
        for i in range(K):
            wrong = max(wrong, proximal * D[i, i] * abs(load[i] - old_load[i]) / max(scale[i], 1e-300))
        for k in range(nv):
            v[k] -= v_new[k]
        change = mass_norm(mass, v, nv)
        stays = change <= STAYS * (size + mass_norm(mass, v_new, nv))
        settled = wrong <= SETTLED or (stays and wrong <= CRUDE and iteration >= LAST_RESORT)
        if (settled and solved) or iteration == MAX_ITERATIONS - 1:
            break
        damped = change > 0.3 * old and not was_damped and 3 < iteration < PLAIN
        if damped:
            for k in range(nv):
                v_new[k] += 0.5 * v[k]
            for i in range(K):
                load[i] = 0.5 * (load[i] + old_load[i])
                friction[i, 0] = 0.5 * (friction[i, 0] + old_friction[i, 0])
                friction[i, 1] = 0.5 * (friction[i, 1] + old_friction[i, 1])
        v[:] = v_new
        old, was_damped = change, damped
    v[:] = v_new
    return solved, settled
