"""The gradient of `contact_gradient.py` for one element, backwards.

With y = (load, friction) of the contacts that are loaded, v = free + mass^-1 J' y and the law r(y, parameters) = 0,
gradients g with respect to v and h with respect to y give K' s = J mass^-1 g + h with K = dr/dy, and -s' dr/dp for
each parameter p. Where contacts are redundant K is singular, and s is the smallest solution.
"""

from math import sqrt

import numpy as np

from lcplearn.scenes.contact_gradient import RANK
from lcplearn.scenes.contact_kernel.compiling import compiled
from lcplearn.scenes.friction_lcp import CREEPS

SINGULAR = 1e-10  # pivots below this, of rows whose largest entry is 1, are those of redundant contacts
SWEEPS = 30  # of Jacobi's rotations; about 8 are needed


@compiled
def _factorise(A, scales, order, n):
    """LU in place with row pivoting, of A with rows of largest entry 1; whether all pivots are well above 0."""
    good = True
    for i in range(n):
        order[i], scales[i] = i, 0.0
        for j in range(n):
            scales[i] = max(scales[i], abs(A[i, j]))
        if not scales[i] > 0.0:
            return False
        for j in range(n):
            A[i, j] /= scales[i]
    for j in range(n):
        best = j
        for i in range(j + 1, n):
            if abs(A[i, j]) > abs(A[best, j]):
                best = i
        good = good and abs(A[best, j]) > SINGULAR
        if not good:
            return False
        if best != j:
            order[j], order[best] = order[best], order[j]
            for k in range(n):
                A[j, k], A[best, k] = A[best, k], A[j, k]
        for i in range(j + 1, n):
            A[i, j] /= A[j, j]
            for k in range(j + 1, n):
                A[i, k] -= A[i, j] * A[j, k]
    return True


@compiled
def _solve_transposed(A, scales, order, n, b, x):
    """x of A' x = b, with A as `_factorise` left it; b is overwritten."""
    for i in range(n):
        for k in range(i):
            b[i] -= A[k, i] * b[k]
        b[i] /= A[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= A[k, i] * b[k]
    for i in range(n):
        x[order[i]] = b[i] / scales[order[i]]


@compiled
def _smallest_solution(A, V, n, b, x):
    """The smallest x of least |A' x - b|, by one-sided Jacobi rotations: A' V has orthogonal columns, the rows of A."""
    for i in range(n):
        for j in range(n):
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(SWEEPS):
        turned = False
        for i in range(n - 1):
            for j in range(i + 1, n):
                a = c = d = 0.0
                for k in range(n):
                    a += A[i, k] * A[i, k]
                    c += A[j, k] * A[j, k]
                    d += A[i, k] * A[j, k]
                if not abs(d) > 1e-15 * sqrt(a * c):
                    continue
                turned = True
                zeta = (c - a) / (2.0 * d)
                t = (1.0 if zeta >= 0.0 else -1.0) / (abs(zeta) + sqrt(1.0 + zeta * zeta))
                cosine = 1.0 / sqrt(1.0 + t * t)
                sine = cosine * t
                for k in range(n):
                    A[i, k], A[j, k] = cosine * A[i, k] - sine * A[j, k], sine * A[i, k] + cosine * A[j, k]
                    V[i, k], V[j, k] = cosine * V[i, k] - sine * V[j, k], sine * V[i, k] + cosine * V[j, k]
        if not turned:
            break
    largest = 0.0
    for i in range(n):
        size = 0.0
        for k in range(n):
            size += A[i, k] ** 2
        largest = max(largest, size)
        x[i] = 0.0
    for i in range(n):
        size = along = 0.0
        for k in range(n):
            size += A[i, k] ** 2
            along += A[i, k] * b[k]
        if size > RANK * RANK * largest:
            for k in range(n):
                x[k] += V[i, k] * along / size


@compiled
def _slope(K, T, nv, rows, y, slip, stuck, unit, mass, mu, compliance, out):
    """K = dr/dy; rows and columns contact by contact, normal first."""
    w = 1 + T
    for i in range(w * K):
        for j in range(w * K):
            s = 0.0
            for k in range(nv):
                s += rows[i, k] * rows[j, k] / mass[k]
            out[i, j] = s
    for c in range(K):
        out[w * c, w * c] += compliance[c]
        if stuck[c]:
            continue
        size = 0.0
        for t in range(T):
            size += slip[c, t] ** 2
        size = max(sqrt(size), 1e-300)
        turning = unit[c] * mu[c] * y[w * c] / size
        for j in range(w * K):
            along = 0.0
            for t in range(T):
                along += slip[c, t] * out[w * c + 1 + t, j] / size
            for t in range(T):
                out[w * c + 1 + t, j] = turning * (out[w * c + 1 + t, j] - along * slip[c, t] / size)
        for t in range(T):
            out[w * c + 1 + t, w * c] += unit[c] * mu[c] * slip[c, t] / size
            out[w * c + 1 + t, w * c + 1 + t] += unit[c]


@compiled
def contact_memory(C, nv, T):
    """What `pull_back_contacts` works in."""
    n = (1 + T) * C
    return (
        np.empty((n, n)), np.empty((n, n)), np.empty(n, np.int64), np.empty(n), np.empty(n), np.empty(n), np.empty(n),
        np.empty((C, T)), np.empty(C), np.empty(C, np.bool_), np.empty(nv), np.empty(nv),
    )  # fmt: skip


@compiled
def _modes(K, T, nv, rows, y, sticks, mu, compliance, free, mass, push, v, unit, slip, stuck):
    """Velocity v after the step, mobility and slip of each contact, and which have no direction of slip."""
    w = 1 + T
    energy, demanded = 0.0, 0.0
    for k in range(nv):
        push[k] = 0.0
        for i in range(w * K):
            push[k] += rows[i, k] * y[i]
        v[k] = free[k] + push[k] / mass[k]
        energy += mass[k] * free[k] ** 2
    for c in range(K):
        unit[c], target = 0.0, compliance[c] * y[w * c]
        for k in range(nv):
            unit[c] += rows[w * c, k] ** 2 / mass[k]
            target += rows[w * c, k] * v[k]
        demanded = max(demanded, target / sqrt(max(unit[c], 1e-300)))
    for c in range(K):
        size = 0.0
        for t in range(T):
            slip[c, t] = 0.0
            for k in range(nv):
                slip[c, t] += rows[w * c + 1 + t, k] * v[k]
            size += slip[c, t] ** 2
        stuck[c] = sticks[c] or sqrt(size) <= CREEPS * sqrt(unit[c]) * (sqrt(energy) + demanded)
        if stuck[c] and not mu[c] * y[w * c] > 0.0:  # what has no friction is held by nothing
            stuck[c], slip[c, :] = False, 0.0


@compiled
def _to_speeds(K, T, y, mu, unit, slip, stuck, s, speed_gradient, to_target, to_mu, to_compliance):
    """From s to the gradients with respect to the speeds of the rows, and to the numbers of the law."""
    w = 1 + T
    for c in range(K):
        to_target[c] = s[w * c]
        to_compliance[c] = -s[w * c] * y[w * c]
        to_mu[c] = 0.0
        speed_gradient[w * c] = -s[w * c]
        if stuck[c]:
            for t in range(1, w):
                speed_gradient[w * c + t] = -s[w * c + t]
            continue
        size, along = 0.0, 0.0
        for t in range(T):
            size += slip[c, t] ** 2
        size = max(sqrt(size), 1e-300)
        for t in range(T):
            along += slip[c, t] * s[w * c + 1 + t] / size
        to_mu[c] = -unit[c] * y[w * c] * along
        turning = unit[c] * mu[c] * y[w * c] / size
        for t in range(T):
            speed_gradient[w * c + 1 + t] = -turning * (s[w * c + 1 + t] - along * slip[c, t] / size)


@compiled
def pull_back_contacts(
    K, T, nv, rows, y, sticks, mu, compliance, free, mass, gradient, y_gradient, memory, to_free, to_rows, to_target,
    to_mu, to_compliance, to_mass,
):  # fmt: skip
    """From the gradients of velocity and impulses to those with respect to what a step of contacts takes.

    Args:
        rows: Jacobians [(1 + T) K, nv] of the K loaded contacts; each contact's normal, then its T tangents.
        y: Impulses along the rows; sticks, mu, compliance [K]; free, mass [nv]: as the step had them.
        gradient: With respect to the velocity after the step; y_gradient: with respect to y.
        to_free, to_rows, to_target, to_mu, to_compliance: Where gradients are written; to_mass is added to.
    """
    slope, right, order, scales, wanted, s, speed_gradient, slip, unit, stuck, push, v = memory
    w = 1 + T
    _modes(K, T, nv, rows, y, sticks, mu, compliance, free, mass, push, v, unit, slip, stuck)
    for i in range(w * K):
        wanted[i] = y_gradient[i]
        for k in range(nv):
            wanted[i] += rows[i, k] * gradient[k] / mass[k]
    _slope(K, T, nv, rows, y, slip, stuck, unit, mass, mu, compliance, slope)
    if _factorise(slope, scales, order, w * K):
        _solve_transposed(slope, scales, order, w * K, wanted, s)
    else:
        _slope(K, T, nv, rows, y, slip, stuck, unit, mass, mu, compliance, slope)
        _smallest_solution(slope, right, w * K, wanted, s)
    _to_speeds(K, T, y, mu, unit, slip, stuck, s, speed_gradient, to_target, to_mu, to_compliance)
    for k in range(nv):
        to_free[k] = gradient[k]
        for i in range(w * K):
            to_free[k] += rows[i, k] * speed_gradient[i]
        to_mass[k] -= to_free[k] * push[k] / mass[k] ** 2
        for i in range(w * K):
            to_rows[i, k] = speed_gradient[i] * v[k] + y[i] * to_free[k] / mass[k]
