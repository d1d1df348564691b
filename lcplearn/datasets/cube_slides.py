"""Real recordings: a plastic cube that slides to rest on a board."""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from lcplearn.datasets.files import check_offsets, find, positive_number, read_npz
from lcplearn.datasets.recordings import Recordings
from lcplearn.datasets.task import Task
from lcplearn.scenes.scene import Drive
from lcplearn.scenes.space import LINE

FILE = "cube_slides.npz"
COLUMNS = ("t_s", "s_m", "v_m_s", "lateral_m", "z_m", "yaw_rate_rad_s")


def read_cube_slides(
    path: Path | str | None = None, *, seed: int = 0, training_slides: int = 40, validation_slides: int = 8
) -> Task:
    """Real slides of a cube to rest, split at random by slide.

    No force acts but gravity and friction, so that only mu can be learned: mass is the published one.

    Args:
        path: The file; None for cube_slides.npz where `find` looks.
        seed: Seed of the split.
        training_slides: Slides to learn from, validation included. All others are the test set.
        validation_slides: How many of these validate instead of train.

    Returns:
        The data; nobody knows the true friction coefficient.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is not what `lcplearn.datasets.get` writes, or has too few slides for the split.
    """
    path = find(FILE) if path is None else Path(path)
    slides, constants = _read(path)
    count = len(slides)
    if not 0 < validation_slides < training_slides < count:
        raise ValueError(
            "training_slides, validation_slides: expected 0 < validation_slides < training_slides < "
            f"{count} (the slides in {path}), got {training_slides} and {validation_slides}"
        )
    slides = [slides[k] for k in torch.randperm(count, generator=torch.Generator().manual_seed(seed)).tolist()]
    learning = training_slides - validation_slides
    parts = (slides[:learning], slides[learning:training_slides], slides[training_slides:])
    return _task([_recordings(part) for part in parts], constants)


def read_all_cube_slides(path: Path | str) -> Task:
    """Real slides as `read_cube_slides` has them, but all of them in each part: to score a model that is trained.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is not what `lcplearn.datasets.get` writes.
    """
    slides, constants = _read(Path(path))
    everything = _recordings(slides)
    return _task([everything] * 3, constants)


def _task(parts: list[Recordings], constants: dict[str, float]) -> Task:
    dt, given = constants["dt"], {name: constants[name] for name in ("gravity", "mass")}
    train, validation, test = parts
    return Task("cube_slides", LINE, dt, train, validation, test, given=given, judged_by=("one_step", "stops"))


def _read(path: Path) -> tuple[list[NDArray], dict[str, float]]:
    """Rows of each slide, and dt, gravity and mass."""
    arrays = read_npz(path, ("data", "offsets", "columns", "dt", "g", "mass_kg"))
    data, offsets = arrays["data"], arrays["offsets"]
    columns = tuple(str(name) for name in np.atleast_1d(arrays["columns"]))
    if columns != COLUMNS or data.ndim != 2 or data.shape[1] != len(COLUMNS) or data.dtype.kind != "f":
        raise ValueError(
            f"{path}: expected the columns {', '.join(COLUMNS)}, got {', '.join(columns)} "
            f"and data of {data.dtype} {list(data.shape)}"
        )
    if len(data) == 0:
        raise ValueError(f"{path}: expected at least one slide, got no rows")
    check_offsets(path, offsets, len(data))
    constants = {
        name: positive_number(path, key, arrays[key])
        for name, key in (("dt", "dt"), ("gravity", "g"), ("mass", "mass_kg"))
    }
    return np.split(data, offsets[1:-1]), constants


def _recordings(slides: list[NDArray]) -> Recordings:
    """Pad at the end with the last position and velocity."""
    instants = max(len(slide) for slide in slides)
    padded = torch.from_numpy(
        np.stack([np.pad(slide, ((0, instants - len(slide)), (0, 0)), mode="edge") for slide in slides])
    ).to(torch.float64)
    columns = [COLUMNS.index("s_m"), COLUMNS.index("v_m_s")]
    return Recordings(
        states=padded[..., columns].contiguous(),
        drive=Drive(torch.zeros(len(slides), instants - 1, 1, dtype=torch.float64)),
        steps=torch.tensor([len(slide) - 1 for slide in slides]),
    )
