"""A loss term of one's own: a method of the model that knows it, by name.

Recordings with outliers: a squared error follows them, Huber's follows the others.

    python -m extending.loss     in examples/
"""

from collections.abc import Callable
from tempfile import TemporaryDirectory

from extending.data_set import simulate_ramp
from extending.formulation import Clipped
from torch import Tensor
from torch.nn.functional import huber_loss

from lcplearn.datasets.recordings import Windows
from lcplearn.training import Optimizer, fit


class RobustClipped(Clipped):
    """`Clipped` with one more loss term, `huber`."""

    def errors(self) -> dict[str, Callable[[Windows], Tensor]]:
        """All terms: functions of windows [B, k + 1 states] that give a value for each window, or each of its steps."""
        return super().errors() | {"huber": self.huber_error}

    def huber_error(self, windows: Windows) -> Tensor:
        """Huber's error of the velocity after one step, [B]; padding is masked by whoever calls it."""
        after = self.advance(windows.states[:, 0], windows.drive.at(0)).state
        return huber_loss(after[:, 1], windows.states[:, 1, 1], reduction="none", delta=0.01)


def main(epochs: int = 60) -> dict[str, float]:
    """Learn with each term; return the error of the learned mass [kg] by term."""
    task, off = simulate_ramp(outliers=0.05), {}
    for term in ("prediction", "huber"):
        model = RobustClipped(dt=task.dt)
        with TemporaryDirectory() as folder:
            optimizer = Optimizer(lbfgs_after=None, lr=0.05)
            fit(model, task, loss={term: 1.0}, epochs=epochs, optimizer=optimizer, folder=f"{folder}/run")
        off[term] = abs(model.physical_parameters()["mass"] - 1.0)
        print(f"{term:>10}: the mass is {off[term]:.3f} kg off")
    return off


if __name__ == "__main__":
    main()
