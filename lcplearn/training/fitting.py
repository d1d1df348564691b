"""Train a formulation from Python: data in, figures and checkpoints out."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.utilities import rank_zero_only

from lcplearn.datasets import Task, WindowLoader, Windows, windows
from lcplearn.formulations import Formulation, Physical, loss_terms
from lcplearn.scenes.space import Space
from lcplearn.training.asked import described_data, described_model, hyperparameters, setting, taken, write_config
from lcplearn.training.callbacks import BestCheckpoint, Divergence, EarlyStop, LastCheckpoint, Report
from lcplearn.training.checkpoint import check_resumable, plain, read
from lcplearn.training.metrics import JUDGES
from lcplearn.training.module import VALIDATION, FormulationModule
from lcplearn.training.optimizer import Optimizer
from lcplearn.training.results import leave
from lcplearn.training.settings import flat
from lcplearn.training.stages import plan
from lcplearn.training.trainer import arguments as trainer_arguments
from lcplearn.training.trainer import build as build_trainer
from lcplearn.training.trainer import quiet, run


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
        validation: Smallest error on the validation data, as `Task.chosen_by` says: of velocities over the steps of a
            window [m/s], or of poses [m]; NaN where training ended before a validation.
        folder: Folder of the run.
    """

    model: Formulation
    metrics: dict[str, float | None] | None
    validation: float
    folder: Path


@quiet()
def fit(
    model: Formulation,
    data: Task,
    *,
    loss: Mapping[str, float] | None = None,
    horizon: int = 1,
    stages: Sequence[Mapping[str, Any]] = (),
    epochs: int = 200,
    batch_size: int | None = None,
    batches: int | None = None,
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
        loss: Weights of the loss terms, see `lcplearn.formulations.loss_terms`; {"prediction": 1.0} by default.
        horizon: Steps of a training window; rollout and pose use more than one.
        stages: What comes before, each with its epochs and what differs: lr, a shorter horizon, weights of loss terms.
        epochs: Epochs to train at most, those of stages included.
        batch_size: Windows in a batch; None for the full batch, which is best for these small models.
        batches: Batches in an epoch, however many windows there are: see `WindowLoader`; None for all windows once.
        optimizer: Adam alone by default.
        patience: Validations without improvement after which to stop; None to go on.
        folder: Where the run is written; a new folder runs/DATE_TIME by default.
        ckpt_path: Checkpoint to resume from.
        allow_changes: Resume although seed, data, optimizer or batch size have changed; config.yaml then says how.
        seed: Seed of the order of the batches.
        logger: A Lightning logger; none by default.
        trainer: Further keyword arguments of Lightning's Trainer: {"accelerator": "cuda"} trains on a GPU.
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
    chosen, folder = trainer_arguments(trainer, epochs), _new_folder(folder)
    _check_agreement(model, data)
    planned = plan(stages, loss=loss, horizon=horizon, epochs=epochs, lr=optimizer.lr)
    cut = windows(data.train, horizon)
    validation = windows(data.validation, horizon if data.chosen_by == "rollout" else None)
    for stage in planned:
        _try_once(model, cut.map(lambda values: values[:1]).first(stage.horizon), stage.loss)
    loader = WindowLoader(cut, batch_size=batch_size, batches=batches, shuffle=batch_size is not None, seed=seed)
    every = chosen["check_val_every_n_epoch"]
    used = {
        "seed": seed, "batch_size": batch_size, "batches": batches, "optimizer": asdict(optimizer),
        "stages": list(map(dict, stages)), "data": described_data(data, settings),
    }  # fmt: skip
    module = FormulationModule(
        model, stages=planned, optimizer=optimizer, chosen_by=data.chosen_by, training=flat(plain(used)),
        log_every=every * (len(loader) if batch_size else 1),
    )  # fmt: skip
    best, last = BestCheckpoint(folder, module.monitor, ckpt_path), LastCheckpoint(folder / "last.ckpt", every)
    stop = [] if patience is None else [EarlyStop(module.monitor, patience=patience)]
    lightning = build_trainer(chosen, folder, [Divergence(folder), best, last, Report(data), *stop], logger)
    seconds, resumed = _resumed(ckpt_path, module, epochs, allow_changes=allow_changes)
    best.comparable = "data.recordings" not in resumed.get("resumed", {}).get("changed", {})
    for callback in stop:
        callback.comparable = best.comparable
    if lightning.is_global_zero:
        rest = {"loss": loss, "horizon": horizon, "epochs": epochs, "patience": patience}
        rest["trainer"] = {key: setting(value) for key, value in (trainer or {}).items()}
        write_config(folder, {**(settings or {"model": described_model(model), **used, **rest}), **resumed})
    with last.listening():
        seconds += run(lightning, module, loader, validation, folder, ckpt_path)
    if last.stopped and read(last.path)["epoch"] + 1 < epochs:  # in the last epoch a signal comes too late
        raise TrainingInterrupted(last.path)
    trained, error = _best(module, best)
    if not lightning.is_global_zero:
        return Result(trained, None, error, folder)
    shown = hyperparameters(module, used, epochs)
    return Result(trained, leave(lightning, trained, data, folder, shown, seconds), error, folder)


def _resumed(
    path: str | Path | None, module: FormulationModule, epochs: int, *, allow_changes: bool
) -> tuple[float, dict[str, Any]]:
    """Seconds of training before a resumption, and what config.yaml says of it."""
    if path is None:
        return 0.0, {}
    changed, before = check_resumable(path, module.described, epochs, allow_changes=allow_changes), read(path)
    says = {"from": str(path), "changed": changed} | ({"epochs": before["epoch"] + 1} if changed else {})
    return before["train_seconds"], {"resumed": says}


def _best(module: FormulationModule, best: BestCheckpoint) -> tuple[Formulation, float]:
    """The model with the parameters that validated best, and their error."""
    error = float("nan")
    if best.best_model_path:
        # From the file and not from the callback: that one stayed in another process with strategy=ddp_fork.
        checkpoint = read(best.best_model_path, "cpu")
        module.load_state_dict(checkpoint["state_dict"])
        error = float(checkpoint["callbacks"][best.state_key]["best_model_score"])
    return module.model.cpu().eval(), error


def _check_agreement(model: Formulation, data: Task) -> None:
    """A model of another time step, space or gravity would learn, but something else; judges are asked at the end."""
    for name, known, asked in (("judged_by", JUDGES, data.judged_by), ("chosen_by", VALIDATION, (data.chosen_by,))):
        for each in asked:
            if each not in known:
                raise ValueError(f"data.{name}: expected one of {', '.join(known)}, got {each!r}")
    ours = {"dt": model.dt, "space": model.space, **model.given}
    theirs = {"dt": data.dt, "space": data.space, **data.given}
    for name in sorted(ours.keys() & theirs.keys()):
        if isinstance(ours[name], int | float | Space) and ours[name] != theirs[name]:
            wanted, got = (
                ", ".join(each.positions) if isinstance(each, Space) else each for each in (theirs[name], ours[name])
            )
            raise ValueError(f"model: expected {name} = {wanted} as in the data, got {got}")
    if isinstance(model, Physical) and "mass" in model.domains and not bool(data.train.drive.force.any()):
        raise ValueError("model: expected learn_mass=False (model=physical_mu), as no force acts that tells a mass")


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
