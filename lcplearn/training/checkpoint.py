"""Checkpoints: what is stored of a model, and how to get it back without Lightning."""

import importlib
from pathlib import Path
from typing import Any

import torch

from lcplearn.formulations import Formulation

PREFIX = "model."  # of the model's entries in the LightningModule's state


def describe(model: Formulation) -> dict[str, Any]:
    """Class and constructor arguments of a model, as plain values."""
    cls = type(model)
    return {"class": f"{cls.__module__}.{cls.__qualname__}", "arguments": dict(model.arguments)}


def load(path: str | Path, map_location: str | torch.device | None = None) -> Formulation:
    """Load a trained model, ready to predict.

    Only plain values are unpickled (`weights_only=True`). The model's class is imported by the name that stands in the
    file and must be a `Formulation`.

    Args:
        path: `best.ckpt` or `last.ckpt` of a run.
        map_location: Where to put the tensors; as they were saved by default.

    Returns:
        The model, in evaluation mode.

    Raises:
        ValueError: no such file, not a checkpoint of lcplearn, or its class is missing or has changed.
    """
    checkpoint = read(path, map_location)
    module, _, name = checkpoint["formulation"]["class"].rpartition(".")
    try:
        cls = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"{path} was made with the class {module}.{name}, which can't be imported here.") from error
    if not (isinstance(cls, type) and issubclass(cls, Formulation)):
        raise ValueError(f"{path} names the class {module}.{name}, which is not a Formulation.")
    state = {key.removeprefix(PREFIX): value for key, value in checkpoint["state_dict"].items()}
    try:
        model = cls(**checkpoint["formulation"]["arguments"])
        model.load_state_dict(state)
    except (TypeError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{path} was made with another version of {module}.{name}: {reason}") from error
    return model.to(map_location).eval() if map_location is not None else model.eval()


def read(path: str | Path, map_location: str | torch.device | None = None) -> dict[str, Any]:
    """Read a checkpoint's content.

    Raises:
        ValueError: no such file, or not a checkpoint of lcplearn.
    """
    if not Path(path).is_file():
        raise ValueError(f"There is no checkpoint {path}; a run's are runs/DATE_TIME/best.ckpt and last.ckpt.")
    try:
        checkpoint = torch.load(path, map_location=map_location, weights_only=True)
    except Exception as error:  # torch.load raises whatever its unpickler met: any of it means the same to the user
        raise ValueError(f"{path} is not a checkpoint that can be loaded safely: {type(error).__name__}.") from error
    if not isinstance(checkpoint, dict) or "formulation" not in checkpoint or "state_dict" not in checkpoint:
        raise ValueError(f"{path} is not a checkpoint of lcplearn.")
    return checkpoint


def check_resumable(path: str | Path, model: Formulation, objective: dict[str, Any], max_epochs: int) -> None:
    """Refuse a checkpoint of another model or loss, or one with nothing left to train.

    Raises:
        ValueError: one sentence that names the first difference.
    """
    checkpoint = read(path)
    saved, ours = checkpoint["formulation"], describe(model)
    if saved["class"] != ours["class"]:
        raise ValueError(f"{path} holds {saved['class']}, but the settings ask for {ours['class']}: change model=.")
    for name in sorted(saved["arguments"].keys() | ours["arguments"].keys()):
        before, now = saved["arguments"].get(name, "its default"), ours["arguments"].get(name, "its default")
        if before != now:
            raise ValueError(f"{path} was trained with model.{name}={before}, but the settings say {now}.")
    for name, before in checkpoint["objective"].items():
        if before != objective[name]:
            raise ValueError(f"{path} was trained with {name} {before}, but the settings say {objective[name]}.")
    # Lightning counts the epoch that is under way; a checkpoint is written at its end.
    done = checkpoint["epoch"] + 1
    if done >= max_epochs:
        raise ValueError(f"{path} has finished its {done} epochs: set trainer.max_epochs above {done} to go on.")
