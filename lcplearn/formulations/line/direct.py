"""Velocity affine in measured friction, which a prediction therefore needs too."""

from collections.abc import Callable
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import relu

from lcplearn.datasets.recordings import Windows
from lcplearn.formulations.line.decomposed import Decomposed
from lcplearn.formulations.line.formulation import Numbers, Pairs, first_step
from lcplearn.formulations.networks import features


class KnownFriction(Decomposed):
    """Decompose the next velocity into parts affine in velocity, force and a known friction vector.

    (v+, v-) = f(v, u) + G y,   f = F (v, u dt) + f_0,   y = friction * dt

    It starts at the frictionless motion of a unit mass, (v+, v-) = (p, -p) with p = v + u dt.
    """

    def __init__(self, *, dt: float, gravity: float = 9.81) -> None:
        super().__init__(dt=dt, gravity=gravity)
        self.f_weight = nn.Parameter(torch.tensor([[1.0, 1.0], [-1.0, -1.0]], dtype=torch.float64))
        self.f_bias = nn.Parameter(torch.zeros(2, dtype=torch.float64))
        self.G = nn.Parameter(torch.zeros(2, 2, dtype=torch.float64))

    def free_parts(self, velocity: Numbers, force: Numbers) -> Pairs:
        """f(v, u): the parts of the velocity without friction [m/s]."""
        return features(velocity, force, self.dt) @ self.f_weight.mT + self.f_bias

    def velocity_parts(self, velocity: Numbers, force: Numbers, friction: Pairs | None = None) -> Pairs:
        """Predict (v+, v-) [m/s] from measured friction [N].

        Raises:
            ValueError: friction is missing.
        """
        if friction is None:
            raise ValueError(
                f"friction: expected measured friction [N], two a step, for {type(self).__name__}, got none"
            )
        return self.free_parts(velocity, force) + friction * self.dt @ self.G.mT

    def errors(self) -> dict[str, Callable[[Windows], Tensor]]:
        """Beside the usual: complementarity (friction * (v+, v-))^2 and nonnegativity max(0, -(v+, v-))^2."""
        more = {"complementarity": self._complementarity_error, "nonnegativity": self._nonnegativity_error}
        return super().errors() | more

    def _complementarity_error(self, windows: Windows) -> Float[Tensor, " B"]:
        velocity, force, friction = first_step(windows)
        parts = self.velocity_parts(velocity, force, friction)
        assert friction is not None  # velocity_parts needs it
        return (friction * parts).square().sum(-1)

    def _nonnegativity_error(self, windows: Windows) -> Float[Tensor, " B"]:
        return relu(-self.velocity_parts(*first_step(windows))).square().sum(-1)


class Direct(KnownFriction):
    """Predict the decomposed velocity from measured friction (lambda+, lambda-).

    v_{k+1} = v+ - v-,   (v+, v-) = f(v, u) + G lambda dt

    Physical labels (the force that acts) are complementary to the velocity but not affine in it, LCP labels (the slack
    variables' fictitious forces) the reverse: no f, G fit the affine system and the complementarity at once.

    Source: Pfrommer's "LCP Notes" (2019), section 3.1.1; NOTES 6.2.
    """

    needs_friction: ClassVar[bool] = True
