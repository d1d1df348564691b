"""A data set of one's own: a function that returns a `Task`. Here it is simulated; read your recordings in its place.

python -m extending.data_set     in examples/
"""

import torch
from extending.scene import RampBlock

from lcplearn.datasets import Recordings, Task
from lcplearn.scenes import LINE, Drive


def simulate_ramp(
    *, seed: int = 0, slope: float = 0.3, mu: float = 0.4, dt: float = 0.05, length: int = 50, outliers: float = 0.0
) -> Task:
    """Recordings of a block on a ramp under random forces, in three parts: to learn from, to validate on, to judge by.

    Args:
        seed: Of the draw; each part has its own.
        slope: Of the ramp [rad]; given to models.
        mu: Friction coefficient; the truth to be found.
        dt: Time step [s].
        length: Steps of a recording.
        outliers: Share of recorded velocities that are wrong by 1 m/s, in the first two parts.
    """
    scene = RampBlock(slope, mu, dt)
    parts = []
    for number in range(3):
        generator = torch.Generator().manual_seed(3 * seed + number)
        force = 4.0 * torch.randn(10, length, 1, generator=generator, dtype=torch.float64)  # [N, T, nv], in newtons
        true = scene.rollout(torch.zeros(10, 2, dtype=torch.float64), force).states  # [N, T + 1, nq + nv]
        wrong = torch.rand(true.shape[:-1], generator=generator) < outliers * (number < 2)
        recorded = true + wrong.unsqueeze(-1) * torch.tensor([0.0, 1.0])
        steps = torch.full((10,), length)  # shorter recordings are padded at their ends, and say so here
        parts.append(Recordings(recorded, Drive(force), steps, true))
    return Task("ramp", LINE, dt, *parts, given={"slope": slope}, truth={"mu": mu}, scene=scene)


def main() -> int:
    """Draw it; return the number of recordings. A shape that does not fit would be named in a ValueError."""
    task = simulate_ramp()
    print(f"{task.name}: {len(task.train.steps)} recordings of {int(task.train.steps[0])} steps to learn from")
    return len(task.train.steps)


if __name__ == "__main__":
    main()
