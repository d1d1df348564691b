"""Turn the public raw logs of the pushes into the arrays of a data file; `lcplearn.datasets.get` writes it.

They are in github.com/robinzhoucmu/MLab_EXP (Apache-2.0). A log is text: the number of pushes; for each push
the object's pose before and after (x y z [mm], quaternion, real part first), the number of force rows and the rows
(time [s], fx fy [N] of the sensor), the number of robot rows and the rows (time [s], x y z [mm], quaternion of the
tool).
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

FOLDER = "PushExp/sensor_log"
FEET = {
    "10_130_10_10_10_130": ((10, 130), (10, 10), (130, 10)),
    "10_90_10_10_30_130": ((10, 10), (90, 30), (10, 130)),
    "30_63.33_43.33_30_43.33_63.33": ((30, 30), (63.33, 43.33), (43.33, 63.33)),
    "30_90_30_30_30_90": ((30, 30), (90, 30), (30, 90)),
    "patch": None,
}  # mm, object frame; the whole face bears where there are none
LOGS = {
    "hardboard": (
        "10_130_10_10_10_130/exp_08_17_50.txt",
        "10_90_10_10_30_130/exp_08_15_50.txt",
        "30_63.33_43.33_30_43.33_63.33/exp_08_17_50.txt",
        "30_90_30_30_30_90/exp_08_11_50_mixed.txt",
        "patch/exp_08_18_1435_50.txt",
    ),
    "wood": (
        "wood_10_130_10_10_10_130/exp_08_17_50.txt",
        "wood_10_90_10_10_30_130/exp_08_18_1100_50.txt",
        "wood_30_63.33_43.33_30_43.33_63.33/exp_08_18_1330_50.txt",
        "wood_30_90_30_30_30_90/exp_08_17_0922_50.txt",
        "wood_patch/exp_08_17_0839_50.txt",
    ),
}
PULL = {"hardboard": 4.2, "wood": 5.0}  # N; with which the authors pulled the object over each surface
MASS, COM, LEG = 1.518, 0.05, 0.15  # kg, m, m
SENSOR = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2.0)  # sensor to tool: a reflection
UNLOADED = 0.3  # s at the start of a log in which the finger touches nothing


class RawPush(NamedTuple):
    """One push of a log, as it stands there.

    Attributes:
        before, after: Pose of the object, x y z [mm] and quaternion.
        force: Rows of time [s] and force [N] in the sensor's frame.
        robot: Rows of time [s], x y z [mm] and quaternion of the tool.
    """

    before: Float[NDArray, "7"]
    after: Float[NDArray, "7"]
    force: Float[NDArray, "n 3"]
    robot: Float[NDArray, "m 8"]


def parse(text: str) -> list[RawPush]:
    """Pushes of a log.

    Raises:
        ValueError: the text is no such log, or ends early.
    """
    lines = (line for line in text.splitlines() if line.strip())

    def rows(count: int, width: int) -> NDArray:
        found = [np.array(next(lines).split(), dtype=np.float64) for _ in range(count)]
        if any(len(row) != width for row in found):
            raise ValueError(f"expected rows of {width} numbers, got {sorted({len(row) for row in found})}")
        return np.array(found).reshape(count, width)

    def number() -> int:
        return int(next(lines))

    try:
        return [RawPush(rows(1, 7)[0], rows(1, 7)[0], rows(number(), 3), rows(number(), 8)) for _ in range(number())]
    except StopIteration:
        raise ValueError("the log ends in the middle of a push") from None


def convert(clone: Path) -> dict[str, NDArray]:
    """Arrays of planar_pushes.npz, as data/README.md describes them, of all logs.

    Raises:
        ValueError: a log is missing or not as expected.
    """
    files = [(surface, name) for surface, names in LOGS.items() for name in names]
    pushes = [(k, number, push) for k, (_, name) in enumerate(files) for number, push in enumerate(_read(clone, name))]
    paths = [np.column_stack((p.robot[:, 0] - p.robot[0, 0], 1e-3 * p.robot[:, 1:3])) for _, _, p in pushes]
    forces = [force_on_object(push) for _, _, push in pushes]
    feet = [FEET[name.partition("/")[0].removeprefix("wood_")] for _, name in files]
    return {
        "config": np.array([k for k, _, _ in pushes], dtype=np.int16),
        "source_push": np.array([number for _, number, _ in pushes], dtype=np.int16),
        "pre_pose": np.array([plane_pose(p.before) for _, _, p in pushes]),
        "post_pose": np.array([plane_pose(p.after) for _, _, p in pushes]),
        "pre_pose7_mm": np.array([p.before for _, _, p in pushes]),
        "post_pose7_mm": np.array([p.after for _, _, p in pushes]),
        "pusher": np.concatenate(paths).astype(np.float32),
        "pusher_offsets": _offsets(paths),
        "force": np.concatenate(forces).astype(np.float32),
        "force_offsets": _offsets(forces),
        "config_name": np.array([name for _, name in files]),
        "config_surface": np.array([surface for surface, _ in files]),
        "config_support_points": np.array([np.full((3, 2), np.nan) if f is None else 1e-3 * np.array(f) for f in feet]),
        "object_vertices": np.array([[0.0, 0.0], [LEG, 0.0], [0.0, LEG]]),
        "object_com": np.array([COM, COM]),
        "object_mass": np.array(MASS),
        "mu_surface_reported": np.array([PULL[surface] / (MASS * 9.8) for surface, _ in files]),
    }


def force_on_object(push: RawPush) -> Float[NDArray, "n 3"]:
    """Rows of time from the start of the robot's rows [s] and force on the object [N], world.

    The zero is the mean of the first 0.3 s; then sensor to tool, and turned by the tool's yaw.
    """
    start = push.robot[0, 0]
    force = -(push.force[:, 1:] @ SENSOR.T)
    force -= force[: max(np.searchsorted(push.force[:, 0], start + UNLOADED), 5)].mean(0)
    angle = yaw(push.robot[0, 4:])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.column_stack((push.force[:, 0] - start, force @ turn.T))


def plane_pose(pose: Float[NDArray, "7"]) -> Float[NDArray, "3"]:
    """x [m], y [m], angle [rad]."""
    return np.array((1e-3 * pose[0], 1e-3 * pose[1], yaw(pose[3:])))


def yaw(quaternion: Float[NDArray, "4"]) -> float:
    """Angle about the vertical of a unit quaternion, real part first [rad]."""
    w, x, y, z = quaternion
    return float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


def _read(clone: Path, name: str) -> Iterator[RawPush]:
    path = clone / FOLDER / name
    if not path.is_file():
        raise ValueError(f"{path} is missing: {clone} is no clone of github.com/robinzhoucmu/MLab_EXP")
    try:
        yield from parse(path.read_text())
    except (ValueError, IndexError) as error:
        raise ValueError(f"{path}: {error}") from None


def _offsets(parts: list[NDArray]) -> NDArray:
    return np.concatenate(([0], np.cumsum([len(part) for part in parts]))).astype(np.int64)
