"""The contacts of one element: rows for those that close, then for those it was wrong about; and whether it rests."""

from math import sqrt

import numpy as np

from lcplearn.lcp.kernel.jit import LARGEST
from lcplearn.scenes.contact_kernel.compiling import compiled, merged
from lcplearn.scenes.contact_kernel.cone import solve_cone
from lcplearn.scenes.contact_kernel.memory import cone_memory, element_memory
from lcplearn.scenes.contact_kernel.modes import settle_modes
from lcplearn.scenes.contact_kernel.rows import apply, cholesky, cone_rows, delassus, mass_norm, solve_lcp
from lcplearn.scenes.friction_lcp import CRUDE, DEAD_SLIP, DEAD_ZONE, FULL_RANK, ROUNDING, SETTLED


@compiled
def _solve_plane(address, K, nv, T, rows, target, mu, compliance, free, mass, at, v, load, friction, slip, sticks):
    """The LCP of K contacts with at most one friction direction; whether it was solved."""
    D, _, _, _, M, q, u, _, _, _, impulse, _, _, _, _, scratch, out, _, _ = cone_memory(at, K, nv)
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


@merged
def _rests(C, nv, T, target, normal, tangents, mu, compliance, mass, scale, v, load, sticks, gram):
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
        holds = mu[i] * load[i] > 0.0 and (sticks[i] or sqrt(slip) <= DEAD_SLIP * scale[i])
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
def _to_scale(count, target, energy, scale):
    """From roots of mobilities to `Problem.speed_scale`, in place."""
    demanded = 0.0
    for i in range(count):
        demanded = max(demanded, target[i] / max(scale[i], 1e-300))
    for i in range(count):
        scale[i] *= energy + demanded


@merged
def _closing(C, nv, target, normal, free, mass, active, unit):
    """How many contacts close in free flight, and whether all is finite; unit are the roots of mobilities."""
    finite, count = True, 0
    for i in range(C):
        speed, alone = 0.0, 0.0
        for k in range(nv):
            speed += normal[i, k] * free[k]
            alone += normal[i, k] ** 2 / mass[k]
        unit[i] = sqrt(alone)
        active[i] = speed - target[i] < 0.0
        count += active[i]
        finite = finite and abs(speed - target[i]) <= LARGEST
    return count, finite


@merged
def _wrong(C, nv, target, normal, compliance, v, load, scale, active):
    """How many contacts without rows the solution violates, and `normals_hold`; they become active."""
    hold, count = True, 0
    for i in range(C):
        opening = -target[i]
        for k in range(nv):
            opening += normal[i, k] * v[k]
        if not active[i] and opening < -ROUNDING * scale[i]:
            active[i] = True
            count += 1
        if load[i] > 0.0:
            opening = -abs(opening + compliance[i] * load[i])
        hold = hold and -CRUDE * scale[i] <= opening <= LARGEST
    return count, hold


@merged
def _solve_needed(
    address, C, nv, T, near, target, normal, tangents, mu, compliance, free, mass, at, v, load, friction, sticks
):  # fmt: skip
    """What closes has rows, then what the solution is wrong about: solved, settled, and whether it is only near.

    Near is a solution that violates the law by less than a slip that counts as none; it is taken if near is true.
    """
    (active, index, unit, scale, _), part, at = element_memory(at, C, nv)
    rows, part_target, part_mu, part_compliance, part_scale, part_load, part_friction, part_slip, part_sticks = part
    accepted = DEAD_SLIP if near else SETTLED
    added, finite = _closing(C, nv, target, normal, free, mass, active, unit)
    energy = mass_norm(mass, free, nv)
    scale[:] = unit
    _to_scale(C, target, energy, scale)
    load[:], sticks[:], v[:] = 0.0, False, free
    for i in range(C):
        for d in range(T):
            friction[i, d] = 0.0
    solved, settled, hold, wrong = True, True, True, 0.0
    while added > 0:
        K = _members(active, index)
        for i in range(K):
            j = index[i]
            part_target[i], part_mu[i], part_compliance[i], part_scale[i] = target[j], mu[j], compliance[j], unit[j]
            for k in range(nv):
                rows[i, k] = normal[j, k]
                for d in range(T):
                    rows[(d + 1) * K + i, k] = tangents[j, d, k]
        _to_scale(K, part_target, energy, part_scale)
        wrong = np.inf
        if T == 2:
            wrong = settle_modes(
                K, nv, rows, part_target, part_mu, part_compliance, free, mass, part_scale, at, v, part_load,
                part_friction, part_slip, part_sticks,
            )  # fmt: skip
        if wrong <= accepted:
            solved, settled = True, wrong <= SETTLED
        elif T == 2:
            solved, settled = solve_cone(
                address, K, nv, rows, part_target, part_mu, part_compliance, free, mass, part_scale, at, v,
                part_load, part_friction, part_slip, part_sticks,
            )  # fmt: skip
        else:
            solved = _solve_plane(
                address, K, nv, T, rows, part_target, part_mu, part_compliance, free, mass, at, v, part_load,
                part_friction, part_slip, part_sticks,
            )  # fmt: skip
            settled = solved
        for i in range(K):
            j = index[i]
            load[j], sticks[j] = part_load[i], part_sticks[i]
            for d in range(T):
                friction[j, d] = part_friction[i, d]
        added, hold = _wrong(C, nv, target, normal, compliance, v, load, scale, active)
    solved = solved and finite and hold and energy <= LARGEST
    return solved, settled, not settled and wrong <= accepted


@merged
def solve_element(
    address, C, nv, T, rest, target, normal, tangents, mu, compliance, free, mass, at, v, load, friction, sticks
):  # fmt: skip
    """Solve the contacts of one element: solved, settled, at rest."""
    (_, _, _, scale, gram), _, _ = element_memory(at, C, nv)
    near = rest
    while True:
        solved, settled, near = _solve_needed(
            address, C, nv, T, near, target, normal, tangents, mu, compliance, free, mass, at, v, load, friction,
            sticks,
        )  # fmt: skip
        at_rest = (
            rest
            and solved
            and (settled or near)
            and _rests(C, nv, T, target, normal, tangents, mu, compliance, mass, scale, v, load, sticks, gram)
        )
        if at_rest or not near:
            return solved, settled or at_rest, at_rest
        near = False
