"""What all that moves can do: advance a state by one step under a drive; and rollouts, step after step."""

from collections.abc import Callable
from enum import IntEnum
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lcplearn.lcp.solution import LCPSolution
from lcplearn.scenes.space import Space

STICK_SPEED = 1e-12  # [m/s] below it a body rests: exact zeros pass, values that a fit only drives towards zero do not


class Mode(IntEnum):
    """What a contact does during a step."""

    STICK = 0
    SLIP = 1
    SEPARATION = 2


class Drive(NamedTuple):
    """What acts on a scene during a step (or, with a dimension T before the last, during T steps).

    Attributes:
        force: External force [N], or force and torque [N m], one for each velocity.
        friction: Measured friction of the step [N], for models that need it; None if there is none.
    """

    force: Float[Tensor, "*batch nv"]
    friction: Float[Tensor, "*batch 2"] | None = None

    def at(self, k: int) -> "Drive":
        """Drive of step k, of a drive over T steps."""
        return self.map(lambda values: values[..., k, :])

    def map(self, f: Callable[[Tensor], Tensor]) -> "Drive":
        """Apply a function to all that acts."""
        return Drive(f(self.force), None if self.friction is None else f(self.friction))


class Step(NamedTuple):
    """What a step gives.

    Attributes:
        state: The next state: positions, then velocities.
        mode: `Mode` of each contact during the step.
        solution: Solution of the step's LCP; None where none was solved.
        solved: Whether the step is right: its LCP solved and, where it was iterated, settled; None without an LCP.
    """

    state: Float[Tensor, "*batch nq_plus_nv"]
    mode: Int[Tensor, "*batch contacts"]
    solution: LCPSolution | None = None
    solved: Bool[Tensor, "*batch"] | None = None


class Trajectory(NamedTuple):
    """States and contact modes over T steps.

    Attributes:
        positions: Positions at the T + 1 instants.
        velocities: Velocities at the T + 1 instants.
        mode: `Mode` values of each contact during each of the T steps.
        solved: `Step.solved` of each step; None where no step has an LCP.
    """

    positions: Float[Tensor, "*batch T+1 nq"]
    velocities: Float[Tensor, "*batch T+1 nv"]
    mode: Int[Tensor, "*batch T contacts"]
    solved: Bool[Tensor, "*batch T"] | None = None

    @property
    def states(self) -> Float[Tensor, "*batch instants nq_plus_nv"]:
        """Positions, then velocities."""
        return torch.cat((self.positions, self.velocities), dim=-1)


@runtime_checkable
class Scene(Protocol):
    """A scene or a learned model: whoever has these can be rolled out, scored, drawn and compared.

    A scene may have more, which is used where it is there: `numbers`, a mapping from the names of its constructor's
    numbers to their `Domain` (`Identified` learns them); `violation(state, drive, after)`, how badly the best contact
    force explains a measured step [m^2/s^2], [*batch] (a loss); a constructor argument `temperature`, which softens
    its thresholds in training; `length` [m], which weighs rotations against translations; `fused_rollout(state,
    drive)`, a rollout by other means than step after step, or None where it can't (see `rollout`).

    Attributes:
        space: What a state is.
        contacts: Number of contacts whose mode a step tells.
        dt: Step size [s].
    """

    @property
    def space(self) -> Space: ...

    @property
    def contacts(self) -> int: ...

    @property
    def dt(self) -> float: ...

    def advance(self, state: Tensor, drive: Drive) -> Step:
        """Advance a state [*batch, nq + nv] by one step of dt."""
        ...


class Moving:
    """Step and rollout, for classes with `advance`."""

    def step(self: Scene, state: Float[Tensor, "*#batch nq_plus_nv"], force: Float[Tensor, "*#batch nv"]) -> Tensor:
        """Next state under a force [N].

        Raises:
            ValueError: State or force has another number of columns.
        """
        check_columns(self.space, state, Drive(force))
        return self.advance(state, Drive(force)).state

    def rollout(
        self: Scene, state: Float[Tensor, "*#batch nq_plus_nv"], forces: Float[Tensor, "*#batch T nv"] | Drive
    ) -> Trajectory:
        """Trajectory from a state [*batch, nq + nv] over T forces [N], or a `Drive` of T steps; see `rollout`."""
        return rollout(self, state, forces)


def rollout(
    scene: Scene, state: Float[Tensor, "*#batch nq_plus_nv"], drive: Float[Tensor, "*#batch T nv"] | Drive
) -> Trajectory:
    """Advance a state T times.

    Batch dimensions of state, drive and of the scene's own parameters broadcast. Gradients flow through all steps;
    where a contact is about to change its mode they are those of one side.

    Args:
        scene: What moves.
        state: Positions, then velocities, at the start.
        drive: What acts during each of T >= 1 steps: the force [N], or a `Drive` that has it. The force of step k acts
            from instant k to k + 1.

    Returns:
        The trajectory, with the start as its first instant.

    Raises:
        ValueError: The force has fewer than two dimensions or no step, friction is of other steps, or a state, force or
            friction has another number of columns.
    """
    drive = drive if isinstance(drive, Drive) else Drive(drive)
    force, space = drive.force, scene.space
    if force.ndim < 2 or force.shape[-2] == 0 or force.shape[-1] != space.nv:
        raise ValueError(f"forces: expected shape [*batch, T, {space.nv}] with T >= 1, got {list(force.shape)}")
    check_columns(space, state, drive)
    friction = drive.friction
    if friction is not None and (friction.ndim < 2 or friction.shape[-2] != force.shape[-2]):
        raise ValueError(f"friction: expected shape [*batch, {force.shape[-2]}, 2], got {list(friction.shape)}")
    fused = getattr(scene, "fused_rollout", None)
    if fused is not None and (path := fused(state, drive)) is not None:
        return path
    batch = torch.broadcast_shapes(state.shape[:-1], force.shape[:-2])
    state = state.expand(*batch, state.shape[-1])
    states, modes, solved = [state], [], []
    for k in range(force.shape[-2]):
        step = scene.advance(state, drive.at(k))
        state = step.state
        states.append(state)
        modes.append(step.mode)
        if step.solved is not None:
            solved.append(step.solved)
    # The first state lacks the dimensions that the scene's own batched parameters add.
    path = torch.stack(torch.broadcast_tensors(*states), dim=-2)
    positions, velocities = space.split(path)
    mode = torch.stack(torch.broadcast_tensors(*modes), dim=-2)
    right = torch.stack(torch.broadcast_tensors(*solved), dim=-1) if solved else None
    return Trajectory(positions, velocities, mode, right)


def check_columns(space: Space, state: Tensor, drive: Drive) -> None:
    """Refuse what a scene would read some columns of, or none.

    Raises:
        ValueError: State, force or friction has another number of columns; the message names it.
    """
    if state.shape[-1:] != (space.nq + space.nv,):
        space.split(state)  # says what it expects; asked only here, as its views take microseconds
    for name, values, columns in (("force", drive.force, space.nv), ("friction", drive.friction, 2)):
        if values is not None and values.shape[-1:] != (columns,):
            raise ValueError(f"{name}: expected shape [*batch, {columns}], got {list(values.shape)}")
