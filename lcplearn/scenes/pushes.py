"""Pushes of an object by a finger, and how they ended: what a scene and a model are given, and what they predict."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


class Push(NamedTuple):
    """What is done to an object: it stands at `pose`, and the finger's centre moves along a straight line.

    Attributes:
        pose: x [m], y [m], angle [rad] of the object's frame in the world.
        start, end: First and last point of the finger [m], world.
    """

    pose: Float[Tensor, "b 3"]
    start: Float[Tensor, "b 2"]
    end: Float[Tensor, "b 2"]


class Pushes(NamedTuple):
    """All that a model sees of pushes.

    The end pose of one push is the start pose of the next in these recordings, so that their order tells the answer:
    it is not here.

    Attributes:
        push: Start pose, and the straightened path of the finger.
        points: The three support points in the object's frame [m]; NaN where the whole face bears.
        surface: Name of the surface under each.
    """

    push: Push
    points: Float[Tensor, "b 3 2"]
    surface: tuple[str, ...]

    def take(self, index: Sequence[int] | Tensor) -> "Pushes":
        """Some of them, by index or mask."""
        rows = torch.as_tensor(index)
        rows = rows.nonzero()[:, 0] if rows.dtype == torch.bool else rows
        surface = tuple(self.surface[k] for k in rows.tolist())
        return Pushes(Push(*(part[rows] for part in self.push)), self.points[rows], surface)

    @property
    def whole_face(self) -> Bool[Tensor, " b"]:
        """Where the object rests on its face and not on three points."""
        return self.points.isnan().any(-1).any(-1)


class Outcome(NamedTuple):
    """What was recorded: how pushes ended.

    Attributes:
        pose: x [m], y [m], angle [rad] of the object's frame at the end.
        force: Force on the object [N], world, mean over the second half of the recording's time.
    """

    pose: Float[Tensor, "b 3"]
    force: Float[Tensor, "b 2"]

    def take(self, index: Sequence[int] | Tensor) -> "Outcome":
        """Some of them, by index or mask."""
        rows = torch.as_tensor(index)
        return Outcome(self.pose[rows], self.force[rows])


def geometries(points: Float[Tensor, "b 3 2"]) -> Int[Tensor, " b"]:
    """Number of each push's support geometry: the same three points in any order, or the whole face."""
    keys = [tuple(sorted(map(tuple, p.nan_to_num(-1.0).mul(1e6).round().tolist()))) for p in points]
    numbers = {key: k for k, key in enumerate(dict.fromkeys(keys))}
    return torch.tensor([numbers[key] for key in keys])
