"""The adjoint of a contact step on the CPU, compiled: the gradient of `contact_gradient.py`, without torch.

With y = (load, friction) of the contacts that are loaded, v = free + mass^-1 J' y and the law r(y, parameters) = 0, a
gradient g with respect to v gives K' s = J mass^-1 g with K = dr/dy, and -s' dr/dp for each parameter p.
"""

from math import sqrt

import numpy as np

from lcplearn.scenes.contact_kernel import compiled
from lcplearn.scenes.friction_lcp import CREEP

SINGULAR = 1e-10  # pivots below this share of the largest entry are those of redundant contacts
SHIFT = 1e-9  # compliance, relative to a contact's own, that then makes their forces unique and moves nothing


@compiled
def _factorise(A, order, n):
    """LU in place with row pivoting; whether all pivots are well above 0."""
    largest, good = 0.0, True
    for i in range(n):
        order[i] = i
        for j in range(n):
            largest = max(largest, abs(A[i, j]))
    for j in range(n):
        best = j
        for i in range(j + 1, n):
            if abs(A[i, j]) > abs(A[best, j]):
                best = i
        good = good and abs(A[best, j]) > SINGULAR * largest
        if not abs(A[best, j]) > 0.0:
            return False
        if best != j:
            order[j], order[best] = order[best], order[j]
            for k in range(n):
                A[j, k], A[best, k] = A[best, k], A[j, k]
        for i in range(j + 1, n):
            A[i, j] /= A[j, j]
            for k in range(j + 1, n):
                A[i, k] -= A[i, j] * A[j, k]
    return good


@compiled
def _solve_transposed(A, order, n, b, x):
    """x of A' x = b, with A as `_factorise` left it; b is overwritten."""
    for i in range(n):
        for k in range(i):
            b[i] -= A[k, i] * b[k]
        b[i] /= A[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= A[k, i] * b[k]
    for i in range(n):
        x[order[i]] = b[i]


@compiled
def _slope(K, T, nv, rows, y, slip, stuck, unit, mass, mu, compliance, shift, out):
    """K = dr/dy; rows and columns contact by contact, normal first."""
    w = 1 + T
    for i in range(w * K):
        for j in range(w * K):
            s = 0.0
            for k in range(nv):
                s += rows[i, k] * rows[j, k] / mass[k]
            out[i, j] = s
    for c in range(K):
        out[w * c, w * c] += compliance[c] + shift * unit[c]
        if stuck[c]:
            for t in range(1, w):
                out[w * c + t, w * c + t] += shift * unit[c]
            continue
        size = 0.0
        for t in range(T):
            size += slip[c, t] ** 2
        size = sqrt(size)
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
        np.empty((n, n)), np.empty(n, np.int64), np.empty(n), np.empty(n), np.empty(n), np.empty((C, T)), np.empty(C),
        np.empty(C, np.bool_), np.empty(nv), np.empty(nv),
    )  # fmt: skip


@compiled
def pull_back_contacts(
    K, T, nv, rows, y, sticks, mu, compliance, free, mass, gradient, memory, to_free, to_rows, to_target, to_mu,
    to_compliance, to_mass,
):  # fmt: skip
    """From the gradient [nv] with respect to the velocity to those with respect to what a step of contacts takes.

    Args:
        rows: Jacobians [(1 + T) K, nv] of the K loaded contacts; each contact's normal, then its T tangents.
        y: Impulses along the rows; sticks, mu, compliance [K]; free, mass [nv]: as the step had them.
        gradient: With respect to the velocity after the step.
        to_free, to_rows, to_target, to_mu, to_compliance: Where gradients are written; to_mass is added to.
    """
    slope, order, wanted, s, speed_gradient, slip, unit, stuck, push, v = memory
    w = 1 + T
    for k in range(nv):
        push[k] = 0.0
        for i in range(w * K):
            push[k] += rows[i, k] * y[i]
        v[k] = free[k] + push[k] / mass[k]
    energy = 0.0
    for k in range(nv):
        energy += mass[k] * free[k] ** 2
    for c in range(K):
        unit[c], size = 0.0, 0.0
        for k in range(nv):
            unit[c] += rows[w * c, k] ** 2 / mass[k]
        for t in range(T):
            slip[c, t] = 0.0
            for k in range(nv):
                slip[c, t] += rows[w * c + 1 + t, k] * v[k]
            size += slip[c, t] ** 2
        stuck[c] = sticks[c] or sqrt(size) <= 10.0 * CREEP * sqrt(unit[c] * energy)
    for i in range(w * K):
        wanted[i] = 0.0
        for k in range(nv):
            wanted[i] += rows[i, k] * gradient[k] / mass[k]
    _slope(K, T, nv, rows, y, slip, stuck, unit, mass, mu, compliance, 0.0, slope)
    if not _factorise(slope, order, w * K):
        _slope(K, T, nv, rows, y, slip, stuck, unit, mass, mu, compliance, SHIFT, slope)
        _factorise(slope, order, w * K)
    _solve_transposed(slope, order, w * K, wanted, s)
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
        size = sqrt(size)
        for t in range(T):
            along += slip[c, t] * s[w * c + 1 + t] / size
        to_mu[c] = -unit[c] * y[w * c] * along
        turning = unit[c] * mu[c] * y[w * c] / size
        for t in range(T):
            speed_gradient[w * c + 1 + t] = -turning * (s[w * c + 1 + t] - along * slip[c, t] / size)
    for k in range(nv):
        to_free[k] = gradient[k]
        for i in range(w * K):
            to_free[k] += rows[i, k] * speed_gradient[i]
        to_mass[k] -= to_free[k] * push[k] / mass[k] ** 2
        for i in range(w * K):
            to_rows[i, k] = speed_gradient[i] * v[k] + y[i] * to_free[k] / mass[k]
