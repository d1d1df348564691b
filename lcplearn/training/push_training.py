"""Train a model of pushes: cross-validate it, fit it to all pushes, and leave what every run leaves."""

import copy
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from lightning.pytorch.loggers import TensorBoardLogger
from tqdm import tqdm

from lcplearn.datasets.pushes import PushData
from lcplearn.formulations.pushing import PushModel, PushPrediction
from lcplearn.training.asked import described_model, write_config
from lcplearn.training.checkpoint import describe
from lcplearn.training.push_figures import draw
from lcplearn.training.push_metrics import by_configuration, errors, format_score, intervals
from lcplearn.training.writing import replace, write_figures


class PushResult(NamedTuple):
    """What a training gave.

    Attributes:
        model: Fitted to all pushes.
        metrics: Figures of the pushes that each split left out, all splits together.
        report: The same as text, with intervals and by configuration.
        folder: Of the run.
    """

    model: PushModel
    metrics: dict[str, float]
    report: str
    folder: Path


def fit_pushes(
    model: PushModel,
    data: PushData,
    *,
    folder: str | Path,
    logger: Any = None,
    settings: Mapping[str, Any] | None = None,
    progress: bool = True,
) -> PushResult:
    """Judge a model by the splits of the data, then fit it to all pushes.

    Args:
        model: Not fitted yet; it is fitted in place.
        data: Pushes with splits.
        folder: Where best.ckpt, metrics.json, config.yaml and the pictures go.
        logger: A Lightning logger; none by default.
        settings: What config.yaml shall say.
        progress: Show a bar.

    Raises:
        ValueError: the folder holds a run already.
    """
    folder = Path(folder)
    write_config(folder, settings or {"model": described_model(model)})
    with tqdm(total=len(data.splits) + 1, desc="cross-validation", unit="fit", disable=not progress) as bar:
        start = time.perf_counter()
        judged, prediction = _cross_validate(model, data, bar)
        cross_validated = time.perf_counter()
        bar.set_description("fit to all")
        for step, figures in enumerate(_fit(model, data, bar)):
            if logger:
                logger.log_metrics({f"train/{name}": value for name, value in figures.items()}, step=step)
        seconds = {"train_seconds": time.perf_counter() - cross_validated}
        seconds["cross_validation_seconds"] = cross_validated - start
    checkpoint = {"formulation": describe(model), "state_dict": model.state_dict()}
    replace(folder / "best.ckpt", lambda file: torch.save(checkpoint, file))

    found = errors(model, judged, prediction)
    metrics = found.figures()
    report = format_score(metrics, intervals(found, judged), by_configuration(found, judged))
    metrics |= {"unsolved_share": 1.0 - float(prediction.solved.double().mean())}
    metrics |= model.physical_parameters() | seconds
    metrics["parameters"] = sum(p.numel() for p in model.parameters() if p.requires_grad)
    write_figures(folder / "metrics.json", metrics)
    pictures = draw(model, judged, prediction)
    for name, figure in pictures.items():
        figure.savefig(folder / f"{name}.png", dpi=120)
    if logger:
        _log(logger, metrics, pictures)
    return PushResult(model, metrics, report, folder)


def _fit(model: PushModel, data: PushData, bar: tqdm) -> Iterator[Mapping[str, float]]:
    """Fit a model to pushes; the bar counts it and shows its figures as they come."""
    for figures in model.fit(data.pushes, data.outcome):
        bar.set_postfix({name: f"{value:.3g}" for name, value in figures.items()}, refresh=True)
        yield figures
    bar.update()


def _cross_validate(model: PushModel, data: PushData, bar: tqdm) -> tuple[PushData, PushPrediction]:
    """All left-out pushes with their predictions; a push stands there as often as it was left out."""
    rows, parts = [], []
    for split in data.splits:
        learner = copy.deepcopy(model)
        for _ in _fit(learner, data.take(split.train), bar):
            pass
        with torch.no_grad():
            parts.append(learner.predict(data.pushes.take(split.test)))
        rows.append(split.test)
    force = None if parts[0].force is None else torch.cat([part.force for part in parts if part.force is not None])
    pose, solved = (torch.cat([getattr(part, name) for part in parts]) for name in ("pose", "solved"))
    return data.take(torch.cat(rows)), PushPrediction(pose, force, solved)


def _log(logger: Any, metrics: Mapping[str, Any], pictures: Mapping[str, Any]) -> None:
    logger.log_metrics({f"test/{name}": float(value) for name, value in metrics.items()})
    if isinstance(logger, TensorBoardLogger):
        for name, figure in pictures.items():
            logger.experiment.add_figure(name, figure)
    logger.finalize("success")
