"""What happens beside the optimisation: reports, early stopping, a clean stop on Ctrl-C."""

import math
import multiprocessing
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import lightning.pytorch as pl
from lightning.fabric.utilities import move_data_to_device
from lightning.pytorch.callbacks import EarlyStopping, ModelCheckpoint, ProgressBar
from lightning.pytorch.loggers import TensorBoardLogger
from tqdm import tqdm

from lcplearn.datasets import Task
from lcplearn.training.checkpoint import read
from lcplearn.training.figures_of_merit import KEYS
from lcplearn.training.metrics import one_step
from lcplearn.training.module import FormulationModule
from lcplearn.training.writing import copy, write_figures

TAGS = {
    "velocity_rmse": "val/velocity_rmse",
    "stick_accuracy": "val/stick_accuracy",
    "false_stick": "val/false_stick",
    "lcp_residual": "val/lcp_residual",
    "unsolved_share": "val/unsolved_share",
}


class Report(pl.Callback):
    """Log how the model does on the validation recordings, and learned numbers beside the true ones."""

    def __init__(self, data: Task) -> None:
        self.data, self.validation = data, data.validation

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self.validation = move_data_to_device(self.data.validation, pl_module.device)
        if isinstance(trainer.logger, TensorBoardLogger):
            pairs = {
                name: ["Multiline", [f"parameters/{name}$", f"parameters/{name}_true"]] for name in self.data.truth
            }
            trainer.logger.experiment.add_custom_scalars({"learned against true": pairs})

    def on_validation_end(self, trainer: pl.Trainer, pl_module: FormulationModule) -> None:  # type: ignore[override]
        if trainer.logger is None or not trainer.is_global_zero:
            return
        model = pl_module.model
        found = one_step(model, self.validation)
        scalars = {tag: value for name, tag in TAGS.items() if (value := found[name]) is not None}
        scalars |= {tag: float(trainer.callback_metrics[tag]) for tag in (pl_module.monitor, "val/loss")}
        for name, value in model.physical_parameters().items():
            scalars[f"parameters/{name}"] = value
            if name in self.data.truth:
                scalars[f"parameters/{name}_true"] = self.data.truth[name]
        trainer.logger.log_metrics(scalars, step=trainer.global_step)


class EarlyStop(EarlyStopping):
    """Stop when the validation error no longer improves; not before the last stage, and LBFGS if it is to finish."""

    def __init__(self, monitor: str, patience: int) -> None:
        super().__init__(monitor, patience=patience, check_on_train_epoch_end=False)
        self.comparable = True  # the errors of a resumed training, with those on the data of this one

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        if self.comparable:
            super().load_state_dict(state_dict)

    def on_validation_end(self, trainer: pl.Trainer, pl_module: FormulationModule) -> None:  # type: ignore[override]
        optimizer, epoch = pl_module.optimizer, trainer.current_epoch
        if epoch >= pl_module.stages[-1].first and (optimizer.lbfgs_after is None or optimizer.finishes(epoch)):
            super().on_validation_end(trainer, pl_module)


class TrainingDivergedError(ArithmeticError):
    """Training gave a number that is not finite; the message is one sentence on what to do."""


class Divergence(pl.Callback):
    """End a training that has diverged, before its numbers get into a checkpoint.

    Args:
        folder: Of the run, whose metrics.json says so; with several processes their parent learns it only there.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        terms = [name for name, value in (outputs or {}).items() if not math.isfinite(float(value))]
        self._end(trainer, pl_module, f"the loss term '{terms[0]}'" if terms else None)

    def on_validation_end(self, trainer: pl.Trainer, pl_module: FormulationModule) -> None:  # type: ignore[override]
        error = float(trainer.callback_metrics.get(pl_module.monitor, 0.0))
        self._end(trainer, pl_module, None if math.isfinite(error) else "the error on the validation data")

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        wrong = [name for name, value in pl_module.named_parameters() if not bool(value.isfinite().all())]
        self._end(trainer, pl_module, f"the parameter {wrong[0]}" if wrong else None)

    def _end(self, trainer: pl.Trainer, module: Any, what: str | None) -> None:
        diverged = what is not None
        if trainer.world_size > 1:  # a process that stops alone leaves the others waiting
            diverged = trainer.strategy.reduce_boolean_decision(diverged, all=False)
        if not diverged:
            return
        optimizer, epoch = module.optimizer, trainer.current_epoch
        cure = (
            "use optimizer=adam, or a larger optimizer.lbfgs_after"
            if optimizer.finishes(epoch)
            else f"lower optimizer.lr, which is {optimizer.lr:g}"
        )
        sentence = f"Training diverged in epoch {epoch + 1}: {what or 'a number'} is not finite; {cure}."
        if (self.folder / "best.ckpt").is_file():
            sentence += f" {self.folder / 'best.ckpt'} holds the best model before."
        if trainer.is_global_zero:
            write_figures(self.folder / "metrics.json", dict.fromkeys(KEYS) | {"diverged": sentence})
        raise TrainingDivergedError(sentence)


class BestCheckpoint(ModelCheckpoint):
    """Keep `best.ckpt`, also over a resumption in another folder: Lightning would forget what was best before.

    It is written before `last.ckpt`, which so never knows an older score.

    Args:
        folder: Of the run.
        monitor: The figure that it is best by.
        resumed: The checkpoint that is resumed, beside which the best model so far lies.
    """

    def __init__(self, folder: Path, monitor: str, resumed: str | Path | None = None) -> None:
        super().__init__(folder, "best", monitor=monitor, enable_version_counter=False, save_on_train_epoch_end=False)
        self.resumed = resumed
        self.comparable = True  # the error of the best model so far, with those on the data of this training

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        if not self.comparable:
            return
        beside = Path(self.resumed or "").with_name("best.ckpt")  # the folder may have been moved since
        before = next((path for path in (beside, Path(state_dict["best_model_path"])) if path.is_file()), None)
        if before is None or self.dirpath is None:
            return  # what was best is lost: better none than a score without its model
        now = Path(self.dirpath) / before.name
        score = read(before, "cpu")["callbacks"][self.state_key]["best_model_score"]
        copy(before, now)
        here = {"dirpath": self.dirpath, "best_model_path": str(now), "kth_best_model_path": str(now)}
        best = {"best_model_score": score, "best_k_models": {str(now): score}, "kth_value": score}
        super().load_state_dict(state_dict | here | best)


class EpochBar(ProgressBar):
    """A bar over epochs: Lightning's count batches, of which a full-batch epoch has one."""

    bar: tqdm | None = None

    def disable(self) -> None:
        """Lightning asks for this on all processes but the first, which `on_train_start` knows by itself."""

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self.bar = tqdm(
            total=trainer.max_epochs, initial=trainer.current_epoch, desc="training", unit="epoch", mininterval=0.5,
            disable=not trainer.is_global_zero, dynamic_ncols=True,
        )  # fmt: skip

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if self.bar is not None:
            self.bar.update()

    def on_validation_end(self, trainer: pl.Trainer, pl_module: FormulationModule) -> None:  # type: ignore[override]
        if self.bar is not None and (monitor := pl_module.monitor) in trainer.callback_metrics:
            values = {monitor: float(trainer.callback_metrics[monitor])} | pl_module.model.physical_parameters()
            self.bar.set_postfix({name: f"{value:.3g}" for name, value in values.items()}, refresh=False)

    def on_exception(self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException) -> None:
        self.teardown(trainer, pl_module, "fit")

    def teardown(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        if self.bar is not None:
            if trainer.should_stop and self.bar.n < (self.bar.total or 0):
                self.bar.set_description_str("stopped early")
            self.bar.close()


class LastCheckpoint(pl.Callback):
    """Write `last.ckpt` regularly, when training ends, and when Ctrl-C or SIGTERM asks for the end.

    A first signal ends training after the current epoch, so that a resumed training continues exactly; a second kills.
    `ModelCheckpoint(save_last=True)` would write it only together with an improvement.

    Args:
        path: Where.
        every: Epochs between two writes.
    """

    def __init__(self, path: Path, every: int) -> None:
        self.path, self.every = path, every
        self._asked = multiprocessing.Value("b", 0, lock=False)  # shared with the processes of strategy=ddp_fork
        self._previous: dict[int, Any] = {}

    @property
    def stopped(self) -> bool:
        """Whether a signal has come, to this process or to one that it forked."""
        return bool(self._asked.value)

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Within, signals end the training; processes that are forked within listen, too."""
        self._listen()
        try:
            yield
        finally:
            self._restore()

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self._listen()  # again: Lightning has put its own handler of SIGTERM before ours

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        stop = self.stopped
        if trainer.world_size > 1:  # a process that stops alone leaves the others waiting
            stop = trainer.strategy.reduce_boolean_decision(stop, all=False)
        done = trainer.current_epoch + 1
        enough = done == trainer.max_epochs or 0 <= trainer.max_steps <= trainer.global_step
        trainer.should_stop = trainer.should_stop or stop
        if trainer.should_stop or enough or done % self.every == 0:
            trainer.save_checkpoint(self.path, weights_only=False)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self._asked.value = 1
        self._restore()

    def _listen(self) -> None:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous.setdefault(number, signal.signal(number, self._stop))

    def _restore(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
