"""The contacts of one element: rows for those that close, then for those it was wrong about; and whether it rests."""

from math import sqrt

import numpy as np

from lcplearn.lcp.kernel.jit import LARGEST
from lcplearn.scenes.contact_kernel.compiling import compiled
from lcplearn.scenes.contact_kernel.cone import solve_cone
from lcplearn.scenes.contact_kernel.rows import apply, cholesky, cone_rows, delassus, mass_norm, solve_lcp
from lcplearn.scenes.friction_lcp import DEAD_SLIP, DEAD_ZONE, FULL_RANK, ROUNDING


@compiled
def _solve_plane(address, K, nv, T, rows, target, mu, compliance, free, mass, numbers, v, load, friction, slip, sticks):
    """The LCP of K contacts with at most one friction direction; whether it was solved."""
    D, M, q, u, impulse, scratch, out = (
        numbers[0], numbers[4], numbers[5], numbers[6], numbers[10], numbers[15], numbers[16]
    )  # fmt: skip
    count = (T + 1) * K
    delassus(rows, mass, free, count, nv, D, u)
    if T == 0:
        n = K
        square = M[: n * n].reshape(n, n)
        for i in range(K):
            for j in range(K):
                square[i, j] = D[i, j]
            square[i, i] += compliance[i]
            q[i] = u[i] - target[i]
    else:
        n = 3 * K
        cone_rows(D, u, target, mu, compliance, K, M, q)
    solved = solve_lcp(address, n, M, q, scratch, out)
    for i in range(K):
        load[i] = impulse[i] = out[i]
        sticks[i] = False
        if T == 1:
            friction[i, 0] = impulse[K + i] = out[K + i] - mu[i] * out[i]
            slip[i, 0] = out[n + K + i] - out[2 * K + i]
            sticks[i] = slip[i, 0] == 0.0
    apply(rows, mass, free, impulse, count, nv, v)
    return solved


@compiled
def _rests(C, nv, T, target, normal, tangents, compliance, mass, scale, v, load, sticks, gram):
    """As `contact_solve._at_rest`."""
    if T == 0:
        return False
    gram[:, :] = 0.0
    held, whole_load = 0, 0.0
    for i in range(C):
        whole_load += load[i]
    for i in range(C):
        speed = 0.0
        for k in range(nv):
            speed += normal[i, k] * v[k]
        limit = DEAD_ZONE * scale[i] + compliance[i] * whole_load
        if not (abs(speed) <= limit and speed - target[i] <= limit):
            continue
        slip = 0.0
        for d in range(T):
            along = 0.0
            for k in range(nv):
                along += tangents[i, d, k] * v[k]
            slip += along * along
        holds = load[i] > 0.0 and (sticks[i] or sqrt(slip) <= DEAD_SLIP * scale[i])
        kept = 1 + (T if holds else 0)
        held += kept
        for d in range(kept):
            row = normal[i] if d == 0 else tangents[i, d - 1]
            for k in range(nv):
                for j in range(k + 1):
                    gram[k, j] += row[k] * row[j] / sqrt(mass[k] * mass[j])
    if held < nv:
        return False
    largest = 0.0
    for k in range(nv):
        largest = max(largest, gram[k, k])
    for k in range(nv):
        gram[k, k] -= FULL_RANK * largest
    return cholesky(gram, nv)


@compiled
def _members(active, index):
    """Number of active contacts; their numbers go to index. Inlined, numba would compile for the count 0 apart."""
    count = 0
    for i in range(active.size):
        if active[i]:
            index[count] = i
            count += 1
    return count


@compiled
def _closing(C, nv, target, normal, free, mass, scale, active):
    """How many contacts close in free flight, and whether all is finite; scale is `Problem.speed_scale`."""
    finite, count, demanded = True, 0, 0.0
    for i in range(C):
        speed, alone = 0.0, 0.0
        for k in range(nv):
            speed += normal[i, k] * free[k]
            alone += normal[i, k] ** 2 / mass[k]
        scale[i] = sqrt(alone)
        demanded = max(demanded, target[i] / max(scale[i], 1e-300))
        active[i] = speed - target[i] < 0.0
        count += active[i]
        finite = finite and abs(speed - target[i]) <= LARGEST
    size = mass_norm(mass, free, nv) + demanded
    for i in range(C):
        scale[i] *= size
    return count, finite


@compiled
def _wrong(C, nv, target, normal, v, scale, active):
    """How many contacts without rows the solution violates, and whether all is finite; they become active."""
    finite, count = True, 0
    for i in range(C):
        speed = 0.0
        for k in range(nv):
            speed += normal[i, k] * v[k]
        finite = finite and abs(speed) <= LARGEST
        if not active[i] and speed - target[i] < -ROUNDING * scale[i]:
            active[i] = True
            count += 1
    return count, finite


@compiled
def solve_element(
    address, C, nv, T, rest, target, normal, tangents, mu, compliance, free, mass, numbers, part, rows, index, active,
    gram, scale, v, load, friction, sticks,
):  # fmt: skip
    """Solve the contacts of one element: solved, settled, at rest. What is not needed is left out, then checked."""
    part_target, part_mu, part_compliance, part_scale, part_load, part_friction, part_slip, part_sticks = part
    added, finite = _closing(C, nv, target, normal, free, mass, scale, active)
    load[:], sticks[:], v[:] = 0.0, False, free
    for i in range(C):
        for d in range(T):
            friction[i, d] = 0.0
    solved, settled = finite, True
    while added > 0:
        K = _members(active, index)
        for i in range(K):
            j = index[i]
            part_target[i], part_mu[i], part_compliance[i], part_scale[i] = target[j], mu[j], compliance[j], scale[j]
            for k in range(nv):
                rows[i, k] = normal[j, k]
                for d in range(T):
                    rows[(d + 1) * K + i, k] = tangents[j, d, k]
        if T == 2:
            solved, settled = solve_cone(
                address, K, nv, rows, part_target, part_mu, part_compliance, free, mass, part_scale, numbers, v,
                part_load, part_friction, part_slip, part_sticks,
            )  # fmt: skip
        else:
            solved = _solve_plane(
                address, K, nv, T, rows, part_target, part_mu, part_compliance, free, mass, numbers, v, part_load,
                part_friction, part_slip, part_sticks,
            )  # fmt: skip
            settled = solved
        for i in range(K):
            j = index[i]
            load[j], sticks[j] = part_load[i], part_sticks[i]
            for d in range(T):
                friction[j, d] = part_friction[i, d]
        added, still_finite = _wrong(C, nv, target, normal, v, scale, active)
        finite = finite and still_finite
    solved = solved and finite
    at_rest = (
        rest
        and solved
        and settled
        and _rests(C, nv, T, target, normal, tangents, compliance, mass, scale, v, load, sticks, gram)
    )
    return solved, settled, at_rest


@compiled
def parts(C):
    """Memory for the contacts that an element needs."""
    return (
        np.empty(C), np.empty(C), np.empty(C), np.empty(C), np.empty(C), np.empty((C, 2)), np.empty((C, 2)),
        np.empty(C, np.bool_),
    )  # fmt: skip
