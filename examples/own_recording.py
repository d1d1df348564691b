"""From CSV files of one's own to a checkpoint, and from the checkpoint to a prediction.

Each file is one recording of a block on a line, one row an instant: time [s], velocity [m/s], and the force [N] from
this instant to the next. Here such files are made first; put your folder in their place.

    python examples/own_recording.py [FOLDER]
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from torch import Tensor

import lcplearn
from lcplearn.datasets import Recordings, Task
from lcplearn.formulations import Physical
from lcplearn.scenes import LINE, Drive, SlidingBlock
from lcplearn.training import Optimizer, fit


def record(folder: Path, dt: float = 0.05) -> None:
    """Write what a real recording would bring: eight pushes of a block of 1.5 kg with mu = 0.4."""
    block = SlidingBlock(mass=1.5, mu=0.4, dt=dt)
    noise = np.random.default_rng(0)
    for k in range(8):
        force = torch.full((40, 1), (7.0 + k) * (-1) ** (k // 4), dtype=torch.float64)
        force[25:] = 0.0
        velocity = block.rollout(torch.zeros(2, dtype=torch.float64), force).velocities[:, 0].numpy()
        rows = (dt * np.arange(41), velocity + 1e-3 * noise.standard_normal(41), np.append(force[:, 0], 0.0))
        header = "time_s,velocity_m_s,force_N"
        np.savetxt(folder / f"push_{k}.csv", np.column_stack(rows), delimiter=",", header=header, comments="")


def read(folder: Path) -> Task:
    """A task of all files: half to learn from, a quarter to validate on, a quarter to judge by."""
    paths = sorted(folder.glob("*.csv"))
    if len(paths) < 4:
        raise ValueError(f"{folder}: expected at least 4 CSV files, one a recording, got {len(paths)}")
    tables = [torch.from_numpy(np.loadtxt(path, delimiter=",", skiprows=1)) for path in paths]
    dt = float(tables[0][1, 0] - tables[0][0, 0])
    longest = max(len(table) for table in tables)

    def padded(column: Tensor) -> Tensor:
        return torch.cat((column, column[-1:].expand(longest - len(column))))

    steps = torch.tensor([len(table) - 1 for table in tables])  # what lies behind is padding
    velocity = torch.stack([padded(table[:, 1]) for table in tables])
    force = torch.stack([padded(table[:, 2]) for table in tables])[:, :-1, None]
    moved = torch.nn.functional.pad(dt * velocity[:, 1:].cumsum(dim=1), (1, 0))
    states = torch.stack((moved, velocity), dim=-1)  # [N, T + 1, nq + nv]
    split = [k % 4 for k in range(len(tables))]
    parts = [[k for k in range(len(tables)) if split[k] in chosen] for chosen in ((0, 1), (2,), (3,))]
    recordings = [Recordings(states[part], Drive(force[part]), steps[part]) for part in parts]
    return Task("own", LINE, dt, *recordings, given={"gravity": 9.81})


def main(folder: Path | None = None, epochs: int = 100) -> dict[str, float]:
    """Learn, load the checkpoint as another program would, predict; return the learned numbers."""
    torch.set_num_threads(1)
    with TemporaryDirectory() as made:
        if folder is None:
            folder = Path(made)
            record(folder)
        task = read(folder)
        model = Physical(dt=task.dt)
        fit(model, task, epochs=epochs, optimizer=Optimizer(lbfgs_after=epochs // 2), folder=f"{made}/run")
        model = lcplearn.load(f"{made}/run/best.ckpt")
    path = model.rollout(torch.tensor([0.0, 1.0]), torch.zeros(20, 1))
    learned = model.physical_parameters()
    print(f"learned: {learned}")
    print(f"from 1 m/s it slides {float(path.positions[-1].detach()):.3f} m and stops")
    return learned


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
    except ValueError as wrong:
        sys.exit(str(wrong))
