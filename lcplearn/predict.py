"""Predict with a trained model: python -m lcplearn.predict CHECKPOINT --input forces.csv --output motion.csv

CSV input has a header and a column `force` [N], one row a time step; models that need measured friction also read
`friction_plus` and `friction_minus` [N]. NPZ input has `forces` [T] or [N, T], and may have `friction` [..., T, 2] and
`state` [..., 2]. `--score DATA` judges the model on recordings instead: cube_slides.npz, or an NPZ file with `dt` and
the arrays of lcplearn.datasets.Recordings.
"""

import argparse
import csv
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.datasets import BlockData, read_all_cube_slides, read_recordings
from lcplearn.datasets.files import read_npz
from lcplearn.formulations import Formulation
from lcplearn.scenes.rollout import Mode, Trajectory
from lcplearn.training.checkpoint import load

FRICTION = ("friction_plus", "friction_minus")


class Inputs(NamedTuple):
    """What drives a rollout.

    Attributes:
        forces: Force of each step [N].
        friction: Measured friction of each step [N], None if there is none.
        state: Position [m] and velocity [m/s] at the start, None if the file has none.
    """

    forces: Float[Tensor, "*batch T 1"]
    friction: Float[Tensor, "*batch T 2"] | None
    state: Float[Tensor, "*batch 2"] | None


def read_inputs(path: str | Path) -> Inputs:
    """Read forces, and what else stands there, from a CSV or NPZ file.

    Raises:
        ValueError: one sentence on what is wrong with the file.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"There is no input file {path}.")
    arrays = {".csv": _read_csv, ".npz": _read_npz}.get(path.suffix, _unknown)(path)
    if "forces" not in arrays:
        raise ValueError(f"{path} has no column 'force'; it has {', '.join(arrays) or 'nothing'}.")
    tensors = {key: torch.as_tensor(value, dtype=torch.float64) for key, value in arrays.items()}
    forces, friction, state = tensors["forces"], tensors.get("friction"), tensors.get("state")
    for name, tensor in (("forces", forces), ("friction", friction), ("state", state)):
        if tensor is not None and not bool(tensor.isfinite().all()):
            raise ValueError(f"{path}: {name} must be finite numbers.")
    if forces.ndim == 0 or forces.shape[-1] == 0:
        raise ValueError(f"{path}: forces must have at least one step.")
    if friction is not None and friction.shape != (*forces.shape, 2):
        raise ValueError(f"{path}: friction must have shape {[*forces.shape, 2]}, got {list(friction.shape)}.")
    if state is not None and state.shape not in ((2,), (*forces.shape[:-1], 2)):
        raise ValueError(f"{path}: state must have shape {[*forces.shape[:-1], 2]} or [2], got {list(state.shape)}.")
    return Inputs(forces[..., None], friction, state)


@torch.no_grad()
def predict(model: Formulation, inputs: Inputs, state: Float[Tensor, "*batch 2"] | None = None) -> Trajectory:
    """Roll the model out.

    Args:
        model: A trained model.
        inputs: Forces, and friction where the model needs it.
        state: Position [m] and velocity [m/s] at the start; the inputs' own, else rest at 0, by default.

    Raises:
        ValueError: the model needs measured friction and the inputs have none, or the state is not finite.
    """
    if model.needs_friction and inputs.friction is None:
        raise ValueError(
            f"{type(model).__name__} needs measured friction: the columns {' and '.join(FRICTION)} in a CSV file, "
            "or an array 'friction' in an NPZ file."
        )
    if state is None:
        state = inputs.state if inputs.state is not None else torch.zeros(2, dtype=torch.float64)
    if not bool(state.isfinite().all()):
        raise ValueError(f"state: expected finite position and velocity, got {state.tolist()}.")
    return model.rollout(state, inputs.forces, inputs.friction if model.needs_friction else None)


def write(path: str | Path, trajectory: Trajectory, dt: float) -> None:
    """Write a trajectory as CSV (one trajectory only) or NPZ.

    Raises:
        ValueError: several trajectories for a CSV file, or another kind of file.
    """
    path = Path(path)
    positions, velocities, mode = (tensor[..., 0].numpy() for tensor in trajectory[:3])
    time = np.arange(positions.shape[-1]) * dt
    if path.suffix == ".npz":
        np.savez(path, time=time, positions=positions, velocities=velocities, mode=mode)
        return
    if path.suffix != ".csv":
        _unknown(path)
    if positions.ndim > 1:
        raise ValueError(f"{path}: a CSV file holds one trajectory, not {len(positions)}; write .npz instead.")
    names = ["", *(Mode(value).name.lower() for value in mode.tolist())]
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("time_s", "position_m", "velocity_m_s", "mode"))
        writer.writerows(zip(time.tolist(), positions.tolist(), velocities.tolist(), names, strict=True))


def read_data(path: str | Path, model: Formulation) -> BlockData:
    """Read recordings to score a model on; all of them are the test.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a file of recordings, or one with another time step than the model's.
    """
    slides = "offsets" in read_npz(path, (), optional=("offsets",))
    data = read_all_cube_slides(path) if slides else read_recordings(path, gravity=model.gravity)
    if abs(data.dt / model.dt - 1.0) > 1e-9:
        raise ValueError(f"{path} has time steps of {data.dt:.6g} s, but the model was trained for {model.dt:.6g} s.")
    if model.needs_friction and data.test.friction is None:
        raise ValueError(f"{type(model).__name__} needs measured friction, and {path} has no array 'friction'.")
    return data


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; what is wrong with a file ends it with one sentence."""
    parser = argparse.ArgumentParser(
        prog="python -m lcplearn.predict", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint", help="best.ckpt of a run")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--input", help="forces, CSV or NPZ")
    what.add_argument("--score", metavar="DATA", help="recordings to judge the model on, NPZ")
    parser.add_argument("--output", help="where to write: motion as CSV or NPZ, or the score as JSON")
    parser.add_argument("--state", nargs=2, type=float, metavar=("POSITION", "VELOCITY"), help="start [m, m/s]")
    parser.add_argument("--plot", metavar="PNG", help="picture of the motion")
    options = parser.parse_args(arguments)
    if options.score and (options.state or options.plot):
        parser.error("--state and --plot go with --input")
    try:
        _score(options) if options.score else _predict(options)
    except (ValueError, OSError) as error:
        sys.exit(str(error))


def _predict(options: argparse.Namespace) -> None:
    model = load(options.checkpoint, "cpu")
    state = None if options.state is None else torch.tensor(options.state, dtype=torch.float64)
    inputs = read_inputs(options.input)
    trajectory = predict(model, inputs, state)
    steps, stuck = trajectory.mode.shape[-2], float((trajectory.mode == Mode.STICK).double().mean())
    print(f"{type(model).__name__}: {steps} steps of {model.dt:.4g} s, at rest in {stuck:.0%} of them")
    if options.output:
        write(options.output, trajectory, model.dt)
    if options.plot:
        _draw(inputs, trajectory, model.dt).savefig(options.plot, dpi=120)


def _score(options: argparse.Namespace) -> None:
    from lcplearn.training.metrics import evaluate, format_table

    model = load(options.checkpoint, "cpu")
    metrics = evaluate(model, read_data(options.score, model))
    print(format_table(metrics))
    if options.output:
        Path(options.output).write_text(json.dumps(metrics, indent=2) + "\n")


def _draw(inputs: Inputs, trajectory: Trajectory, dt: float) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 6.0), layout="constrained")
    rows = [
        ("force [N]", inputs.forces[..., 0]),
        ("velocity [m/s]", trajectory.velocities[..., 0]),
        ("position [m]", trajectory.positions[..., 0]),
    ]
    time = torch.arange(trajectory.positions.shape[-2]) * dt
    for ax, (label, values) in zip(figure.subplots(3, 1, sharex=True), rows, strict=True):
        series = values.reshape(-1, values.shape[-1])
        for line in series[:10]:
            ax.stairs(line, time, baseline=None, linewidth=1.5) if label.startswith("force") else ax.plot(time, line)
        ax.set_ylabel(label)
        ax.grid(alpha=0.3)
    ax.set_xlabel("time [s]")
    return figure


def _read_csv(path: Path) -> dict[str, Any]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:  # spreadsheets begin a file with a byte order mark
            reader = csv.DictReader(file, skipinitialspace=True)
            rows, header = list(reader), list(reader.fieldnames or [])
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} is not a CSV file: {error}.") from None

    def column(name: str) -> list[float]:
        values = []
        for line, row in enumerate(rows, start=2):
            try:
                values.append(float(row[name]))
            except (TypeError, ValueError):
                raise ValueError(f"{path}, line {line}: {name} must be a number, got {row[name]!r}.") from None
        return values

    if "force" not in header:
        return dict.fromkeys(header)
    arrays: dict[str, Any] = {"forces": column("force")}
    if set(FRICTION) <= set(header):
        arrays["friction"] = np.array([column(name) for name in FRICTION]).T
    return arrays


def _read_npz(path: Path) -> dict[str, Any]:
    arrays = read_npz(path, ("forces",), optional=("friction", "state"))
    text = [name for name, array in arrays.items() if array.dtype.kind == "U"]
    if text:
        raise ValueError(f"{path}: {text[0]} must be numbers, got text.")
    return arrays


def _unknown(path: Path) -> Any:
    raise ValueError(f"{path} must end in .csv or .npz.")


if __name__ == "__main__":
    main()
