"""What a data set is: recordings of a moving block, split for training and testing, and windows cut from them."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

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
