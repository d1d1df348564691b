"""Steps and rollouts of bodies in space on the CPU, compiled: `spatial_body.py` without gradients."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lcplearn.lcp.kernel.calling import call
from lcplearn.lcp.kernel.jit import LARGEST
from lcplearn.lcp.kernel.memory import address as data_address
from lcplearn.lcp.pivoting import solver_address
from lcplearn.scenes.contact_kernel.compiling import compiled, fingerprint
from lcplearn.scenes.contact_kernel.memory import bare, contact_scratch, grid, row, step_memory
from lcplearn.scenes.contact_kernel.slices import by_slices
from lcplearn.scenes.contact_kernel.steps import SECONDS, SEPARATION, contacts_address
from lcplearn.scenes.spatial_turning import midpoint_spin, rotation, turn


@compiled
def approach(x, R, gravity, force, corners, mass, numbers, dt, newton, gyroscopic, free, normal, gap, closing):
    """Free velocity, normals, gaps and closing speeds of all corners at a state x."""
    radius, ground = numbers[0], numbers[4]
    for i in range(3):
        free[i] = x[7 + i] + dt * (gravity[i] + force[i] / mass[i])
        free[3 + i] = x[10 + i]
    if gyroscopic:
        midpoint_spin(free[3:], mass[3:], dt)
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
            gained = max(before - after_free, 0.0)
            closing[i] = -before if gap[i] + dt * after_free < 0.0 and -before > gained else 0.0
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
        turn(after[3:7], v[3:], dt)


def _make_roll(sources: str) -> Any:
    def _roll(
        contacts, address, dt, newton, gyroscopic, rest, impact_speed, scratch, start, force, corners, mass, numbers,
        gravity, states, modes, solved, loads, frictions, sticking,
    ):  # fmt: skip
        """T steps of each element; numbers are radius, restitution, mu, mu_impact, ground, compliance."""
        sources  # noqa: B018, for the cache
        B, T, C = len(start), force.shape[1], corners.shape[1]
        given, found, at = step_memory(data_address(scratch), C, 6)
        target, normal, tangents, mu, compliance, free, mass_now = given
        v, load, friction, mode, sticks, flags = found
        R, at = grid(at, 3, 3)
        gap, at = row(at, C)
        closing, at = row(at, C)
        rest_of, _ = row(at, scratch.size - (at - data_address(scratch)) // 8)
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
                    call(contacts, (address, rest, rest_of, *given, *found))
                at_rest = flags[0, 2]
                solved[b, t] = flags[0, 0] and flags[0, 1]
                modes[b, t] = mode[0]
                if kept:
                    loads[b, t], frictions[b, t], sticking[b, t] = load[0], friction[0], sticks[0]
                _move(x[t], v[0], at_rest, dt, x[t + 1])

    return compiled(_roll, cached=True)


_roll = _make_roll(fingerprint("spatial_kernel.py", "spatial_turning.py"))


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


def roll(given: Sequence[NDArray], options: Options, *, keep: bool = False) -> Rolled:
    """T steps of a batch of bodies.

    Args:
        given: start [B, 13], force [B, T, 6], corners [B, C, 3], diagonal of the mass matrix [B, 6], the numbers
            radius, restitution, mu, mu_impact, ground and compliance / mass [B, 6], and gravity [B, 3].
        options: The rest.
        keep: Whether a gradient will be asked for.
    """
    B, T, C = len(given[0]), given[1].shape[1], given[2].shape[1]
    kept = B if keep else 0
    rolled = Rolled(
        np.empty((B, T + 1, 13)), np.empty((B, T, C), np.int64), np.empty((B, T), np.bool_), np.empty((kept, T, C)),
        np.empty((kept, T, C, 2)), np.empty((kept, T, C), np.bool_),
    )  # fmt: skip
    run = partial(_roll, contacts_address(), solver_address(), *options)
    by_slices(run, (*given, *rolled), B, T * SECONDS * C, 32 * C + 28 + contact_scratch(C, 6))
    return rolled
