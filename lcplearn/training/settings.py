"""Check what a user wrote, in one sentence each and without importing torch.

Settings are plain dictionaries here: only train.py knows Hydra. What a `_target_` accepts is read from its source.
"""

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from lcplearn.training.signatures import signature
from lcplearn.training.vocabulary import FROM_DATA, TRAINER, suggestion, unknown, vocabulary

# Ranges that the targets check too, seconds later: of data, model and optimizer.
POSITIVE = {
    *("dt", "mass", "trajectories", "length", "width", "initial_mass", "initial_mu", "lr", "lbfgs_iterations", "shift"),
}
AT_LEAST_0 = {"noise", "mu", "depth", "initial_noise", "lbfgs_after", "anneal_epochs"}
TYPES = {"int": (int,), "float": (int, float), "str": (str,), "bool": (bool,), "None": (type(None),), "Path": (str,)}


class SettingsError(ValueError):
    """A mistake in the settings; the message is one sentence for the person who wrote them."""


def check(settings: Mapping[str, Any], conf: Path, *, multirun: bool = False, processes: int = 1) -> None:
    """Refuse settings that can't be what was meant.

    Args:
        settings: The resolved settings of a run.
        conf: Folder of the configuration, whose train.yaml and folders name what may stand at the top level.
        multirun: True in a sweep.
        processes: How many torchrun started.

    Raises:
        SettingsError: the first mistake found.
    """
    for key in settings:
        if key not in vocabulary(conf, "")[0]:
            raise SettingsError(unknown(key, conf))
    for group in ("data", "model", "loss", "optimizer", "trainer"):
        if not settings.get(group):
            raise SettingsError(f"{group}: expected the name of a file in conf/{group}/, got {settings.get(group)}")
    for kind, keys in {
        "int": ("seed", "threads"),
        "int | None": ("batch_size", "batches", "patience"),
        "bool": ("allow_changes",),
    }.items():
        for key in keys:
            _check_type(key, settings.get(key), kind)
    if not isinstance(settings.get("stages"), list):
        raise SettingsError(f"stages: expected a list, [] for none, got {settings.get('stages')!r}")
    if settings["threads"] < 1:
        raise SettingsError(f"threads: expected at least 1, got {settings['threads']}")
    if settings["patience"] is not None and settings["patience"] < 1:
        raise SettingsError(f"patience: expected at least 1, or null for never, got {settings['patience']}")
    if not 0 <= settings["seed"] < 2**32:  # what NumPy's generator takes
        raise SettingsError(f"seed: expected at least 0 and below 2^32, got {settings['seed']}")
    _check_friction(settings)
    _check_pushes(settings, conf)
    for group in ("data", "model", "optimizer", "logger"):
        if settings.get(group) or group != "logger":  # logger=none is empty
            _check_target(group, settings[group])
    if settings["batch_size"] is not None and settings["optimizer"].get("lbfgs_after") is not None:
        raise SettingsError("LBFGS needs the full batch: set batch_size=null, or optimizer=adam.")
    _check_ranges(settings)
    _check_learn(settings["model"].get("learn", {}))
    own = not str(settings["model"].get("_target_")).startswith("lcplearn.")  # and may have loss terms of its own
    _check_loss(settings["loss"], settings["loss"] if own else vocabulary(conf, "loss")[0])
    length, horizon = settings["data"].get("length"), settings["loss"].get("horizon", 1)
    if length is not None and horizon > length:
        raise SettingsError(f"loss.horizon: expected at most data.length={length}, got {horizon}")
    _check_arguments("trainer", settings["trainer"], TRAINER)
    for key, default in (("max_epochs", None), ("check_val_every_n_epoch", 1)):
        epochs = settings["trainer"].get(key, default)
        if epochs is None or epochs < 1:
            raise SettingsError(f"trainer.{key}: expected at least 1, got {epochs}")
    if settings["trainer"].get("precision", "64-true") not in ("64-true", "64", 64):
        precision = settings["trainer"]["precision"]
        raise SettingsError(f"trainer.precision: expected 64-true, as sticking is judged at 1e-12 m/s, got {precision}")
    _check_processes(settings["trainer"], multirun, processes)
    _check_checkpoint(settings.get("ckpt_path"))


def check_torchrun(arguments: Sequence[str]) -> None:
    """Refuse a command whose processes, started by torchrun, would not write to one folder.

    Args:
        arguments: The command line; Hydra makes the folder before `check` is called.

    Raises:
        SettingsError: a sweep, or a folder that each process would name after its own clock.
    """
    if not {"-m", "--multirun"}.isdisjoint(arguments):
        raise SettingsError("torchrun trains one run: sweep (-m) without it, with trainer.strategy=ddp_fork.")
    if not {"--help", "--cfg", "-c", "--hydra-help"}.isdisjoint(arguments):
        return
    if not any(argument.lstrip("+").startswith("hydra.run.dir=") for argument in arguments):
        raise SettingsError("torchrun's processes need one folder: add hydra.run.dir=runs/NAME.")


def _check_processes(trainer: Mapping[str, Any], multirun: bool, processes: int) -> None:
    """Several processes train together, and none starts the sweep again."""
    strategy, devices = str(trainer.get("strategy", "auto")), trainer.get("devices", 1)
    count = len(devices) if isinstance(devices, list) else devices  # a list names them
    cores = os.cpu_count() or 1
    if trainer.get("accelerator") == "cpu" and isinstance(count, int) and count > cores:
        raise SettingsError(f"trainer.devices={count} would start {count} processes on {cores} cores.")
    forks = strategy.startswith(("ddp_fork", "ddp_spawn"))
    starts_again = not forks and (strategy.startswith("ddp") or count != 1)  # Lightning's auto is ddp for several
    if multirun and starts_again:
        raise SettingsError(
            f"A sweep (-m) can't run with trainer.strategy={strategy} and trainer.devices={devices}: "
            "use trainer.strategy=ddp_fork, or trainer.strategy=auto and one device."
        )
    alone = forks or not strategy.startswith("ddp")
    if processes > 1 and (alone or not isinstance(count, int) or count * trainer.get("num_nodes", 1) != processes):
        raise SettingsError(
            f"torchrun started {processes} processes: set trainer.strategy=ddp and trainer.devices={processes}, "
            "or on several nodes each one's trainer.devices and +trainer.num_nodes."
        )


def _check_ranges(settings: Mapping[str, Any]) -> None:
    for group in ("data", "model", "optimizer"):
        for key, value in settings[group].items():
            if isinstance(value, bool) or not isinstance(value, int | float):
                continue
            if key in POSITIVE and not 0 < value < float("inf"):
                raise SettingsError(f"{group}.{key}: expected a positive number, got {value}")
            if key in AT_LEAST_0 and not 0 <= value < float("inf"):
                raise SettingsError(f"{group}.{key}: expected at least 0, got {value}")


def _check_learn(learn: Any) -> None:
    """Starts of a scene's numbers, by name: numbers, or lists of them."""
    if not isinstance(learn, Mapping):
        raise SettingsError(f"model.learn: expected names and their starts, got {learn!r}")
    for name, start in learn.items():
        rows = start if isinstance(start, list) else [start]
        for number in (each for row in rows for each in (row if isinstance(row, list) else [row])):
            _check_type(f"model.learn.{name}", number, "float")


def _check_friction(settings: Mapping[str, Any]) -> None:
    """Models of known friction learn from labels, which of lcplearn's data only simulated ones have."""
    model = str(settings["model"].get("_target_")).rpartition(".")[2]
    data = str(settings["data"].get("_target_"))
    if model not in ("Direct", "PlanarDirect", "Slack") or not data.startswith("lcplearn."):
        return
    if model == "Slack" and "planar" in data:
        raise SettingsError(
            "model=slack is for a block on a line: in two directions the slacks don't determine the velocity."
        )
    accepted = signature(data)
    if accepted is not None and "friction" not in accepted:
        raise SettingsError(f"model={model.lower()} needs friction labels, which only simulated blocks have.")
    if not settings["data"].get("friction"):
        kinds = "slack" if model == "Slack" else "physical or data.friction=lcp"
        raise SettingsError(f"model={model.lower()} needs friction labels: set data.friction={kinds}.")


def _check_pushes(settings: Mapping[str, Any], conf: Path) -> None:
    """Models of pushes learn from pushes, and from nothing else; they fit themselves, so that no loss can be chosen."""
    models, data = (".pushing." in str(settings["model"].get("_target_")), settings["data"].get("_target_"))
    pushes = str(data).endswith("read_pushes")
    if models != pushes:
        asked = "data=pushes needs a model of pushes" if pushes else "a model of pushes needs data=pushes"
        raise SettingsError(f"{asked}: experiment=pushes_supports, pushes_residual, pushes_ridge, ...")
    if not pushes:
        return
    for group, choice in (("loss", "prediction"), ("optimizer", "adam_lbfgs"), ("trainer", "cpu")):
        content = yaml.safe_load((conf / group / f"{choice}.yaml").read_text())
        read = {"defaults", "enable_progress_bar"}  # the last of the trainer is heeded
        if any(settings[group].get(key) != value for key, value in content.items() if key not in read):
            raise SettingsError(f"{group} can't be chosen with data=pushes: these models fit themselves.")
    top = yaml.safe_load((conf / "train.yaml").read_text())
    for key in ("batch_size", "batches", "patience", "stages", "ckpt_path"):
        if settings.get(key) != top[key]:
            raise SettingsError(f"{key} can't be set with data=pushes: a fit takes seconds and is done as a whole.")


def _check_loss(loss: Mapping[str, Any], known: Iterable[str]) -> None:
    """Terms and horizon are those that the files in conf/loss/ name."""
    for key, value in loss.items():
        _known(key, sorted(known), "setting", prefix="loss.")
        _check_type(f"loss.{key}", value, "int" if key == "horizon" else "float")
        if not 0 <= value < float("inf"):
            raise SettingsError(f"loss.{key}: expected a finite number of at least 0, got {value}")
    if not any(value for key, value in loss.items() if key != "horizon"):
        raise SettingsError("loss: expected a positive weight, loss.prediction=1.0 for instance, got none")
    if loss.get("horizon", 1) < 1:
        raise SettingsError(f"loss.horizon: expected at least 1, got {loss['horizon']}")


def _check_checkpoint(path: Any) -> None:
    _check_type("ckpt_path", path, "str | None")
    if path is None or Path(path).is_file():
        return
    folder = Path(path) if Path(path).is_dir() else Path(path).parent
    there = sorted(str(file) for file in folder.glob("**/*.ckpt"))[:3] if folder != Path(".") else []
    hint = f"did you mean {' or '.join(there)}?" if there else "checkpoints are named runs/DATE_TIME/last.ckpt."
    raise SettingsError(f"ckpt_path={path} is not a file; {hint}")


def _check_target(group: str, values: Any) -> None:
    if not isinstance(values, Mapping) or not isinstance(values.get("_target_"), str):
        raise SettingsError(f"{group}: expected the name of a file in conf/{group}/, got {values!r}")
    arguments = {key: value for key, value in values.items() if not key.startswith("_")}
    _check_arguments(group, arguments, values["_target_"])


def _check_arguments(group: str, arguments: Mapping[str, Any], target: str) -> None:
    accepted = signature(target)
    if accepted is None:  # not written in Python, or re-exported: the call itself will tell
        return
    accepted = {name: kind for name, kind in accepted.items() if group != "model" or name not in FROM_DATA}
    for key, value in arguments.items():
        if "**" not in accepted:
            _known(key, accepted, "setting", prefix=f"{group}.")
        _check_type(f"{group}.{key}", value, accepted.get(key, ""))


def _known(key: str, known: Iterable[str], what: str, prefix: str = "") -> None:
    if key not in known:
        raise SettingsError(f"Unknown {what} '{prefix}{key}'; {suggestion(key, known, prefix)}")


def _check_type(name: str, value: Any, annotation: str) -> None:
    """Compare with an annotation made of int, float, str, bool, Path and None; others are the target's own business."""
    text = re.sub(r"Optional\[(\w+)\]", r"\1 | None", annotation.replace("typing.", ""))
    text = re.sub(r"Union\[([\w, ]+)\]", lambda match: match[1].replace(",", " |"), text)
    kinds = [kind.strip() for kind in text.split("|")]
    if not all(kind in TYPES for kind in kinds):
        return
    allowed = tuple(cls for kind in kinds for cls in TYPES[kind])
    wrong_bool = isinstance(value, bool) and bool not in allowed  # bool is an int to isinstance
    if wrong_bool or not isinstance(value, allowed):
        raise SettingsError(f"{name}: expected {' or '.join(kinds)}, got {value!r}")


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested values by dotted names."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        found |= flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return found
