"""The one interface of all learned models: they advance a state under a drive, as scenes do."""

import inspect
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, ClassVar

from jaxtyping import Float
from torch import Tensor, nn

from lcplearn.datasets.recordings import Windows
from lcplearn.datasets.task import Task
from lcplearn.domains import positive
from lcplearn.scenes.scene import Drive, Scene, Step, Trajectory, check_columns, rollout
from lcplearn.scenes.space import Space


class Formulation(nn.Module):
    """Predict the state of what moves after one time step.

    Subclasses implement `advance`; rollouts and loss terms follow from it. Constructors take keyword arguments only.

    Attributes:
        space: What a state is.
        contacts: Number of contacts whose mode a step tells.
        dt: Time step [s].
        radius: What weighs rotations against translations in losses and figures [m].
        given: Numbers taken as known, by name; data must agree with them.
        needs_friction: True if a prediction needs measured friction.
        temperature: Softening of a threshold in training [m/s], see `softened`; 0 in predictions. An attribute and no
            argument: it would go through every signature between the loss and the threshold for two models' sake.
        arguments: Constructor arguments as they were given: with the class, what a checkpoint needs to rebuild it.
    """

    needs_friction: ClassVar[bool] = False
    space: Space
    contacts: int = 1
    radius: float = 1.0
    given: Mapping[str, Any]
    temperature: float = 0.0
    arguments: dict[str, Any]

    def __new__(cls, *wrong: Any, **arguments: Any) -> "Formulation":
        if wrong:
            raise TypeError(f"{cls.__name__}: expected keyword arguments only, got {wrong[0]!r} without a name")
        model = super().__new__(cls)
        model.__dict__["arguments"] = arguments  # nn.Module's own __setattr__ works only after its __init__
        return model

    def __init__(self, *, space: Space, dt: float, given: Mapping[str, Any] | None = None) -> None:
        super().__init__()
        self.space, self.dt, self.given = space, positive("dt", dt), dict(given or {})

    def advance(self, state: Float[Tensor, "*batch nq_plus_nv"], drive: Drive) -> Step:
        """Predict the state one step later.

        Args:
            state: Positions, then velocities.
            drive: Force during the step; measured friction, of the kind that the model was trained with, is read by
                models with `needs_friction` only.

        Raises:
            ValueError: friction is needed and missing.
        """
        raise NotImplementedError

    def moving(self) -> Scene:
        """What a rollout advances: the model, or a scene with the learned numbers, made once for all steps."""
        return self

    def moving_each(self, count: int) -> Scene:
        """As `moving`, for rollouts of count windows whose gradients may need care one by one."""
        return self.moving()

    def step(
        self,
        state: Float[Tensor, "*batch nq_plus_nv"],
        force: Float[Tensor, "*batch nv"],
        friction: Float[Tensor, "*batch 2"] | None = None,
    ) -> Float[Tensor, "*batch nq_plus_nv"]:
        """Advance a state by one step under a force [N], in float64 as all parameters are.

        Raises:
            ValueError: State, force or friction has another number of columns.
        """
        drive = Drive(force, friction).map(Tensor.double)
        check_columns(self.space, state, drive)
        return self.advance(state.double(), drive).state

    def rollout(
        self,
        state: Float[Tensor, "*batch nq_plus_nv"],
        forces: Float[Tensor, "*batch T nv"],
        friction: Float[Tensor, "*batch T 2"] | None = None,
    ) -> Trajectory:
        """Predict a trajectory from an initial state and the forces of T steps.

        Args:
            state: Positions, then velocities, at the start.
            forces: Force during each step [N].
            friction: Measured friction during each step [N]; models with `needs_friction` only.

        Returns:
            Positions, velocities and the contact modes of each step.
        """
        return rollout(self.moving(), state.double(), Drive(forces, friction).map(Tensor.double))

    def errors(self) -> dict[str, Callable[[Windows], Tensor]]:
        """Loss terms that the model has: functions of windows that give a value for each first step, or each step."""
        return {"prediction": self.prediction_error, "rollout": self.rollout_error, "pose": self.pose_error}

    def prediction_error(self, windows: Windows) -> Float[Tensor, " B"]:
        """Squared error of the velocity after the first step of each window [m^2/s^2]."""
        moving = self.moving_each(len(windows.valid))
        after = moving.advance(windows.states[:, 0], windows.drive.at(0)).state
        return self.velocity_error(after, windows.states[:, 1])

    def rollout_error(self, windows: Windows) -> Float[Tensor, "B k"]:
        """Squared error of the velocity after each step, predicted from the window's first state [m^2/s^2]."""
        return self.velocity_error(self._predicted(windows), windows.states[:, 1:])

    def pose_error(self, windows: Windows) -> Float[Tensor, "B k"]:
        """Robust distance of the positions after each step, predicted from the window's first state [m].

        c (sqrt(1 + d^2 / c^2) - 1), with rotations weighted by `radius` and c = radius / 10: nearly d where d > c, so
        that windows that fell to another side don't decide alone.
        """
        predicted, measured = self._predicted(windows)[..., : self.space.nq], windows.states[:, 1:, : self.space.nq]
        squared = self.space.squared_speed(self.space.difference(predicted, measured), self.radius)
        c = self.radius / 10.0
        return c * ((1.0 + squared / c**2).sqrt() - 1.0)

    def _predicted(self, windows: Windows) -> Float[Tensor, "B k nq_plus_nv"]:
        path = rollout(self.moving_each(len(windows.valid)), windows.states[:, 0], windows.drive)
        return path.states[:, 1:]

    def velocity_error(
        self, predicted: Float[Tensor, "*batch nq_plus_nv"], measured: Float[Tensor, "*batch nq_plus_nv"]
    ) -> Float[Tensor, "*batch"]:
        """Squared distance of the velocities of two states [m^2/s^2], rotations weighted by `radius`."""
        difference = predicted[..., self.space.nq :] - measured[..., self.space.nq :]
        return self.space.squared_speed(difference, self.radius)

    def physical_parameters(self) -> dict[str, float]:
        """Learned numbers with a physical meaning, such as `mu` and `mass` [kg], where the model determines them."""
        return {}

    @contextmanager
    def softened(self, temperature: float) -> Iterator[None]:
        """Within, thresholds have this temperature [m/s]; whoever predicts or validates sees the exact ones."""
        self.temperature = temperature
        try:
            yield
        finally:
            self.temperature = 0.0


def build(cls: type[Formulation], task: Task, **arguments: Any) -> Formulation:
    """Build a model for a task, which tells space, dt, what is given and whether positions matter to those that ask.

    Args:
        cls: Class of the model.
        task: What is to be learned.
        arguments: The other constructor arguments.

    Raises:
        ValueError: An argument is missing or unknown, or what the constructor refuses.
    """
    known: dict[str, Any] = {
        "gravity": task.given.get("gravity"),
        "space": task.space,
        "dt": task.dt,
        "given": dict(task.given),
        "positions": task.positions,
    }
    signature = inspect.signature(cls.__init__)
    known = {name: value for name, value in known.items() if name in signature.parameters and value is not None}
    try:
        signature.bind(None, **known | arguments)
    except TypeError as error:
        raise ValueError(f"model: {cls.__name__}: {error}") from None
    return cls(**known | arguments)
