"""A block between a spring and dry friction: a scene whose state matters, in one file."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.domains import NOT_NEGATIVE, POSITIVE, Domain, check_numbers
from lcplearn.lcp.solve import solve_lcp
from lcplearn.scenes.scene import Drive, Moving, Step
from lcplearn.scenes.sliding_block import move
from lcplearn.scenes.space import LINE, Space


@dataclass(frozen=True)
class SpringBlock(Moving):
    """A block on a table, tied to a wall by a spring that is at ease at position 0.

    0 <= (v+, v-)  ⟂  (m/dt + k dt) (v+, v-) + (mu m g - s, mu m g + s) >= 0,   s = m v/dt + u - k x,   v' = v+ - v-

    The spring pulls where the block is after the step, so that a stiff one is stable. The block sticks exactly where
    the spring is weaker than friction.

    Attributes:
        mass: Mass [kg]; > 0. Number or tensor that broadcasts over the batch, like the next three.
        mu: Friction coefficient; >= 0.
        stiffness: Of the spring [N/m]; >= 0.
        dt: Step size [s]; > 0.
        gravity: Gravitational acceleration [m/s^2]; >= 0.

    Gradient: With respect to the state, the force and all numbers; at the change of stick and slip that of one side.

    Status: `Step.solved`.

    Raises:
        ValueError: A number is out of its domain; the message names it.

    Source: Stewart and Trinkle 1996 (implicit in velocity and force); NOTES 5.4 is its case without a spring.
    """

    space: ClassVar[Space] = LINE
    contacts: ClassVar[int] = 1
    numbers: ClassVar[Mapping[str, Domain]] = {
        "mass": POSITIVE,
        **dict.fromkeys(("mu", "stiffness", "gravity"), NOT_NEGATIVE),
    }

    mass: float | Tensor
    mu: float | Tensor
    stiffness: float | Tensor
    dt: float
    gravity: float | Tensor = 9.81

    def __post_init__(self) -> None:
        check_numbers(self)

    def advance(self, state: Float[Tensor, "*#batch 2"], drive: Drive) -> Step:
        """Next position and velocity, and contact mode: STICK or SLIP."""
        position, velocity = state.unbind(-1)
        push = self.mass / self.dt * velocity + drive.force[..., 0] - self.stiffness * position
        inertia = torch.as_tensor(self.mass / self.dt + self.stiffness * self.dt, dtype=push.dtype, device=push.device)
        limit = self.mu * self.mass * self.gravity
        M = inertia[..., None, None] * torch.eye(2, dtype=push.dtype, device=push.device)
        solution = solve_lcp(M, torch.stack((limit - push, limit + push), dim=-1), method="diagonal")
        velocity = solution.z[..., 0] - solution.z[..., 1]
        return move(position, velocity, solution, self.dt)
