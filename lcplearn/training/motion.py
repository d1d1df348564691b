"""A predicted motion as a file and as a picture."""

import csv
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.datasets.files import replace
from lcplearn.formulations import Formulation
from lcplearn.scenes.scene import Mode, Trajectory
from lcplearn.training.figures import strip

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write(path: str | Path, trajectory: Trajectory, model: Formulation) -> None:
    """Write a trajectory as CSV (one trajectory only) or NPZ; the model's space names the columns.

    Models that solve LCPs have `solved` beside the modes: 0 for a step without a verified solution.

    Raises:
        ValueError: several trajectories for a CSV file, or another kind of file.
    """
    path = Path(path)
    if path.suffix not in (".csv", ".npz"):
        raise ValueError(f"{path}: expected a name that ends in .csv or .npz")
    positions, velocities, mode = (tensor.numpy() for tensor in trajectory[:3])
    time = np.arange(positions.shape[-2]) * model.dt
    solved = {} if trajectory.solved is None else {"solved": trajectory.solved.numpy()}
    if path.suffix == ".npz":
        if model.space.nv == 1:
            positions, velocities, mode = positions[..., 0], velocities[..., 0], mode[..., 0]
        arrays = {"time": time, "positions": positions, "velocities": velocities, "mode": mode, **solved}
        replace(path, lambda file: np.savez(file, **arrays))  # type: ignore[arg-type]  # numpy types **arrays as flags
        return
    if positions.ndim > 2:
        raise ValueError(f"{path}: a CSV file holds one trajectory, not {len(positions)}; write .npz instead.")
    modes = ["mode"] if mode.shape[-1] == 1 else [f"mode_{k}" for k in range(1, mode.shape[-1] + 1)]
    steps: list[list[Any]] = [[Mode(value).name.lower() for value in row] for row in mode.tolist()]
    if solved:
        steps = [[*step, int(right)] for step, right in zip(steps, solved["solved"].tolist(), strict=True)]
    steps.insert(0, [""] * len(steps[0]))  # no step leads to the start
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(("time_s", *model.space.positions, *model.space.velocities, *modes, *solved))
    for instant, position, velocity, step in zip(time, positions.tolist(), velocities.tolist(), steps, strict=True):
        writer.writerow((f"{instant:.12g}", *position, *velocity, *step))  # 0.15, not 0.15000000000000002
    replace(path, lambda file: file.write(text.getvalue().encode()))


def draw(forces: Float[Tensor, "*batch T nv"], trajectory: Trajectory, model: Formulation) -> "Figure":
    """Draw forces, velocities and positions over time, and where a single trajectory is at rest."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 6.0), layout="constrained")
    line = model.space.nv == 1
    rows = [
        ("force [N]" if line else "force [N, N m]", forces),
        ("velocity [m/s]" if line else "velocity [m/s, rad/s]", trajectory.velocities),
        ("position [m]" if line else "position", trajectory.positions),
    ]
    time = torch.arange(trajectory.positions.shape[-2]) * model.dt
    axes = figure.subplots(3, 1, sharex=True)
    for ax, (label, values) in zip(axes, rows, strict=True):
        for series in values.transpose(-1, -2).reshape(-1, values.shape[-2])[:10]:
            if label.startswith("force"):
                ax.stairs(series, time, baseline=None, linewidth=1.5)
            else:
                ax.plot(time, series)
        ax.set_ylabel(label)
        ax.grid(alpha=0.3)
    ax.set_xlabel("time [s]")
    if trajectory.velocities.ndim == 2:
        speed = model.space.speed(trajectory.velocities, model.radius)
        strip(axes[1], time, speed, 0.02, "tab:red", "at rest")
        axes[1].legend(fontsize=8)
    return figure
