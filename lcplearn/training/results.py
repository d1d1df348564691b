"""What a run leaves when its training has ended: figures, pictures and the logger's page."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.loggers import TensorBoardLogger

from lcplearn.datasets import Task
from lcplearn.formulations import Formulation
from lcplearn.training import figures, toss_figures
from lcplearn.training.metrics import Predictions, evaluate, table
from lcplearn.training.writing import write_figures

# The figures that stand beside the hyperparameters; metrics.json and the table have all.
MAIN = (
    "velocity_rmse", "stick_accuracy", "rollout_rmse_1000", "stop_error_median_mm", "rest_share", "mu_error",
    "position_integral", "rotation_integral", "at_rest",
    "train_seconds",
)  # fmt: skip


def leave(
    trainer: pl.Trainer, model: Formulation, task: Task, folder: Path, used: Mapping[str, Any], seconds: float
) -> dict[str, float | None]:
    """Judge the model, and write metrics.json, the pictures and the logger's page.

    Args:
        trainer: Whose logger is told.
        model: The trained model, on the CPU.
        task: Whose test part judges.
        folder: The run's.
        used: What it was trained with, by name, as HPARAMS shows it.
        seconds: Time of training [s].

    Returns:
        The figures, see `metrics.evaluate`.
    """
    predictions = Predictions(model, task)
    metrics = evaluate(model, task, train_seconds=seconds, predictions=predictions)
    write_figures(folder / "metrics.json", metrics)
    pictures = figures.draw(predictions)
    for name, figure in pictures.items():
        # Pictures are looked at side by side and far from their folder.
        figure.suptitle(f"{type(model).__name__}   {folder.name}", fontsize=11)
        figure.savefig(folder / f"{name}.png", dpi=120)
    _log(trainer, metrics, used, pictures)
    if "tosses" in task.judged_by:
        moving = toss_figures.animation(toss_figures.median_toss(predictions))
        (folder / "toss.gif").write_bytes(moving)
        if isinstance(trainer.logger, TensorBoardLogger):
            toss_figures.log_animation(trainer.logger.experiment, moving, trainer.global_step)
    return metrics


def _log(
    trainer: pl.Trainer, metrics: Mapping[str, float | None], used: Mapping[str, Any], pictures: Mapping[str, Any]
) -> None:
    finite = {key: float(value) for key, value in metrics.items() if value is not None and math.isfinite(value)}
    if trainer.logger is None:
        return
    if not isinstance(trainer.logger, TensorBoardLogger):
        trainer.logger.log_hyperparams(dict(used))
        trainer.logger.log_metrics({f"test/{key}": value for key, value in finite.items()})
        trainer.logger.save()
        return
    main = {f"test/{key}": finite[key] for key in MAIN if key in finite}
    trainer.logger.log_hyperparams(dict(used), main)
    writer = trainer.logger.experiment
    lines = ["| figure | value | meaning |", "|---|---|---|"]
    for cells in table(metrics):
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    writer.add_text("results", "\n".join(lines))
    for name, figure in pictures.items():
        writer.add_figure(f"test/{name}", figure, global_step=trainer.global_step)
    writer.flush()
