"""What is to be learned: recordings to learn from and to be judged by, what is known and what is the truth."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lcplearn.datasets.files import number, positive_number, read_npz
from lcplearn.datasets.recordings import Recordings
from lcplearn.domains import positive
from lcplearn.scenes.scene import Drive, Scene
from lcplearn.scenes.space import LINE, Space

MOTION = ("one_step", "rollout")  # judges of every recorded motion


@dataclass(frozen=True)
class Task:
    """Recordings of one thing that moves, split by recording, and what is known of it.

    Attributes:
        name: What moves, in a word or two.
        space: What a state is.
        dt: Step size [s]; > 0.
        train, validation: Recordings to learn from, with measurement noise.
        test: Recordings for one-step errors, free of noise if simulated.
        test_long: Recordings for errors over long rollouts, free of noise; None if there are none beside `test`.
        given: Numbers that models may take as known, by name: gravity [m/s^2], say.
        truth: True numbers, by name, that learned ones are compared with.
        judged_by: Names of judges (`lcplearn.training.metrics.JUDGES`).
        scene: What made the recordings; None if they are not simulated.
        chosen_by: What the best model of a training is chosen by, on the validation recordings: "rollout", its velocity
            error over windows, or "pose", its pose error over whole recordings.
        positions: Whether velocities change with positions, so that models without contact structure should see them.

    Raises:
        ValueError: A shape doesn't fit the space, recordings have no step, or dt is not positive.
    """

    name: str
    space: Space
    dt: float
    train: Recordings
    validation: Recordings
    test: Recordings
    test_long: Recordings | None = None
    given: Mapping[str, Any] = field(default_factory=dict)
    truth: Mapping[str, float] = field(default_factory=dict)
    judged_by: tuple[str, ...] = MOTION
    scene: Scene | None = None
    chosen_by: str = "rollout"
    positions: bool = False

    def __post_init__(self) -> None:
        positive("dt", self.dt)
        for name in ("train", "validation", "test", "test_long"):
            if (part := getattr(self, name)) is not None:
                check_recordings(name, part, self.space)


def check_recordings(name: str, part: Recordings, space: Space) -> None:
    """Compare the shapes of recordings with each other and with the space.

    Raises:
        ValueError: One is another than it should be; the message names it.
    """
    columns = space.nq + space.nv
    if not isinstance(part.drive, Drive):
        raise ValueError(f"{name}.drive: expected a Drive, got {type(part.drive).__name__}")
    force, states = part.drive.force, part.states
    if force.ndim != 3 or force.shape[0] == 0 or force.shape[1] == 0:
        raise ValueError(f"{name}.drive.force: expected shape [N, T, {space.nv}], got {list(force.shape)}")
    count, steps = force.shape[:2]
    shapes: list[tuple[str, Tensor | None, tuple[int, ...]]] = [
        ("drive.force", force, (count, steps, space.nv)),
        ("drive.friction", part.drive.friction, (count, steps, 2)),
        ("states", states, (count, steps + 1, columns)),
        ("true_states", part.true_states, (count, steps + 1, columns)),
        ("steps", part.steps, (count,)),
    ]
    for field_name, tensor, shape in shapes:
        if tensor is not None and tuple(tensor.shape) != shape:
            raise ValueError(f"{name}.{field_name}: expected shape {list(shape)}, got {list(tensor.shape)}")
        if tensor is not None and field_name != "steps" and tensor.dtype != torch.float64:
            raise ValueError(f"{name}.{field_name}: expected float64, got {tensor.dtype}")
    if part.steps.is_floating_point():
        raise ValueError(f"{name}.steps: expected integers, got {part.steps.dtype}")
    if not bool(((part.steps >= 1) & (part.steps <= steps)).all()):
        raise ValueError(f"{name}.steps: expected numbers from 1 to {steps}, got {part.steps.tolist()}")
    valid = part.valid
    known = torch.cat((valid[:, :1], valid), dim=1)
    masks = {"states": known, "true_states": known, "drive.force": valid, "drive.friction": valid}
    for field_name, tensor, _ in shapes:
        if field_name in masks and tensor is not None and not bool(tensor[masks[field_name]].isfinite().all()):
            raise ValueError(f"{name}.{field_name}: expected finite numbers, got NaN or infinity")
    space.normalised(states[known], f"{name}.states")  # refuses what is no rotation


def read_recordings(
    path: Path | str,
    *,
    space: Space = LINE,
    given: Mapping[str, Any] | None = None,
    truth: tuple[str, ...] = ("mu", "mass"),
) -> Task:
    """Recordings of one's own, all of them in each part: to score a model that is trained.

    Args:
        path: NPZ file with dt, positions [N, T + 1, nq], velocities [N, T + 1, nv] and forces [N, T, nv]; on a line
            the last dimension may be missing. It may have friction [N, T, 2], steps [N], true_positions and
            true_velocities.
        space: What a state is.
        given: Numbers that are known; gravity of 9.81 m/s^2 by default.
        truth: Names of true numbers that the file may have.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It lacks an array, or one has another shape or kind than it should.
    """
    optional = ("friction", "steps", "true_positions", "true_velocities", *truth)
    arrays = read_npz(path, ("positions", "velocities", "forces", "dt"), optional=optional)
    forces = arrays["forces"]
    ndim = 2 if space.nv == 1 and forces.ndim == 2 else 3
    if forces.ndim != ndim or forces.size == 0:
        wanted = "[N, T]" if space.nv == 1 else f"[N, T, {space.nv}]"
        raise ValueError(f"{path}: forces: expected shape {wanted}, got {list(forces.shape)}")
    count, steps = forces.shape[:2]
    columns = {"forces": space.nv, "velocities": space.nv, "true_velocities": space.nv}
    columns |= {"positions": space.nq, "true_positions": space.nq}
    shapes: dict[str, tuple[int, ...]] = {"friction": (count, steps, 2), "steps": (count,)}
    for name, width in columns.items():
        shapes[name] = (count, steps + (name != "forces"), *([width] if ndim == 3 else []))
    tensors = {name: _tensor(path, name, arrays[name], shape) for name, shape in shapes.items() if name in arrays}
    if ndim == 2:
        tensors |= {name: tensors[name].unsqueeze(-1) for name in columns if name in tensors}
    if "true_positions" in tensors and "true_velocities" not in tensors:
        raise ValueError(f"{path}: true_velocities: expected beside true_positions, got none")
    positions, true = tensors["positions"], None
    if "true_velocities" in tensors:
        true = torch.cat((tensors.get("true_positions", positions), tensors["true_velocities"]), dim=-1)
    lengths = tensors.get("steps", torch.full((count,), steps))
    if not bool(((lengths >= 1) & (lengths <= steps)).all()):
        raise ValueError(f"{path}: steps: expected numbers from 1 to {steps}, got {lengths.tolist()}")
    everything = Recordings(
        states=torch.cat((positions, tensors["velocities"]), dim=-1),
        drive=Drive(tensors["forces"], tensors.get("friction")),
        steps=lengths,
        true_states=true,
    )
    return Task(
        name=Path(path).stem,
        space=space,
        dt=positive_number(path, "dt", arrays["dt"]),
        train=everything,
        validation=everything,
        test=everything,
        test_long=everything,
        given={"gravity": 9.81} if given is None else given,
        truth={name: number(path, name, arrays[name]) for name in truth if name in arrays},
    )


def _tensor(path: Path | str, name: str, array: NDArray, shape: tuple[int, ...]) -> Tensor:
    kinds, what, dtype = ("iu", "integers", torch.int64) if name == "steps" else ("fiu", "numbers", torch.float64)
    if array.shape != shape or array.dtype.kind not in kinds:
        raise ValueError(
            f"{path}: {name}: expected {what} of shape {list(shape)}, got {array.dtype} {list(array.shape)}"
        )
    return torch.as_tensor(np.ascontiguousarray(array), dtype=dtype)
