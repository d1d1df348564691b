"""Train a formulation from Python: data in, figures and checkpoints out."""

import hashlib
import json
import logging
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
import yaml
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from torch.multiprocessing import ProcessRaisedException
from torch.utils.data import DataLoader

from lcplearn.datasets import BlockData, WindowLoader, windows
from lcplearn.formulations import Formulation, Windows, loss_terms
from lcplearn.training.callbacks import (
    BestCheckpoint,
    Divergence,
    EarlyStop,
    EpochBar,
    LastCheckpoint,
    Report,
    TrainingDivergedError,
)
from lcplearn.training.checkpoint import check_resumable, describe, read
from lcplearn.training.module import VALIDATION, FormulationModule
from lcplearn.training.optimizer import Optimizer
from lcplearn.training.results import leave
from lcplearn.training.settings import FROM_DATA
from lcplearn.training.writing import AtomicCheckpointIO

DEFAULTS = {"precision": "64-true", "accelerator": "cpu", "devices": 1, "enable_model_summary": False}


class TrainingInterrupted(KeyboardInterrupt):
    """Training was stopped by a signal; `checkpoint` is where it can be resumed."""

    def __init__(self, checkpoint: Path) -> None:
        super().__init__(f"training stopped; resume with ckpt_path={checkpoint}")
        self.checkpoint = checkpoint


@dataclass(frozen=True)
class Result:
    """What a training gave.

    Attributes:
        model: The model with the parameters that validated best.
        metrics: Figures on the test data, see `metrics.KEYS`; None on processes other than the first.
        validation: Smallest velocity error on the validation data, over the steps of a window [m/s].
        folder: Folder of the run.
    """

    model: Formulation
    metrics: dict[str, float | None] | None
    validation: float
    folder: Path


def fit(
    model: Formulation,
    data: BlockData,
    *,
    loss: Mapping[str, float] | None = None,
    horizon: int = 1,
    epochs: int = 200,
    batch_size: int | None = None,
    optimizer: Optimizer | None = None,
    patience: int | None = 5,
    folder: str | Path | None = None,
    ckpt_path: str | Path | None = None,
    allow_changes: bool = False,
    seed: int = 0,
    logger: Any = None,
    trainer: Mapping[str, Any] | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Result:
    """Train a formulation and judge it on the test data.

    Args:
        model: What to train; its parameters are changed in place.
        data: Recordings to learn from.
        loss: Weights of the loss terms; {"prediction": 1.0} by default.
        horizon: Steps of a training window; only the rollout loss uses more than one.
        epochs: Epochs to train at most.
        batch_size: Windows in a batch; None for the full batch, which is best for these small models.
        optimizer: Adam alone by default.
        patience: Validations without improvement after which to stop; None to go on.
        folder: Where the run is written; a new folder runs/DATE_TIME by default.
        ckpt_path: Checkpoint to resume from.
        allow_changes: Resume although seed, data, optimizer or batch size have changed; config.yaml then says how.
        seed: Seed of the order of the batches.
        logger: A Lightning logger; none by default.
        trainer: Further keyword arguments of Lightning's Trainer.
        settings: What config.yaml shall say, for `lcplearn.compare`; the arguments of this call by default.

    Returns:
        The model, its figures and the folder with best.ckpt, last.ckpt, metrics.json, config.yaml and pictures.

    Raises:
        ValueError: loss, data and model don't fit, no epoch, a checkpoint that can't be resumed, or a folder that
            holds a run already.
        TrainingDivergedError: a number was not finite; best.ckpt holds the best model before, if there was one.
        TrainingInterrupted: a signal ended the training.
    """
    loss, optimizer = dict(loss or {"prediction": 1.0}), optimizer or Optimizer()
    if (model.dt, model.gravity) != (data.dt, data.gravity):
        raise ValueError(
            f"model: expected dt = {data.dt} s and gravity = {data.gravity} m/s^2 as in the data, "
            f"got {model.dt} and {model.gravity}"
        )
    if epochs < 1:
        raise ValueError(f"epochs: expected at least 1, got {epochs}")
    folder = _new_folder(folder)
    _quiet()
    batches, validation = windows(data.train, horizon), windows(data.validation, horizon)
    _try_once(model, _first(batches), loss)
    loader = WindowLoader(batches, batch_size=batch_size, shuffle=batch_size is not None, seed=seed)
    chosen = {"max_epochs": epochs, "check_val_every_n_epoch": 10, **DEFAULTS, **(trainer or {})}
    every = chosen["check_val_every_n_epoch"] = min(chosen["check_val_every_n_epoch"], epochs)
    used = {"seed": seed, "batch_size": batch_size, "optimizer": asdict(optimizer), "data": _data(data, settings)}
    module = FormulationModule(
        model, loss=loss, horizon=horizon, optimizer=optimizer, training=_flat(used),
        log_every=every * (len(loader) if batch_size else 1),
    )  # fmt: skip
    best, last = BestCheckpoint(folder, ckpt_path), LastCheckpoint(folder / "last.ckpt", every)
    callbacks = [Divergence(folder), best, last, Report(data), *chosen.pop("callbacks", [])]
    if chosen.get("enable_progress_bar", True):
        callbacks.append(EpochBar())
    if patience is not None:
        callbacks.append(EarlyStop(VALIDATION, patience=patience))
    if chosen["precision"] not in ("64-true", "64", 64):
        raise ValueError(
            f"trainer: expected precision 64-true, as sticking is judged at 1e-12 m/s, got {chosen['precision']}"
        )
    if chosen["accelerator"] in ("cuda", "gpu") and not torch.cuda.is_available():
        raise ValueError("torch finds no CUDA device here: use trainer=cpu (trainer={'accelerator': 'cpu'}).")
    with _trainer_errors():
        lightning_trainer = pl.Trainer(
            default_root_dir=folder, callbacks=callbacks, logger=logger or False, num_sanity_val_steps=0,
            plugins=[AtomicCheckpointIO(), *_plugins(chosen.pop("plugins", None))], **chosen,
        )  # fmt: skip
    seconds, resumed = 0.0, None
    if ckpt_path is not None:
        changed = check_resumable(ckpt_path, module.described, epochs, allow_changes=allow_changes)
        before = read(ckpt_path)
        seconds, resumed = before["train_seconds"], {"from": str(ckpt_path), "changed": changed}
        resumed |= {"epochs": before["epoch"] + 1} if changed else {}
    if lightning_trainer.is_global_zero:
        rest = {
            "loss": loss,
            "horizon": horizon,
            "epochs": epochs,
            "patience": patience,
            "trainer": {key: _plain(value) for key, value in (trainer or {}).items()},
        }
        says = dict(settings) if settings else {"model": _model(model), **used, **rest}
        _write_config(folder, says | ({"resumed": resumed} if resumed else {}))
    seconds += _run(lightning_trainer, module, loader, validation, folder, ckpt_path)
    if last.stopped:
        raise TrainingInterrupted(last.path)
    trained, error = _best(module, best)
    if not lightning_trainer.is_global_zero:
        return Result(trained, None, error, folder)
    shown = _hyperparameters(module, used, epochs)
    return Result(trained, leave(lightning_trainer, trained, data, folder, shown, seconds), error, folder)


def _run(
    trainer: pl.Trainer,
    module: FormulationModule,
    loader: WindowLoader,
    validation: Windows,
    folder: Path,
    ckpt_path: str | Path | None,
) -> float:
    """Train, and return how long it took [s]."""
    start = time.perf_counter()
    validation_loader = DataLoader([validation], batch_size=None)  # type: ignore[arg-type, var-annotated]  # one batch
    try:
        with _trainer_errors():
            trainer.fit(module, loader, validation_loader, ckpt_path=ckpt_path, weights_only=True)
    except ProcessRaisedException:  # of strategy=ddp_fork, which knows the exception as text only
        figures = folder / "metrics.json"
        if not figures.is_file():
            raise
        raise TrainingDivergedError(json.loads(figures.read_text())["diverged"]) from None
    return time.perf_counter() - start


def _best(module: FormulationModule, best: BestCheckpoint) -> tuple[Formulation, float]:
    """The model with the parameters that validated best, and their error."""
    error = float("nan")
    if best.best_model_path:
        # From the file and not from the callback: that one stayed in another process with strategy=ddp_fork.
        checkpoint = read(best.best_model_path, "cpu")
        module.load_state_dict(checkpoint["state_dict"])
        error = float(checkpoint["callbacks"][best.state_key]["best_model_score"])
    return module.model.cpu().eval(), error


def _hyperparameters(module: FormulationModule, used: Mapping[str, Any], epochs: int) -> dict[str, Any]:
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
        "horizon": module.horizon,
        "loss": " ".join(f"{name}={weight:g}" for name, weight in weights.items()),
        "model arguments": " ".join(f"{name}={value}" for name, value in arguments.items()),
    }


def _data(data: BlockData, settings: Mapping[str, Any] | None) -> dict[str, Any]:
    """The data's settings as far as they are known, and a fingerprint of what is learned from."""
    digest = hashlib.sha256()
    for part in (data.train, data.validation):
        for tensor in part:
            if tensor is not None:
                digest.update(tensor.detach().cpu().numpy().tobytes())
    known = {name: value for name, value in (settings or {}).get("data", {}).items() if name != "path"}
    return known | {"recordings": digest.hexdigest()[:16]}


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return flat


def _write_config(folder: Path, settings: Mapping[str, Any]) -> None:
    """Write config.yaml, which marks the folder as taken: of two runs at once in one folder, the second is refused."""
    text = yaml.safe_dump(dict(settings), sort_keys=False)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with (folder / "config.yaml").open("x") as file:
            file.write(text)
    except FileExistsError:
        raise _taken(folder) from None


def _plain(value: Any) -> Any:
    """A callback, as others that are no settings, by the name of its class."""
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return value if value is None or isinstance(value, str | int | float) else type(value).__name__


def _plugins(given: Any) -> list[Any]:
    return [] if given is None else list(given) if isinstance(given, list | tuple) else [given]


def _try_once(model: Formulation, window: Windows, loss: Mapping[str, float]) -> None:
    """Refuse what doesn't fit before anything is written, and compile the solver before the clock starts."""
    torch.stack([*loss_terms(model, window, loss).values()]).sum().backward()
    model.zero_grad()


def _new_folder(folder: str | Path | None) -> Path:
    folder = Path(folder) if folder is not None else Path("runs") / f"{datetime.now():%Y-%m-%d_%H-%M-%S-%f}"
    # The other processes of strategy=ddp start when the first has already written its settings there.
    if getattr(rank_zero_only, "rank", 0) == 0 and (folder / "config.yaml").exists():
        raise _taken(folder)
    return folder


def _taken(folder: Path) -> ValueError:
    return ValueError(f"{folder} holds a run already: choose another folder, nothing is overwritten.")


@contextmanager
def _trainer_errors() -> Iterator[None]:
    """Settings that Lightning refuses, such as a device that isn't there, are the caller's mistake."""
    try:
        yield
    except MisconfigurationException as error:
        raise ValueError(f"Lightning's Trainer can't use these settings: {' '.join(str(error).split())}") from error


def _first(batch: Windows) -> Windows:
    friction = None if batch.friction is None else batch.friction[:1]
    return Windows(batch.velocity[:1], batch.force[:1], friction, batch.valid[:1])


def _model(model: Formulation) -> dict[str, Any]:
    described = describe(model)
    return {"_target_": described["class"], **described["arguments"]}


def _quiet() -> None:
    """Silence, by message, what a user can't act on."""
    for name in ("pytorch.utilities.rank_zero", "fabric.utilities.rank_zero", "fabric.utilities.distributed"):
        logging.getLogger(f"lightning.{name}").setLevel(logging.WARNING)
    for message in (
        r".*isinstance\(treespec, LeafSpec\)",
        r".*does not have many workers",
        r".*smaller than the logging interval",
        r".*Checkpoint directory .* exists and is not empty",
        r".*The dirpath has changed from",
    ):
        warnings.filterwarnings("ignore", message=message)
