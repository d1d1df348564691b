"""Real recordings: an acrylic cube tossed onto a board.

The file counts lengths in half widths of the cube; everything read from it is in SI units.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from lcplearn.datasets.contactnets import (
    DT,
    GRAVITY,
    HALF_WIDTH,
    INERTIA,
    MASS,
    MU_REPORTED,
    RESTITUTION_REPORTED,
    TOSS_COLUMNS,
    TOSSES_FILE,
)
from lcplearn.datasets.files import check_offsets, find, positive_number, read_npz
from lcplearn.datasets.recordings import Recordings
from lcplearn.datasets.task import Task
from lcplearn.scenes.scene import Drive
from lcplearn.scenes.space import POSE

# Numbers of the published files, drawn once: with seed 0 everybody learns from the same tosses and chooses by the same.
LEARN = (
    *(518, 21, 255, 246, 168, 414, 415, 263, 208, 310, 534, 397, 272, 554, 0, 344, 448, 194, 57, 542, 162, 285, 206),
    *(183, 11, 438, 118, 428, 202, 558, 93, 446, 369, 513, 136, 282, 449, 177, 483, 328, 317, 412, 210, 56, 521, 59),
    *(361, 238, 257, 259, 514, 556, 146, 157, 188, 42, 181, 376, 505, 251, 416, 473, 23, 212),
)
CHOOSE = (
    *(281, 148, 307, 247, 368, 546, 149, 452, 288, 135, 426, 379, 52, 493, 536, 535, 95, 312, 18, 33, 198, 86, 293),
    *(234, 117, 68, 348, 32, 240, 9, 155, 562, 91, 374, 543, 97, 396, 422, 280, 277, 471, 528, 87, 175, 413, 356, 53),
    431,
)
_LENGTHS = (0, 1, 2, 7, 8, 9)  # columns of a state that are in half widths or half widths a second
_CONSTANTS = {  # key in the file: value where a file of the same format lacks it
    "dt": DT,
    "half_width_m": HALF_WIDTH,
    "mass_kg": MASS,
    "inertia_kg_m2": INERTIA,
    "mu_reported": MU_REPORTED,
    "restitution_reported": RESTITUTION_REPORTED,
}


@dataclass(frozen=True)
class Tosses:
    """Tosses of one cube, padded at their ends with their last row.

    Attributes:
        states: Position [m], unit quaternion (body to world, real part first), velocity [m/s], angular velocity in the
            body frame [rad/s].
        steps: Steps of each toss that are not padding.
        numbers: Number of the published file of each toss; -1 where the file does not say.
        dt: Time between two rows [s].
        half_width: Half of the cube's width [m].
        gravity: Gravitational acceleration [m/s^2].
        mass, inertia, mu, restitution: Published values [kg, kg m^2, 1, 1].
    """

    states: Float[Tensor, "N rows 13"]
    steps: Int[Tensor, " N"]
    numbers: tuple[int, ...]
    dt: float
    half_width: float
    gravity: float
    mass: float
    inertia: float
    mu: float
    restitution: float


def read_tosses(path: Path | str | None = None, *, only_starts: bool = False) -> Tosses:
    """Read all tosses of a file.

    Args:
        path: The file; None for cube_tosses.npz where `find` looks. It needs `state` and `offsets`; constants that it
            lacks are the published ones.
        only_starts: Check row 0 of each toss only: what comes after is a judge's business, and may be anything.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is not what `lcplearn.datasets.get` writes.
    """
    path = find(TOSSES_FILE) if path is None else Path(path)
    arrays = read_npz(
        path, ("state", "offsets"), optional=("source_id", "g_scaled", *_CONSTANTS), finite=not only_starts
    )
    state, offsets = arrays["state"], arrays["offsets"]
    if state.ndim != 2 or state.shape[1] != len(TOSS_COLUMNS) or state.dtype.kind != "f":
        raise ValueError(f"{path}: state: expected numbers of shape [rows, 13], got {state.dtype} {list(state.shape)}")
    check_offsets(path, offsets, len(state))
    checked = state[offsets[:-1]] if only_starts else state
    norms = np.linalg.norm(checked[:, 3:7], axis=1)
    if not np.isfinite(checked).all() or not (np.abs(norms - 1.0) < 1e-3).all():
        what = "row 0 of each toss" if only_starts else "rows"
        raise ValueError(f"{path}: state: expected {what} to be finite with unit quaternions, got other numbers")
    numbers = arrays.get("source_id", np.full(len(offsets) - 1, -1))
    if numbers.shape != (len(offsets) - 1,) or numbers.dtype.kind not in "iu":
        raise ValueError(f"{path}: source_id: expected {len(offsets) - 1} integers, got {list(numbers.shape)}")
    constants = {
        key: positive_number(path, key, arrays[key]) if key in arrays else value for key, value in _CONSTANTS.items()
    }
    half_width = constants["half_width_m"]
    gravity = positive_number(path, "g_scaled", arrays["g_scaled"]) * half_width if "g_scaled" in arrays else GRAVITY
    lengths = np.diff(offsets)
    rows = np.minimum(np.arange(lengths.max()), lengths[:, None] - 1) + offsets[:-1, None]
    states = state.astype(np.float64)[rows]
    states[..., _LENGTHS] *= half_width
    return Tosses(
        states=torch.from_numpy(states),
        steps=torch.from_numpy(lengths.astype(np.int64) - 1),
        numbers=tuple(numbers.tolist()),
        dt=constants["dt"],
        half_width=half_width,
        gravity=gravity,
        mass=constants["mass_kg"],
        inertia=constants["inertia_kg_m2"],
        mu=constants["mu_reported"],
        restitution=constants["restitution_reported"],
    )


def in_file_units(states: Float[Tensor, "N rows 13"], steps: Int[Tensor, " N"], half_width: float) -> NDArray:
    """Rows [rows, 13] of padded SI states as `state` of the file has them."""
    rows = torch.cat([toss[: count + 1] for toss, count in zip(states, steps.tolist(), strict=True)])
    found: NDArray = rows.detach().double().numpy().copy()
    found[:, _LENGTHS] /= half_width
    return found


def split(numbers: tuple[int, ...], seed: int = 0) -> tuple[list[int], list[int], list[int]]:
    """Which tosses to learn from, to choose by and to judge by, as indices.

    With seed 0 these are the frozen `LEARN` and `CHOOSE`, and all others. Another seed draws as many of each, in the
    order of a hash of seed and number, so that a number's place does not depend on which others there are.

    Raises:
        ValueError: Tosses of the frozen split are missing, or there are too few to draw another one.
    """
    where = {number: index for index, number in enumerate(numbers)}
    if seed == 0:
        missing = [number for number in (*LEARN, *CHOOSE) if number not in where]
        if missing:
            raise ValueError(
                f"source_id: expected the {len(LEARN) + len(CHOOSE)} tosses of the split of seed 0, "
                f"got {len(where)} tosses without {len(missing)} of them"
            )
        learn, choose = [where[number] for number in LEARN], [where[number] for number in CHOOSE]
    else:
        drawn = sorted(where, key=lambda number: hashlib.sha256(f"{seed}:{number}".encode()).digest())
        first, second = len(LEARN), len(LEARN) + len(CHOOSE)
        if len(drawn) <= second:
            raise ValueError(f"source_id: expected more than {second} different tosses to split, got {len(drawn)}")
        learn, choose = [where[n] for n in drawn[:first]], [where[n] for n in drawn[first:second]]
    taken = {*learn, *choose}
    return learn, choose, [index for index in range(len(numbers)) if index not in taken]


def read_cube_tosses(path: Path | str | None = None, *, seed: int = 0, tosses: int = 64, judge: bool = True) -> Task:
    """Real tosses of a cube: learn from some, choose by 48 others, judge by the rest.

    Args:
        path: The file; None for cube_tosses.npz where `find` looks.
        seed: Seed of the split; 0 is the frozen one.
        tosses: How many of the 64 to learn from, in their order.
        judge: False judges by the 48 tosses that choose, too: whoever looks often should not look at the rest.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is not what `lcplearn.datasets.get` writes, or has too few tosses.
    """
    found = read_tosses(path)
    learn, choose, rest = split(found.numbers, seed)
    if not 1 <= tosses <= len(learn):
        raise ValueError(f"tosses: expected 1 to {len(learn)}, got {tosses}")
    return _task(found, learn[:tosses], choose, rest if judge else choose)


def _task(found: Tosses, learn: list[int], choose: list[int], judge: list[int]) -> Task:
    def recordings(chosen: list[int]) -> Recordings:
        steps = found.steps[chosen]
        states = found.states[chosen, : int(steps.max()) + 1]
        return Recordings(states, Drive(states.new_zeros(len(chosen), states.shape[1] - 1, 6)), steps)

    return Task(
        name="cube tosses",
        space=POSE,
        dt=found.dt,
        train=recordings(learn),
        validation=recordings(choose),
        test=recordings(judge),
        given={
            "half_width": found.half_width,
            "mass": found.mass,
            "gravity": found.gravity,
            "inertia": found.inertia,
            "mu": found.mu,
            "restitution": found.restitution,
        },
        judged_by=("tosses",),
        chosen_by="pose",
        positions=True,
    )
