"""The LightningModule: one formulation, its loss and its optimisers."""

import time
from collections.abc import Mapping, Sequence
from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor

from lcplearn.datasets import Windows
from lcplearn.formulations import Formulation, loss_terms
from lcplearn.training.checkpoint import describe, plain
from lcplearn.training.optimizer import Optimizer
from lcplearn.training.stages import Stage

# torch's LBFGS learns curvature only from steps with y.s > 1e-10, an absolute number: losses of 1e-12 need enlarging.
LBFGS_SCALE = 1e8

VALIDATION = {  # what the best model is chosen by, against measured states: `Task.chosen_by`, and its name in logs
    "rollout": "val/rollout_rmse",  # [m/s], velocity error over the steps of a window
    "pose": "val/pose_error",  # [m], robust, over whole recordings
}


class FormulationModule(pl.LightningModule):
    """Train a formulation.

    Optimisation is manual, in Lightning's words, because two optimisers take turns; both are in every checkpoint, so
    that a training can be resumed on either side of the switch.

    Args:
        model: What to train.
        stages: What is minimised when.
        chosen_by: What the best model is chosen by, see `VALIDATION`.
        optimizer: Optimisers and their schedule.
        log_every: Steps between two logs of the loss.
        training: What else the training was asked for, as plain values; a resumption compares it.
    """

    model: Formulation
    seconds_before: float
    started: float

    def __init__(
        self,
        model: Formulation,
        *,
        stages: Sequence[Stage],
        optimizer: Optimizer,
        chosen_by: str = "rollout",
        log_every: int = 1,
        training: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.model, self.stages, self.optimizer, self.chosen_by = model, tuple(stages), optimizer, chosen_by
        self.monitor = VALIDATION[chosen_by]
        self.log_every, self.training_settings = log_every, dict(training or {})
        self.seconds_before, self.started = 0.0, time.perf_counter()

    def configure_optimizers(self) -> list[torch.optim.Optimizer]:
        return self.optimizer.build(self.model)

    def on_fit_start(self) -> None:
        self.started = time.perf_counter()

    def on_train_epoch_start(self) -> None:
        optimizers, stage = self._optimizers(), self.stage
        if self.current_epoch + 1 == self.trainer.max_epochs:  # what no validation sees can't become the best
            self.trainer.check_val_every_n_epoch = 1
        if self.current_epoch == stage.first:
            for optimizer in optimizers:
                optimizer.state.clear()  # the gradients of another loss have another size
        for group in optimizers[0].param_groups:
            group["lr"] = stage.learning_rate(self.current_epoch, self.optimizer)

    def training_step(self, windows: Windows, index: int) -> dict[str, Tensor]:
        finishes = self.optimizer.finishes(self.current_epoch)
        active = self._optimizers()[-1 if finishes else 0]
        scale = LBFGS_SCALE if finishes else 1.0
        report: dict[str, Tensor] = {}

        def closure() -> Tensor:
            active.zero_grad()
            terms = self._terms(windows)
            total = self._total(terms)
            self.manual_backward(scale * total)
            report.update({name: term.detach() for name, term in terms.items()}, total=total.detach())
            # All processes must see one loss, or their line searches part ways.
            return scale * self.trainer.strategy.reduce(total.detach(), reduce_op="mean")

        active.step(closure=closure)
        # A scalar costs 0.5 ms to log: only those that are shown are.
        if self.logger and self.global_step % self.log_every == 0:
            scalars = {f"train/{name}": float(value) for name, value in report.items()}
            scalars["train/lr"] = float(active.param_groups[0]["lr"])
            self.logger.log_metrics(scalars, step=self.global_step)
        return report

    def validation_step(self, windows: Windows, index: int) -> None:
        # The best model is the one that predicts best as it is deployed. The loss may say otherwise: that of `direct`
        # has a floor which differs between training and validation data although the velocity is exact.
        loss = self.stage.loss
        terms = loss_terms(self.model, windows, {self.chosen_by: 1.0} | {k: v for k, v in loss.items() if v})
        chosen = terms[self.chosen_by].sqrt() if self.chosen_by == "rollout" else terms[self.chosen_by]
        values = {self.monitor: chosen, "val/loss": self._total(terms)}
        self.log_dict(values, sync_dist=True, batch_size=len(windows.valid), logger=False)  # callbacks.Report does

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint.update(self.described, train_seconds=self.seconds)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self.seconds_before = checkpoint["train_seconds"]

    @property
    def described(self) -> dict[str, Any]:
        """What is trained, what is minimised, and by what, as plain values."""
        last = self.stages[-1]
        objective = {"loss": {name: weight for name, weight in last.loss.items() if weight}, "horizon": last.horizon}
        return {"formulation": describe(self.model), "objective": plain(objective), "training": self.training_settings}

    @property
    def stage(self) -> Stage:
        """That of the current epoch."""
        return [stage for stage in self.stages if stage.first <= self.current_epoch][-1]

    @property
    def seconds(self) -> float:
        """Time spent in training so far [s], that before a resumption included."""
        return self.seconds_before + time.perf_counter() - self.started

    def _terms(self, windows: Windows) -> dict[str, Tensor]:
        with self.model.softened(self.optimizer.temperature(self.current_epoch)):
            return loss_terms(self.model, windows.first(self.stage.horizon), self.stage.loss)

    def _total(self, terms: Mapping[str, Tensor]) -> Tensor:
        loss = self.stage.loss
        return torch.stack([loss[name] * term for name, term in terms.items() if loss.get(name)]).sum()

    def _optimizers(self) -> list[Any]:
        found = self.optimizers()
        return found if isinstance(found, list) else [found]
