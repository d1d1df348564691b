"""A block that falls onto the ground, without and with restitution."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.domains import POSITIVE, REAL, SHARE, Domain, check_numbers
from lcplearn.lcp.solve import solve_lcp
from lcplearn.scenes.scene import Drive, Mode, Moving, Step
from lcplearn.scenes.space import LINE, Space


@dataclass(frozen=True)
class FallingBlock(Moving):
    """A block that falls, lands without penetrating and stays.

    0 <= x_{k+1} ⟂ lambda = (m/dt^2) x_{k+1} - (m/dt^2) (x_k + dt v_k + dt^2 (u/m - g)) >= 0, one row.

    z is the next gap [m], w the contact force [N]. Landing takes two steps: the first ends at gap 0 with velocity
    -x_k/dt, the second at rest. Each step in free flight loses the energy m g^2 dt^2 / 2 (implicit Euler).

    Attributes:
        mass: Mass [kg]; > 0. Number or tensor that broadcasts over the batch.
        dt: Step size [s]; > 0.
        gravity: Gravitational acceleration [m/s^2]. Number or tensor that broadcasts over the batch.

    Gradient: With respect to the state, the force and all numbers; where the block just touches that of one side.

    Status: `Step.solved`.

    Raises:
        ValueError: A number is out of its domain; the message names it.

    Source: Pfrommer's "LCP Notes" (2019), section 1, with general mass and an external force; NOTES 5.1.
    """

    space: ClassVar[Space] = LINE
    contacts: ClassVar[int] = 1
    numbers: ClassVar[Mapping[str, Domain]] = {"mass": POSITIVE, "gravity": REAL}

    mass: float | Tensor
    dt: float
    gravity: float | Tensor = 9.81

    def __post_init__(self) -> None:
        check_numbers(self)

    def lcp(
        self, gap: Float[Tensor, "*#batch"], velocity: Float[Tensor, "*#batch"], force: Float[Tensor, "*#batch"]
    ) -> tuple[Tensor, Tensor]:
        """The LCP of one step.

        Args:
            gap: Distance from the ground before the step [m].
            velocity: Velocity before the step, upward [m/s].
            force: External force, upward [N], beside gravity.

        Returns:
            M [*#batch, 1, 1] and q [*batch, 1].
        """
        stiffness = self.mass / self.dt**2
        free_gap = gap + self.dt * self._free_velocity(velocity, force)
        return _one_row(stiffness, free_gap), -(stiffness * free_gap).unsqueeze(-1)

    def closed_form(
        self, gap: Float[Tensor, "*#batch"], velocity: Float[Tensor, "*#batch"], force: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "..."]:
        """Next gap max(x_k + dt v_k + dt^2 (u/m - g), 0) [m]."""
        return torch.relu(gap + self.dt * self._free_velocity(velocity, force))

    def advance(self, state: Float[Tensor, "*#batch 2"], drive: Drive) -> Step:
        """Next gap and velocity, and contact mode: SEPARATION, or STICK while the gap is 0."""
        gap, velocity = state.unbind(-1)
        force = drive.force[..., 0]
        solution = solve_lcp(*self.lcp(gap, velocity, force), method="diagonal")
        next_gap = solution.z[..., 0]
        # (x_{k+1} - x_k) / dt, written so that rest is exactly 0 and free flight has no cancellation
        next_velocity = torch.where(next_gap > 0, self._free_velocity(velocity, force), (next_gap - gap) / self.dt)
        mode = torch.where(next_gap > 0, int(Mode.SEPARATION), int(Mode.STICK))
        return Step(torch.stack((next_gap, next_velocity), dim=-1), mode.unsqueeze(-1), solution, solution.solved)

    def _free_velocity(self, velocity: Tensor, force: Tensor) -> Tensor:
        return velocity + self.dt * (force / self.mass - self.gravity)


@dataclass(frozen=True)
class BouncingBlock(Moving):
    """A block that falls and bounces off the ground.

    0 <= v_{k+1} + e v_k ⟂ lambda = (m/dt) (v_{k+1} - v_k) - u + m g >= 0 where x_k + dt v_k <= 0, else lambda = 0.

    z is the velocity in excess of the rebound [m/s], w the contact force [N]. This is Moreau's law on the velocity
    level: the LCP on gaps of FallingBlock can't rebound. The gap may drift below 0 by about g dt^2.

    Attributes:
        mass: Mass [kg]; > 0. Number or tensor that broadcasts over the batch, like restitution.
        restitution: Ratio e of rebound to impact speed; 0 <= e <= 1.
        dt: Step size [s]; > 0.
        gravity: Gravitational acceleration [m/s^2].

    Gradient: With respect to the state, the force and all numbers, at the contact that was found. Which step an impact
        falls into is no smooth function of anything: the velocity jumps there, and the gradient does not see it.

    Status: `Step.solved`.

    Raises:
        ValueError: A number is out of its domain; the message names it.

    Source: NOTES 5.2; Moreau 1988.
    """

    space: ClassVar[Space] = LINE
    contacts: ClassVar[int] = 1
    numbers: ClassVar[Mapping[str, Domain]] = {"mass": POSITIVE, "restitution": SHARE, "gravity": REAL}

    mass: float | Tensor
    restitution: float | Tensor
    dt: float
    gravity: float | Tensor = 9.81

    def __post_init__(self) -> None:
        check_numbers(self)

    def lcp(self, velocity: Float[Tensor, "*#batch"], force: Float[Tensor, "*#batch"]) -> tuple[Tensor, Tensor]:
        """The LCP of one step in contact: M [*#batch, 1, 1], q [*batch, 1], from velocity [m/s] and force [N]."""
        inertia = self.mass / self.dt
        excess = self._free_velocity(velocity, force) + self.restitution * velocity
        return _one_row(inertia, excess), -(inertia * excess).unsqueeze(-1)

    def advance(self, state: Float[Tensor, "*#batch 2"], drive: Drive) -> Step:
        """Next gap and velocity, and contact mode: SEPARATION, or STICK while the ground pushes."""
        gap, velocity = state.unbind(-1)
        force = drive.force[..., 0]
        solution = solve_lcp(*self.lcp(velocity, force), method="diagonal")
        in_contact = (gap + self.dt * velocity <= 0) & (solution.z[..., 0] == 0)
        free = self._free_velocity(velocity, force)
        next_velocity = torch.where(in_contact, 0.0 - self.restitution * velocity, free)
        mode = torch.where(in_contact, int(Mode.STICK), int(Mode.SEPARATION))
        state = torch.stack((gap + self.dt * next_velocity, next_velocity), dim=-1)
        return Step(state, mode.unsqueeze(-1), solution, solution.solved)

    def _free_velocity(self, velocity: Tensor, force: Tensor) -> Tensor:
        return velocity + self.dt * (force / self.mass - self.gravity)


def _one_row(value: float | Tensor, like: Tensor) -> Tensor:
    """value [*batch] as a 1 x 1 matrix, in the dtype and on the device of like."""
    return torch.as_tensor(value, dtype=like.dtype, device=like.device)[..., None, None]
