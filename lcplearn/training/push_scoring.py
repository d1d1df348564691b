"""Score a trained model of pushes on a file of pushes, and write what it predicts."""

from pathlib import Path

import numpy as np
import torch

from lcplearn.datasets.pushes import read_all_pushes
from lcplearn.formulations.pushing import PushModel
from lcplearn.training.push_metrics import by_configuration, errors, format_score, intervals
from lcplearn.training.writing import replace


@torch.no_grad()
def score_pushes(model: PushModel, path: str | Path, output: str | Path | None = None) -> str:
    """Judge a model on all pushes of a file; it sees path, start pose and configuration only.

    Args:
        model: The model.
        path: A file like planar_pushes.npz. Without end poses and forces there is nothing to judge by.
        output: NPZ file for the predictions, `post_pose` [m, m, rad] and, if the model has one, `force` [N].

    Returns:
        The figures with bootstrap intervals, and by configuration, as text.

    Raises:
        ValueError: the file is not as described in data/README.md, holds another object or a surface that the model
            has not learned, or `output` is no NPZ file.
    """
    if output is not None and Path(output).suffix != ".npz":
        raise ValueError(f"{output}: predictions of pushes are written as .npz.")
    data = read_all_pushes(path)
    for name in ("vertices", "com", "mass"):
        ours, theirs = (np.asarray(value) for value in (model.arguments[name], getattr(data, name)))
        if ours.shape != theirs.shape or not np.allclose(ours, theirs, rtol=1e-6):
            raise ValueError(
                f"{path}: {name}: expected {ours.tolist()}, of the object that was learned, got {theirs.tolist()}"
            )
    prediction = model.predict(data.pushes)
    if output is not None:
        arrays = {"post_pose": prediction.pose.numpy()}
        if prediction.force is not None:
            arrays["force"] = prediction.force.numpy()
        replace(output, lambda file: np.savez(file, **arrays))  # type: ignore[arg-type]
    unsolved = int((~prediction.solved).sum())
    text = f"{type(model).__name__}: {len(data.configuration)} pushes, {unsolved} of them not solved"
    if bool(data.outcome.pose.isnan().any()):
        return f"{text}; the file has no end poses to judge by"
    found = errors(model, data, prediction)
    return f"{text}\n\n{format_score(found.figures(), intervals(found, data), by_configuration(found, data))}"
