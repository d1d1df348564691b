"""Baselines without contact structure: none of them can hold a block exactly at rest."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lcplearn.formulations.formulation import Formulation
from lcplearn.formulations.networks import features, log_parameter, network


class Affine(Formulation):
    """Predict the next velocity as an affine function of velocity and force.

    v_{k+1} = b_v v_k + b_u u + b_0

    It starts at the frictionless motion of a unit mass, v_{k+1} = v_k + u dt.
    """

    def __init__(self, *, dt: float, gravity: float = 9.81) -> None:
        super().__init__(dt=dt, gravity=gravity)
        self.weight = nn.Parameter(torch.ones(2, dtype=torch.float64))
        self.bias = nn.Parameter(torch.zeros((), dtype=torch.float64))

    def next_velocity(
        self,
        velocity: Float[Tensor, "*batch"],
        force: Float[Tensor, "*batch"],
        friction: Float[Tensor, "*batch 2"] | None = None,
    ) -> Float[Tensor, "*batch"]:
        return features(velocity, force, self.dt) @ self.weight + self.bias


class MLP(Formulation):
    """Predict the change of velocity by a network of velocity and force.

    v_{k+1} = v_k + net(v_k, u dt)

    Args:
        dt: Time step [s].
        gravity: Acceleration of gravity [m/s^2].
        width: Units of a hidden layer.
        depth: Hidden layers.
        activation: "relu" or "tanh".
    """

    def __init__(
        self, *, dt: float, gravity: float = 9.81, width: int = 64, depth: int = 2, activation: str = "relu"
    ) -> None:
        super().__init__(dt=dt, gravity=gravity)
        self.net = network(2, 1, width=width, depth=depth, activation=activation)

    def next_velocity(
        self,
        velocity: Float[Tensor, "*batch"],
        force: Float[Tensor, "*batch"],
        friction: Float[Tensor, "*batch 2"] | None = None,
    ) -> Float[Tensor, "*batch"]:
        change: Tensor = self.net(features(velocity, force, self.dt))
        return velocity + change[..., 0]


class ForceMLP(Formulation):
    """Predict the friction force by a network and add it to the frictionless motion.

    v_{k+1} = v_k + (u + net(v_k, u dt)) dt / m

    The notes' "most obvious idea". Sticking would need net = -u - m v_k / dt exactly, which a smooth fit never gives.
    The mass is learned but not identifiable: the network can imitate any other mass, so it is not reported.

    Args:
        dt: Time step [s].
        gravity: Acceleration of gravity [m/s^2].
        initial_mass: Mass at the start of training [kg]; > 0.
        width: Units of a hidden layer.
        depth: Hidden layers.
        activation: "relu" or "tanh".

    Source: notes section 3.
    """

    def __init__(
        self,
        *,
        dt: float,
        gravity: float = 9.81,
        initial_mass: float = 1.0,
        width: int = 64,
        depth: int = 2,
        activation: str = "relu",
    ) -> None:
        super().__init__(dt=dt, gravity=gravity)
        self.log_mass = log_parameter("initial_mass", initial_mass)
        self.net = network(2, 1, width=width, depth=depth, activation=activation)

    def friction_force(
        self, velocity: Float[Tensor, "*batch"], force: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """Predicted friction force [N]."""
        # The network's output is an impulse of order one: its division by dt keeps it learnable when dt is small.
        impulse: Tensor = self.net(features(velocity, force, self.dt))
        return impulse[..., 0] / self.dt

    def next_velocity(
        self,
        velocity: Float[Tensor, "*batch"],
        force: Float[Tensor, "*batch"],
        friction: Float[Tensor, "*batch 2"] | None = None,
    ) -> Float[Tensor, "*batch"]:
        return velocity + (force + self.friction_force(velocity, force)) * self.dt / self.log_mass.exp()
