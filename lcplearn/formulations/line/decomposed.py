"""Models that predict (v+, v-), the velocity decomposed by its sign."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import relu

from lcplearn.datasets.recordings import Windows
from lcplearn.formulations.line.formulation import LineFormulation, Numbers, Pairs, Prediction, first_step


class Decomposed(LineFormulation):
    """Predict v+ and v-; the velocity is their difference. Subclasses implement `velocity_parts`."""

    def velocity_parts(self, velocity: Numbers, force: Numbers, friction: Pairs | None = None) -> Pairs:
        """Predict (v+, v-) [m/s]; friction [N] is measured."""
        raise NotImplementedError

    def predict(self, velocity: Numbers, force: Numbers, friction: Pairs | None = None) -> Prediction:
        parts = self.velocity_parts(velocity, force, friction)
        return parts[..., 0] - parts[..., 1], None

    def prediction_error(self, windows: Windows) -> Float[Tensor, " B"]:
        """Squared error of (v+, v-) after the first step [m^2/s^2]."""
        after = windows.states[:, 1, 1]
        parts = self.velocity_parts(*first_step(windows))
        return (parts - torch.stack((relu(after), relu(-after)), dim=-1)).square().sum(-1)
