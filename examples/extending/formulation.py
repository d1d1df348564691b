"""A formulation of one's own: what is learned, and how a step follows from it.

v' = max(0, v + a u + b) with learned a and b: what clips is exactly 0 on an open set of inputs, so that it sticks.

    python -m extending.formulation     in examples/
"""

from tempfile import TemporaryDirectory

import torch
from extending.data_set import simulate_ramp
from torch import Tensor, nn

from lcplearn.formulations import LineFormulation
from lcplearn.training import Optimizer, fit


class Clipped(LineFormulation):
    """One velocity on a line, that only goes forward. Models with other states subclass `Formulation`: `advance`.

    Args:
        dt: Time step [s]; `dt`, `space`, `given` and `gravity` are taken from the data where a constructor asks.
        initial_mobility: Where a starts, in 1/kg.
    """

    def __init__(self, *, dt: float, initial_mobility: float = 0.5) -> None:
        super().__init__(dt=dt)  # constructors take keywords only: a checkpoint holds them
        self.mobility = nn.Parameter(torch.tensor(initial_mobility, dtype=torch.float64))
        self.shift = nn.Parameter(torch.tensor(0.0, dtype=torch.float64))

    def predict(self, velocity: Tensor, force: Tensor, friction: Tensor | None = None) -> tuple[Tensor, None]:
        """Velocity after a step [m/s], for any batch shape; the second would be the solution of an LCP."""
        return (velocity + self.dt * (self.mobility * force + self.shift)).clamp_min(0.0), None

    def physical_parameters(self) -> dict[str, float]:
        """Numbers with a meaning: shown while it trains, and in its results."""
        return {"mass": 1.0 / self.mobility.item()}


def main(epochs: int = 60) -> float:
    """Learn the ramp; return the learned mass [kg]."""
    task = simulate_ramp()
    model = Clipped(dt=task.dt)
    with TemporaryDirectory() as folder:
        result = fit(model, task, epochs=epochs, optimizer=Optimizer(lbfgs_after=epochs // 2), folder=f"{folder}/run")
    print(f"mass {model.physical_parameters()['mass']:.4f} kg; sticks kept: {result.metrics['stick_accuracy']:.1%}")
    return model.physical_parameters()["mass"]


if __name__ == "__main__":
    main()
