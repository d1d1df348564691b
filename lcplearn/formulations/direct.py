"""Velocity affine in measured friction (the notes' 3.1.1), which a prediction therefore needs too."""

from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lcplearn.formulations.formulation import Formulation
from lcplearn.formulations.networks import features


class KnownFriction(Formulation):
    """Decompose the next velocity into parts affine in velocity, force and a known friction vector.

    (v+, v-) = f(v, u) + G y,   f = F (v, u dt) + f_0,   y = friction * dt

    It starts at the frictionless motion of a unit mass, (v+, v-) = (p, -p) with p = v + u dt.
    """

    def __init__(self, *, dt: float, gravity: float = 9.81) -> None:
        super().__init__(dt=dt, gravity=gravity)
        self.f_weight = nn.Parameter(torch.tensor([[1.0, 1.0], [-1.0, -1.0]], dtype=torch.float64))
        self.f_bias = nn.Parameter(torch.zeros(2, dtype=torch.float64))
        self.G = nn.Parameter(torch.zeros(2, 2, dtype=torch.float64))

    def free_parts(
        self, velocity: Float[Tensor, "*batch"], force: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch 2"]:
        """f(v, u): the parts of the velocity without friction [m/s]."""
        return features(velocity, force, self.dt) @ self.f_weight.mT + self.f_bias

    def velocity_parts(
        self,
        velocity: Float[Tensor, "*batch"],
        force: Float[Tensor, "*batch"],
        friction: Float[Tensor, "*batch 2"] | None = None,
    ) -> Float[Tensor, "*batch 2"]:
        """Predict (v+, v-) [m/s] from measured friction [N].

        Raises:
            ValueError: friction is missing.
        """
        if friction is None:
            name = type(self).__name__
            raise ValueError(f"{name} needs friction=... (measured friction [N], two per step) and got none.")
        return self.free_parts(velocity, force) + friction * self.dt @ self.G.mT


class Direct(KnownFriction):
    """Predict the decomposed velocity from measured friction (lambda+, lambda-).

    v_{k+1} = v+ - v-,   (v+, v-) = f(v, u) + G lambda dt

    Physical labels (the force that acts) are complementary to the velocity but not affine in it, LCP labels (the slack
    variables' fictitious forces) the reverse: no f, G fit the affine system and the complementarity at once.

    Source: notes section 3.1.1; errata 16-19.
    """

    needs_friction: ClassVar[bool] = True

    def next_velocity(
        self,
        velocity: Float[Tensor, "*batch"],
        force: Float[Tensor, "*batch"],
        friction: Float[Tensor, "*batch 2"] | None = None,
    ) -> Float[Tensor, "*batch"]:
        parts = self.velocity_parts(velocity, force, friction)
        return parts[..., 0] - parts[..., 1]
