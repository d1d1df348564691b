"""What drives a prediction: forces, and what else stands in a CSV or NPZ file."""

import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.datasets.files import positive_number, read_npz
from lcplearn.scenes.space import LINE, Space

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
        raise ValueError(f"{path}: expected a name that ends in .csv or .npz")
    arrays = _read_npz(path) if path.suffix == ".npz" else _read_csv(path, _force_names(space))
    tensors = {key: torch.as_tensor(value, dtype=torch.float64) for key, value in arrays.items()}
    forces, friction, state = tensors["forces"], tensors.get("friction"), tensors.get("state")
    for name, tensor in (("forces", forces), ("friction", friction), ("state", state)):
        if tensor is not None and not bool(tensor.isfinite().all()):
            raise ValueError(f"{path}: {name}: expected finite numbers, got NaN or infinity")
    if forces.ndim == 0 or forces.shape[-1] == 0 or forces.numel() == 0:
        raise ValueError(f"{path}: forces: expected at least one step, got none")
    if space.nv == 1 and not (forces.ndim > 1 and forces.shape[-1] == 1):
        forces = forces[..., None]
    if forces.ndim not in (2, 3) or forces.shape[-1] != space.nv:
        wanted = "[T], [T, 1], [N, T] or [N, T, 1]" if space.nv == 1 else f"[T, {space.nv}] or [N, T, {space.nv}]"
        raise ValueError(f"{path}: forces: expected shape {wanted}, got {list(tensors['forces'].shape)}")
    steps, columns = forces.shape[:-1], space.nq + space.nv
    if friction is not None and friction.shape != (*steps, 2):
        raise ValueError(f"{path}: friction: expected shape {[*steps, 2]}, got {list(friction.shape)}")
    if state is not None and state.shape not in ((columns,), (*steps[:-1], columns)):
        wanted = f"{[*steps[:-1], columns]} or [{columns}]"
        raise ValueError(f"{path}: state: expected shape {wanted}, got {list(state.shape)}")
    dt = tensors.get("dt")
    return Inputs(forces, friction, state, None if dt is None else positive_number(path, "dt", dt.numpy()))


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
    missing = [name for name in names if name not in header]
    if missing:
        raise ValueError(f"{path} has no column '{missing[0]}'; it has {', '.join(header) or 'nothing'}.")
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
            raise ValueError(f"{path}: {clock}: expected instants at equal steps [s], got others")
    return arrays


def _number(text: str, what: str) -> float:
    """A decimal number; Python's own `float` would take 1_000 too."""
    try:
        if "_" in text:
            raise ValueError
        return float(text)
    except ValueError:
        hint = "; decimals have a point, not a comma" if re.fullmatch(r"\s*[+-]?\d+,\d+\s*", text) else ""
        raise ValueError(f"{what}: expected a number, got {text!r}{hint}") from None


def _read_npz(path: Path) -> dict[str, Any]:
    arrays = read_npz(path, ("forces",), optional=("friction", "state", "dt"))
    text = [name for name, array in arrays.items() if array.dtype.kind == "U"]
    if text:
        raise ValueError(f"{path}: {text[0]}: expected numbers, got text")
    return arrays
