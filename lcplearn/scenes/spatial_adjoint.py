"""The gradient of rollouts in space on the CPU, compiled: `spatial_kernel.py` backwards.

States, loads and friction forces are kept; all else of a step is computed anew. The notation x_ is the gradient with
respect to x.
"""

from typing import Any

from lcplearn.lcp.kernel.memory import address as data_address
from lcplearn.scenes.contact_kernel.adjoint import UNKNOWN, pull_back_contacts
from lcplearn.scenes.contact_kernel.compiling import compiled, fingerprint, merged
from lcplearn.scenes.contact_kernel.memory import (
    adjoint_scratch,
    bare,
    bare_flags,
    block,
    grid,
    loaded_memory,
    row,
)
from lcplearn.scenes.spatial_kernel import approach, jacobian
from lcplearn.scenes.spatial_turning import rotation, rotation_back, spin_back, turn_back


@compiled
def _corner_back(c, R, rows_, gap_, radius, c_, R_, numbers_, x_):
    """Backwards through the rows [3, 6] (normal, x, y) and the gap of a corner."""
    for d in range(3):
        row = rows_[0] if d == 2 else rows_[1 + d]
        r0, r1, r2 = c[0] - radius * R[2, 0], c[1] - radius * R[2, 1], c[2] - radius * R[2, 2]
        g0 = R[d, 1] * row[5] - R[d, 2] * row[4]
        g1 = R[d, 2] * row[3] - R[d, 0] * row[5]
        g2 = R[d, 0] * row[4] - R[d, 1] * row[3]
        R_[d, 0] += row[4] * r2 - row[5] * r1
        R_[d, 1] += row[5] * r0 - row[3] * r2
        R_[d, 2] += row[3] * r1 - row[4] * r0
        c_[0], c_[1], c_[2] = c_[0] + g0, c_[1] + g1, c_[2] + g2
        numbers_[0] -= g0 * R[2, 0] + g1 * R[2, 1] + g2 * R[2, 2]
        R_[2, 0] -= radius * g0
        R_[2, 1] -= radius * g1
        R_[2, 2] -= radius * g2
    for k in range(3):
        R_[2, k] += gap_ * c[k]
        c_[k] += gap_ * R[2, k]
    numbers_[0] -= gap_
    numbers_[4] -= gap_
    x_[2] += gap_


@compiled
def _back_memory(at, C):
    """Free velocity, rows, gaps and closing speeds of C corners; gradients of a step; and what follows."""
    free, at = row(at, 6)
    normal, at = grid(at, C, 6)
    tangents, at = block(at, C, 2, 6)
    gap, at = row(at, C)
    closing, at = row(at, C)
    free_, at = row(at, 6)
    v_, at = row(at, 6)
    x_, at = row(at, 13)
    R, at = grid(at, 3, 3)
    R_, at = grid(at, 3, 3)
    return (free, normal, tangents, gap, closing), (free_, v_, x_, R_), R, at


@compiled
def _gather(load, friction, sticking, approached, numbers, impact_speed, loaded):
    """The contacts that are loaded, one after the other: their number."""
    _, normal, tangents, _, closing = approached
    rows, y, sticks, mu, soft, share, index = loaded
    K = 0
    for i in range(load.size):
        if load[i] > 0.0:
            index[K], sticks[K], soft[K] = i, sticking[i], numbers[5]
            share[K] = min(closing[i] / impact_speed, 1.0)
            mu[K] = numbers[2] + (numbers[3] - numbers[2]) * share[K]
            rows[3 * K], y[3 * K] = normal[i], load[i]
            for d in range(2):
                rows[3 * K + 1 + d], y[3 * K + 1 + d] = tangents[i, d], friction[i, d]
            K += 1
    return K


@compiled
def _contact_back(
    i, dt, newton, impact_speed, x, R, corners, numbers, approached, loaded, gradients, corners_, R_, numbers_, x_
):  # fmt: skip
    """Backwards through target and friction of the loaded contact i, to its corner and to the numbers."""
    _, normal, _, gap, closing = approached
    share, j = loaded[5][i], loaded[6][i]
    rows_, _, target_, mu_, soft_ = gradients
    bounce_, gap_, closing_ = target_[i], -target_[i] / dt, 0.0
    if newton:
        bounce = numbers[1] * closing[j]
        if bounce > 0.0 and bounce + gap[j] / dt > 0.0:
            gap_ += target_[i] / dt
        else:
            bounce_ = 0.0
    numbers_[1] += bounce_ * closing[j]
    closing_ += bounce_ * numbers[1]
    numbers_[2] += mu_[i] * (1.0 - share)
    numbers_[3] += mu_[i] * share
    if share < 1.0:
        closing_ += mu_[i] * (numbers[3] - numbers[2]) / impact_speed
    numbers_[5] += soft_[i]
    if closing[j] > 0.0:  # closing = -n x' and, by the continuous law, less gap / dt
        for k in range(6):
            rows_[3 * i, k] -= closing_ * x[7 + k]
            x_[7 + k] -= closing_ * normal[j, k]
        if not newton and gap[j] > 0.0:
            gap_ -= closing_ / dt
    _corner_back(corners[j], R, rows_[3 * i : 3 * i + 3], gap_, numbers[0], corners_[j], R_, numbers_, x_)


@compiled
def _free_back(x, free, gyroscopic, mass, dt, force, free_, x_, force_, mass_, gravity_):
    """Backwards through the velocity after a step without contacts; adds to x_[7:], mass_ and gravity_."""
    for k in range(6):
        force_[k] = dt * free_[k] / mass[k]
        mass_[k] -= dt * force[k] * free_[k] / mass[k] ** 2
    for k in range(3):
        gravity_[k] += dt * free_[k]
        x_[7 + k] += free_[k]
    if gyroscopic:
        before = (x_[10], x_[11], x_[12])
        spin_back(x[10:13], free[3:], mass[3:], dt, force[3:], free_, x_, mass_[3:])
        for k in range(3):
            x_[10 + k] += before[k]
    else:
        for k in range(3, 6):
            x_[7 + k] += free_[k]


@merged
def _step_back(
    known, at, C, dt, newton, gyroscopic, impact_speed, x, after, force, corners, mass, numbers, gravity, load,
    friction, sticks, out, after_, force_, corners_, mass_, numbers_, gravity_,
):  # fmt: skip
    """Backwards through a step from x to after: adds to out, the gradient of x, and to those of all else.

    known is as in `pull_back_contacts`, and is returned.
    """
    approached, (free_, v_, x_, R_), R, at = _back_memory(at, C)
    loaded, gradients, at = loaded_memory(at, C, 6, 2)
    free, normal, tangents, gap, closing = approached
    rows, y, stuck, mu, soft, _, _ = loaded
    rows_, nothing, target_, mu_, soft_ = gradients
    rotation(x[3:7], R)
    approach(x, R, gravity, force, corners, mass, numbers, dt, newton, gyroscopic, free, normal, gap, closing)
    x_[:], R_[:, :], v_[:] = 0.0, 0.0, after_[7:]
    for k in range(3):
        x_[k] = after_[k]
        v_[k] += dt * after_[k]
    turn_back(x, after, after[7:], dt, after_, v_, x_)
    for i in range(C):
        if load[i] > 0.0:
            for d in range(2):
                jacobian(corners, i, R, numbers[0], d, tangents[i, d])
    K = _gather(load, friction, sticks, approached, numbers, impact_speed, loaded)
    free_[:] = v_
    if K:
        nothing[:] = 0.0  # impulses are no result
        known = pull_back_contacts(
            known, K, 2, 6, rows, y, stuck, mu, soft, free, mass, v_, nothing, at, free_, rows_, target_, mu_, soft_,
            mass_,
        )  # fmt: skip
    for i in range(K):
        _contact_back(
            i, dt, newton, impact_speed, x, R, corners, numbers, approached, loaded, gradients, corners_, R_, numbers_,
            x_,
        )  # fmt: skip
    _free_back(x, free, gyroscopic, mass, dt, force, free_, x_, force_, mass_, gravity_)
    rotation_back(x, R_, x_)
    for k in range(13):
        out[k] += x_[k]
    return known


@compiled
def _again(t, x, F):
    """Whether step t + 1 is step t once more."""
    other = 0
    for k in range(13):
        other += x[t, k] != x[t + 1, k]
    for k in range(6):
        other += F[t, k] != F[t + 1, k]
    return other == 0


def _make_roll_back(sources: str) -> Any:
    def _roll_back(
        dt, newton, gyroscopic, rest, impact_speed, scratch, force, corners, mass, numbers, gravity, states, modes,
        solved, loads, frictions, sticking, states_, force_, corners_, mass_, numbers_, gravity_,
    ):  # fmt: skip
        """Gradients from that of the states; that of the start replaces states_[:, 0].

        Nothing goes back through a step that is not solved, whose numbers need not be finite.
        """
        sources  # noqa: B018, for the cache
        B, T, C = len(states), force.shape[1], corners.shape[1]
        at = data_address(scratch)
        for b in range(B):
            x, F, points, m, own = bare(states[b]), bare(force[b]), bare(corners[b]), bare(mass[b]), bare(numbers[b])
            load, friction, sticks, down = bare(loads[b]), bare(frictions[b]), bare_flags(sticking[b]), bare(gravity[b])
            x_, F_, points_, m_ = bare(states_[b]), bare(force_[b]), bare(corners_[b]), bare(mass_[b])
            own_, down_ = bare(numbers_[b]), bare(gravity_[b])
            known = UNKNOWN
            for t in range(T - 1, -1, -1):
                if known != UNKNOWN and not _again(t, x, F):
                    known = UNKNOWN
                if solved[b, t]:
                    known = _step_back(
                        known, at, C, dt, newton, gyroscopic, impact_speed, x[t], x[t + 1], F[t], points, m, own, down,
                        load[t], friction[t], sticks[t], x_[t], x_[t + 1], F_[t], points_, m_, own_, down_,
                    )  # fmt: skip

    return compiled(_roll_back, cached=True)


roll_back = _make_roll_back(fingerprint("spatial_kernel.py", "spatial_adjoint.py", "spatial_turning.py"))


def back_scratch(C: int) -> int:
    """Numbers of memory that `roll_back` needs."""
    return 20 * C + 49 + adjoint_scratch(C, 6, 2)
