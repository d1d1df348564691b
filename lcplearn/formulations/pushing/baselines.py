"""Pushes without physics: features of a push to its motion, in the object's axes."""

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lcplearn.formulations.pushing.features import WIDTHS, Features, features, near, same
from lcplearn.formulations.pushing.push_model import PushModel, PushPrediction
from lcplearn.scenes.pushed_object import PushedObject
from lcplearn.scenes.pushes import Outcome, Pushes


class Baseline(PushModel):
    """What the two have in common: they see `features` of a push, and predict no force."""

    def __init__(self, *, vertices: Sequence[Sequence[float]], com: Sequence[float], mass: float) -> None:
        super().__init__(vertices=vertices, com=com, mass=mass)
        corners = torch.tensor(self.arguments["vertices"], dtype=torch.float64)
        self.object = PushedObject(corners, self.com, mass)

    def output(self, pushes: Pushes) -> Float[Tensor, "b 3"]:
        """Predicted motion [mm]."""
        raise NotImplementedError

    def predict(self, pushes: Pushes) -> PushPrediction:
        pose = self.pose(pushes, self.output(pushes) / 1e3)
        return PushPrediction(pose, None, torch.ones(len(pose), dtype=torch.bool))


class Ridge(Baseline):
    """Kernel ridge regression: a function of where and in which direction an edge is pushed, and one of each geometry.

    Gaussian kernels of the contact and the direction, times 1, and times a share for pushes of the same support
    geometry; pushes of different edges have nothing to do with each other. On a geometry that it has not seen, the
    common function is left. Widths, share and penalty are those with the least leave-one-out error on the pushes that
    it is fitted to.

    Args:
        vertices, com, mass: The object.
        known: Number of pushes that it was fitted to, from a checkpoint.
    """

    WIDTHS = (0.35, 0.5, 0.7, 1.0)  # of the contact [RADIUS]
    DIRECTIONS = (0.5, 0.8, 1.2)  # widths, of unit vectors
    SHARES = (0.1, 0.3, 1.0)
    PENALTIES = (1e-2, 1e-1, 1.0)

    def __init__(self, *, known: int = 0, **thing: Any) -> None:
        super().__init__(**thing)
        self.arguments["known"] = known
        self.register_buffer("seen", torch.zeros(known, sum(WIDTHS), dtype=torch.float64))
        self.register_buffer("weights", torch.zeros(known, 3, dtype=torch.float64))
        self.register_buffer("chosen", torch.ones(3, dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(3, dtype=torch.float64))

    def fit(self, pushes: Pushes, outcome: Outcome) -> Iterator[dict[str, float]]:
        seen, motion = features(pushes, self.object), 1e3 * self.motion(pushes, outcome.pose)
        centred, best = motion - motion.mean(0), float("inf")
        for numbers in itertools.product(self.WIDTHS, self.DIRECTIONS, self.SHARES):
            chosen = torch.tensor(numbers, dtype=torch.float64)
            values, vectors = torch.linalg.eigh(_kernel(seen, seen, chosen))
            for penalty in self.PENALTIES:
                inverse = (vectors / (values + penalty)) @ vectors.mT
                weights = inverse @ centred
                left_out = (weights / inverse.diagonal()[:, None]).norm(dim=-1).mean()  # error of each without itself
                if float(left_out) < best:
                    best, self.chosen, self.weights = float(left_out), chosen, weights
            yield {"deviation_mm": best}
        self.seen, self.mean = torch.cat(seen, -1), motion.mean(0)
        self.arguments["known"] = len(self.seen)

    def output(self, pushes: Pushes) -> Float[Tensor, "b 3"]:
        seen = Features(*self.seen.split(WIDTHS, -1))
        return _kernel(features(pushes, self.object), seen, self.chosen) @ self.weights + self.mean


def _kernel(a: Features, b: Features, numbers: Tensor) -> Float[Tensor, "na nb"]:
    width, direction, share = numbers
    common = near(a.body, b.body, width) * near(a.direction, b.direction, direction) * same(a.edge, b.edge)
    return common * (1.0 + share * same(a.geometry, b.geometry))


class PushMLP(Baseline):
    """A network of two hidden layers, by AdamW.

    Its inputs are contact, direction, and which edge and which of the known geometries it is, as zeros and ones.

    Args:
        vertices, com, mass: The object.
        width: Of the layers.
        rounds: Steps of the optimizer, each on all pushes.
        decay: Weight decay.
        known: Number of support geometries that it was fitted to, from a checkpoint.
    """

    def __init__(
        self, *, width: int = 64, rounds: int = 400, decay: float = 1e-2, known: int = 0, **thing: Any
    ) -> None:
        super().__init__(**thing)
        self.arguments |= {"width": width, "rounds": rounds, "decay": decay, "known": known}
        self.register_buffer("geometries", torch.zeros(known, 6, dtype=torch.float64))
        self.register_buffer("scale", torch.ones(3, dtype=torch.float64))
        self.network = self._network()

    def _network(self) -> nn.Sequential:
        inputs, width = 4 + len(self.object.vertices) + len(self.geometries), self.arguments["width"]
        return nn.Sequential(
            nn.Linear(inputs, width), nn.Tanh(), nn.Linear(width, width), nn.Tanh(), nn.Linear(width, 3)
        ).double()

    def _inputs(self, pushes: Pushes) -> Float[Tensor, "b f"]:
        seen = features(pushes, self.object)
        edges = torch.arange(len(self.object.vertices), dtype=torch.float64)[:, None]
        return torch.cat((seen.body, seen.direction, same(seen.edge, edges), same(seen.geometry, self.geometries)), -1)

    def fit(self, pushes: Pushes, outcome: Outcome) -> Iterator[dict[str, float]]:
        if len(pushes.surface) < 2:  # their spread scales the outputs
            raise ValueError(f"pushes: expected at least 2 to learn from, got {len(pushes.surface)}")
        self.geometries = features(pushes, self.object).geometry.unique(dim=0)
        self.arguments["known"] = len(self.geometries)
        self.network = self._network()
        inputs, motion = self._inputs(pushes), 1e3 * self.motion(pushes, outcome.pose)
        self.scale = motion.std(0)
        rounds = self.arguments["rounds"]
        optimizer = torch.optim.AdamW(self.parameters(), lr=5e-3, weight_decay=self.arguments["decay"])
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, rounds)
        for step in range(rounds):
            optimizer.zero_grad()
            loss = (self.scale * self.network(inputs) - motion).norm(dim=-1).mean()
            loss.backward()
            optimizer.step()
            schedule.step()
            if step % 20 == 19:
                yield {"deviation_mm": float(loss.detach())}

    def output(self, pushes: Pushes) -> Float[Tensor, "b 3"]:
        return self.scale * self.network(self._inputs(pushes))
