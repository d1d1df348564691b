"""The adapter of models that know one scalar velocity: it unpacks states, and advances the position."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.datasets.recordings import Windows
from lcplearn.domains import positive
from lcplearn.formulations.formulation import Formulation
from lcplearn.lcp.solution import LCPSolution
from lcplearn.scenes.scene import STICK_SPEED, Drive, Mode, Step
from lcplearn.scenes.space import LINE

Numbers = Float[Tensor, "*batch"]
Pairs = Float[Tensor, "*batch 2"]
Prediction = tuple[Tensor, LCPSolution | None]


class LineFormulation(Formulation):
    """Predict the velocity of a block on a line after one time step.

    Subclasses implement `predict`. The position is advanced with the new velocity (implicit Euler):
    x_{k+1} = x_k + dt v_{k+1}; no prediction depends on it.

    Args:
        dt: Time step [s].
        gravity: Acceleration of gravity [m/s^2].
    """

    def __init__(self, *, dt: float, gravity: float = 9.81) -> None:
        super().__init__(space=LINE, dt=dt, given={"gravity": positive("gravity", gravity)})
        self.gravity = float(gravity)

    def predict(self, velocity: Numbers, force: Numbers, friction: Pairs | None = None) -> Prediction:
        """Predict the velocity one step later.

        Args:
            velocity: Velocity now [m/s].
            force: Force applied during the step [N].
            friction: Measured friction during the step [N], for models with `needs_friction` only.

        Returns:
            Velocity after the step [m/s], and the solution of the model's LCP, if it solves one.
        """
        raise NotImplementedError

    def next_velocity(self, velocity: Numbers, force: Numbers, friction: Pairs | None = None) -> Numbers:
        """Velocity after a step [m/s], see `predict`."""
        return self.predict(velocity, force, friction)[0]

    def advance(self, state: Float[Tensor, "*batch 2"], drive: Drive) -> Step:
        position, velocity = state.unbind(-1)
        velocity, solution = self.predict(velocity, drive.force[..., 0], drive.friction)
        mode = torch.where(velocity.abs() < STICK_SPEED, int(Mode.STICK), int(Mode.SLIP)).unsqueeze(-1)
        state = torch.stack((position + self.dt * velocity, velocity), dim=-1)
        return Step(state, mode, solution, None if solution is None else solution.solved)

    def prediction_error(self, windows: Windows) -> Float[Tensor, " B"]:
        return step_error(self.next_velocity, windows)

    def rollout_error(self, windows: Windows) -> Float[Tensor, "B k"]:
        return path_error(self.next_velocity, windows)


def step_error(next_velocity: Callable[..., Tensor], windows: Windows) -> Float[Tensor, " B"]:
    """`Formulation.prediction_error` of what has velocities, without positions and modes, which it does not read."""
    return (next_velocity(*first_step(windows)) - windows.states[:, 1, 1]).square()


def path_error(next_velocity: Callable[..., Tensor], windows: Windows) -> Float[Tensor, "B k"]:
    """`Formulation.rollout_error` where no velocity depends on a position."""
    velocity, force, friction = windows.states[:, 0, 1], windows.drive.force[..., 0], windows.drive.friction
    predicted = []
    for k in range(windows.valid.shape[1]):
        velocity = next_velocity(velocity, force[:, k], None if friction is None else friction[:, k])
        predicted.append(velocity)
    return (torch.stack(predicted, dim=1) - windows.states[:, 1:, 1]).square()


def first_step(windows: Windows) -> tuple[Tensor, Tensor, Tensor | None]:
    """Velocity before, force and friction of the first step of each window."""
    friction = windows.drive.friction
    return windows.states[:, 0, 1], windows.drive.force[:, 0, 0], None if friction is None else friction[:, 0]
