"""Real pushes of a steel triangle by a robot's finger: where it stood, how the finger moved, where it ended."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from lcplearn.datasets.files import check_offsets, find, positive_number, read_npz
from lcplearn.scenes.pushes import Outcome, Push, Pushes, geometries

FILE = "planar_pushes.npz"
PROTOCOLS = ("known", "unseen_supports", "few")
_INPUTS = (
    "config", "pre_pose", "pusher", "pusher_offsets", "config_name", "config_surface", "object_vertices", "object_com",
    "object_mass",
)  # fmt: skip
_OUTCOME = ("post_pose", "force", "force_offsets")


class Split(NamedTuple):
    """Indices of the pushes to learn from and of those to judge on."""

    train: Int[Tensor, " n"]
    test: Int[Tensor, " m"]


@dataclass(frozen=True)
class PushData:
    """Pushes, their outcome, and how models are judged on them.

    Attributes:
        pushes: What models see.
        outcome: What they are to predict.
        configuration: Number of the configuration of each push, for reports.
        names: Name of each configuration.
        vertices: Corners of the object in its frame [m], counterclockwise.
        com: Its centre of mass [m].
        mass: [kg].
        splits: Each trains a model of its own; the figures are those of all their test pushes together.
    """

    pushes: Pushes
    outcome: Outcome
    configuration: Int[Tensor, " b"]
    names: tuple[str, ...]
    vertices: Float[Tensor, "v 2"]
    com: Float[Tensor, "2"]
    mass: float
    splits: tuple[Split, ...] = ()

    def take(self, rows: Int[Tensor, " n"]) -> "PushData":
        """Some of them, without splits."""
        some = {"pushes": self.pushes.take(rows), "outcome": self.outcome.take(rows)}
        return PushData(**{**vars(self), **some, "configuration": self.configuration[rows], "splits": ()})


def read_pushes(
    path: Path | str | None = None,
    *,
    protocol: str = "known",
    folds: int = 10,
    training_pushes: int | None = None,
    seed: int = 0,
) -> PushData:
    """Real pushes, and how to judge models on them.

    Protocols: "known" leaves each of `folds` random parts out in turn; "unseen_supports" leaves each support geometry
    out, on all surfaces; "few" learns from `training_pushes` random ones and is judged on all others, `folds` times.

    Args:
        path: The file; None for planar_pushes.npz where `find` looks.
        protocol: One of `PROTOCOLS`.
        folds: Parts, or repetitions.
        training_pushes: Pushes to learn from with "few".
        seed: Seed of the parts.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is not as described in data/README.md, has no end poses or forces to learn from, or a
            setting does not fit it.
    """
    path = find(FILE) if path is None else Path(path)
    data = read_all_pushes(path)
    count = len(data.configuration)
    for name, told in data.outcome._asdict().items():
        if bool(told.isnan().any()):
            raise ValueError(f"{path}: {name}: expected how each push ended, to learn from, got none")
    if protocol not in PROTOCOLS:
        raise ValueError(f"protocol: expected one of {', '.join(PROTOCOLS)}, got {protocol}")
    if not 2 <= folds <= count:
        raise ValueError(f"folds: expected 2 to {count} (the pushes in {path}), got {folds}")
    if (training_pushes is not None) != (protocol == "few"):
        raise ValueError(f"training_pushes: expected with protocol=few and only there, got {training_pushes}")
    if training_pushes is not None and not 0 < training_pushes < count:
        raise ValueError(f"training_pushes: expected 1 to {count - 1}, got {training_pushes}")
    generator = torch.Generator().manual_seed(seed)
    if protocol == "few":
        orders = [torch.randperm(count, generator=generator) for _ in range(folds)]
        splits = [Split(order[:training_pushes], order[training_pushes:]) for order in orders]
    elif protocol == "known":
        order = torch.randperm(count, generator=generator)
        parts = [order[k::folds] for k in range(folds)]
        splits = [Split(torch.cat([*parts[:k], *parts[k + 1 :]]), parts[k]) for k in range(folds)]
    else:
        geometry = geometries(data.pushes.points)
        splits = [Split((geometry != k).nonzero()[:, 0], (geometry == k).nonzero()[:, 0]) for k in geometry.unique()]
    return PushData(**{**vars(data), "splits": tuple(splits)})


def read_all_pushes(path: Path | str) -> PushData:
    """All pushes of a file, without splits: to score a model that is trained.

    A file without end poses or forces can be predicted, and not scored by them: they are NaN.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is not as described in data/README.md.
    """
    arrays = read_npz(path, _INPUTS, optional=_OUTCOME)
    arrays |= read_npz(path, ("config_support_points",), finite=False)  # NaN where the whole face bears
    config = _configurations(path, arrays)
    ends = np.array([straighten(rows[:, 1:]) for rows in _records(path, arrays, "pusher")])
    pose, force = np.full((len(config), 3), np.nan), np.full((len(config), 2), np.nan)
    pose = arrays.get("post_pose", pose)
    if "force" in arrays and "force_offsets" in arrays:
        rows = _records(path, arrays, "force")
        force = np.array([part[part[:, 0] >= part[-1, 0] / 2.0, 1:].mean(0) for part in rows])
    pre_pose, start, end, post_pose, mean_force, points, vertices, com = (
        torch.from_numpy(np.ascontiguousarray(array)).to(torch.float64)
        for array in (
            arrays["pre_pose"], ends[:, 0], ends[:, 1], pose, force, arrays["config_support_points"][config],
            arrays["object_vertices"], arrays["object_com"],
        )
    )  # fmt: skip
    return PushData(
        pushes=Pushes(Push(pre_pose, start, end), points, tuple(str(arrays["config_surface"][k]) for k in config)),
        outcome=Outcome(post_pose, mean_force),
        configuration=torch.from_numpy(config),
        names=tuple(str(name).partition("/")[0] for name in arrays["config_name"]),
        vertices=vertices,
        com=com,
        mass=positive_number(path, "object_mass", arrays["object_mass"]),
    )


def straighten(path: Float[NDArray, "n 2"]) -> Float[NDArray, "2 2"]:
    """First and last point of a path, on its line of least squares.

    Recorded to 0.1 mm, a path of 30 ms steps jumps in direction from step to step; the finger itself moved straight.
    """
    points = path.astype(np.float64)
    middle = points.mean(0)
    direction = np.linalg.svd(points - middle, full_matrices=False)[2][0]
    return middle + np.outer((points[[0, -1]] - middle) @ direction, direction)


def _configurations(path: Path | str, arrays: dict[str, NDArray]) -> NDArray:
    """Number of each push's configuration, after checking all shapes."""
    count, configurations = arrays["config"].size, arrays["config_name"].size
    corners = max((3, *arrays["object_vertices"].shape[:1]))
    shapes = {
        "config": (count,), "pre_pose": (count, 3), "post_pose": (count, 3), "config_name": (configurations,),
        "config_surface": (configurations,), "config_support_points": (configurations, 3, 2), "object_com": (2,),
        "object_vertices": (corners, 2),
    }  # fmt: skip
    for name, shape in shapes.items():
        if name not in arrays:
            continue
        kinds, what = {"config": ("iu", "integers"), "config_name": ("U", "text"), "config_surface": ("U", "text")}.get(
            name, ("fiu", "numbers")
        )
        if arrays[name].shape != shape or arrays[name].dtype.kind not in kinds:
            got = f"{arrays[name].dtype} {list(arrays[name].shape)}"
            raise ValueError(f"{path}: {name}: expected {what} of shape {list(shape)}, got {got}")
    config = arrays["config"].astype(np.int64)
    if count == 0 or config.min() < 0 or config.max() >= configurations:
        raise ValueError(f"{path}: config: expected numbers from 0 to {configurations - 1} for at least one push")
    for points in arrays["config_support_points"]:
        if not (np.isnan(points).all() or _bear(points, arrays["object_com"])):
            raise ValueError(
                f"{path}: config_support_points: expected three points around the centre of mass, or NaN for the "
                f"whole face, got {points.tolist()}"
            )
    return config


def _bear(points: NDArray, com: NDArray) -> bool:
    """Whether all three points bear a share of the weight."""
    arms = points - com
    shares = [a[0] * b[1] - a[1] * b[0] for a, b in ((arms[1], arms[2]), (arms[2], arms[0]), (arms[0], arms[1]))]
    return bool((np.array(shares) > 0.0).all() or (np.array(shares) < 0.0).all())


def _records(path: Path | str, arrays: dict[str, NDArray], name: str) -> list[NDArray]:
    rows, offsets = arrays[name], arrays[f"{name}_offsets"]
    if rows.ndim != 2 or rows.shape[1] != 3 or rows.dtype.kind == "U" or offsets.size != len(arrays["config"]) + 1:
        raise ValueError(f"{path}: {name}: expected rows of 3 numbers for {len(arrays['config'])} pushes")
    check_offsets(path, offsets, len(rows))
    return np.split(rows.astype(np.float64), offsets[1:-1])
