"""A scene of one's own: a block of 1 kg on a ramp that friction keeps from sliding back.

python -m extending.scene        in examples/
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

import lcplearn
from lcplearn.domains import NOT_NEGATIVE, REAL, Domain, check_numbers
from lcplearn.scenes import LINE, Drive, Mode, Moving, Space, Step


@dataclass(frozen=True)
class RampBlock(Moving):
    """One row: 0 <= v' ⟂ v'/dt - v/dt - u - g sin(slope) + mu g cos(slope) >= 0, with u the force on 1 kg.

    Attributes:
        slope: Of the ramp [rad].
        mu: Friction coefficient.
        dt: Time step [s].
    """

    space: ClassVar[Space] = LINE  # what a state is: positions, then velocities, with names and units
    contacts: ClassVar[int] = 1  # modes that a step tells
    numbers: ClassVar[Mapping[str, Domain]] = {"slope": REAL, "mu": NOT_NEGATIVE}  # what `Identified` can learn

    slope: float | Tensor
    mu: float | Tensor
    dt: float

    def __post_init__(self) -> None:
        check_numbers(self)  # a wrong number is a ValueError that names it

    def advance(self, state: Tensor, drive: Drive) -> Step:
        """Advance states [*batch, 2] by one step: build M and q, solve, integrate."""
        position, velocity = state.unbind(-1)
        slope = torch.as_tensor(self.slope, dtype=state.dtype)
        pull = 9.81 * (slope.sin() - self.mu * slope.cos())
        M = torch.eye(1, dtype=state.dtype) / self.dt
        q = -velocity / self.dt - drive.force[..., 0] - pull
        solution = lcplearn.solve_lcp(M, q.unsqueeze(-1), method="diagonal")
        velocity = solution.z[..., 0]
        mode = torch.where(velocity == 0, int(Mode.STICK), int(Mode.SLIP)).unsqueeze(-1)
        return Step(torch.stack((position + self.dt * velocity, velocity), dim=-1), mode, solution, solution.solved)


def main() -> float:
    """Let it slide to rest; return its last speed [m/s]."""
    block = RampBlock(slope=0.3, mu=0.4, dt=0.05)
    path = block.rollout(torch.tensor([0.0, 2.0], dtype=torch.float64), torch.zeros(100, 1, dtype=torch.float64))
    print(f"slides {float(path.positions[-1]):.2f} m; the last speed is {float(path.velocities[-1])} m/s")
    return float(path.velocities[-1])


if __name__ == "__main__":
    main()
