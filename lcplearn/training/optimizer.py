"""When which optimiser takes over: Adam with cosine decay, then LBFGS."""

import math
from dataclasses import dataclass

import torch
from torch import nn

from lcplearn.domains import NOT_NEGATIVE, POSITIVE, check


@dataclass(frozen=True, kw_only=True)
class Optimizer:
    """Adam with cosine decay to zero, finished by LBFGS with strong Wolfe line search.

    Everything is a function of the epoch, so that a resumed training continues exactly.

    Attributes:
        lr: Learning rate of Adam at the start; > 0.
        lbfgs_after: Epoch in which LBFGS takes over; None for Adam to the end. LBFGS wants the full batch.
        lbfgs_iterations: Iterations of LBFGS in one epoch.
        anneal_epochs: Epochs in which models with a `temperature` start with a softened threshold; 0 for none.
        anneal_from: Softening at the start [m/s]; it falls to 1/500 of this over `anneal_epochs`, then to 0.

    Raises:
        ValueError: a value out of range.

    Source: NOTES 6.4 (the plateau) and 6.6.
    """

    lr: float = 5e-2
    lbfgs_after: int | None = None
    lbfgs_iterations: int = 10
    anneal_epochs: int = 0
    anneal_from: float = 1.0

    def __post_init__(self) -> None:
        check(POSITIVE, lr=self.lr, lbfgs_iterations=self.lbfgs_iterations, anneal_from=self.anneal_from)
        check(NOT_NEGATIVE, lbfgs_after=self.lbfgs_after, anneal_epochs=self.anneal_epochs)

    def build(self, model: nn.Module) -> list[torch.optim.Optimizer]:
        """Adam, and LBFGS if it is asked for."""
        parameters = [p for p in model.parameters() if p.requires_grad]
        adam = torch.optim.Adam(parameters, lr=float(self.lr))
        if self.lbfgs_after is None:
            return [adam]
        # No tolerances: losses of 1e-17 and below are meant. Early stopping ends what no longer improves.
        lbfgs = torch.optim.LBFGS(
            parameters,
            max_iter=self.lbfgs_iterations,
            history_size=20,
            tolerance_grad=0.0,
            tolerance_change=0.0,
            line_search_fn="strong_wolfe",
        )
        return [adam, lbfgs]

    def finishes(self, epoch: int) -> bool:
        """Whether LBFGS has taken over."""
        return self.lbfgs_after is not None and epoch >= self.lbfgs_after

    def learning_rate(self, epoch: int, max_epochs: int) -> float:
        """Adam's learning rate in an epoch."""
        last = max_epochs if self.lbfgs_after is None else min(self.lbfgs_after, max_epochs)
        return float(self.lr) * 0.5 * (1.0 + math.cos(math.pi * min(epoch / max(last, 1), 1.0)))

    def temperature(self, epoch: int) -> float:
        """Softening of the stick threshold in an epoch [m/s]."""
        if epoch >= self.anneal_epochs:
            return 0.0
        return self.anneal_from * 500.0 ** (-epoch / self.anneal_epochs)
