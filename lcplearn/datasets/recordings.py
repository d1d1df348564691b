"""Recordings of what moves, and windows cut from them to learn from."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lcplearn.scenes.scene import Drive


class Recordings(NamedTuple):
    """N recordings, padded at their ends to a common length of T steps.

    Attributes:
        states: Measured states at the instants: positions, then velocities.
        drive: What acted during each step: force [N, T, nv]; friction labels [N, T, 2], if there are any.
        steps: Steps of each recording that are not padding; >= 1.
        true_states: States without measurement noise; None if unknown.
    """

    states: Float[Tensor, "N T+1 nq_plus_nv"]
    drive: Drive
    steps: Int[Tensor, " N"]
    true_states: Float[Tensor, "N T+1 nq_plus_nv"] | None = None

    def map(self, f: Callable[[Tensor], Tensor]) -> "Recordings":
        """Apply a function, a choice of recordings say, to all that is recorded."""
        true = None if self.true_states is None else f(self.true_states)
        return Recordings(f(self.states), self.drive.map(f), f(self.steps), true)

    @property
    def truth(self) -> Float[Tensor, "N instants nq_plus_nv"]:
        """States without noise where they are known, else the measured ones."""
        return self.states if self.true_states is None else self.true_states

    @property
    def valid(self) -> Bool[Tensor, "N T"]:
        """False for steps after the end of a shorter recording."""
        return torch.arange(self.drive.force.shape[1], device=self.steps.device) < self.steps[:, None]


class Windows(NamedTuple):
    """B windows of k steps from measured trajectories.

    Attributes:
        states: Measured states at the k + 1 ends of the steps.
        drive: What acted during each step: force [B, k, nv]; friction labels [B, k, 2], if there are any.
        valid: False for steps after the end of a recording. What stands there has no effect, but must be finite: in
            what `windows` cuts it is the last state and no force.
    """

    states: Float[Tensor, "B k+1 nq_plus_nv"]
    drive: Drive
    valid: Bool[Tensor, "B k"]

    def map(self, f: Callable[[Tensor], Tensor]) -> "Windows":
        """Apply a function, a choice of windows say, to all that is in them."""
        return Windows(f(self.states), self.drive.map(f), f(self.valid))

    def first(self, k: int) -> "Windows":
        """The first k steps of each window."""
        return Windows(self.states[:, : k + 1], self.drive.map(lambda values: values[:, :k]), self.valid[:, :k])


def windows(recordings: Recordings, k: int | None = None) -> Windows:
    """All stretches of k successive steps.

    A recording of n >= k steps has n - k + 1 of them; a shorter one gives a single stretch, with `valid` False after
    its end. Padding (NaN, say) never gets into a window.

    Args:
        recordings: Recordings to cut.
        k: Steps of a stretch; None for whole recordings.

    Returns:
        The stretches, in the order of the recordings and of time.

    Raises:
        ValueError: k is below 1.
    """
    horizon = recordings.drive.force.shape[1]
    k = horizon if k is None else k
    if k < 1:
        raise ValueError(f"k: expected at least 1 step, got {k}")
    starts = torch.arange(max(horizon - k, 0) + 1)
    recording, start = torch.nonzero(starts <= (recordings.steps[:, None] - k).clamp(min=0), as_tuple=True)
    instants = start[:, None] + torch.arange(k + 1)
    recording = recording[:, None]
    end = recordings.steps[recording]
    valid = instants[:, :-1] < end

    def cut(values: Tensor) -> Tensor:
        return torch.where(valid[..., None], values[recording, instants[:, :-1].clamp(max=horizon - 1)], 0.0)

    return Windows(recordings.states[recording, instants.minimum(end)], recordings.drive.map(cut), valid)
