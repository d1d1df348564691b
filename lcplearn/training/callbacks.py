"""What happens beside the optimisation: reports, early stopping, a clean stop on Ctrl-C."""

import shutil
import signal
import threading
from pathlib import Path
from types import FrameType
from typing import Any

import lightning.pytorch as pl
from lightning.fabric.utilities import move_data_to_device
from lightning.pytorch.callbacks import EarlyStopping, ModelCheckpoint, ProgressBar
from lightning.pytorch.loggers import TensorBoardLogger
from tqdm import tqdm

from lcplearn.datasets import BlockData
from lcplearn.training.metrics import one_step
from lcplearn.training.module import VALIDATION, FormulationModule

TAGS = {
    "velocity_rmse": "val/velocity_rmse",
    "stick_accuracy": "mode/stick_accuracy",
    "false_stick": "mode/false_stick",
    "lcp_residual": "residual/lcp",
    "unsolved_share": "solve/unsolved_share",
}


class Report(pl.Callback):
    """Log how the model does on the validation recordings, and learned mu and mass beside the true ones."""

    def __init__(self, data: BlockData) -> None:
        self.data, self.validation = data, data.validation

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self.validation = move_data_to_device(self.data.validation, pl_module.device)
        if isinstance(trainer.logger, TensorBoardLogger):
            pairs = {name: ["Multiline", [f"param/{name}$", f"param/{name}_true"]] for name in ("mu", "mass")}
            trainer.logger.experiment.add_custom_scalars({"learned against true": pairs})

    def on_validation_end(self, trainer: pl.Trainer, pl_module: FormulationModule) -> None:  # type: ignore[override]
        if trainer.logger is None or not trainer.is_global_zero:
            return
        model = pl_module.model
        found = one_step(model, self.validation)
        scalars = {tag: value for name, tag in TAGS.items() if (value := found[name]) is not None}
        for name, value in model.physical_parameters().items():
            scalars[f"param/{name}"] = value
            if getattr(self.data, name) is not None:
                scalars[f"param/{name}_true"] = getattr(self.data, name)
        trainer.logger.log_metrics(scalars, step=trainer.global_step)


class EarlyStop(EarlyStopping):
    """Stop when the validation error no longer improves; where LBFGS is to finish, not before it has begun."""

    def on_validation_end(self, trainer: pl.Trainer, pl_module: FormulationModule) -> None:  # type: ignore[override]
        optimizer = pl_module.optimizer
        if optimizer.lbfgs_after is None or optimizer.finishes(trainer.current_epoch):
            super().on_validation_end(trainer, pl_module)


class BestCheckpoint(ModelCheckpoint):
    """Keep `best.ckpt`, also over a resumption in another folder: Lightning would forget what was best before."""

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        before = Path(state_dict["best_model_path"])
        if before.is_file() and self.dirpath is not None and before.parent != Path(self.dirpath):
            now = Path(self.dirpath) / before.name
            now.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(before, now)
            moved = {"dirpath": self.dirpath, "best_model_path": str(now), "kth_best_model_path": str(now)}
            state_dict = state_dict | moved | {"best_k_models": {str(now): state_dict["best_model_score"]}}
        super().load_state_dict(state_dict)


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
        if self.bar is not None and VALIDATION in trainer.callback_metrics:
            values = {VALIDATION: float(trainer.callback_metrics[VALIDATION])} | pl_module.model.physical_parameters()
            self.bar.set_postfix({name: f"{value:.3g}" for name, value in values.items()}, refresh=False)

    def teardown(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        if self.bar is not None:
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
        self.path, self.every, self.stopped = path, every, False
        self._previous: dict[int, Any] = {}

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if threading.current_thread() is threading.main_thread():
            self._previous = {number: signal.signal(number, self._stop) for number in (signal.SIGINT, signal.SIGTERM)}

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if trainer.world_size > 1:  # a process that stops alone leaves the others waiting
            self.stopped = trainer.strategy.reduce_boolean_decision(self.stopped, all=False)
        done = trainer.current_epoch + 1
        trainer.should_stop = trainer.should_stop or self.stopped
        if trainer.should_stop or done == trainer.max_epochs or done % self.every == 0:
            trainer.save_checkpoint(self.path, weights_only=False)

    def teardown(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        self._restore()

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self.stopped = True
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous = {}
