"""The friction force as a network."""

from torch import Tensor

from lcplearn.formulations.line.formulation import LineFormulation, Numbers, Pairs, Prediction
from lcplearn.formulations.networks import features, log_parameter, network


class ForceMLP(LineFormulation):
    """Predict the friction force by a network and add it to the frictionless motion.

    v_{k+1} = v_k + (u + net(v_k, u dt)) dt / m

    The "most obvious idea". Sticking would need net = -u - m v_k / dt exactly, which a smooth fit never gives.
    The mass is learned but not identifiable: the network can imitate any other mass, so it is not reported.

    Args:
        dt: Time step [s].
        gravity: Acceleration of gravity [m/s^2].
        initial_mass: Mass at the start of training [kg]; > 0.
        width: Units of a hidden layer.
        depth: Hidden layers.
        activation: "relu" or "tanh".

    Source: Pfrommer's "LCP Notes" (2019), section 3.
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

    def friction_force(self, velocity: Numbers, force: Numbers) -> Numbers:
        """Predicted friction force [N]."""
        # The network's output is an impulse of order one: its division by dt keeps it learnable when dt is small.
        impulse: Tensor = self.net(features(velocity, force, self.dt))
        return impulse[..., 0] / self.dt

    def predict(self, velocity: Numbers, force: Numbers, friction: Pairs | None = None) -> Prediction:
        return velocity + (force + self.friction_force(velocity, force)) * self.dt / self.log_mass.exp(), None
