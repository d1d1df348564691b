"""What a training was asked for, as plain values: for config.yaml, for a resumption and for HPARAMS."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from lcplearn.datasets import Task
from lcplearn.formulations import Formulation
from lcplearn.formulations.pushing import PushModel
from lcplearn.training.checkpoint import describe, plain
from lcplearn.training.module import FormulationModule
from lcplearn.training.vocabulary import FROM_DATA


def hyperparameters(module: FormulationModule, used: Mapping[str, Any], epochs: int) -> dict[str, Any]:
    """What tells runs apart, the same names for every model, so that a table of many runs has one column for each."""
    described = module.described
    arguments = {name: value for name, value in described["formulation"]["arguments"].items() if name not in FROM_DATA}
    weights = described["objective"]["loss"]
    # TensorBoard sorts them by name and shows the first five: numbers make these the five that matter.
    return {
        "1 model": described["formulation"]["class"].rpartition(".")[2],
        "2 seed": used["seed"],
        "3 noise": used["data"].get("noise", ""),
        "4 lr": used["optimizer"]["lr"],
        "5 epochs": epochs,
        "batch_size": used["batch_size"] or "all",
        "horizon": module.stages[-1].horizon,
        "loss": " ".join(f"{name}={weight:g}" for name, weight in weights.items()),
        "model arguments": " ".join(f"{name}={value}" for name, value in arguments.items()),
    }


def described_data(data: Task, settings: Mapping[str, Any] | None) -> dict[str, Any]:
    """The data's settings as far as they are known, and a fingerprint of what is learned from."""
    digest = hashlib.sha256()
    for part in (data.train, data.validation):
        for tensor in (part.states, *part.drive, part.steps, part.true_states):
            if tensor is not None:
                digest.update(tensor.detach().cpu().numpy().tobytes())
    known = {name: value for name, value in (settings or {}).get("data", {}).items() if name != "path"}
    return known | {"recordings": digest.hexdigest()[:16]}


def write_config(folder: Path, settings: Mapping[str, Any]) -> None:
    """Write config.yaml, which marks the folder as taken: of two runs at once in one folder, the second is refused."""
    text = yaml.safe_dump(plain(settings), sort_keys=False)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with (folder / "config.yaml").open("x") as file:
            file.write(text)
    except FileExistsError:
        raise taken(folder) from None


def setting(value: Any) -> Any:
    """A callback, as others that are no settings, by the name of its class."""
    if isinstance(value, list | tuple):
        return [setting(each) for each in value]
    value = plain(value)
    return value if value is None or isinstance(value, str | int | float) else type(value).__name__


def described_model(model: Formulation | PushModel) -> dict[str, Any]:
    """A model as a configuration names it."""
    described = describe(model)
    return {"_target_": described["class"], **described["arguments"]}


def taken(folder: Path) -> ValueError:
    """The error that saves a run from being overwritten."""
    return ValueError(f"{folder} holds a run already: choose another folder, nothing is overwritten.")
