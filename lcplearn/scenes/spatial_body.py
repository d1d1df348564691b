"""A convex body in space, tossed onto or sliding on level ground."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.domains import NOT_NEGATIVE, POSITIVE, REAL, SHARE, Domain, check, check_numbers
from lcplearn.scenes.contact import (
    Contacts,
    RestitutionLaw,
    check_law,
    closing_speed,
    compiled_contacts,
    contact_step,
    outside_graphs,
    rebound,
)
from lcplearn.scenes.contact_violation import Touch
from lcplearn.scenes.numbers import Number, as_tensor, common_batch, matvec, one_batch, stack_numbers
from lcplearn.scenes.scene import Drive, Moving, Step, Trajectory
from lcplearn.scenes.space import POSE, Space, rotation_matrix


@dataclass(frozen=True)
class SpatialBody(Moving):
    """A rigid body that touches the ground with spheres around its corners.

    A state is `POSE`: position and quaternion, velocity of the centre of mass, angular velocity in body coordinates.
    The drive is a force in world coordinates and a torque in body coordinates. A step is implicit Euler: velocities
    from `contact_step`, then positions at the new velocities. Flight under constant force is exact at the velocities;
    the torque-free spin keeps its energy (implicit midpoint).

    Friction may differ at impacts: mu + (mu_impact - mu) min(1, closing / impact_speed), with the closing speed of
    `closing_speed`.

    Gradient: implicit, through all steps, with respect to the state, the drive and all numbers (see `contact_step`).
    A compiled step that is not solved passes none on.

    Attributes:
        corners: Centres of the spheres in body coordinates [m], [C, 3] or [*batch, C, 3]; the origin is the centre of
            mass.
        inertia: Moment of inertia [kg m^2], the same about every axis, or a tuple of three, about the body's axes.
        mu: Friction coefficient; >= 0.
        dt: Step size [s].
        mass: [kg]. Only inertia / mass matters to the motion if no force is driven.
        radius: Of the spheres [m]; 0 is sharp corners.
        restitution: Part of the closing speed that comes back; from 0 to 1.
        mu_impact: Friction coefficient of an impact at impact_speed and above; None is mu.
        impact_speed: [m/s].
        ground: Height of the ground [m].
        gravity: Downward acceleration [m/s^2], or the vector of it [3], for a slope.
        compliance: Of a contact, times mass (see `Contacts`).
        restitution_law: See `rebound`.
        polygon: None is the exact friction cone; k is a polygon of 2 k directions.
        rest: Whether rest is written as 0 (see `contact_step`).

    Source: Stewart and Trinkle 1996; NOTES 5.7.
    """

    numbers: ClassVar[Mapping[str, Domain]] = {
        **dict.fromkeys(("mass", "inertia"), POSITIVE),
        **dict.fromkeys(("mu", "mu_impact", "radius", "compliance"), NOT_NEGATIVE),
        **dict.fromkeys(("corners", "ground", "gravity"), REAL),
        "restitution": SHARE,
    }

    corners: Tensor
    inertia: Number | tuple[Number, Number, Number]
    mu: Number
    dt: float
    mass: Number = 1.0
    radius: Number = 0.0
    restitution: Number = 0.0
    mu_impact: Number | None = None
    impact_speed: float = 1.0
    ground: Number = 0.0
    gravity: Number = 9.81
    compliance: Number = 0.0
    restitution_law: RestitutionLaw = "newton"
    polygon: int | None = None
    rest: bool = True

    def __post_init__(self) -> None:
        check_numbers(self)
        check(POSITIVE, impact_speed=self.impact_speed)
        check_law(self.restitution_law)
        if self.corners.ndim < 2 or self.corners.shape[-1] != 3:
            raise ValueError(f"corners: expected shape [*batch, C, 3], got {list(self.corners.shape)}")

    @property
    def space(self) -> Space:
        """`POSE`."""
        return POSE

    @property
    def contacts(self) -> int:
        """Number of corners."""
        return self.corners.shape[-2]

    def advance(self, state: Float[Tensor, "*#batch 13"], drive: Drive) -> Step:
        """Advance a state by one step; the mode is that of each corner."""
        found = self._fused(state, drive.force.unsqueeze(-2))
        if found is not None:
            states, mode, solved = found
            return Step(states[..., 1, :], mode[..., 0, :], None, solved[..., 0])
        position, before = POSE.split(state)
        turn = rotation_matrix(position[..., 3:])
        mass = self._mass(state)
        free = self._free_velocity(before, turn, drive.force, mass)
        contacts = self._contacts(position, before, free, turn)
        step = contact_step(contacts, free, mass, self.dt, polygon=self.polygon, rest=self.rest)
        moved = POSE.advance(position, step.velocity, self.dt)
        # Normalising a quaternion may move its last bit: what rests does not move at all.
        moved = torch.where(step.at_rest.unsqueeze(-1), moved - moved.detach() + position.detach(), moved)
        state = torch.cat((moved, step.velocity), dim=-1)
        return Step(state, step.mode, None, step.solved & step.settled)

    def fused_rollout(self, state: Tensor, drive: Drive) -> Trajectory | None:
        """The same in one compiled loop, forwards and backwards; None where that can't be: not on the CPU, ..."""
        found = self._fused(state, drive.force)
        return None if found is None else Trajectory(*POSE.split(found[0]), *found[1:])

    @outside_graphs
    def _fused(self, state: Tensor, force: Tensor) -> tuple[Tensor, Tensor, Tensor] | None:
        """States, modes and whether each step is right of a fused rollout of force [*batch, T, 6]."""
        if self.polygon is not None or compiled_contacts(state.device) is None:
            return None
        if state.dtype is not torch.float64 or force.dtype is not torch.float64:
            return None
        POSE.split(state)
        if force.shape[-1] != POSE.nv:
            raise ValueError(f"force: expected {POSE.nv} columns, force and torque, got {list(force.shape)}")
        mass, down = self._mass(state), self._gravity(state)
        numbers = (self.radius, self.restitution, self.mu, self.mu if self.mu_impact is None else self.mu_impact)
        given = stack_numbers(*numbers, self.ground, self.compliance / self.mass, like=state)
        shapes = (state.shape[:-1], force.shape[:-2], self.corners.shape[:-2], mass.shape[:-1], given.shape[:-1])
        batch = common_batch(*shapes, down.shape[:-1])

        from lcplearn.scenes.spatial_kernel import Options
        from lcplearn.scenes.spatial_node import roll_out

        found = roll_out(
            Options(
                dt=self.dt,
                newton=self.restitution_law == "newton",
                gyroscopic=isinstance(self.inertia, tuple),
                rest=self.rest,
                impact_speed=self.impact_speed,
            ),
            one_batch(state, batch, 13),
            one_batch(force, batch, *force.shape[-2:]),
            one_batch(self.corners, batch, self.contacts, 3),
            one_batch(mass, batch, 6),
            one_batch(given, batch, 6),
            one_batch(down, batch, 3),
        )
        states, mode, solved = (x.reshape((*batch, *x.shape[1:])) for x in found)
        return states, mode, solved

    def touch_at(self, position: Float[Tensor, "*#batch 7"]) -> Touch:
        """Gaps, Jacobians and friction coefficients of the corners at a pose, as at rest there."""
        still = torch.zeros_like(position[..., :6])
        contacts = self._contacts(position, still, still, rotation_matrix(position[..., 3:]))
        return Touch(contacts.gap, contacts.normal, contacts.tangents, contacts.mu.expand(contacts.gap.shape))

    def _mass(self, like: Tensor) -> Tensor:
        """Diagonal of the mass matrix [*batch, 6]."""
        inertia = self.inertia if isinstance(self.inertia, tuple) else (self.inertia,) * 3
        return stack_numbers(self.mass, self.mass, self.mass, *inertia, like=like)

    def _gravity(self, like: Tensor) -> Tensor:
        """Acceleration of gravity as a vector [*batch, 3]."""
        if isinstance(self.gravity, Tensor) and self.gravity.shape[-1:] == (3,):
            return self.gravity
        return stack_numbers(0.0, 0.0, -self.gravity, like=like)

    def _free_velocity(self, velocity: Tensor, turn: Tensor, force: Tensor, mass: Tensor) -> Tensor:
        linear = velocity[..., :3] + self.dt * (self._gravity(velocity) + force[..., :3] / mass[..., :3])
        spin = velocity[..., 3:]
        if isinstance(self.inertia, tuple):
            spin = _midpoint_spin(spin, mass[..., 3:], self.dt)
        spin = spin + self.dt * force[..., 3:] / mass[..., 3:]
        return torch.cat(torch.broadcast_tensors(linear, spin), dim=-1)

    def _contacts(self, position: Tensor, before: Tensor, free: Tensor, turn: Tensor) -> Contacts:
        corners = self.corners.to(position)
        radius, ground, mu, restitution = (
            as_tensor(x, position).unsqueeze(-1) for x in (self.radius, self.ground, self.mu, self.restitution)
        )
        centres = corners @ turn.mT
        gap = position[..., 2:3] + centres[..., 2] - radius - ground
        # A lever from the centre of mass to the lowest point of a sphere, and the three directions, in body coordinates
        lever = corners - radius.unsqueeze(-1) * turn[..., 2:3, :]
        linear = torch.eye(3, dtype=position.dtype, device=position.device).expand(*lever.shape[:-1], 3, 3)
        angular = torch.linalg.cross(*torch.broadcast_tensors(lever.unsqueeze(-2), turn.unsqueeze(-3)))
        x, y, normal = torch.cat(torch.broadcast_tensors(linear, angular), dim=-1).unbind(-2)
        closing = closing_speed(gap, matvec(normal, before), matvec(normal, free), self.dt, self.restitution_law)
        if self.mu_impact is not None:
            share = torch.clamp(closing / self.impact_speed, max=1.0)
            mu = mu + (as_tensor(self.mu_impact, position).unsqueeze(-1) - mu) * share
        compliance = as_tensor(self.compliance / self.mass, position)
        return Contacts(
            gap=gap,
            normal=normal,
            tangents=torch.stack((x, y), dim=-2),
            mu=mu,
            bounce=rebound(gap, closing, restitution, self.dt, self.restitution_law),
            compliance=compliance.unsqueeze(-1),
        )


def box_corners(half_widths: Tensor, radius: Number = 0.0) -> Tensor:
    """Centres [8, 3] of spheres of a radius [m] that fit into the corners of a box; half widths [3] in metres."""
    signs = torch.tensor(list(product((-1.0, 1.0), repeat=3)), dtype=half_widths.dtype, device=half_widths.device)
    inner = half_widths - (radius.unsqueeze(-1) if isinstance(radius, Tensor) else radius)
    return signs * inner.unsqueeze(-2)


def _midpoint_spin(spin: Tensor, inertia: Tensor, dt: float) -> Tensor:
    """Angular velocity after a torque-free step: I (w' - w) + dt m x I m = 0 with m = (w + w') / 2, by Newton.

    m . I (w' - w) = 0, so the energy stays. Four iterations reach rounding for dt |w| up to about 1.
    """
    half = dt / 2.0
    middle = spin
    for _ in range(4):
        error = inertia * (middle - spin) + half * torch.linalg.cross(middle, inertia * middle)
        slope = torch.diag_embed(inertia).expand(*error.shape, 3) + half * (
            _cross_matrix(middle) * inertia.unsqueeze(-2) - _cross_matrix(inertia * middle)
        )
        middle = middle - torch.linalg.solve(slope, error)
    return 2.0 * middle - spin


def _cross_matrix(a: Tensor) -> Tensor:
    """The matrix of b -> a x b."""
    x, y, z = a.unbind(-1)
    o = torch.zeros_like(x)
    rows = ((o, -z, y), (z, o, -x), (-y, x, o))
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
