"""Learn a sliding block from noisy recordings, and see that it comes to rest exactly.

python examples/sliding_block.py
"""

from tempfile import TemporaryDirectory

import torch

from lcplearn.datasets import simulate_sliding_block
from lcplearn.formulations import MLP, Structured
from lcplearn.training import Optimizer, fit


def main(epochs: int = 150) -> tuple[float, float]:
    """Train a formulation that can stick and a network that can't; return the speed of each after two seconds."""
    torch.set_num_threads(1)
    data = simulate_sliding_block(noise=0.01, mu=0.4, mass=1.5)
    speeds = []
    for model in (Structured(dt=data.dt), MLP(dt=data.dt, space=data.space)):
        with TemporaryDirectory() as folder:
            optimizer = Optimizer(lbfgs_after=2 * epochs // 3)
            result = fit(model, data, epochs=epochs, optimizer=optimizer, folder=f"{folder}/run")
        start = torch.tensor([0.0, 2.0], dtype=torch.float64)  # position [m], velocity [m/s]
        path = result.model.rollout(start, torch.zeros(40, 1, dtype=torch.float64))  # forces [N]
        speeds.append(abs(float(path.velocities[-1].detach())))
        print(f"{type(model).__name__:>10}: {speeds[-1]:.3g} m/s after {40 * data.dt:.0f} s without a force")
        print(f"{'':>10}  learned: {result.model.physical_parameters() or 'no number with a meaning'}")
    return speeds[0], speeds[1]


if __name__ == "__main__":
    main()
