"""What all models of pushes share: they are built from an object, fitted to pushes, and predict end poses."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from lcplearn.scenes.pushed_object import rotate
from lcplearn.scenes.pushes import Outcome, Pushes

RADIUS = 0.05  # m; radius of gyration of the triangle: makes rotation comparable to translation


class PushPrediction(NamedTuple):
    """How pushes end.

    Attributes:
        pose: x [m], y [m], angle [rad] of the object's frame.
        force: Force on the object [N], world, mean over the second half of the path; None where a model has none.
        solved: False where a step has no verified solution, or its friction did not settle.
    """

    pose: Float[Tensor, "b 3"]
    force: Float[Tensor, "b 2"] | None
    solved: Bool[Tensor, " b"]


class PushModel(nn.Module):
    """A model of pushes of one object.

    Args:
        vertices: Corners in the object's frame [m], counterclockwise.
        com: Centre of mass in the object's frame [m].
        mass: [kg].
    """

    def __init__(self, *, vertices: Sequence[Sequence[float]], com: Sequence[float], mass: float) -> None:
        super().__init__()
        self.arguments: dict[str, Any] = {
            "vertices": [[float(x) for x in vertex] for vertex in vertices],
            "com": [float(x) for x in com],
            "mass": float(mass),
        }
        self.com = torch.tensor(self.arguments["com"], dtype=torch.float64)

    def predict(self, pushes: Pushes) -> PushPrediction:
        """Where pushes end."""
        raise NotImplementedError

    def fit(self, pushes: Pushes, outcome: Outcome) -> Iterator[dict[str, float]]:
        """Learn, in place; yields figures to show after each iteration."""
        raise NotImplementedError

    def physical_parameters(self) -> dict[str, float]:
        """Learned numbers that have a meaning; none by default."""
        return {}

    def motion(self, pushes: Pushes, pose: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3"]:
        """Displacement of the centre of mass and RADIUS times the turn, in the object's axes at the start [m]."""
        start = pushes.push.pose
        # Differences first: what does not move has a motion of exactly 0.
        shift = pose[:, :2] - start[:, :2] + (rotate(pose[:, 2], self.com) - rotate(start[:, 2], self.com))
        turn = torch.remainder(pose[:, 2] - start[:, 2] + math.pi, 2.0 * math.pi) - math.pi
        return torch.cat((rotate(-start[:, 2], shift), RADIUS * turn[:, None]), -1)

    def pose(self, pushes: Pushes, motion: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3"]:
        """The inverse of `motion`."""
        start = pushes.push.pose
        angle = start[:, 2] + motion[:, 2] / RADIUS
        centre = start[:, :2] + rotate(start[:, 2], self.com) + rotate(start[:, 2], motion[:, :2])
        return torch.cat((centre - rotate(angle, self.com), angle[:, None]), -1)


def jacobian(output: Float[Tensor, "b m"], each: Float[Tensor, "b p"]) -> Float[Tensor, "b m p"]:
    """Derivative of each element's output with respect to its own numbers, one backward pass a column."""
    columns = [torch.autograd.grad(column.sum(), each, retain_graph=True)[0] for column in output.unbind(-1)]
    return torch.stack(columns, 1)
