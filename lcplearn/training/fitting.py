"""Train a formulation from Python: data in, figures and checkpoints out."""

import json
import logging
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from torch.multiprocessing import ProcessRaisedException
from torch.utils.data import DataLoader

from lcplearn.datasets import Task, WindowLoader, Windows, windows
from lcplearn.formulations import Formulation, loss_terms
from lcplearn.scenes.space import Space
from lcplearn.training.asked import described_data, described_model, flat, hyperparameters, plain, taken, write_config
from lcplearn.training.callbacks import (
    BestCheckpoint,
    Divergence,
    EarlyStop,
    EpochBar,
    LastCheckpoint,
    Report,
    TrainingDivergedError,
)
from lcplearn.training.checkpoint import check_resumable, read
from lcplearn.training.module import FormulationModule
from lcplearn.training.optimizer import Optimizer
from lcplearn.training.results import leave
from lcplearn.training.stages import plan
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
        metrics: Figures on the test data, see `metrics.evaluate`; None on processes other than the first.
        validation: Smallest velocity error on the validation data, over the steps of a window [m/s].
        folder: Folder of the run.
    """

    model: Formulation
    metrics: dict[str, float | None] | None
    validation: float
    folder: Path


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence, by message and for the time of a training, what a user can't act on."""
    names = ("pytorch.utilities.rank_zero", "fabric.utilities.rank_zero", "fabric.utilities.distributed")
    loggers = [logging.getLogger(f"lightning.{name}") for name in names]
    levels = [logger.level for logger in loggers]
    with warnings.catch_warnings():
        for message in (
            r".*isinstance\(treespec, LeafSpec\)",
            r".*does not have many workers",
            r".*smaller than the logging interval",
            r".*Checkpoint directory .* exists and is not empty",
            r".*The dirpath has changed from",
        ):
            warnings.filterwarnings("ignore", message=message)
        for logger in loggers:
            logger.setLevel(logging.WARNING)
        try:
            yield
        finally:
            for logger, level in zip(loggers, levels, strict=True):
                logger.setLevel(level)


@_quiet()
def fit(
    model: Formulation,
    data: Task,
    *,
    loss: Mapping[str, float] | None = None,
    horizon: int = 1,
    stages: Sequence[Mapping[str, Any]] = (),
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
        stages: What comes before, each with its epochs and what differs: lr, a shorter horizon, weights of loss terms.
        epochs: Epochs to train at most, those of stages included.
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
    _check_agreement(model, data)
    if epochs < 1:
        raise ValueError(f"epochs: expected at least 1, got {epochs}")
    folder = _new_folder(folder)
    planned = plan(stages, loss=loss, horizon=horizon, epochs=epochs, lr=optimizer.lr)
    batches = windows(data.train, horizon)
    validation = windows(data.validation, horizon if data.chosen_by == "rollout" else None)
    for stage in planned:
        _try_once(model, batches.map(lambda values: values[:1]).first(stage.horizon), stage.loss)
    loader = WindowLoader(batches, batch_size=batch_size, shuffle=batch_size is not None, seed=seed)
    chosen = {"max_epochs": epochs, "check_val_every_n_epoch": 10, **DEFAULTS, **(trainer or {})}
    every = chosen["check_val_every_n_epoch"] = min(chosen["check_val_every_n_epoch"], epochs)
    used = {
        "seed": seed,
        "batch_size": batch_size,
        "optimizer": asdict(optimizer),
        "stages": [dict(stage) for stage in stages],
        "data": described_data(data, settings),
    }
    module = FormulationModule(
        model, stages=planned, optimizer=optimizer, chosen_by=data.chosen_by, training=flat(used),
        log_every=every * (len(loader) if batch_size else 1),
    )  # fmt: skip
    best, last = BestCheckpoint(folder, module.monitor, ckpt_path), LastCheckpoint(folder / "last.ckpt", every)
    callbacks = [Divergence(folder), best, last, Report(data), *chosen.pop("callbacks", [])]
    if chosen.get("enable_progress_bar", True):
        callbacks.append(EpochBar())
    if patience is not None:
        callbacks.append(EarlyStop(module.monitor, patience=patience))
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
            "trainer": {key: plain(value) for key, value in (trainer or {}).items()},
        }
        says = dict(settings) if settings else {"model": described_model(model), **used, **rest}
        write_config(folder, says | ({"resumed": resumed} if resumed else {}))
    seconds += _run(lightning_trainer, module, loader, validation, folder, ckpt_path)
    if last.stopped:
        raise TrainingInterrupted(last.path)
    trained, error = _best(module, best)
    if not lightning_trainer.is_global_zero:
        return Result(trained, None, error, folder)
    shown = hyperparameters(module, used, epochs)
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


def _plugins(given: Any) -> list[Any]:
    return [] if given is None else list(given) if isinstance(given, list | tuple) else [given]


def _check_agreement(model: Formulation, data: Task) -> None:
    """A model of another time step, space or gravity would learn, but something else."""
    ours = {"dt": model.dt, "space": model.space, **model.given}
    theirs = {"dt": data.dt, "space": data.space, **data.given}
    for name in sorted(ours.keys() & theirs.keys()):
        if isinstance(ours[name], int | float | Space) and ours[name] != theirs[name]:
            raise ValueError(f"model: expected {name} = {theirs[name]} as in the data, got {ours[name]}")


def _try_once(model: Formulation, window: Windows, loss: Mapping[str, float]) -> None:
    """Refuse what doesn't fit before anything is written, and compile the solver before the clock starts."""
    torch.stack([*loss_terms(model, window, loss).values()]).sum().backward()
    for name, parameter in model.named_parameters():
        if parameter.requires_grad and parameter.grad is None:
            terms = ", ".join(term for term, weight in loss.items() if weight)
            raise ValueError(
                f"model: expected a loss ({terms}) that depends on all that is learned, got no {name} in it"
            )
    model.zero_grad()


def _new_folder(folder: str | Path | None) -> Path:
    folder = Path(folder) if folder is not None else Path("runs") / f"{datetime.now():%Y-%m-%d_%H-%M-%S-%f}"
    # The other processes of strategy=ddp start when the first has already written its settings there.
    if getattr(rank_zero_only, "rank", 0) == 0 and (folder / "config.yaml").exists():
        raise taken(folder)
    return folder


@contextmanager
def _trainer_errors() -> Iterator[None]:
    """Settings that Lightning refuses, such as a device that isn't there, are the caller's mistake."""
    try:
        yield
    except MisconfigurationException as error:
        raise ValueError(f"Lightning's Trainer can't use these settings: {' '.join(str(error).split())}") from error
