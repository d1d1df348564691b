"""A polygon in its vertical plane, tossed onto or sliding on level ground; and one that stands on another."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.domains import NOT_NEGATIVE, POSITIVE, REAL, SHARE, Domain, check, check_numbers
from lcplearn.scenes.contact import (
    Contacts,
    ContactStep,
    RestitutionLaw,
    check_law,
    closing_speed,
    contact_step,
    rebound,
)
from lcplearn.scenes.numbers import Number, as_tensor, matvec, stack_numbers
from lcplearn.scenes.scene import Drive, Moving, Step
from lcplearn.scenes.space import PLANE, Space


@dataclass(frozen=True)
class PlanarBody(Moving):
    """A rigid polygon over level ground; y points up.

    A state is `PLANE`: x, y, angle of the centre of mass and their velocities; the drive is a force and a torque. A
    step is implicit Euler: velocities from `contact_step`, then positions at the new velocities.

    Attributes:
        corners: In body coordinates [m], [C, 2] or [*batch, C, 2]; the origin is the centre of mass.
        inertia: Moment of inertia [kg m^2].
        mu: Friction coefficient; >= 0.
        dt: Step size [s].
        mass: [kg].
        restitution: Part of the closing speed that comes back; from 0 to 1 (see `rebound`).
        ground: Height of the ground [m].
        gravity: Downward acceleration [m/s^2], or the vector of it [2], for a slope.
        compliance: Of a contact, times mass (see `Contacts`).
        restitution_law: See `rebound`.
        rest: Whether rest is written as 0 (see `contact_step`).

    Gradient: Implicit, with respect to the state, the drive and all numbers; one-sided at a change of mode. Which step
        an impact falls into is not differentiated.

    Status: `Step.solved`: the LCP was solved and the contacts settled.

    Raises:
        ValueError: A number is out of its domain, corners have another shape, or there is no such restitution_law.

    Source: Stewart and Trinkle 1996; NOTES 5.7.
    """

    numbers: ClassVar[Mapping[str, Domain]] = {
        **dict.fromkeys(("mass", "inertia"), POSITIVE),
        **dict.fromkeys(("mu", "compliance"), NOT_NEGATIVE),
        **dict.fromkeys(("corners", "ground", "gravity"), REAL),
        "restitution": SHARE,
    }

    corners: Tensor
    inertia: Number
    mu: Number
    dt: float
    mass: Number = 1.0
    restitution: Number = 0.0
    ground: Number = 0.0
    gravity: Number = 9.81
    compliance: Number = 0.0
    restitution_law: RestitutionLaw = "newton"
    rest: bool = True

    def __post_init__(self) -> None:
        check_numbers(self)
        check_law(self.restitution_law)
        if self.corners.ndim < 2 or self.corners.shape[-1] != 2:
            raise ValueError(f"corners: expected shape [*batch, C, 2], got {list(self.corners.shape)}")

    @property
    def space(self) -> Space:
        """`PLANE`."""
        return PLANE

    @property
    def contacts(self) -> int:
        """Number of corners."""
        return self.corners.shape[-2]

    def advance(self, state: Float[Tensor, "*#batch 6"], drive: Drive) -> Step:
        """Advance a state by one step; the mode is that of each corner."""
        position, before = PLANE.split(state)
        mass = stack_numbers(self.mass, self.mass, self.inertia, like=state)
        down = as_tensor(self.gravity, state)
        if down.shape[-1:] != (2,):
            down = torch.stack((torch.zeros_like(down), -down), dim=-1)
        free = before + self.dt * (drive.force / mass + torch.nn.functional.pad(down, (0, 1)))
        lever = turned(self.corners.to(state), position[..., 2])
        normal, tangent = (
            point_jacobian(lever, lever.new_tensor([0.0, 1.0])),
            point_jacobian(lever, lever.new_tensor([1.0, 0.0])),
        )
        ground, mu, restitution, compliance = (
            as_tensor(x, state).unsqueeze(-1) for x in (self.ground, self.mu, self.restitution, self.compliance)
        )
        gap = position[..., 1:2] + lever[..., 1] - ground
        closing = closing_speed(gap, matvec(normal, before), matvec(normal, free), self.dt, self.restitution_law)
        bounce = rebound(gap, closing, restitution, self.dt, self.restitution_law)
        contacts = Contacts(gap, normal, tangent.unsqueeze(-2), mu, bounce, compliance / mass[..., :1])
        return moved(PLANE, position, contact_step(contacts, free, mass, self.dt, rest=self.rest), self.dt)


STACK = Space(
    positions=("lower_x_m", "lower_y_m", "upper_x_m", "upper_y_m", "lower_angle_rad", "upper_angle_rad"),
    velocities=(
        *("lower_x_velocity_m_s", "lower_y_velocity_m_s", "upper_x_velocity_m_s", "upper_y_velocity_m_s"),
        *("lower_angular_velocity_rad_s", "upper_angular_velocity_rad_s"),
    ),
    rotations=2,
)


@dataclass(frozen=True)
class PlanarStack(Moving):
    """Two rectangles in a vertical plane, the upper on the lower, which is on level ground.

    The contacts are the lower one's corners at the ground, then the upper one's corners at the lower one's upper face,
    which is taken as endless: the upper rectangle must not reach beyond it.

    Attributes:
        lower: Half width and half height of the rectangle on the ground [m].
        upper: The same of the one on top of it.
        masses: Of lower and upper [kg], spread evenly.
        mu: Friction coefficient at the ground and between the two; >= 0.
        dt: Step size [s].
        gravity: Downward acceleration [m/s^2], or the vector of it [2], for a slope.
        rest: Whether rest is written as 0 (see `contact_step`).
    """

    lower: tuple[float, float]
    upper: tuple[float, float]
    masses: tuple[Number, Number]
    mu: tuple[Number, Number]
    dt: float
    gravity: Number = 9.81
    rest: bool = True

    def __post_init__(self) -> None:
        check(POSITIVE, dt=self.dt, lower=min(self.lower), upper=min(self.upper))
        for mass in self.masses:
            check(POSITIVE, masses=mass)

    @property
    def space(self) -> Space:
        """`STACK`."""
        return STACK

    @property
    def contacts(self) -> int:
        """Four corners each."""
        return 8

    def advance(self, state: Float[Tensor, "*#batch 12"], drive: Drive) -> Step:
        """Advance a state by one step; the mode is that of each corner."""
        position, before = STACK.split(state)
        spread = [m * (a * a + b * b) / 3.0 for m, (a, b) in zip(self.masses, (self.lower, self.upper), strict=True)]
        first, second = self.masses
        mass = stack_numbers(first, first, second, second, *spread, like=state)
        down = as_tensor(self.gravity, state)
        if down.shape[-1:] != (2,):
            down = torch.stack((torch.zeros_like(down), -down), dim=-1)
        free = before + self.dt * (
            drive.force / mass + torch.nn.functional.pad(torch.cat((down, down), dim=-1), (0, 2))
        )
        gap, normal, tangent = self._contacts(position)
        mu = torch.cat(
            [as_tensor(x, state).unsqueeze(-1).expand(*as_tensor(x, state).shape, 4) for x in self.mu], dim=-1
        )
        nothing = torch.zeros_like(gap)
        contacts = Contacts(gap, normal, tangent.unsqueeze(-2), mu, nothing, nothing)
        return moved(STACK, position, contact_step(contacts, free, mass, self.dt, rest=self.rest), self.dt)

    def _contacts(self, position: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Gaps [*batch, 8], normal and tangent Jacobians [*batch, 8, 6]."""
        low, high, angles = position.split((2, 2, 2), dim=-1)
        axes = position.new_tensor([[1.0, 0.0], [0.0, 1.0]])
        lever = turned(rectangle(*self.lower).to(position), angles[..., 0])
        ground = [_of_one(point_jacobian(lever, axis), 0) for axis in axes]
        gap = low[..., 1:] + lever[..., 1]
        lever = turned(rectangle(*self.upper).to(position), angles[..., 1])
        along, up = turned(axes, angles[..., 0]).unbind(-2)
        arm = lever + (high - low).unsqueeze(-2)  # from the lower centre
        between = [
            _of_one(point_jacobian(lever, axis.unsqueeze(-2)), 1) - _of_one(point_jacobian(arm, axis.unsqueeze(-2)), 0)
            for axis in (along, up)
        ]
        face = matvec(arm, up) - self.lower[1]
        tangent, normal = (torch.cat(pair, dim=-2) for pair in zip(ground, between, strict=True))
        return torch.cat((gap, face), dim=-1), normal, tangent


def rectangle(half_width: float, half_height: float) -> Float[Tensor, "4 2"]:
    """Corners of a rectangle around the origin [m]."""
    signs = torch.tensor([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]], dtype=torch.float64)
    return signs * torch.tensor([half_width, half_height], dtype=torch.float64)


def turned(points: Float[Tensor, "*#batch C 2"], angle: Float[Tensor, "*#batch"]) -> Float[Tensor, "..."]:
    """Points turned by an angle [rad] about the origin."""
    cosine, sine = angle.cos()[..., None], angle.sin()[..., None]
    x, y = points.unbind(-1)
    return torch.stack((cosine * x - sine * y, sine * x + cosine * y), dim=-1)


def point_jacobian(lever: Float[Tensor, "*#batch C 2"], axis: Float[Tensor, "*#batch 2"]) -> Float[Tensor, "..."]:
    """Speed along an axis of points with a lever from the centre: rows for (x, y, angular) velocity."""
    lever, axis = torch.broadcast_tensors(lever, axis)
    return torch.cat((axis, lever[..., :1] * axis[..., 1:] - lever[..., 1:] * axis[..., :1]), dim=-1)


def moved(space: Space, position: Tensor, found: ContactStep, dt: float) -> Step:
    """The step at the velocity that the contacts gave."""
    state = torch.cat(torch.broadcast_tensors(space.advance(position, found.velocity, dt), found.velocity), dim=-1)
    return Step(state, found.mode, None, found.solved & found.settled)


def _of_one(rows: Tensor, body: int) -> Tensor:
    """Rows of one body's velocity as rows of the velocities of both."""
    result = rows.new_zeros(*rows.shape[:-1], 6)
    result[..., 2 * body : 2 * body + 2], result[..., 4 + body] = rows[..., :2], rows[..., 2]
    return result
