"""Predict with a trained model: python -m lcplearn.predict CHECKPOINT --input forces.csv --output motion.csv

CSV input has a header and a column `force` [N] (`force_1`, `force_2`, ... for models of several velocities), one row a
time step; models that need measured friction also read
`friction_plus` and `friction_minus` [N]; a column `time_s` or `time` [s] must have the model's steps. NPZ input has
`forces` [T, nv] or [N, T, nv], without nv where it is 1, and may have `friction` [..., T, 2], `state` [..., nq + nv]
and `dt` [s]. `--score DATA`
judges the model on recordings instead: cube_slides.npz, or an NPZ file with `dt` and the arrays of
lcplearn.datasets.Recordings.

A model of pushes is judged by `--score PUSHES.npz`, a file like planar_pushes.npz; `--output` is then an NPZ file of
predictions, `post_pose` (pushes, 3) [m, m, rad] and `force` (pushes, 2) [N].

A model of tosses is judged by `--score TOSSES.npz`, a file like cube_tosses.npz; `--output` is then an NPZ file with
the predicted `state` and `offsets`. They are predicted from row 0 of each toss and nothing else of it.
"""

import argparse
import csv
import re
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.datasets import Task, read_all_cube_slides, read_recordings
from lcplearn.datasets.files import find, positive_number, read_npz
from lcplearn.formulations import Formulation
from lcplearn.formulations.pushing import PushModel
from lcplearn.scenes.scene import Mode, Trajectory
from lcplearn.scenes.space import LINE, Space
from lcplearn.training.checkpoint import load

FRICTION = ("friction_plus", "friction_minus")
TIME = ("time_s", "time")


class Inputs(NamedTuple):
    """What drives a rollout.

    Attributes:
        forces: Force of each step [N].
        friction: Measured friction of each step [N], None if there is none.
        state: Positions, then velocities, at the start, None if the file has none.
        dt: Time of a step [s], None if the file has none.
    """

    forces: Float[Tensor, "*batch T nv"]
    friction: Float[Tensor, "*batch T 2"] | None
    state: Float[Tensor, "*batch nq_plus_nv"] | None
    dt: float | None = None


def read_inputs(path: str | Path, space: Space = LINE) -> Inputs:
    """Read forces, and what else stands there, from a CSV or NPZ file.

    Args:
        path: The file.
        space: Of the model that will be driven.

    Raises:
        ValueError: one sentence on what is wrong with the file.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"There is no input file {path}.")
    if path.suffix not in (".csv", ".npz"):
        _unknown(path)
    arrays = _read_npz(path) if path.suffix == ".npz" else _read_csv(path, _force_names(space))
    if "forces" not in arrays:
        missing = next(name for name in _force_names(space) if name not in arrays)
        raise ValueError(f"{path} has no column '{missing}'; it has {', '.join(arrays) or 'nothing'}.")
    tensors = {key: torch.as_tensor(value, dtype=torch.float64) for key, value in arrays.items()}
    forces, friction, state = tensors["forces"], tensors.get("friction"), tensors.get("state")
    for name, tensor in (("forces", forces), ("friction", friction), ("state", state)):
        if tensor is not None and not bool(tensor.isfinite().all()):
            raise ValueError(f"{path}: {name} must be finite numbers.")
    if forces.ndim == 0 or forces.shape[-1] == 0 or forces.numel() == 0:
        raise ValueError(f"{path}: forces must have at least one step.")
    if space.nv == 1 and not (forces.ndim > 1 and forces.shape[-1] == 1):
        forces = forces[..., None]
    if forces.ndim not in (2, 3) or forces.shape[-1] != space.nv:
        wanted = "[T], [T, 1], [N, T] or [N, T, 1]" if space.nv == 1 else f"[T, {space.nv}] or [N, T, {space.nv}]"
        raise ValueError(f"{path}: forces must have shape {wanted}, got {list(tensors['forces'].shape)}.")
    steps, columns = forces.shape[:-1], space.nq + space.nv
    if friction is not None and friction.shape != (*steps, 2):
        raise ValueError(f"{path}: friction must have shape {[*steps, 2]}, got {list(friction.shape)}.")
    if state is not None and state.shape not in ((columns,), (*steps[:-1], columns)):
        wanted = f"{[*steps[:-1], columns]} or [{columns}]"
        raise ValueError(f"{path}: state must have shape {wanted}, got {list(state.shape)}.")
    dt = tensors.get("dt")
    return Inputs(forces, friction, state, None if dt is None else positive_number(path, "dt", dt.numpy()))


@torch.no_grad()
def predict(model: Formulation, inputs: Inputs, state: Float[Tensor, "*batch nq_plus_nv"] | None = None) -> Trajectory:
    """Roll the model out.

    Args:
        model: A trained model.
        inputs: Forces, and friction where the model needs it.
        state: Positions, then velocities, at the start; the inputs' own, else rest at 0, by default.

    Raises:
        ValueError: the model needs measured friction and the inputs have none, their time step is another than the
            model's, or the state is not finite.
    """
    if inputs.dt is not None and abs(inputs.dt / model.dt - 1.0) > 1e-6:
        raise ValueError(
            f"The input has time steps of {inputs.dt:.6g} s, but the model was trained for {model.dt:.6g} s."
        )
    if model.needs_friction and inputs.friction is None:
        raise ValueError(
            f"{type(model).__name__} needs measured friction: the columns {' and '.join(FRICTION)} in a CSV file, "
            "or an array 'friction' in an NPZ file."
        )
    if state is None:
        state = inputs.state if inputs.state is not None else model.space.origin()
    if not bool(state.isfinite().all()):
        raise ValueError(f"state: expected finite positions and velocities, got {state.tolist()}.")
    return model.rollout(state, inputs.forces, inputs.friction if model.needs_friction else None)


def write(path: str | Path, trajectory: Trajectory, model: Formulation) -> None:
    """Write a trajectory as CSV (one trajectory only) or NPZ; the model's space names the columns.

    Raises:
        ValueError: several trajectories for a CSV file, or another kind of file.
    """
    path = Path(path)
    positions, velocities, mode = (tensor.numpy() for tensor in trajectory[:3])
    time = np.arange(positions.shape[-2]) * model.dt
    if path.suffix == ".npz":
        if model.space.nv == 1:
            positions, velocities, mode = positions[..., 0], velocities[..., 0], mode[..., 0]
        np.savez(path, time=time, positions=positions, velocities=velocities, mode=mode)
        return
    if path.suffix != ".csv":
        _unknown(path)
    if positions.ndim > 2:
        raise ValueError(f"{path}: a CSV file holds one trajectory, not {len(positions)}; write .npz instead.")
    contacts = mode.shape[-1]
    names = [[""] * contacts, *([Mode(value).name.lower() for value in row] for row in mode.tolist())]
    modes = ["mode"] if contacts == 1 else [f"mode_{k}" for k in range(1, contacts + 1)]
    rows = zip(time.tolist(), positions.tolist(), velocities.tolist(), names, strict=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("time_s", *model.space.positions, *model.space.velocities, *modes))
        writer.writerows((instant, *position, *velocity, *name) for instant, position, velocity, name in rows)


def read_data(path: str | Path, model: Formulation) -> Task:
    """Read recordings to score a model on; all of them are the test.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a file of recordings, or one with another time step than the model's.
    """
    path = _found(path)
    slides = "offsets" in read_npz(path, (), optional=("offsets",))
    truth = tuple(model.physical_parameters())
    data = (
        read_all_cube_slides(path)
        if slides
        else read_recordings(path, space=model.space, given=model.given, truth=truth)
    )
    if abs(data.dt / model.dt - 1.0) > 1e-9:
        raise ValueError(f"{path} has time steps of {data.dt:.6g} s, but the model was trained for {model.dt:.6g} s.")
    if model.needs_friction and data.test.drive.friction is None:
        raise ValueError(f"{type(model).__name__} needs measured friction, and {path} has no array 'friction'.")
    return data


def _found(path: str | Path) -> Path:
    """A data file, looked for where train.py looks if it isn't there."""
    path = Path(path)
    return find(path.name) if not path.exists() and str(path.parent) in (".", "data") else path


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
    parser.add_argument("--state", nargs="+", type=float, metavar="NUMBER", help="start: positions, then velocities")
    parser.add_argument("--plot", metavar="PICTURE", help="picture of the motion: PNG, PDF or SVG")
    parser.add_argument(
        "--trust", action="store_true", help="import the model's class from any module that the file names"
    )
    parser.add_argument("--version", action="version", version=f"lcplearn {version('lcplearn')}")
    options = parser.parse_args(arguments)
    if options.score and (options.state or options.plot):
        parser.error("--state and --plot go with --input")
    try:
        _score(options) if options.score else _predict(options)
    except OSError as error:
        sys.exit(f"{error.filename}: {error.strerror}." if error.filename and error.strerror else f"{error}.")
    except ValueError as error:
        sys.exit(str(error))


def _predict(options: argparse.Namespace) -> None:
    model = load(options.checkpoint, "cpu", trust=options.trust)
    if isinstance(model, PushModel):
        raise ValueError(f"{type(model).__name__} predicts pushes, not motion under forces: use --score PUSHES.npz.")
    state = None if options.state is None else torch.tensor(options.state, dtype=torch.float64)
    inputs = read_inputs(options.input, model.space)
    trajectory = predict(model, inputs, state)
    steps, stuck = trajectory.mode.shape[-2], float((trajectory.mode == Mode.STICK).double().mean())
    for path in (options.output, options.plot):
        if path:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
    if options.output:
        write(options.output, trajectory, model)
    if options.plot:
        _draw(inputs, trajectory, model).savefig(options.plot, dpi=120)
    unsolved = 0 if trajectory.solved is None else int((~trajectory.solved).sum())
    warning = (
        f"; {unsolved} of all steps without a verified solution: don't trust what follows them" if unsolved else ""
    )
    several = f"{len(trajectory.mode)} trajectories of " if trajectory.mode.ndim > 2 else ""
    print(
        f"{type(model).__name__}: {several}{steps} step{'s' * (steps > 1)} of {model.dt:.4g} s, "
        f"at rest in {stuck:.0%} of them{warning}"
    )


def _score(options: argparse.Namespace) -> None:
    from lcplearn.training.metrics import evaluate, format_table
    from lcplearn.training.writing import write_figures

    model = load(options.checkpoint, "cpu", trust=options.trust)
    if isinstance(model, PushModel):
        from lcplearn.training.push_scoring import score_pushes

        print(score_pushes(model, options.score, options.output))
        return
    if "state" in read_npz(_found(options.score), (), optional=("state",), finite=False):
        _score_tosses(model, options)
        return
    metrics = evaluate(model, read_data(options.score, model))
    print(format_table(metrics))
    if options.output:
        write_figures(options.output, metrics)


def _score_tosses(model: Formulation, options: argparse.Namespace) -> None:
    from lcplearn.training import toss_scores

    tosses = toss_scores.read_for(_found(options.score), model)
    predicted = toss_scores.predict_tosses(model, tosses)
    print(toss_scores.report(model, predicted, tosses))
    if options.output:
        toss_scores.write_tosses(options.output, predicted, tosses)


def _draw(inputs: Inputs, trajectory: Trajectory, model: Formulation) -> Any:
    from matplotlib.figure import Figure

    from lcplearn.training.figures import strip

    figure = Figure(figsize=(8.0, 6.0), layout="constrained")
    line = model.space.nv == 1
    rows = [
        ("force [N]" if line else "force [N, N m]", inputs.forces),
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


def _force_names(space: Space) -> list[str]:
    return ["force"] if space.nv == 1 else [f"force_{k}" for k in range(1, space.nv + 1)]


def _read_csv(path: Path, names: Sequence[str]) -> dict[str, Any]:
    """Columns of numbers; whatever else stands in the file is refused, with its line."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:  # spreadsheets begin a file with a byte order mark
            reader = csv.reader(file, skipinitialspace=True)
            lines = [(reader.line_num, cells) for cells in reader]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} is not a CSV file: {error}.") from None
    while lines and not any(cell.strip() for cell in lines[-1][1]):  # editors end a file with empty lines
        lines.pop()
    header = [name.strip() for name in lines.pop(0)[1]] if lines else []
    twice = sorted({name for name in header if header.count(name) > 1})
    if twice:
        raise ValueError(f"{path}, line 1: there are several columns '{twice[0]}'.")
    if not set(names) <= set(header):
        return dict.fromkeys(header)
    for line, cells in lines:
        if not any(cell.strip() for cell in cells):
            raise ValueError(f"{path}, line {line} is empty, but each line is one time step.")
        if len(cells) != len(header):
            hint = "; decimals have a point, not a comma" if len(cells) > len(header) else ""
            raise ValueError(f"{path}, line {line} has {len(cells)} cells, but the header {len(header)}{hint}.")

    def column(name: str) -> list[float]:
        index = header.index(name)
        return [_number(cells[index], f"{path}, line {line}: {name}") for line, cells in lines]

    arrays: dict[str, Any] = {"forces": np.array([column(name) for name in names]).T}
    if set(FRICTION) <= set(header):
        arrays["friction"] = np.array([column(name) for name in FRICTION]).T
    clock = next((name for name in TIME if name in header), None)
    if clock is not None and len(lines) > 1:
        time = np.array(column(clock))
        steps = np.diff(time)
        arrays["dt"] = (time[-1] - time[0]) / len(steps)
        if not arrays["dt"] > 0 or np.abs(steps / arrays["dt"] - 1.0).max() > 1e-3:
            raise ValueError(f"{path}: {clock} must rise by equal steps [s].")
    return arrays


def _number(text: str, what: str) -> float:
    """A decimal number; Python's own `float` would take 1_000 too."""
    try:
        if "_" in text:
            raise ValueError
        return float(text)
    except ValueError:
        hint = "; decimals have a point, not a comma" if re.fullmatch(r"\s*[+-]?\d+,\d+\s*", text) else ""
        raise ValueError(f"{what} must be a number, got {text!r}{hint}.") from None


def _read_npz(path: Path) -> dict[str, Any]:
    arrays = read_npz(path, ("forces",), optional=("friction", "state", "dt"))
    text = [name for name, array in arrays.items() if array.dtype.kind == "U"]
    if text:
        raise ValueError(f"{path}: {text[0]} must be numbers, got text.")
    return arrays


def _unknown(path: Path) -> Any:
    raise ValueError(f"{path} must end in .csv or .npz.")


if __name__ == "__main__":
    main()
