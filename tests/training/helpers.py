"""Small data, short trainings and train.py as a user runs it, shared by the training tests."""

import os
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from unittest import mock

from lcplearn.datasets import Task, simulate_sliding_block
from lcplearn.training import Optimizer, Result, fit

ROOT = Path(__file__).parents[2]
QUIET = {"enable_progress_bar": False}
SMALL = ["data.trajectories=4", "data.length=30", "+data.long_length=20", "trainer.check_val_every_n_epoch=1"]


def small_data(**arguments: Any) -> Task:
    sizes = {"trajectories": 4, "length": 30, "validation_trajectories": 2, "test_trajectories": 3, "test_length": 100,
             "long_trajectories": 2, "long_length": 1000}  # fmt: skip
    return simulate_sliding_block(**(sizes | arguments))


def tiny_data(**arguments: Any) -> Task:
    return small_data(test_length=20, long_length=20, **arguments)


def short_fit(model: Any, data: Task, folder: Path, *, pictures: bool = False, **arguments: Any) -> Result:
    """Train for a few epochs; pictures take longer than that, so that only tests which look at them draw any."""
    chosen: dict[str, Any] = {"epochs": 4, "optimizer": Optimizer(lbfgs_after=2, lbfgs_iterations=3)}
    chosen |= {"trainer": QUIET | {"check_val_every_n_epoch": 1}} | arguments
    with nullcontext() if pictures else mock.patch("lcplearn.training.figures.draw", return_value={}):
        return fit(model, data, folder=folder, **chosen)


def environment(**more: str) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "COLUMNS": "120"} | more


def train(
    folder: Path, *overrides: str, launcher: tuple[str, ...] = (), **more: str
) -> subprocess.CompletedProcess[str]:
    """Run train.py in a folder, by itself or by a launcher, with more environment variables."""
    command = [sys.executable, *launcher, str(ROOT / "train.py"), *overrides]
    return subprocess.run(command, cwd=folder, env=environment(**more), capture_output=True, text=True, timeout=300)
