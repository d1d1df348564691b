"""What a data set is: recordings of a moving block, split for training and testing, and windows cut from them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lcplearn.datasets.files import positive_number, read_npz
from lcplearn.formulations.losses import Windows


class Recordings(NamedTuple):
    """N recordings, padded at their ends to a common length of T steps.

    Attributes:
        positions: Positions at the instants [m].
        velocities: Measured velocities at the instants [m/s].
        forces: External force of each step [N].
        friction: Friction labels of each step [N], of the kind that the simulator was asked for; None if unknown.
        steps: Steps of each recording that are not padding.
        true_velocities: Velocities without measurement noise [m/s]; None if unknown.
    """

    positions: Float[Tensor, "N T+1"]
    velocities: Float[Tensor, "N T+1"]
    forces: Float[Tensor, "N T"]
    friction: Float[Tensor, "N T 2"] | None
    steps: Int[Tensor, " N"]
    true_velocities: Float[Tensor, "N T+1"] | None


@dataclass(frozen=True)
class BlockData:
    """Recordings of one block, split by recording.

    Attributes:
        kind: Where the recordings come from.
        train, validation: Recordings to learn from, with measurement noise.
        test: Recordings for one-step errors, free of noise if simulated.
        test_long: Recordings for errors over long rollouts, free of noise; None if there are none beside `test`.
        dt: Step size [s].
        gravity: Gravitational acceleration [m/s^2].
        mass: True mass [kg]; None if unknown.
        mu: True friction coefficient; None if unknown.
    """

    kind: Literal["sliding_block", "falling_block", "cube_slides"]
    train: Recordings
    validation: Recordings
    test: Recordings
    test_long: Recordings | None
    dt: float
    gravity: float
    mass: float | None
    mu: float | None


def read_recordings(path: Path | str, *, gravity: float = 9.81) -> BlockData:
    """Recordings of one's own, all of them in each part: to score a model that is trained.

    Args:
        path: NPZ file with dt and the arrays of `Recordings`, of which friction, steps and true_velocities may be
            missing; it may have the true mu and mass.
        gravity: Gravitational acceleration [m/s^2].

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It lacks an array, or one has another shape or kind than it should.
    """
    needed, known = ("positions", "velocities", "forces"), ("mu", "mass")
    arrays = read_npz(path, (*needed, "dt"), optional=("friction", "steps", "true_velocities", *known))
    if arrays["forces"].ndim != 2 or arrays["forces"].size == 0:
        raise ValueError(f"{path}: forces: expected shape [N, T], got {list(arrays['forces'].shape)}")
    count, steps = arrays["forces"].shape
    shapes: dict[str, tuple[int, ...]] = {"forces": (count, steps), "friction": (count, steps, 2), "steps": (count,)}
    shapes |= dict.fromkeys(("positions", "velocities", "true_velocities"), (count, steps + 1))
    fields: dict[str, Tensor | None] = dict.fromkeys(Recordings._fields)
    fields["steps"] = torch.full((count,), steps)
    for name, shape in shapes.items():
        if name not in arrays:
            continue
        array, kinds = arrays[name], "iu" if name == "steps" else "fiu"
        if array.shape != shape or array.dtype.kind not in kinds:
            what = "integers" if name == "steps" else "numbers"
            raise ValueError(
                f"{path}: {name}: expected {what} of shape {list(shape)}, got {array.dtype} {list(array.shape)}"
            )
        fields[name] = torch.as_tensor(array, dtype=torch.int64 if name == "steps" else torch.float64)
    everything = Recordings(**fields)  # type: ignore[arg-type]  # those that are needed are there
    if not bool(((everything.steps >= 1) & (everything.steps <= steps)).all()):
        raise ValueError(f"{path}: steps: expected numbers from 1 to {steps}")
    truth = {name: positive_number(path, name, arrays[name]) if name in arrays else None for name in known}
    dt = positive_number(path, "dt", arrays["dt"])
    return BlockData("sliding_block", everything, everything, everything, everything, dt, gravity, **truth)


def windows(recordings: Recordings, k: int | None = None) -> Windows:
    """All stretches of k successive steps.

    A recording of n >= k steps has n - k + 1 of them; a shorter one gives a single stretch, with `valid` False after
    its end.

    Args:
        recordings: Recordings to cut.
        k: Steps of a stretch; None for whole recordings.

    Returns:
        The stretches, in the order of the recordings and of time.

    Raises:
        ValueError: k is below 1.
    """
    horizon = recordings.forces.shape[1]
    k = horizon if k is None else k
    if k < 1:
        raise ValueError(f"k: expected at least 1 step, got {k}")
    starts = torch.arange(max(horizon - k, 0) + 1)
    recording, start = torch.nonzero(starts <= (recordings.steps[:, None] - k).clamp(min=0), as_tuple=True)
    instants = start[:, None] + torch.arange(k + 1)
    recording, steps = recording[:, None], instants[:, :-1]
    valid = steps < recordings.steps[recording]
    steps = steps.clamp(max=horizon - 1)
    return Windows(
        velocity=recordings.velocities[recording, instants.clamp(max=horizon)],
        force=recordings.forces[recording, steps],
        friction=None if recordings.friction is None else recordings.friction[recording, steps],
        valid=valid,
    )
