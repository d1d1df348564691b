"""The gradient of `contact_gradient.py` for one element, backwards.

With y = (load, friction) of the contacts that are loaded, v = free + mass^-1 J' y and the law r(y, parameters) = 0,
gradients g with respect to v and h with respect to y give K' s = J mass^-1 g + h with K = dr/dy, and -s' dr/dp for
each parameter p. Where contacts are redundant K is singular, and s is the smallest solution.
"""

from math import sqrt

from lcplearn.scenes.contact_kernel.compiling import compiled, merged
from lcplearn.scenes.contact_kernel.dense import factorise, rotate_apart, smallest_solution, solve_transposed
from lcplearn.scenes.contact_kernel.memory import adjoint_memory
from lcplearn.scenes.friction_lcp import CREEPS

UNKNOWN, REGULAR, REDUNDANT = 0, 1, 2  # of the derivative of the law: nothing, its factors, or its rotations


@compiled
def _slope(K, T, nv, rows, response, y, slip, stuck, unit, mu, compliance, out):
    """K = dr/dy; rows and columns contact by contact, normal first. response are the rows over the mass."""
    w = 1 + T
    for i in range(w * K):
        for j in range(w * K):
            s = 0.0
            for k in range(nv):
                s += rows[i, k] * response[j, k]
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


@merged
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


@merged
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
    known, K, T, nv, rows, y, sticks, mu, compliance, free, mass, gradient, y_gradient, at, to_free, to_rows, to_target,
    to_mu, to_compliance, to_mass,
):  # fmt: skip
    """From the gradients of velocity and impulses to those with respect to what a step of contacts takes.

    Args:
        known: What is in the memory of a call for the same contacts, their forces and velocities: UNKNOWN if nothing.
        rows: Jacobians [(1 + T) K, nv] of the K loaded contacts; each contact's normal, then its T tangents.
        y: Impulses along the rows; sticks, mu, compliance [K]; free, mass [nv]: as the step had them.
        gradient: With respect to the velocity after the step; y_gradient: with respect to y.
        to_free, to_rows, to_target, to_mu, to_compliance: Where gradients are written; to_mass is added to.

    Returns:
        What is known after it.
    """
    slope, right, response, order, scales, wanted, s, speed_gradient, slip, unit, stuck, push, v = adjoint_memory(
        at, K, nv, T
    )
    w = 1 + T
    _modes(K, T, nv, rows, y, sticks, mu, compliance, free, mass, push, v, unit, slip, stuck)
    for i in range(w * K):
        wanted[i] = y_gradient[i]
        for k in range(nv):
            response[i, k] = rows[i, k] / mass[k]
            wanted[i] += response[i, k] * gradient[k]
    if known == UNKNOWN:
        known = REGULAR
        _slope(K, T, nv, rows, response, y, slip, stuck, unit, mu, compliance, slope)
        if not factorise(slope, scales, order, w * K):
            known = REDUNDANT
            _slope(K, T, nv, rows, response, y, slip, stuck, unit, mu, compliance, slope)
            rotate_apart(slope, right, w * K)
    if known == REGULAR:
        solve_transposed(slope, scales, order, w * K, wanted, s)
    else:
        smallest_solution(slope, right, w * K, wanted, s)
    _to_speeds(K, T, y, mu, unit, slip, stuck, s, speed_gradient, to_target, to_mu, to_compliance)
    for k in range(nv):
        to_free[k] = gradient[k]
        for i in range(w * K):
            to_free[k] += rows[i, k] * speed_gradient[i]
        to_mass[k] -= to_free[k] * push[k] / mass[k] ** 2
        for i in range(w * K):
            to_rows[i, k] = speed_gradient[i] * v[k] + y[i] * to_free[k] / mass[k]
    return known
