"""ReLU on the decomposed velocities (the notes' Remark 4)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import relu

from lcplearn.formulations.formulation import Formulation
from lcplearn.formulations.networks import features, network

INITIAL_BIAS = -0.01  # [m/s] negative: a small stick band from the start, with both outputs alive outside it


class ReLU(Formulation):
    """Predict the decomposed velocity by rectified affine maps, or by a rectified network.

    v_{k+1} = v+ - v-,   (v+, v-) = relu(W h + bias),   h = (v, u dt) or the last hidden layer of a network

    With h = (v, u dt), W = [[1, 1 / m], [-1, -1 / m]] and bias = -mu g dt this is the closed form of the direct LCP.
    The rows of W start as mirror images (w, -w): every sample then has a live output, whereas independent rows leave a
    dead one, without gradient, in about one start of four.

    Args:
        dt: Time step [s].
        gravity: Acceleration of gravity [m/s^2].
        use_network: Put a tanh network below the rectified outputs.
        width: Units of a hidden layer.
        depth: Hidden layers.

    Source: notes Remark 4; learning.md B2.
    """

    def __init__(
        self, *, dt: float, gravity: float = 9.81, use_network: bool = False, width: int = 64, depth: int = 1
    ) -> None:
        super().__init__(dt=dt, gravity=gravity)
        # The network's last layer, from h to (v+, v-), is `output` in both cases.
        self.trunk: nn.Sequential | None = None
        if use_network:
            *hidden, output = network(2, 2, width=width, depth=depth, activation="tanh")
            self.trunk, self.output = nn.Sequential(*hidden), output
        else:
            self.output = nn.Linear(2, 2, dtype=torch.float64)
        with torch.no_grad():
            self.output.weight[1] = -self.output.weight[0]
            self.output.bias.fill_(INITIAL_BIAS)

    def velocity_parts(
        self,
        velocity: Float[Tensor, "*batch"],
        force: Float[Tensor, "*batch"],
        friction: Float[Tensor, "*batch 2"] | None = None,
    ) -> Float[Tensor, "*batch 2"]:
        """Predict (v+, v-) >= 0 [m/s]."""
        h = features(velocity, force, self.dt)
        return relu(self.output(h if self.trunk is None else self.trunk(h)))

    def next_velocity(
        self,
        velocity: Float[Tensor, "*batch"],
        force: Float[Tensor, "*batch"],
        friction: Float[Tensor, "*batch 2"] | None = None,
    ) -> Float[Tensor, "*batch"]:
        parts = self.velocity_parts(velocity, force)
        return parts[..., 0] - parts[..., 1]
