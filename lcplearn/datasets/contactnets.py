"""Turn the published ContactNets cube tosses into the arrays of two data files; `lcplearn.datasets.get` writes them.

They are in `data/tosses_processed` of github.com/DAIRLab/contact-nets (BSD-3-Clause). Each toss is a file NUMBER.pt
with a tensor [1, T, 19]: position (x, y, z), quaternion of the body in the world (w, x, y, z), velocity, angular
velocity in the body frame, six unused controls; lengths in half widths of the cube, 148 rows a second.
"""

import pickle
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from lcplearn.datasets.cube_slides import COLUMNS as SLIDE_COLUMNS

TOSSES_FILE = "cube_tosses.npz"
TOSS_COLUMNS = ("x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz", "wx_body", "wy_body", "wz_body")
DT = 1 / 148  # [s]
HALF_WIDTH = 0.0524  # [m]
GRAVITY = 9.81  # [m/s^2]
MASS = 0.37  # [kg], published, as are the next three
INERTIA = 0.00081  # [kg m^2] about each axis
MU_REPORTED = 0.18
RESTITUTION_REPORTED = 0.125
_CONTROLS = 6
_CORNERS = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0], indexing="ij"), axis=-1).reshape(8, 3)


class Slide(NamedTuple):
    """The slide to rest at the end of a toss.

    Attributes:
        start_row: Row of the toss at which it starts.
        rows: Values of `cube_slides.COLUMNS`, one row an instant.
    """

    start_row: int
    rows: NDArray


def read_toss(path: Path | str) -> NDArray:
    """State rows [T, 13] of one published toss, in its own units (`TOSS_COLUMNS`).

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It isn't a tensor [1, T, 19] of finite numbers with zero controls. Pickled code is never run.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with warnings.catch_warnings(action="ignore"):  # about odd pickles: the ValueError below says it
            toss = torch.load(path, weights_only=True, map_location="cpu")
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError, KeyError):
        raise ValueError(f"{path}: expected one saved tensor, got something that can't be read without risk") from None
    columns = len(TOSS_COLUMNS) + _CONTROLS
    if not isinstance(toss, torch.Tensor) or toss.ndim != 3 or toss.shape[0] != 1 or toss.shape[2] != columns:
        shape = list(toss.shape) if isinstance(toss, torch.Tensor) else type(toss).__name__
        raise ValueError(f"{path}: expected a tensor of shape [1, T, {columns}], got {shape}")
    if toss.shape[1] == 0:
        raise ValueError(f"{path}: expected at least one row, got none")
    rows: NDArray = toss[0].to(torch.float64).numpy()
    if not np.isfinite(rows).all():
        raise ValueError(f"{path}: {int((~np.isfinite(rows)).sum())} values are NaN or infinite")
    if rows[:, len(TOSS_COLUMNS) :].any():
        raise ValueError(f"{path}: expected the last {_CONTROLS} columns (controls) to be zero, got other numbers")
    return rows[:, : len(TOSS_COLUMNS)]


def final_slide(toss: NDArray) -> Slide | None:
    """The last stretch of a toss in which the cube slides flat on the board, if there is one.

    A row is flat if its four lowest corners are below 0.12 half widths, it turns at less than 1 rad/s and moves
    vertically at less than 1.5 half widths/s. The last unbroken run of flat rows counts if it has at least 16 rows
    and starts faster than 0.1 m/s. With d the horizontal unit vector from its start to its stop, s is along d and
    lateral is d_x y - d_y x; yaw rate is the angular velocity about the body's own z axis.

    Args:
        toss: State rows, as `read_toss` gives them.

    Returns:
        The slide in SI units, or None.
    """
    corner_heights = toss[:, 2:3] + _up_in_body(toss[:, 3:7]) @ _CORNERS.T
    fourth_lowest = np.sort(corner_heights, axis=1)[:, 3]
    turning = np.linalg.norm(toss[:, 10:13], axis=1)
    flat = (fourth_lowest < 0.12) & (turning < 1.0) & (np.abs(toss[:, 9]) < 1.5)
    if not flat.any():
        return None
    stop = int(np.flatnonzero(flat)[-1]) + 1
    breaks = np.flatnonzero(~flat[:stop])
    start = int(breaks[-1]) + 1 if len(breaks) else 0
    rows = toss[start:stop]
    if len(rows) < 16 or np.linalg.norm(rows[0, 7:9]) * HALF_WIDTH <= 0.1:
        return None
    moved = (rows[:, :2] - rows[0, :2]) * HALF_WIDTH
    direction = moved[-1] / np.linalg.norm(moved[-1])
    return Slide(
        start,
        np.column_stack(
            (
                np.arange(len(rows)) * DT,
                moved @ direction,
                rows[:, 7:9] @ direction * HALF_WIDTH,
                direction[0] * moved[:, 1] - direction[1] * moved[:, 0],
                rows[:, 2] * HALF_WIDTH,
                rows[:, 12],
            )
        ),
    )


def convert(folder: Path | str) -> tuple[dict[str, NDArray], dict[str, NDArray]]:
    """All tosses of a folder and the slides at their ends, as the arrays of the two data files.

    Args:
        folder: Folder with files NUMBER.pt.

    Returns:
        Arrays of cube_tosses.npz and of cube_slides.npz.

    Raises:
        FileNotFoundError: The folder is missing or has no such file.
        ValueError: A file can't be used, or no toss ends in a slide.
    """
    folder = Path(folder)
    paths = sorted((path for path in folder.glob("*.pt") if path.stem.isdecimal()), key=lambda path: int(path.stem))
    if not paths:
        raise FileNotFoundError(
            f"{folder}: expected toss files 0.pt, 1.pt, ... (data/tosses_processed of contact-nets), got none"
        )
    numbers = np.array([int(path.stem) for path in paths], dtype=np.int32)
    tosses = [read_toss(path) for path in paths]
    slides = [(number, slide) for number, toss in zip(numbers, tosses, strict=True) if (slide := final_slide(toss))]
    if not slides:
        raise ValueError(f"{folder}: none of the {len(tosses)} tosses ends in a flat slide")
    toss_arrays = {
        "state": np.concatenate(tosses),
        "toss_index": np.repeat(np.arange(len(tosses), dtype=np.int32), [len(toss) for toss in tosses]),
        "offsets": _offsets(tosses),
        "source_id": numbers,
        "columns": np.array(TOSS_COLUMNS),
        "dt": np.array(DT),
        "half_width_m": np.array(HALF_WIDTH),
        "g_scaled": np.array(GRAVITY / HALF_WIDTH),
        "mass_kg": np.array(MASS),
        "inertia_kg_m2": np.array(INERTIA),
        "corners_scaled": _CORNERS,
        "mu_reported": np.array(MU_REPORTED),
        "restitution_reported": np.array(RESTITUTION_REPORTED),
    }
    slide_arrays = {
        "data": np.concatenate([slide.rows for _, slide in slides]),
        "offsets": _offsets([slide.rows for _, slide in slides]),
        "columns": np.array(SLIDE_COLUMNS),
        "source_id": np.array([number for number, _ in slides], dtype=np.int32),
        "source_start_row": np.array([slide.start_row for _, slide in slides]),
        "dt": np.array(DT),
        "g": np.array(GRAVITY),
        "mass_kg": np.array(MASS),
    }
    return toss_arrays, slide_arrays


def _up_in_body(quaternions: NDArray) -> NDArray:
    """World z axis in body coordinates, [T, 3]: its product with a body point is the point's height."""
    w, x, y, z = quaternions.T
    return np.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), axis=-1)


def _offsets(records: list[NDArray]) -> NDArray:
    return np.cumsum([0, *(len(record) for record in records)], dtype=np.int64)
