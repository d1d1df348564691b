"""Baselines without contact structure: none of them can hold a body exactly at rest."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lcplearn.datasets.recordings import Windows
from lcplearn.formulations.formulation import Formulation
from lcplearn.formulations.networks import network
from lcplearn.scenes.scene import STICK_SPEED, Drive, Mode, Step
from lcplearn.scenes.space import LINE, Space


class Baseline(Formulation):
    """Predict the next velocity as a function of the state and of the force's impulse; its one mode is that of all.

    Args:
        dt: Time step [s].
        space: What a state is.
        positions: Whether the function sees positions too; without them it is the same everywhere.
    """

    def __init__(self, *, dt: float, space: Space = LINE, positions: bool = False) -> None:
        super().__init__(space=space, dt=dt)
        self.first = 0 if positions else space.nq  # of the state's columns that it sees
        self.inputs = space.nq + space.nv - self.first + space.nv

    def next_velocity(
        self, velocity: Float[Tensor, "*batch nv"], inputs: Float[Tensor, "*batch n"]
    ) -> Float[Tensor, "*batch nv"]:
        """Velocity after a step, from that before it and from all inputs: (state, force * dt)."""
        raise NotImplementedError

    def advance(self, state: Float[Tensor, "*batch nq_plus_nv"], drive: Drive) -> Step:
        position, velocity = self.space.split(state)[0], self._velocity_after(state, drive)
        rests = self.space.speed(velocity, self.radius) < STICK_SPEED
        mode = torch.where(rests, int(Mode.STICK), int(Mode.SLIP)).unsqueeze(-1)
        return Step(torch.cat((self.space.advance(position, velocity, self.dt), velocity), dim=-1), mode)

    def prediction_error(self, windows: Windows) -> Float[Tensor, " B"]:
        # As the base class has it, without the positions and modes, which it does not read.
        after = self._velocity_after(windows.states[:, 0], windows.drive.at(0))
        return self.space.squared_speed(after - windows.states[:, 1, self.space.nq :], self.radius)

    def _velocity_after(self, state: Tensor, drive: Drive) -> Tensor:
        inputs = torch.cat((state[..., self.first :], drive.force * self.dt), dim=-1)
        return self.next_velocity(state[..., self.space.nq :], inputs)


class Affine(Baseline):
    """Predict the next velocity as an affine function of velocity and force.

    v_{k+1} = B (v_k, u dt) + b_0

    It starts at the frictionless motion of a unit mass, v_{k+1} = v_k + u dt.

    Args:
        dt: Time step [s].
        space: What a state is.
        positions: Whether the function sees positions too.
    """

    def __init__(self, *, dt: float, space: Space = LINE, positions: bool = False) -> None:
        super().__init__(dt=dt, space=space, positions=positions)
        one = torch.eye(space.nv, dtype=torch.float64)
        unseen = torch.zeros(space.nv, self.inputs - 2 * space.nv, dtype=torch.float64)
        self.weight = nn.Parameter(torch.cat((unseen, one, one), dim=-1))
        self.bias = nn.Parameter(torch.zeros(space.nv, dtype=torch.float64))
        self.register_load_state_dict_pre_hook(_as_rows)

    def next_velocity(
        self, velocity: Float[Tensor, "*batch nv"], inputs: Float[Tensor, "*batch n"]
    ) -> Float[Tensor, "*batch nv"]:
        return nn.functional.linear(inputs, self.weight, self.bias)


def _as_rows(module: nn.Module, state: dict[str, Tensor], prefix: str, *others: Any) -> None:
    """Checkpoints of version 0.1, of one velocity, have a row without its dimension."""
    for name, parameter in module.named_parameters():
        if (saved := state.get(prefix + name)) is not None and saved.numel() == parameter.numel():
            state[prefix + name] = saved.reshape(parameter.shape)


class MLP(Baseline):
    """Predict the change of velocity by a network of velocity and force.

    v_{k+1} = v_k + net(v_k, u dt)

    Args:
        dt: Time step [s].
        space: What a state is.
        positions: Whether the network sees positions too.
        width: Units of a hidden layer.
        depth: Hidden layers.
        activation: "relu" or "tanh".
    """

    def __init__(
        self,
        *,
        dt: float,
        space: Space = LINE,
        positions: bool = False,
        width: int = 64,
        depth: int = 2,
        activation: str = "relu",
    ) -> None:
        super().__init__(dt=dt, space=space, positions=positions)
        self.net = network(self.inputs, space.nv, width=width, depth=depth, activation=activation)

    def next_velocity(
        self, velocity: Float[Tensor, "*batch nv"], inputs: Float[Tensor, "*batch n"]
    ) -> Float[Tensor, "*batch nv"]:
        change: Tensor = self.net(inputs)
        return velocity + change
