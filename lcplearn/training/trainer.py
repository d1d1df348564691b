"""Lightning's Trainer as this project uses it: its defaults, its errors, and what it would say to nobody's use."""

import json
import logging
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from torch.multiprocessing import ProcessRaisedException
from torch.utils.data import DataLoader

from lcplearn.datasets import WindowLoader, Windows
from lcplearn.training.callbacks import EpochBar, TrainingDivergedError
from lcplearn.training.module import FormulationModule
from lcplearn.training.writing import AtomicCheckpointIO


def arguments(given: Mapping[str, Any] | None, epochs: int) -> dict[str, Any]:
    """Keyword arguments of the Trainer: the defaults of this project, and what is given.

    Raises:
        ValueError: a number of epochs, another precision than float64, a GPU that isn't there, or no validations.
    """
    if "max_epochs" in (given or {}):
        raise ValueError("trainer: expected the number of epochs as epochs=, by which stages and rates are planned")
    chosen = {
        "max_epochs": epochs,
        "check_val_every_n_epoch": 10,
        "precision": "64-true",
        "accelerator": "cpu",
        "devices": 1,
        "enable_model_summary": False,
        **(given or {}),
    }
    if chosen["precision"] not in ("64-true", "64", 64):
        raise ValueError(
            f"trainer: expected precision 64-true, as sticking is judged at 1e-12 m/s, got {chosen['precision']}"
        )
    if chosen["accelerator"] in ("cuda", "gpu") and not torch.cuda.is_available():
        raise ValueError("torch finds no CUDA device here: use trainer=cpu (trainer={'accelerator': 'cpu'}).")
    every = chosen["check_val_every_n_epoch"]
    if not isinstance(every, int) or every < 1:
        raise ValueError(f"trainer: expected check_val_every_n_epoch of at least 1, got {every!r}")
    chosen["check_val_every_n_epoch"] = min(every, epochs)
    return chosen


def build(chosen: Mapping[str, Any], folder: Path, callbacks: Sequence[pl.Callback], logger: Any) -> pl.Trainer:
    """Make the Trainer of `arguments`, with callbacks of ours beside those that are chosen."""
    rest = dict(chosen)
    more, plugins = (rest.pop(name, None) or [] for name in ("callbacks", "plugins"))
    callbacks = [*callbacks, *(more if isinstance(more, list | tuple) else [more])]
    if rest.get("enable_progress_bar", True):
        callbacks.append(EpochBar())
    plugins = [AtomicCheckpointIO(), *(plugins if isinstance(plugins, list | tuple) else [plugins])]
    with _errors(TypeError):  # of devices=x, for instance
        return pl.Trainer(
            default_root_dir=folder, callbacks=callbacks, logger=logger or False, plugins=plugins,
            num_sanity_val_steps=0, **rest,
        )  # fmt: skip


def run(
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
        with _errors():
            trainer.fit(module, loader, validation_loader, ckpt_path=ckpt_path, weights_only=True)
    except ProcessRaisedException:  # of strategy=ddp_fork, which knows the exception as text only
        figures = folder / "metrics.json"
        if not figures.is_file():
            raise
        raise TrainingDivergedError(json.loads(figures.read_text())["diverged"]) from None
    return time.perf_counter() - start


@contextmanager
def quiet() -> Iterator[None]:
    """Silence, by message and for the time of a training, what a user can't act on."""
    names = ("pytorch.utilities.rank_zero", "fabric.utilities.rank_zero", "fabric.utilities.distributed")
    loggers = [logging.getLogger(name) for name in (*(f"lightning.{name}" for name in names), "matplotlib.animation")]
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


@contextmanager
def _errors(*more: type[Exception]) -> Iterator[None]:
    """Settings that Lightning refuses, such as a device that isn't there, are the caller's mistake."""
    refused: tuple[type[Exception], ...] = (MisconfigurationException, *more)
    try:
        yield
    except refused as error:
        raise ValueError(f"Lightning's Trainer can't use these settings: {' '.join(str(error).split())}") from error
