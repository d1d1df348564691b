"""The gradient of rollouts in space on the CPU, compiled: `spatial_kernel.py` backwards.

States, loads and friction forces are kept; all else of a step is computed anew. The notation x_ is the gradient with
respect to x.
"""

from math import cos, sin, sqrt
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
from lcplearn.scenes.spatial_kernel import SMALL, approach, jacobian, rotation


@compiled
def _turn_back(x, after, v, dt, after_, v_, x_):
    """Backwards through q' = q exp(dt w) / |q|: adds to v_ [6] and writes x_[3:7]."""
    a, b, c = dt * v[3], dt * v[4], dt * v[5]
    square = (a * a + b * b + c * c) / 4.0
    if square < SMALL:
        cosine, sinc, slope = 1.0 - square / 2.0, 1.0 - square / 6.0, -1.0 / 6.0 + square / 60.0
    else:
        half = sqrt(square)
        cosine, sinc = cos(half), sin(half) / half
        slope = (cosine - sinc) / (2.0 * square)
    a, b, c = sinc * a / 2.0, sinc * b / 2.0, sinc * c / 2.0
    w0, x0, y0, z0 = x[3], x[4], x[5], x[6]
    norm, along = sqrt(w0 * w0 + x0 * x0 + y0 * y0 + z0 * z0), 0.0
    for i in range(4):
        along += after[3 + i] * after_[3 + i]
    u0, u1, u2, u3 = (
        (after_[3] - after[3] * along) / norm, (after_[4] - after[4] * along) / norm,
        (after_[5] - after[5] * along) / norm, (after_[6] - after[6] * along) / norm,
    )  # fmt: skip
    x_[3] = u0 * cosine + u1 * a + u2 * b + u3 * c
    x_[4] = -u0 * a + u1 * cosine - u2 * c + u3 * b
    x_[5] = -u0 * b + u1 * c + u2 * cosine - u3 * a
    x_[6] = -u0 * c - u1 * b + u2 * a + u3 * cosine
    e0 = w0 * u0 + x0 * u1 + y0 * u2 + z0 * u3
    e1 = -x0 * u0 + w0 * u1 + z0 * u2 - y0 * u3
    e2 = -y0 * u0 - z0 * u1 + w0 * u2 + x0 * u3
    e3 = -z0 * u0 + y0 * u1 - x0 * u2 + w0 * u3
    turning = dt * (v[3] * e1 + v[4] * e2 + v[5] * e3)
    radial = (-sinc * e0 + slope * turning) / 4.0
    v_[3] += dt * (sinc * e1 / 2.0 + radial * dt * v[3])
    v_[4] += dt * (sinc * e2 / 2.0 + radial * dt * v[4])
    v_[5] += dt * (sinc * e3 / 2.0 + radial * dt * v[5])


@compiled
def _rotation_back(x, R_, x_):
    """Backwards through the rotation matrix; adds to x_[3:7]."""
    w, x0, y, z = x[3], x[4], x[5], x[6]
    x_[3] += 2.0 * (
        z * (R_[1, 0] - R_[0, 1]) + y * (R_[0, 2] - R_[2, 0]) + x0 * (R_[2, 1] - R_[1, 2])
    )  # fmt: skip
    x_[4] += 2.0 * (
        y * (R_[0, 1] + R_[1, 0]) + z * (R_[0, 2] + R_[2, 0]) + w * (R_[2, 1] - R_[1, 2])
        - 2.0 * x0 * (R_[1, 1] + R_[2, 2])
    )  # fmt: skip
    x_[5] += 2.0 * (
        x0 * (R_[0, 1] + R_[1, 0]) + z * (R_[1, 2] + R_[2, 1]) + w * (R_[0, 2] - R_[2, 0])
        - 2.0 * y * (R_[0, 0] + R_[2, 2])
    )  # fmt: skip
    x_[6] += 2.0 * (
        x0 * (R_[0, 2] + R_[2, 0]) + y * (R_[1, 2] + R_[2, 1]) + w * (R_[1, 0] - R_[0, 1])
        - 2.0 * z * (R_[0, 0] + R_[1, 1])
    )  # fmt: skip


@compiled
def _spin_back(spin, free_spin, inertia, dt, torque, free_, x_, inertia_):
    """Backwards through the implicit midpoint step: writes x_[10:13], adds to inertia_."""
    h = dt / 2.0
    m0, m1, m2 = (
        (spin[0] + free_spin[0] - dt * torque[0] / inertia[0]) / 2.0,
        (spin[1] + free_spin[1] - dt * torque[1] / inertia[1]) / 2.0,
        (spin[2] + free_spin[2] - dt * torque[2] / inertia[2]) / 2.0,
    )
    i0, i1, i2 = inertia[0], inertia[1], inertia[2]
    # the transposed matrix of the residual's derivative
    a, d, g = i0, h * (i2 - i1) * m2, h * (i2 - i1) * m1
    b, e, k = h * (i0 - i2) * m2, i1, h * (i0 - i2) * m0
    c, f, m = h * (i1 - i0) * m1, h * (i1 - i0) * m0, i2
    e0, e1, e2 = 2.0 * free_[3], 2.0 * free_[4], 2.0 * free_[5]
    determinant = a * (e * m - f * k) - b * (d * m - f * g) + c * (d * k - e * g)
    s0 = (e0 * (e * m - f * k) - b * (e1 * m - f * e2) + c * (e1 * k - e * e2)) / determinant
    s1 = (a * (e1 * m - f * e2) - e0 * (d * m - f * g) + c * (d * e2 - e1 * g)) / determinant
    s2 = (a * (e * e2 - e1 * k) - b * (d * e2 - e1 * g) + e0 * (d * k - e * g)) / determinant
    x_[10], x_[11], x_[12] = i0 * s0 - free_[3], i1 * s1 - free_[4], i2 * s2 - free_[5]
    inertia_[0] -= s0 * (m0 - spin[0]) + h * m0 * (s1 * m2 - s2 * m1)
    inertia_[1] -= s1 * (m1 - spin[1]) + h * m1 * (s2 * m0 - s0 * m2)
    inertia_[2] -= s2 * (m2 - spin[2]) + h * m2 * (s0 * m1 - s1 * m0)


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
        _spin_back(x[10:13], free[3:], mass[3:], dt, force[3:], free_, x_, mass_[3:])
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
    _turn_back(x, after, after[7:], dt, after_, v_, x_)
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
    _rotation_back(x, R_, x_)
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
        scratch, dt, newton, gyroscopic, rest, impact_speed, force, corners, mass, numbers, gravity, states, modes,
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


roll_back = _make_roll_back(fingerprint("contact_gradient.py", "spatial_kernel.py", "spatial_adjoint.py"))


def back_scratch(C: int) -> int:
    """Numbers of memory that `roll_back` needs."""
    return 20 * C + 49 + adjoint_scratch(C, 6, 2)
