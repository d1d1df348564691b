"""Friction on a table in two directions: learned models that stick exactly."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lcplearn.formulations.formulation import Formulation
from lcplearn.formulations.networks import log_parameter, network
from lcplearn.scenes.planar_block import slide_in_plane
from lcplearn.scenes.scene import Drive, Mode, Step
from lcplearn.scenes.space import TABLE, Space


class PlanarFriction(Formulation):
    """Predict v' = S(b, l) = b max(0, 1 - l / |b|), the closed form of the friction cone, of a learned b and l > 0.

    It sticks exactly wherever |b| <= l, whatever errors the learned values have. b is affine in velocity and impulse
    (v, u dt) and l a number: the structured model. With depth > 0 both come from a network: the radial ReLU. (A ReLU
    for each facet of a polygon has the wrong law along the radius.)

    The slack formulation has no counterpart in two directions: with more than two facets z is no function of the
    slacks, so that what is measured does not determine the velocity.

    Args:
        dt: Time step [s].
        space: Must be `TABLE`.
        initial_limit: l at the start, over dt [m/s^2]; low, because a block that never slips has no gradient.
        depth: Hidden layers of a network for b and l; 0 for none.
        width: Units of a hidden layer.
        activation: "relu" or "tanh".

    Source: NOTES 5.7.
    """

    def __init__(
        self,
        *,
        dt: float,
        space: Space = TABLE,
        initial_limit: float = 1.0,
        depth: int = 0,
        width: int = 64,
        activation: str = "tanh",
    ) -> None:
        super().__init__(space=space, dt=dt)
        if space != TABLE:
            raise ValueError(f"space: expected TABLE (x, y), got {', '.join(space.positions)}")
        one = torch.eye(2, dtype=torch.float64)
        self.weight, self.bias = nn.Parameter(torch.cat((one, one), dim=-1)), nn.Parameter(one.new_zeros(2))
        self.log_limit = log_parameter("initial_limit", initial_limit * dt)
        self.net = network(4, 3, width=width, depth=depth, activation=activation) if depth else None

    def advance(self, state: Float[Tensor, "*batch 4"], drive: Drive) -> Step:
        position, velocity = TABLE.split(state)
        inputs = torch.cat((velocity, self.dt * drive.force), dim=-1)
        b, log_limit = nn.functional.linear(inputs, self.weight, self.bias), self.log_limit
        if self.net is not None:
            change = self.net(inputs)
            b, log_limit = b + change[..., :2], log_limit + change[..., 2]
        moved = slide_in_plane(b, log_limit.exp())
        mode = torch.where((moved == 0.0).all(-1, keepdim=True), int(Mode.STICK), int(Mode.SLIP))
        return Step(torch.cat((TABLE.advance(position, moved, self.dt), moved), dim=-1), mode)
