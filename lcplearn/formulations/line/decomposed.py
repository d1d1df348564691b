"""Error of models that predict (v+, v-), the velocity decomposed by its sign."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import relu

from lcplearn.datasets.recordings import Windows


def decomposed_error(parts: Float[Tensor, "B 2"], windows: Windows) -> Float[Tensor, " B"]:
    """Squared error of (v+, v-) after the first step of each window [m^2/s^2]."""
    after = windows.states[:, 1, 1]
    return (parts - torch.stack((relu(after), relu(-after)), dim=-1)).square().sum(-1)
