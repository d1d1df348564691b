"""Checkpoints: what is stored of a model, and how to get it back without Lightning."""

import importlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lcplearn.formulations import FORMULATIONS, Formulation
from lcplearn.formulations.baselines import Baseline
from lcplearn.formulations.pushing import PushModel
from lcplearn.scenes.space import Space

PREFIX = "model."  # of the model's entries in the LightningModule's state


def describe(model: Formulation | PushModel) -> dict[str, Any]:
    """Class and constructor arguments of a model, as plain values."""
    return {"class": _name(type(model)), "arguments": {k: plain(value) for k, value in model.arguments.items()}}


def _name(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"


def plain(value: Any) -> Any:
    """A value as `weights_only` and YAML read it back: numbers of numpy become Python's, classes their names."""
    if isinstance(value, type):
        return _name(value)
    if isinstance(value, torch.Tensor | np.ndarray | np.generic):  # a dt that numpy computed, say
        return value.tolist()
    if isinstance(value, Mapping):
        return {name: plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        each = map(plain, value)
        return list(each) if isinstance(value, list) else tuple(each)
    if isinstance(value, Space):
        return {name: list(each) if isinstance(each, tuple) else each for name, each in vars(value).items()}
    return value


def _restored(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Constructor arguments as `describe` found them."""
    if not isinstance(space := arguments.get("space"), Mapping):
        return dict(arguments)
    names = {name: tuple(space[name]) for name in ("positions", "velocities")}
    return {**arguments, "space": Space(**names, rotations=space["rotations"])}


def load(path: str | Path, map_location: str | torch.device | None = None, *, trust: bool = False) -> Any:
    """Load a trained model, ready to predict.

    Only plain values are unpickled (`weights_only=True`). The model's class, and that of its scene, are imported by the
    names that stand in the file. Importing runs code, so only lcplearn's own modules and those that are imported
    already are looked at, unless the file is trusted.

    Args:
        path: `best.ckpt` or `last.ckpt` of a run.
        map_location: Where to put the tensors; as they were saved by default.
        trust: Import whatever module the file names.

    Returns:
        The model, a `Formulation` or a `PushModel`, in evaluation mode.

    Raises:
        ValueError: no such file, not a checkpoint of lcplearn, its class is missing, has changed or would have to be
            imported from elsewhere, or a parameter is not finite.
    """
    checkpoint = read(path, map_location)
    for imported in (checkpoint["formulation"]["class"], checkpoint["formulation"]["arguments"].get("scene")):
        module = str(imported or "").rpartition(".")[0]
        if module and not (trust or module in sys.modules or module.startswith("lcplearn.")):
            raise ValueError(
                f"{path} was made with the class {imported}, and importing {module} runs its code: if you trust the "
                f"file, import {module} first, or load with trust=True (--trust on a command line)."
            )
    module, _, name = checkpoint["formulation"]["class"].rpartition(".")
    ours = {cls.__name__: cls for cls in FORMULATIONS.values()}
    try:
        moved = module.startswith("lcplearn.formulations.") and name in ours
        cls = ours[name] if moved else getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"{path} was made with the class {module}.{name}, which can't be imported here.") from error
    if not (isinstance(cls, type) and issubclass(cls, Formulation | PushModel)):
        raise ValueError(f"{path} names the class {module}.{name}, which is not a Formulation.")
    state = {key.removeprefix(PREFIX): value for key, value in checkpoint["state_dict"].items()}
    wrong = [key for key, value in state.items() if not bool(torch.as_tensor(value).isfinite().all())]
    if wrong:
        raise ValueError(f"{path}: {wrong[0]} is not finite; the training that wrote it had diverged.")
    try:
        arguments = _restored(checkpoint["formulation"]["arguments"])
        if issubclass(cls, Baseline):
            arguments.pop("gravity", None)  # in version 0.1 they took it, without a use for it
        model = cls(**arguments)
        model.load_state_dict(state)
    except (TypeError, ValueError, KeyError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{path} was made with another version of {module}.{name}: {reason}") from error
    return model.to(map_location).eval() if map_location is not None else model.eval()


def read(path: str | Path, map_location: str | torch.device | None = None) -> dict[str, Any]:
    """Read a checkpoint's content.

    Raises:
        ValueError: no such file, or not a checkpoint of lcplearn.
    """
    if not Path(path).is_file():
        raise ValueError(f"There is no checkpoint {path}; the last run has runs/latest/best.ckpt and last.ckpt.")
    try:
        checkpoint = torch.load(path, map_location=map_location, weights_only=True)
    except Exception as error:  # torch.load raises whatever its unpickler met: any of it means the same to the user
        raise ValueError(
            f"{path} is not a checkpoint that can be loaded safely: it is truncated, another kind of file, or holds "
            f"more than plain values ({type(error).__name__})."
        ) from error
    if not (isinstance(checkpoint, dict) and _well_formed(checkpoint)):
        raise ValueError(f"{path} is not a checkpoint of lcplearn.")
    return checkpoint


def _well_formed(checkpoint: Mapping[str, Any]) -> bool:
    formulation, state = checkpoint.get("formulation"), checkpoint.get("state_dict")
    return (
        isinstance(formulation, dict)
        and isinstance(formulation.get("class"), str)
        and isinstance(formulation.get("arguments"), dict)
        and isinstance(state, dict)
        and all(isinstance(value, torch.Tensor) for value in state.values())
    )


def check_resumable(
    path: str | Path, ours: Mapping[str, Any], max_epochs: int, *, allow_changes: bool
) -> dict[str, Any]:
    """Refuse a checkpoint of another training, or one with nothing left to train.

    Args:
        path: The checkpoint.
        ours: What this training does, as in a checkpoint: formulation, objective and training.
        max_epochs: How many epochs this training has.
        allow_changes: Whether seed, data, optimizer and batch size may differ.

    Returns:
        What differs, by name: [before, now].

    Raises:
        ValueError: one sentence that names the first difference.
    """
    checkpoint = read(path)
    if not {"objective", "training", "epoch"} <= set(checkpoint):
        raise ValueError(
            f"{path} holds a model, but no training that could go on, as those of lcplearn 0.1: "
            "it predicts, and is trained further from the start, without ckpt_path."
        )
    saved, now = checkpoint["formulation"], ours["formulation"]
    # By name: a module may have moved since.
    if saved["class"].rpartition(".")[2] != now["class"].rpartition(".")[2]:
        raise ValueError(f"{path} holds {saved['class']}, but the settings ask for {now['class']}: change model=.")
    for name, (before, after) in _differences(saved["arguments"], now["arguments"]).items():
        raise ValueError(f"{path} was trained with model.{name}={before}, but the settings say {after}.")
    for name, before in checkpoint["objective"].items():
        if before != ours["objective"][name]:
            raise ValueError(
                f"{path} was trained with {name} {before}, but the settings say {ours['objective'][name]}."
            )
    changed = _differences(checkpoint["training"], ours["training"])
    if "data.recordings" not in changed:  # the same numbers, however they were asked for
        changed = {name: pair for name, pair in changed.items() if not name.startswith("data.")}
    if changed and not allow_changes:
        # That recordings differ follows from another setting, unless it is the only difference.
        name, (before, after) = next(iter(sorted(changed.items(), key=lambda item: item[0] == "data.recordings")))
        raise ValueError(
            f"{path} was trained with {name}={before}, but the settings say {after}: to go on all the same, "
            "add allow_changes=true."
        )
    # Lightning counts the epoch that is under way; a checkpoint is written at its end.
    done = checkpoint["epoch"] + 1
    if done >= max_epochs:
        raise ValueError(f"{path} has finished its {done} epochs: set trainer.max_epochs above {done} to go on.")
    return changed


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, list[Any]]:
    default = "its default"
    names = sorted(before.keys() | now.keys())
    pairs = {name: [before.get(name, default), now.get(name, default)] for name in names}
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}
