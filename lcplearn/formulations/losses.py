"""Loss terms: what of a window of measurements a model is asked to match."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lcplearn.datasets.recordings import Windows
from lcplearn.domains import NOT_NEGATIVE
from lcplearn.formulations.formulation import Formulation


def loss_terms(model: Formulation, windows: Windows, weights: Mapping[str, float]) -> dict[str, Tensor]:
    """Evaluate the loss terms with positive weight; the training loss is the sum of weight times term.

    All terms are means over the valid steps [m^2/s^2; complementarity: N^2 m^2/s^2]. The model has them (see
    `Formulation.errors`):

    prediction:       squared error of one step: of (v+, v-) where the model decomposes velocity, else of v
    rollout:          squared error of v over all steps of the window, predicted from its first measured state
    pose:             robust distance of positions over all steps of the window [m], see `Formulation.pose_error`
    complementarity:  (friction * (v+, v-))^2, `direct` and `slack` only
    nonnegativity:    max(0, -(v+, v-))^2, `direct` and `slack` only
    violation:        how badly the best friction explains the measured steps: the first of each window for
                      `structured`, all of them for scenes that have a `violation`

    Args:
        model: The formulation to judge.
        windows: Measured windows; `rollout`, `pose` and a scene's `violation` look beyond the first step.
        weights: Weight of each term, by name; missing terms have weight zero.

    Returns:
        The unweighted terms, each a scalar.

    Raises:
        ValueError: a term that the model doesn't have, a negative weight, no positive weight, or missing friction.

    Source: NOTES 6.5.
    """
    errors = model.errors()
    active = [name for name, weight in weights.items() if weight]
    for name, weight in weights.items():
        if weight and name not in errors:
            raise ValueError(f"loss: expected terms of {type(model).__name__} ({', '.join(errors)}), got {name!r}")
        if weight not in NOT_NEGATIVE:
            raise ValueError(f"loss.{name}: expected {NOT_NEGATIVE.words}, got {weight}")
    if not active:
        raise ValueError(f"loss: expected a positive weight for one of {', '.join(errors)}, got none")
    return {name: _mean(errors[name](windows), windows.valid) for name in active}


def _mean(errors: Float[Tensor, " B"] | Float[Tensor, "B k"], valid: Bool[Tensor, "B k"]) -> Float[Tensor, ""]:
    valid = valid if errors.ndim == 2 else valid[:, 0]
    return torch.where(valid, errors, 0.0).sum() / valid.sum().clamp(min=1)
