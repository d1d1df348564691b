"""What is minimised when: a training may go through stages, each with its own loss, horizon and learning rate."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from lcplearn.domains import positive
from lcplearn.training.optimizer import Optimizer


@dataclass(frozen=True)
class Stage:
    """Some epochs with one loss.

    Attributes:
        epochs: Their number; >= 1.
        loss: Weights of the loss terms.
        horizon: Steps of a window that the loss sees.
        lr: Learning rate of Adam at the start of the stage.
        first: Epoch with which it starts.
    """

    epochs: int
    loss: Mapping[str, float]
    horizon: int
    lr: float
    first: int = 0

    def learning_rate(self, epoch: int, optimizer: Optimizer) -> float:
        """Adam's learning rate in an epoch of the stage."""
        after = optimizer.lbfgs_after
        own = replace(optimizer, lr=self.lr, lbfgs_after=None if after is None else max(after - self.first, 0))
        return own.learning_rate(epoch - self.first, self.epochs)


def plan(
    before: Sequence[Mapping[str, Any]], *, loss: Mapping[str, float], horizon: int, epochs: int, lr: float
) -> tuple[Stage, ...]:
    """The stages of a training of so many epochs.

    Args:
        before: Stages before the last one: `epochs`, and what differs of lr, horizon and the weights of the loss.
        loss: Weights of the loss terms of the last stage, which take the place of those that a stage leaves out.
        horizon: Steps of its windows; the longest.
        epochs: Epochs of the whole training.
        lr: Learning rate of the last stage.

    Raises:
        ValueError: No epoch or no step, a stage lacks its epochs or leaves none to the last stage, its horizon is out
            of range, or its learning rate is no positive number.
    """
    if epochs < 1:
        raise ValueError(f"epochs: expected at least 1, got {epochs}")
    if horizon < 1:
        raise ValueError(f"horizon: expected at least 1 step, got {horizon}")
    if not isinstance(before, Sequence) or not all(isinstance(stage, Mapping) for stage in before):
        raise ValueError(f"stages: expected a list of {{epochs: .., what differs}}, got {before!r}")
    stages: list[Stage] = []
    first = 0
    for number, given in enumerate((*before, {}), 1):
        what = {"lr": lr, "horizon": horizon, "epochs": epochs - first if number > len(before) else 0} | dict(given)
        stage = Stage(what.pop("epochs"), {}, what.pop("horizon"), what.pop("lr"), first)
        if not (isinstance(stage.epochs, int) and stage.epochs >= 1):
            raise ValueError(f"stages: expected at least 1 epoch in stage {number}, got {stage.epochs!r}")
        if not (isinstance(stage.horizon, int) and 1 <= stage.horizon <= horizon):
            raise ValueError(f"stages: expected a horizon from 1 to {horizon} in stage {number}, got {stage.horizon!r}")
        positive(f"stages: lr of stage {number}", stage.lr)
        stages.append(replace(stage, loss=dict(loss) | what))
        first += stage.epochs
    return tuple(stages)
