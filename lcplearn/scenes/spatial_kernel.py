"""Steps and rollouts of bodies in space on the CPU, compiled: `spatial_body.py` without gradients."""

from collections.abc import Sequence
from math import cos, sin, sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from lcplearn.lcp.kernel.calling import call
from lcplearn.lcp.kernel.jit import LARGEST
from lcplearn.lcp.kernel.memory import address as data_address
from lcplearn.lcp.pivoting import solver_address
from lcplearn.scenes.contact_kernel.compiling import compiled, fingerprint
from lcplearn.scenes.contact_kernel.memory import bare, contact_scratch, grid, row, step_memory
from lcplearn.scenes.contact_kernel.steps import SEPARATION, contacts_address

SMALL = 1e-8  # squared half angle below which series are exact; as in space.py


@compiled
def rotation(q, R):
    """The matrix of a unit quaternion."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)


@compiled
def _turn(q, w, dt):
    """q exp(dt w), of norm 1."""
    a, b, c = dt * w[0], dt * w[1], dt * w[2]
    square = (a * a + b * b + c * c) / 4.0
    half = sqrt(square)
    if square < SMALL:
        cosine, sinc = 1.0 - square / 2.0, 1.0 - square / 6.0
    else:
        cosine, sinc = cos(half), sin(half) / half
    a, b, c = sinc * a / 2.0, sinc * b / 2.0, sinc * c / 2.0
    w0, x0, y0, z0 = q[0], q[1], q[2], q[3]
    q[0] = w0 * cosine - (x0 * a + y0 * b + z0 * c)
    q[1] = w0 * a + cosine * x0 + (y0 * c - z0 * b)
    q[2] = w0 * b + cosine * y0 + (z0 * a - x0 * c)
    q[3] = w0 * c + cosine * z0 + (x0 * b - y0 * a)
    norm = sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    for i in range(4):
        q[i] /= norm


@compiled
def _midpoint_spin(w, inertia, dt):
    """As in spatial_body.py, in place; the 3 x 3 systems by Cramer's rule."""
    i0, i1, i2 = inertia[0], inertia[1], inertia[2]
    h = dt / 2.0
    x, y, z = w[0], w[1], w[2]
    for _ in range(4):
        e0 = i0 * (x - w[0]) + h * (i2 - i1) * y * z
        e1 = i1 * (y - w[1]) + h * (i0 - i2) * z * x
        e2 = i2 * (z - w[2]) + h * (i1 - i0) * x * y
        a, b, c = i0, h * (i2 - i1) * z, h * (i2 - i1) * y
        d, e, f = h * (i0 - i2) * z, i1, h * (i0 - i2) * x
        g, k, m = h * (i1 - i0) * y, h * (i1 - i0) * x, i2
        determinant = a * (e * m - f * k) - b * (d * m - f * g) + c * (d * k - e * g)
        x -= (e0 * (e * m - f * k) - b * (e1 * m - f * e2) + c * (e1 * k - e * e2)) / determinant
        y -= (a * (e1 * m - f * e2) - e0 * (d * m - f * g) + c * (d * e2 - e1 * g)) / determinant
        z -= (a * (e * e2 - e1 * k) - b * (d * e2 - e1 * g) + e0 * (d * k - e * g)) / determinant
    w[0], w[1], w[2] = 2.0 * x - w[0], 2.0 * y - w[1], 2.0 * z - w[2]


@compiled
def approach(x, R, gravity, force, corners, mass, numbers, dt, newton, gyroscopic, free, normal, gap, closing):
    """Free velocity, normals, gaps and closing speeds of all corners at a state x."""
    radius, ground = numbers[0], numbers[4]
    for i in range(3):
        free[i] = x[7 + i] + dt * (gravity[i] + force[i] / mass[i])
        free[3 + i] = x[10 + i]
    if gyroscopic:
        _midpoint_spin(free[3:], mass[3:], dt)
    for i in range(3):
        free[3 + i] += dt * force[3 + i] / mass[3 + i]
    for i in range(len(corners)):
        height = R[2, 0] * corners[i, 0] + R[2, 1] * corners[i, 1] + R[2, 2] * corners[i, 2]
        gap[i] = x[2] + height - radius - ground
        jacobian(corners, i, R, radius, 2, normal[i])
        before = after_free = 0.0
        for k in range(6):
            before += normal[i, k] * x[7 + k]
            after_free += normal[i, k] * free[k]
        if newton:
            closing[i] = max(-before, 0.0) if gap[i] + dt * after_free < 0.0 else 0.0
        else:
            closing[i] = max(-before - max(gap[i], 0.0) / dt, 0.0)


@compiled
def jacobian(corners, i, R, radius, d, row):
    """Of the lowest point of the sphere at corner i, along the world's axis d."""
    r0 = corners[i, 0] - radius * R[2, 0]
    r1 = corners[i, 1] - radius * R[2, 1]
    r2 = corners[i, 2] - radius * R[2, 2]
    row[0], row[1], row[2] = 1.0 * (d == 0), 1.0 * (d == 1), 1.0 * (d == 2)
    row[3] = r1 * R[d, 2] - r2 * R[d, 1]
    row[4] = r2 * R[d, 0] - r0 * R[d, 2]
    row[5] = r0 * R[d, 1] - r1 * R[d, 0]


@compiled
def _aims(numbers, dt, newton, impact_speed, free, normal, gap, closing, target, mu, compliance):
    """Target speed, friction and compliance of all corners; whether none of them closes in free flight."""
    flies = True
    for i in range(gap.size):
        bounce, opening = numbers[1] * closing[i], 0.0
        if newton and bounce > 0.0:
            bounce = max(bounce + gap[i] / dt, 0.0)
        target[i] = bounce - gap[i] / dt
        mu[i] = numbers[2] + (numbers[3] - numbers[2]) * min(closing[i] / impact_speed, 1.0)
        compliance[i] = numbers[5]
        for k in range(6):
            opening += normal[i, k] * free[k]
        opening -= target[i]
        flies = flies and 0.0 <= opening <= LARGEST
    return flies


@compiled
def _stays(t, states, force):
    """Whether the step before last left the body at rest, and nothing has pushed it since."""
    if t < 2:
        return False
    moves = 0
    for k in range(6):
        moves += states[t - 1, 7 + k] != 0.0
        moves += force[t, k] != force[t - 1, k]
    return moves == 0


@compiled
def _move(x, v, at_rest, dt, after):
    """The state after a step at a velocity; what rests keeps the last bit of its quaternion."""
    for i in range(3):
        after[i] = x[i] + dt * v[i]
    for i in range(4):
        after[3 + i] = x[3 + i]
    for k in range(6):
        after[7 + k] = v[k]
    if not at_rest:
        _turn(after[3:7], v[3:], dt)


def _make_roll(sources: str) -> Any:
    def _roll(
        contacts, address, scratch, memory, dt, newton, gyroscopic, rest, impact_speed, start, force, corners, mass,
        numbers, gravity, states, modes, solved, loads, frictions, sticking,
    ):  # fmt: skip
        """T steps of each element; numbers are radius, restitution, mu, mu_impact, ground, compliance."""
        sources  # noqa: B018, for the cache
        B, T, C = len(start), force.shape[1], corners.shape[1]
        given, found, at = step_memory(data_address(memory), C, 6)
        target, normal, tangents, mu, compliance, free, mass_now = given
        v, load, friction, mode, sticks, flags = found
        R, at = grid(at, 3, 3)
        gap, at = row(at, C)
        closing, at = row(at, C)
        kept = len(loads) > 0  # somebody will ask for the gradient
        for b in range(B):
            x, F, points, m, own = bare(states[b]), bare(force[b]), bare(corners[b]), bare(mass[b]), bare(numbers[b])
            down = bare(gravity[b])
            x[0], mass_now[0] = start[b], m
            at_rest = False
            for t in range(T):
                if at_rest and _stays(t, x, F):
                    x[t + 1] = x[t]  # the step before, again
                    modes[b, t], solved[b, t] = modes[b, t - 1], solved[b, t - 1]
                    if kept:
                        loads[b, t], frictions[b, t] = loads[b, t - 1], frictions[b, t - 1]
                        sticking[b, t] = sticking[b, t - 1]
                    continue
                rotation(x[t, 3:7], R)
                approach(
                    x[t], R, down, F[t], points, m, own, dt, newton, gyroscopic, free[0], normal[0], gap, closing
                )  # fmt: skip
                if _aims(
                    own, dt, newton, impact_speed, free[0], normal[0], gap, closing, target[0], mu[0], compliance[0]
                ):  # fmt: skip
                    v[0], load[0], friction[0], mode[0], sticks[0] = free[0], 0.0, 0.0, SEPARATION, False
                    flags[0, 0], flags[0, 1], flags[0, 2] = True, True, False
                else:
                    for i in range(C):
                        for d in range(2):
                            jacobian(points, i, R, own[0], d, tangents[0, i, d])
                    call(contacts, (address, rest, scratch, *given, *found))
                at_rest = flags[0, 2]
                solved[b, t] = flags[0, 0] and flags[0, 1]
                modes[b, t] = mode[0]
                if kept:
                    loads[b, t], frictions[b, t], sticking[b, t] = load[0], friction[0], sticks[0]
                _move(x[t], v[0], at_rest, dt, x[t + 1])

    return compiled(_roll, cached=True)


_roll = _make_roll(fingerprint("spatial_kernel.py"))


class Options(NamedTuple):
    """What is the same for all elements: as in `SpatialBody`; gyroscopic: with moments of inertia that differ."""

    dt: float
    newton: bool
    gyroscopic: bool
    rest: bool
    impact_speed: float


class Rolled(NamedTuple):
    """Steps of a batch, and what of each contact a gradient needs (empty unless it is asked for).

    Shapes: states [B, T + 1, 13]; modes, loads, sticks [B, T, C]; solved [B, T]; frictions [B, T, C, 2].
    """

    states: NDArray
    modes: NDArray
    solved: NDArray
    loads: NDArray
    frictions: NDArray
    sticks: NDArray


def roll(given: Sequence[Tensor], options: Options, *, keep: bool = False) -> Rolled:
    """T steps of a batch of bodies.

    Args:
        given: start [B, 13], force [B, T, 6], corners [B, C, 3], diagonal of the mass matrix [B, 6], the numbers
            radius, restitution, mu, mu_impact, ground and compliance / mass [B, 6], and gravity [B, 3].
        options: The rest.
        keep: Whether a gradient will be asked for.
    """
    start, force, corners, mass, numbers, gravity = (x.detach().contiguous().numpy() for x in given)
    B, T, C = len(start), force.shape[1], corners.shape[1]
    kept = B if keep else 0
    rolled = Rolled(
        np.empty((B, T + 1, 13)), np.empty((B, T, C), np.int64), np.empty((B, T), np.bool_), np.empty((kept, T, C)),
        np.empty((kept, T, C, 2)), np.empty((kept, T, C), np.bool_),
    )  # fmt: skip
    scratch, memory = np.empty(contact_scratch(C, 6)), np.empty(32 * C + 28)
    _roll(
        contacts_address(), solver_address(), scratch, memory, *options, start, force, corners, mass, numbers, gravity,
        *rolled,
    )  # fmt: skip
    return rolled
