"""Predict the tosses of a file from row 0 of each, and judge the predictions by the other rows."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.datasets.cube_tosses import Tosses, in_file_units, read_tosses
from lcplearn.formulations import Formulation
from lcplearn.training.toss_metrics import format_scores, score_restarts, score_tosses
from lcplearn.training.writing import replace

TOGETHER = 128  # tosses in a rollout, of similar length


def read_for(path: Path | str, model: Formulation) -> Tosses:
    """Tosses to score a model on, of which only row 0 of each is checked.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It holds no tosses, or those of another cube or time step than the model's.
    """
    tosses = read_tosses(path, only_starts=True)
    if model.space.nq + model.space.nv != tosses.states.shape[-1]:
        raise ValueError(f"{path} holds tosses in space, but {type(model).__name__} moves otherwise.")
    for what, ours, theirs in (
        ("a time step of {:.6g} s", model.dt, tosses.dt),
        ("a half width of {:.6g} m", model.given.get("half_width", tosses.half_width), tosses.half_width),
    ):
        if abs(ours / theirs - 1.0) > 1e-6:
            raise ValueError(f"{path} has {what.format(theirs)}, but the model was trained for {what.format(ours)}.")
    return tosses


@torch.no_grad()
def rollout(model: Formulation, start: Float[Tensor, "B 13"], steps: int) -> Float[Tensor, "B rows 13"]:
    """States from a start, nothing but gravity and contact acting."""
    return model.rollout(start, start.new_zeros(len(start), steps, 6)).states


def predict_tosses(model: Formulation, tosses: Tosses) -> Float[Tensor, "N rows 13"]:
    """Predicted states of whole tosses, from row 0 of each alone; padding repeats what is not asked for."""
    predicted = tosses.states[:, :1].repeat(1, tosses.states.shape[1], 1)
    for chosen in tosses.steps.argsort().split(TOGETHER):
        steps = int(tosses.steps[chosen].max())
        predicted[chosen, 1 : steps + 1] = rollout(model, tosses.states[chosen, 0], steps)[:, 1:]
    return predicted


def write_tosses(path: Path | str, predicted: Float[Tensor, "N rows 13"], tosses: Tosses) -> None:
    """Write `state` and `offsets` as the file of the recorded tosses has them."""
    path = Path(path)
    if path.suffix != ".npz":
        raise ValueError(f"{path}: expected a name that ends in .npz")
    offsets = np.concatenate(([0], np.cumsum(tosses.steps.numpy() + 1)))
    state = in_file_units(predicted, tosses.steps, tosses.half_width)
    replace(path, lambda file: np.savez_compressed(file, state=state, offsets=offsets))


def report(model: Formulation, predicted: Float[Tensor, "N rows 13"], tosses: Tosses) -> str:
    """The tables: whole tosses, and restarts from recorded rows, as far as these are finite."""
    known = torch.where(tosses.states.isfinite().all(-1).all(-1), tosses.steps, 0)
    scores = score_tosses(tosses.states, predicted, tosses.steps, tosses.half_width)
    lines = ["Whole tosses, from row 0", format_scores(scores)]
    if bool((known > 0).any()):
        restarts = score_restarts(lambda start, k: rollout(model, start, k), tosses.states, known, tosses.half_width)
        lines += ["", "Restarted from recorded rows", format_scores(restarts)]
    return "\n".join(lines)
