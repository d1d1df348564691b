"""A cube tossed onto level ground, in the numbers that tosses can teach."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lcplearn.domains import NOT_NEGATIVE, POSITIVE, REAL, SHARE, Domain, check
from lcplearn.scenes.contact import RestitutionLaw, check_law
from lcplearn.scenes.contact_violation import contact_violation
from lcplearn.scenes.numbers import Number
from lcplearn.scenes.scene import Drive, Mode, Moving, Step, Trajectory
from lcplearn.scenes.space import POSE, Space, rotation_matrix
from lcplearn.scenes.spatial_body import SpatialBody, box_corners

IMPACT_SPEED = 10.0  # [half widths/s] closing speed from which on an impact has the friction mu_impact
TENTH = 0.00524  # [m] a tenth of the published cube's half width: lengths that may be negative are learned in this unit


@dataclass(frozen=True)
class TossedCube(Moving):
    """`SpatialBody` with the corners of a cube, rounded, or with corners of its own.

    A recorded velocity is a difference of two positions: the mean over dt. With n substeps of h = dt / n the velocity
    of the last substep of a fall is v + g (dt - h) / 2, and a step from there moves by dt (v + g dt), as one step does.
    So in flight the velocity of a state is that mean, whatever the substeps; where a corner touches, it is that of the
    last substep, and a cube at rest has velocity 0. A corner touches below the height of g dt^2, which a body that was
    at rest falls in a step. As this depends on the pose alone, a rollout goes on as it would without it (NOTES 5.7).

    Attributes:
        half_width: Half of the cube's width [m].
        inertia: Moment of inertia about every axis [kg m^2].
        mu, mu_impact, restitution, mass, gravity, compliance, restitution_law: As in `SpatialBody`.
        radius: Of the spheres at the corners [m]. They are moved in by as much, so that the faces stay where they are.
        ground: Height of the ground [m].
        corners: Centres of the spheres in body coordinates [m], in place of the cube's; [8, 3] or [*batch, 8, 3].
        polygon: As in `SpatialBody`.
        substeps: Steps of the contacts within one of dt; the force is that of all of them.
    """

    half_width: float
    inertia: Number
    mu: Number
    dt: float
    mass: float = 1.0
    mu_impact: Number | None = None
    restitution: Number = 0.0
    radius: Number = 0.0
    ground: Number = 0.0
    gravity: float = 9.81
    compliance: Number = 1e-3
    restitution_law: RestitutionLaw = "continuous"
    corners: Tensor | None = None
    polygon: int | None = None
    substeps: int = 1

    numbers: ClassVar[Mapping[str, Domain]] = {
        "mu": POSITIVE,
        "mu_impact": POSITIVE,
        "restitution": SHARE,
        "inertia": POSITIVE,
        "radius": POSITIVE,
        "compliance": POSITIVE,
        "ground": REAL._replace(unit=TENTH),
        "corners": REAL._replace(unit=2.0 * TENTH),
    }

    def __post_init__(self) -> None:
        check(POSITIVE, half_width=self.half_width)
        check(NOT_NEGATIVE, radius=self.radius)
        check_law(self.restitution_law)
        if self.substeps < 1:
            raise ValueError(f"substeps: expected at least 1, got {self.substeps}")

    @property
    def space(self) -> Space:
        """`POSE`."""
        return POSE

    @property
    def contacts(self) -> int:
        """Eight."""
        return 8

    @property
    def length(self) -> float:
        """What weighs rotations against translations [m]."""
        return self.half_width

    @property
    def body(self) -> SpatialBody:
        """The body that moves."""
        corners = self.corners
        if corners is None:
            radius = self.radius
            like = radius if isinstance(radius, Tensor) else torch.zeros((), dtype=torch.float64)
            corners = box_corners(torch.full((3,), self.half_width, dtype=like.dtype, device=like.device), radius)
        return SpatialBody(
            corners=corners,
            inertia=self.inertia,
            mu=self.mu,
            dt=self.dt / self.substeps,
            mass=self.mass,
            radius=self.radius,
            restitution=self.restitution,
            mu_impact=self.mu_impact,
            impact_speed=IMPACT_SPEED * self.half_width,
            ground=self.ground,
            gravity=self.gravity,
            compliance=self.compliance,
            restitution_law=self.restitution_law,
            polygon=self.polygon,
        )

    def advance(self, state: Float[Tensor, "*#batch 13"], drive: Drive) -> Step:
        """Advance a state by one step; the mode of a corner is that of the last of the substeps in which it touches."""
        body = self.body
        steps = [self.substep(self._fallen(body, state, 1.0), drive)]
        while len(steps) < self.substeps:
            steps.append(self.substep(steps[-1].state, drive))
        solved = torch.stack([step.solved for step in steps if step.solved is not None]).all(0)
        mode = _touching(torch.stack([step.mode for step in steps], dim=-2))
        return steps[-1]._replace(state=self._fallen(body, steps[-1].state, -1.0), mode=mode, solved=solved)

    def substep(self, state: Float[Tensor, "*#batch 13"], drive: Drive) -> Step:
        """Advance a state by one of the substeps."""
        return self.body.advance(state, drive)

    def fused_rollout(self, state: Tensor, drive: Drive) -> Trajectory | None:
        """As `SpatialBody.fused_rollout`."""
        n, body = self.substeps, self.body
        drive = drive.map(lambda x: x.repeat_interleave(n, dim=-2))
        path = body.fused_rollout(self._fallen(body, state, 1.0), drive)
        if path is None or path.solved is None or n == 1:
            return path
        rows = self._fallen(body, path.states[..., ::n, :].movedim(-2, 0), -1.0).movedim(0, -2)
        mode, solved = _touching(path.mode.unflatten(-2, (-1, n))), path.solved.unflatten(-1, (-1, n)).all(-1)
        return Trajectory(*POSE.split(rows), mode, solved)

    def _fallen(
        self, body: SpatialBody, state: Float[Tensor, "*#batch 13"], steps: float
    ) -> Float[Tensor, "*#batch 13"]:
        """The state with that much of g (dt - h) / 2 added to its velocity, if no corner touches."""
        if self.substeps == 1:
            return state
        position, _ = POSE.split(state)
        corners = body.corners.to(state) @ rotation_matrix(position[..., 3:])[..., 2, :, None]
        gap = position[..., 2] + corners[..., 0].amin(-1) - self.radius - self.ground
        more = torch.zeros_like(state)
        more[..., 9] = -steps * self.gravity * (self.dt - body.dt) / 2.0
        return state + torch.where(gap.unsqueeze(-1) > self.gravity * self.dt**2, more, 0.0)

    def violation(
        self, before: Float[Tensor, "*batch 13"], drive: Drive, after: Float[Tensor, "*batch 13"]
    ) -> Float[Tensor, "*batch"]:
        """How badly the best contact impulses explain a recorded step [m^2/s^2]; see `contact_violation`.

        Restitution and friction at impacts have no part in it.
        """
        position, velocity = POSE.split(after)
        contacts = self.body.touch_at(position)
        linear = before.new_tensor([0.0, 0.0, -self.gravity]) + drive.force[..., :3] / self.mass
        acceleration = torch.cat((linear, torch.zeros_like(linear)), dim=-1)  # a torque is not driven
        one = torch.ones_like(velocity[..., :1])
        inertia = torch.as_tensor(self.inertia, dtype=velocity.dtype) / self.mass
        return contact_violation(
            contacts,
            velocity,
            velocity - before[..., 7:] - self.dt * acceleration,
            torch.cat(
                (one.expand(*one.shape[:-1], 3), (inertia.unsqueeze(-1) * one).expand(*one.shape[:-1], 3)), dim=-1
            ),
            velocity.new_tensor([1.0] * 3 + [self.half_width**2] * 3),
            self.dt,
        )


def _touching(modes: Int[Tensor, "*batch n C"]) -> Int[Tensor, "*batch C"]:
    """Mode in the last of n substeps in which a corner touches: an impact in an early one is not lost."""
    first, *later = modes.unbind(-2)
    for mode in later:
        first = torch.where(mode == Mode.SEPARATION, first, mode)
    return first
