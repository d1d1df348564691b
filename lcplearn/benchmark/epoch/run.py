"""`benchmark epoch [KEY=VALUE ...]`: train as train.py would, and say where the CPU time of its epochs goes."""

import argparse
import tempfile
from itertools import pairwise
from typing import Any
from unittest.mock import patch

import numpy as np
from lightning.pytorch.core.optimizer import LightningOptimizer
from lightning.pytorch.loggers import TensorBoardLogger

from lcplearn import train
from lcplearn.benchmark.epoch.clock import Clock, Times
from lcplearn.benchmark.harness.study import Table, Value, format_table
from lcplearn.datasets import WindowLoader
from lcplearn.lcp import gradient
from lcplearn.scenes import spatial_node
from lcplearn.scenes.contact_kernel import steps
from lcplearn.training.module import FormulationModule
from lcplearn.training.writing import AtomicCheckpointIO

REST = "Lightning, callbacks, the rest"
# A part counts without what it calls of the others. Contacts of bodies have compiled nodes of their own.
PLACES = (
    ("solve", gradient, "solve"),
    ("solve", steps, "_solve"),
    ("solve", spatial_node, "roll"),
    ("solve, backward", gradient, "adjoint"),
    ("solve, backward", steps._Contacts, "backward"),
    ("solve, backward", spatial_node, "pull_back"),
    ("model and loss", FormulationModule, "_terms"),
    ("model and loss", FormulationModule, "_total"),
    ("torch, backward", FormulationModule, "manual_backward"),
    ("optimiser", LightningOptimizer, "step"),
    ("data", WindowLoader, "__iter__"),
    ("validation, without its solves", FormulationModule, "validation_step"),
    ("logs and checkpoints", TensorBoardLogger, "log_metrics"),
    ("logs and checkpoints", AtomicCheckpointIO, "save_checkpoint"),
)
PARTS = (*dict.fromkeys(part for part, *_ in PLACES), REST)


def run(options: argparse.Namespace) -> None:
    """Train in a folder that goes again, and print the table."""
    epochs = _train(options.overrides)
    if len(epochs) < 2:
        raise ValueError("overrides: expected a training of at least three epochs, the first of which is not counted")
    print(f"\n{format_table(table(epochs))}\n\n{len(epochs)} epochs, the first left out; CPU time of one process.")


def _train(overrides: list[str]) -> list[Times]:
    """Seconds by part of each epoch but the first, whose start is Lightning's own."""
    clock, readings = Clock(REST), []

    class Marked(FormulationModule):
        """Reads the clock where an epoch starts and where training ends."""

        def on_train_epoch_start(self) -> None:
            readings.append(clock.read())
            super().on_train_epoch_start()

        def on_train_end(self) -> None:
            readings.append(clock.read())

    with (
        tempfile.TemporaryDirectory() as folder,
        clock.timing(PLACES),
        patch("lcplearn.training.fitting.FormulationModule", Marked),
    ):
        train.command([*overrides, f"hydra.run.dir={folder}/run"])
    return [_difference(after, before) for before, after in pairwise(readings[1:])]


def _difference(after: Times, before: Times) -> Times:
    return {part: after.get(part, 0.0) - before.get(part, 0.0) for part in PARTS}


def table(epochs: list[Times]) -> Table:
    """Milliseconds an epoch by part: mean, smallest and largest, and the share of the whole."""
    times: dict[str, Any] = {part: 1e3 * np.array([epoch[part] for epoch in epochs]) for part in PARTS}
    times["all"] = sum(times.values())
    lines: list[list[Value]] = [
        [part, float(x.mean()), float(x.min()), float(x.max()), 100.0 * float(x.sum() / times["all"].sum())]
        for part, x in times.items()
    ]
    return Table(("part of an epoch", "mean [ms]", "smallest", "largest", "share [%]"), lines)
