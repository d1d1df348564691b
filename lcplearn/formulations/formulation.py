"""The one interface of all learned models: (velocity, force) -> velocity after one time step."""

from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lcplearn.formulations.networks import positive
from lcplearn.lcp.solution import LCPSolution
from lcplearn.lcp.solve import solve_lcp
from lcplearn.scenes.rollout import Mode, Trajectory, rollout

STICK_SPEED = 1e-12  # [m/s] below it a block rests: exact zeros pass, values that a fit only drives towards zero do not


class Formulation(nn.Module):
    """Predict the velocity of a block after one time step.

    Subclasses implement `next_velocity`; position, rollouts and modes follow from it. The position is advanced with
    the new velocity (implicit Euler, as in the notes): x_{k+1} = x_k + dt v_{k+1}.

    Attributes:
        dt: Time step [s].
        gravity: Acceleration of gravity [m/s^2].
        needs_friction: True if a prediction needs measured friction.
        last_solution: The last LCP solved in a forward pass, detached; None if there was none.
        arguments: Constructor arguments as they were given: with the class, what a checkpoint needs to rebuild it.
    """

    needs_friction: ClassVar[bool] = False
    last_solution: LCPSolution | None
    arguments: dict[str, Any]

    def __new__(cls, **arguments: Any) -> "Formulation":
        model = super().__new__(cls)
        model.__dict__["arguments"] = arguments  # nn.Module's own __setattr__ works only after its __init__
        return model

    def __init__(self, *, dt: float, gravity: float = 9.81) -> None:
        super().__init__()
        self.dt = positive("dt", dt)
        self.gravity = positive("gravity", gravity)
        self.last_solution = None

    def next_velocity(
        self,
        velocity: Float[Tensor, "*batch"],
        force: Float[Tensor, "*batch"],
        friction: Float[Tensor, "*batch 2"] | None = None,
    ) -> Float[Tensor, "*batch"]:
        """Predict the velocity one step later.

        Args:
            velocity: Velocity now [m/s].
            force: Force applied during the step [N].
            friction: Measured friction during the step [N], of the kind that the model was trained with; read by
                models with `needs_friction` only.

        Returns:
            Velocity after the step [m/s].
        """
        raise NotImplementedError

    def step(
        self,
        state: Float[Tensor, "*batch 2"],
        force: Float[Tensor, "*batch 1"],
        friction: Float[Tensor, "*batch 2"] | None = None,
    ) -> Float[Tensor, "*batch 2"]:
        """Advance position [m] and velocity [m/s] by one step under a force [N], in float64 as all parameters are."""
        position, velocity = state.double().unbind(-1)
        velocity = self.next_velocity(velocity, force[..., 0].double(), None if friction is None else friction.double())
        return torch.stack((position + self.dt * velocity, velocity), dim=-1)

    def rollout(
        self,
        state: Float[Tensor, "*batch 2"],
        forces: Float[Tensor, "*batch T 1"],
        friction: Float[Tensor, "*batch T 2"] | None = None,
    ) -> Trajectory:
        """Predict a trajectory from an initial state and the forces of T steps.

        Args:
            state: Position [m] and velocity [m/s] at the start.
            forces: Force during each step [N].
            friction: Measured friction during each step [N]; models with `needs_friction` only.

        Returns:
            Positions, velocities and the mode of each step: stick where the new velocity is below 1e-12 m/s.
        """
        measured = None if friction is None else iter(friction.unbind(-2))  # `rollout` takes the steps in order

        def step(state: Tensor, force: Tensor) -> tuple[Tensor, Tensor]:
            after = self.step(state, force, None if measured is None else next(measured))
            rests = after[..., 1:].abs() < STICK_SPEED
            return after, torch.where(rests, int(Mode.STICK), int(Mode.SLIP))

        return rollout(step, state, forces)

    def physical_parameters(self) -> dict[str, float]:
        """Friction coefficient `mu` and `mass` [kg] where the model determines them, else nothing."""
        return {}

    def solve(
        self, M: Float[Tensor, "*#batch n n"], q: Float[Tensor, "*#batch n"], method: str = "auto"
    ) -> LCPSolution:
        """Solve the model's LCP and keep the detached solution as `last_solution` for reports."""
        solution = solve_lcp(M, q, method=method)
        self.last_solution = LCPSolution(*(_detached(field) for field in solution))
        return solution


def _detached(field: Any) -> Any:
    return field.detach() if isinstance(field, Tensor) else field
