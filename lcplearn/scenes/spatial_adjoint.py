"""The gradient of rollouts in space on the CPU, compiled: `spatial_kernel.py` backwards.

States, loads and friction forces are kept; all else of a step is computed anew. The notation x_ is the gradient with
respect to x.
"""

from collections.abc import Sequence
from math import cos, sin, sqrt
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lcplearn.scenes.contact_kernel.adjoint import contact_memory, pull_back_contacts
from lcplearn.scenes.contact_kernel.compiling import compiled, fingerprint, refuse_batched
from lcplearn.scenes.spatial_kernel import SMALL, Options, Rolled, approach, roll, rotation


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
def _approach_memory(C):
    """Free velocity, rows, gaps and closing speeds of C corners."""
    return np.empty(6), np.empty((C, 6)), np.empty((C, 2, 6)), np.empty(C), np.empty(C)


@compiled
def _loaded_memory(C):
    """Of the loaded contacts: rows, impulses, stick, mu, compliance, share of an impact, their numbers."""
    return (
        np.empty((3 * C, 6)), np.empty(3 * C), np.empty(C, np.bool_), np.empty(C), np.empty(C), np.empty(C),
        np.empty(C, np.int64),
    )  # fmt: skip


@compiled
def _loaded_gradients(C):
    """With respect to rows, target, mu and compliance; and zeros, for the impulses, which are no result."""
    return np.empty((3 * C, 6)), np.empty(C), np.empty(C), np.empty(C), np.zeros(3 * C)


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
    rows_, target_, mu_, soft_, _ = gradients
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


def _make_roll_back(sources: str) -> Any:
    def _roll_back(
        dt, newton, gyroscopic, rest, impact_speed, force, corners, mass, numbers, gravity, states, modes, solved,
        loads, frictions, sticking, states_, force_, corners_, mass_, numbers_, gravity_,
    ):  # fmt: skip
        """Gradients from that of the states; that of the start replaces states_[:, 0].

        Nothing goes back through a step that is not solved, whose numbers need not be finite.
        """
        sources  # noqa: B018, for the cache
        B, T, C = len(states), force.shape[1], corners.shape[1]
        memory, loaded, gradients = contact_memory(C, 6, 2), _loaded_memory(C), _loaded_gradients(C)
        rows, y, sticks, mu, soft, _, _ = loaded
        rows_, target_, mu_, soft_, nothing = gradients
        approached = _approach_memory(C)
        free, normal, tangents, gap, closing = approached
        free_, v_, x_, R, R_ = np.empty(6), np.empty(6), np.empty(13), np.empty((3, 3)), np.empty((3, 3))
        for b in range(B):
            m = mass[b]
            for t in range(T - 1, -1, -1):
                if not solved[b, t]:
                    continue
                x, after, after_ = states[b, t], states[b, t + 1], states_[b, t + 1]
                rotation(x[3:7], R)
                approach(
                    x, R, gravity[b], force[b, t], corners[b], m, numbers[b], dt, newton, gyroscopic, free, normal,
                    tangents, gap, closing,
                )  # fmt: skip
                x_[:], R_[:, :] = 0.0, 0.0
                v_[:] = after_[7:]
                for k in range(3):
                    x_[k] = after_[k]
                    v_[k] += dt * after_[k]
                _turn_back(x, after, after[7:], dt, after_, v_, x_)
                K = _gather(loads[b, t], frictions[b, t], sticking[b, t], approached, numbers[b], impact_speed, loaded)
                free_[:] = v_
                if K:
                    pull_back_contacts(
                        K, 2, 6, rows, y, sticks, mu, soft, free, m, v_, nothing, memory, free_, rows_, target_, mu_,
                        soft_, mass_[b],
                    )  # fmt: skip
                for i in range(K):
                    _contact_back(
                        i, dt, newton, impact_speed, x, R, corners[b], numbers[b], approached, loaded, gradients,
                        corners_[b], R_, numbers_[b], x_,
                    )  # fmt: skip
                _free_back(x, free, gyroscopic, m, dt, force[b, t], free_, x_, force_[b, t], mass_[b], gravity_[b])
                _rotation_back(x, R_, x_)
                for k in range(13):
                    states_[b, t, k] += x_[k]

    return compiled(_roll_back, cached=True)


_roll_back = _make_roll_back(fingerprint("contact_gradient.py", "spatial_kernel.py", "spatial_adjoint.py"))


def roll_out(options: Options, *given: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """States [B, T + 1, 13], modes [B, T, C] and whether each step is right [B, T]; for what is given see `roll`."""
    if torch.is_grad_enabled() and any(x.requires_grad for x in given):
        found: tuple[Tensor, Tensor, Tensor] = _Rollout.apply(options, *given)
        return found
    states, modes, solved = (torch.from_numpy(x) for x in roll(given, options)[:3])
    return states, modes, solved


class _Rollout(torch.autograd.Function):
    """Rollouts of a batch as one node."""

    @staticmethod
    def forward(ctx: Any, options: Options, *given: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        rolled = tuple(torch.from_numpy(x) for x in roll(given, options, keep=True))
        ctx.options = options
        ctx.save_for_backward(*given, *rolled)
        states, modes, solved = rolled[:3]
        ctx.mark_non_differentiable(modes, solved)
        return states, modes, solved

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
        refuse_batched((gradient,))
        given, rolled = ctx.saved_tensors[:6], ctx.saved_tensors[6:]
        return (None, *pull_back(given, ctx.options, Rolled(*(x.detach().numpy() for x in rolled)), gradient))


def pull_back(given: Sequence[Tensor], options: Options, rolled: Rolled, gradient: Tensor) -> list[Tensor]:
    """Gradients with respect to what `roll` was given, from that with respect to the states."""
    states_ = gradient.detach().clone(memory_format=torch.contiguous_format)
    results = [torch.zeros_like(x, memory_format=torch.contiguous_format) for x in given[1:]]
    values = [x.detach().contiguous().numpy() for x in given[1:]]
    _roll_back(*options, *values, *rolled, states_.numpy(), *(x.numpy() for x in results))
    return [states_[:, 0], *results]
