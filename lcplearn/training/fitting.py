"""Train a formulation from Python: data in, figures and checkpoints out."""

import json
import logging
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
import yaml
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from torch.utils.data import DataLoader

from lcplearn.datasets import BlockData, WindowLoader, windows
from lcplearn.formulations import Formulation, Windows, loss_terms
from lcplearn.training import figures
from lcplearn.training.callbacks import BestCheckpoint, EarlyStop, EpochBar, LastCheckpoint, Report
from lcplearn.training.checkpoint import check_resumable, describe, read
from lcplearn.training.metrics import evaluate, table
from lcplearn.training.module import VALIDATION, FormulationModule
from lcplearn.training.optimizer import Optimizer

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
        seed: Seed of the order of the batches.
        logger: A Lightning logger; none by default.
        trainer: Further keyword arguments of Lightning's Trainer.
        settings: What config.yaml shall say, for `lcplearn.compare`; the arguments of this call by default.

    Returns:
        The model, its figures and the folder with best.ckpt, last.ckpt, metrics.json, config.yaml and pictures.

    Raises:
        ValueError: loss, data and model don't fit, no epoch, a checkpoint that can't be resumed, or a folder that
            holds a run already.
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
    best = BestCheckpoint(folder, "best", monitor=VALIDATION, enable_version_counter=False)
    last = LastCheckpoint(folder / "last.ckpt", every)
    callbacks: list[pl.Callback] = [best, last, Report(data), *chosen.pop("callbacks", [])]
    if chosen.get("enable_progress_bar", True):
        callbacks.append(EpochBar())
    if patience is not None:
        callbacks.append(EarlyStop(VALIDATION, patience=patience))
    with _trainer_errors():
        lightning_trainer = pl.Trainer(
            default_root_dir=folder, callbacks=callbacks, logger=logger or False, num_sanity_val_steps=0, **chosen
        )
    module = FormulationModule(
        model, loss=loss, horizon=horizon, optimizer=optimizer, log_every=every * (len(loader) if batch_size else 1)
    )
    seconds_before = 0.0
    if ckpt_path is not None:
        check_resumable(ckpt_path, model, module.objective, epochs)
        seconds_before = read(ckpt_path)["train_seconds"]
    if lightning_trainer.is_global_zero:
        folder.mkdir(parents=True, exist_ok=True)
        settings = settings or _settings(model, loss=loss, horizon=horizon, seed=seed, epochs=epochs)
        (folder / "config.yaml").write_text(yaml.safe_dump(dict(settings), sort_keys=False))
    start = time.perf_counter()
    validation_loader = DataLoader([validation], batch_size=None)  # type: ignore[arg-type, var-annotated]  # one batch
    with _trainer_errors():
        lightning_trainer.fit(module, loader, validation_loader, ckpt_path=ckpt_path, weights_only=True)
    if last.stopped:
        raise TrainingInterrupted(last.path)
    return _finish(lightning_trainer, module, best, data, folder, seconds_before + time.perf_counter() - start)


def _try_once(model: Formulation, window: Windows, loss: Mapping[str, float]) -> None:
    """Refuse what doesn't fit before anything is written, and compile the solver before the clock starts."""
    torch.stack([*loss_terms(model, window, loss).values()]).sum().backward()
    model.zero_grad()


def _finish(
    trainer: pl.Trainer,
    module: FormulationModule,
    best: BestCheckpoint,
    data: BlockData,
    folder: Path,
    seconds: float,
) -> Result:
    """Take the best parameters, judge them and write what a run leaves; only the first process writes."""
    model, validation = module.model.cpu().eval(), float("nan")
    if best.best_model_path:
        # From the file and not from the callback: that one stayed in another process with strategy=ddp_fork.
        checkpoint = read(best.best_model_path, "cpu")
        module.load_state_dict(checkpoint["state_dict"])
        validation = float(checkpoint["callbacks"][best.state_key]["best_model_score"])
    if not trainer.is_global_zero:
        return Result(model, None, validation, folder)
    metrics = evaluate(model, data, train_seconds=seconds)
    (folder / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n")
    pictures = figures.draw(model, data)
    for name, figure in pictures.items():
        figure.savefig(folder / f"{name}.png", dpi=120)
    _log_results(trainer, module, metrics, validation, pictures)
    return Result(model, metrics, validation, folder)


def _log_results(
    trainer: pl.Trainer,
    module: FormulationModule,
    metrics: Mapping[str, float | None],
    validation: float,
    pictures: Mapping[str, Any],
) -> None:
    """Hyperparameters, result table and figures for the logger's page."""
    if trainer.logger is None:
        return
    numbers = {f"test/{key}": float(value) for key, value in metrics.items() if value is not None}
    described = describe(module.model)
    weights = {f"loss.{name}": weight for name, weight in module.loss.items()}
    hyperparameters = {"model": described["class"].rpartition(".")[2], "horizon": module.horizon} | weights
    hyperparameters |= described["arguments"]
    if not isinstance(trainer.logger, TensorBoardLogger):
        trainer.logger.log_metrics(numbers)
        return
    trainer.logger.log_hyperparams(hyperparameters, {f"hp/best_{VALIDATION}": validation} | numbers)
    writer = trainer.logger.experiment
    rows = "".join(f"\n| {name} | {value} | {meaning} |" for name, value, meaning in table(metrics))
    writer.add_text("results", "| figure | value | meaning |\n|---|---|---|" + rows)
    for name, figure in pictures.items():
        writer.add_figure(name, figure, global_step=trainer.global_step)
    writer.flush()


def _new_folder(folder: str | Path | None) -> Path:
    folder = Path(folder) if folder is not None else Path("runs") / time.strftime("%Y-%m-%d_%H-%M-%S")
    # The other processes of strategy=ddp start when the first has already written its settings there.
    if getattr(rank_zero_only, "rank", 0) == 0 and (folder / "config.yaml").exists():
        raise ValueError(f"{folder} holds a run already: choose another folder, nothing is overwritten.")
    return folder


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


def _settings(model: Formulation, **arguments: Any) -> dict[str, Any]:
    described = describe(model)
    return {"model": {"_target_": described["class"], **described["arguments"]}, **arguments}


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
