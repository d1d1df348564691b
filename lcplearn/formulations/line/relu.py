"""ReLU on the decomposed velocities."""

from typing import cast

import torch
from torch import nn
from torch.nn.functional import relu

from lcplearn.formulations.line.decomposed import Decomposed
from lcplearn.formulations.line.formulation import Numbers, Pairs
from lcplearn.formulations.networks import features, network

INITIAL_BIAS = -0.01  # [m/s] negative: a small stick band from the start, with both outputs alive outside it


class ReLU(Decomposed):
    """Predict the decomposed velocity by rectified affine maps, or by a rectified network.

    v_{k+1} = v+ - v-,   (v+, v-) = relu(W h + bias),   h = (v, u dt) or the last hidden layer of a network

    With h = (v, u dt), W = [[1, 1 / m], [-1, -1 / m]] and bias = -mu g dt this is the closed form of the direct LCP.
    The rows of W start as mirror images (w, -w): every sample then has a live output, whereas independent rows leave a
    dead one, without gradient, in about one start of four.

    Args:
        dt: Time step [s].
        gravity: Acceleration of gravity [m/s^2].
        width: Units of a hidden layer.
        depth: Hidden layers below the rectified outputs; 0 makes them affine in (v, u dt).

    Source: Pfrommer's "LCP Notes" (2019), Remark 4; NOTES 6.2.
    """

    def __init__(self, *, dt: float, gravity: float = 9.81, width: int = 64, depth: int = 0) -> None:
        super().__init__(dt=dt, gravity=gravity)
        self.net = network(2, 2, width=width, depth=depth, activation="tanh")
        output = cast(nn.Linear, self.net[-1])
        with torch.no_grad():
            if depth == 0:
                output.weight[0].abs_()  # a block goes on, and goes where it is pushed: from w < 0 the outputs can die
            output.weight[1] = -output.weight[0]
            output.bias.fill_(INITIAL_BIAS)

    def velocity_parts(self, velocity: Numbers, force: Numbers, friction: Pairs | None = None) -> Pairs:
        """Predict (v+, v-) >= 0 [m/s]."""
        return relu(self.net(features(velocity, force, self.dt)))
