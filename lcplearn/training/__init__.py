"""Train a formulation: `fit` from Python, `settings` for what a user may write in a configuration."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lcplearn.training.callbacks import TrainingDivergedError
    from lcplearn.training.checkpoint import load
    from lcplearn.training.fitting import Result, TrainingInterrupted, fit
    from lcplearn.training.optimizer import Optimizer

__all__ = ["Optimizer", "Result", "TrainingDivergedError", "TrainingInterrupted", "fit", "load"]

_HOMES = {"load": "checkpoint", "Optimizer": "optimizer", "TrainingDivergedError": "callbacks"}


def __getattr__(name: str) -> Any:
    # Loaded on first use, so that train.py can refuse a mistyped setting before it pays for torch and Lightning.
    if name not in __all__:
        raise AttributeError(f"module 'lcplearn.training' has no attribute {name!r}")
    return getattr(import_module(f"lcplearn.training.{_HOMES.get(name, 'fitting')}"), name)
