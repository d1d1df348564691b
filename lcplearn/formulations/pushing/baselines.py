"""Pushes without physics: features of a push to its motion, in the object's axes."""

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lcplearn.formulations.pushing.push_model import RADIUS, PushModel, PushPrediction
from lcplearn.scenes.pushed_object import PushedObject, rotate
from lcplearn.scenes.pushes import Outcome, Pushes

POINTS = 6  # of a support geometry; zeros where the whole face bears


class Baseline(PushModel):
    """What the two have in common: features, and that they predict no force.

    Features, in units of RADIUS: where the finger first touches, its direction and way from there, the three support
    points about the centre of mass in a fixed order, and whether the whole face bears.
    """

    def __init__(self, *, vertices: Sequence[Sequence[float]], com: Sequence[float], mass: float) -> None:
        super().__init__(vertices=vertices, com=com, mass=mass)
        corners = torch.tensor(self.arguments["vertices"], dtype=torch.float64)
        self.object = PushedObject(corners, self.com, mass)

    def features(self, pushes: Pushes) -> Float[Tensor, "b f"]:
        push, angle = pushes.push, pushes.push.pose[:, 2]
        contact = push.start + self.object.first_touch(push)[:, None] * (push.end - push.start)
        body = rotate(-angle, contact - push.pose[:, :2]) - self.com
        way = rotate(-angle, push.end - contact)
        order = (1e4 * pushes.points[..., 0] + pushes.points[..., 1]).argsort(-1)
        points = pushes.points.gather(1, order[..., None].expand(-1, -1, 2)) - self.com
        points = points.nan_to_num(0.0).flatten(1)
        length = way.norm(dim=-1, keepdim=True)
        face = pushes.whole_face[:, None].to(torch.float64)
        return torch.cat(
            (body / RADIUS, way / length.clamp_min(1e-9), 5.0 * length / RADIUS, points / RADIUS, face), -1
        )

    def output(self, pushes: Pushes) -> Float[Tensor, "b 3"]:
        """Predicted motion [mm]."""
        raise NotImplementedError

    def predict(self, pushes: Pushes) -> PushPrediction:
        pose = self.pose(pushes, self.output(pushes) / 1e3)
        return PushPrediction(pose, None, torch.ones(len(pose), dtype=torch.bool))


class Ridge(Baseline):
    """Kernel ridge regression with a Gaussian kernel.

    Width and penalty are those with the least leave-one-out error on the pushes that it is fitted to.

    Args:
        vertices, com, mass: The object.
        known: Number of pushes that it was fitted to, from a checkpoint.
    """

    WIDTHS = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0)
    PENALTIES = (1e-4, 1e-3, 1e-2, 1e-1)

    def __init__(self, *, known: int = 0, **thing: Any) -> None:
        super().__init__(**thing)
        self.arguments["known"] = known
        self.register_buffer("seen", torch.zeros(known, 6 + POINTS, dtype=torch.float64))
        self.register_buffer("weights", torch.zeros(known, 3, dtype=torch.float64))
        self.register_buffer("width", torch.ones((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(3, dtype=torch.float64))

    def fit(self, pushes: Pushes, outcome: Outcome) -> Iterator[dict[str, float]]:
        seen, motion = self.features(pushes), 1e3 * self.motion(pushes, outcome.pose)
        centred, best = motion - motion.mean(0), float("inf")
        for width in self.WIDTHS:
            gram = self._kernel(seen, seen, torch.tensor(width))
            for penalty in self.PENALTIES:
                inverse = torch.linalg.inv(gram + penalty * torch.eye(len(gram), dtype=torch.float64))
                weights = inverse @ centred
                left_out = (weights / inverse.diagonal()[:, None]).norm(dim=-1).mean()  # error of each without itself
                if float(left_out) < best:
                    best = float(left_out)
                    self.width, self.weights = torch.tensor(width, dtype=torch.float64), weights
            yield {"deviation_mm": best}
        self.seen, self.mean = seen, motion.mean(0)
        self.arguments["known"] = len(seen)

    def output(self, pushes: Pushes) -> Float[Tensor, "b 3"]:
        return self._kernel(self.features(pushes), self.seen, self.width) @ self.weights + self.mean

    @staticmethod
    def _kernel(a: Tensor, b: Tensor, width: Tensor) -> Tensor:
        return (-0.5 * torch.cdist(a, b).square() / width**2).exp()


class PushMLP(Baseline):
    """A network of two hidden layers, by AdamW.

    Args:
        vertices, com, mass: The object.
        width: Of the layers.
        rounds: Steps of the optimizer, each on all pushes.
        decay: Weight decay.
    """

    def __init__(self, *, width: int = 64, rounds: int = 400, decay: float = 1e-2, **thing: Any) -> None:
        super().__init__(**thing)
        self.arguments |= {"width": width, "rounds": rounds, "decay": decay}
        inputs = 6 + POINTS
        self.register_buffer("centre", torch.zeros(inputs, dtype=torch.float64))
        self.register_buffer("spread", torch.ones(inputs, dtype=torch.float64))
        self.register_buffer("scale", torch.ones(3, dtype=torch.float64))
        self.network = nn.Sequential(
            nn.Linear(inputs, width), nn.Tanh(), nn.Linear(width, width), nn.Tanh(), nn.Linear(width, 3)
        ).double()

    def fit(self, pushes: Pushes, outcome: Outcome) -> Iterator[dict[str, float]]:
        inputs, motion = self.features(pushes), 1e3 * self.motion(pushes, outcome.pose)
        self.centre, self.spread = inputs.mean(0), inputs.std(0).clamp_min(1e-3)
        self.scale = motion.std(0)
        rounds = self.arguments["rounds"]
        optimizer = torch.optim.AdamW(self.parameters(), lr=5e-3, weight_decay=self.arguments["decay"])
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, rounds)
        for step in range(rounds):
            optimizer.zero_grad()
            loss = (self.output(pushes) - motion).norm(dim=-1).mean()
            loss.backward()
            optimizer.step()
            schedule.step()
            if step % 20 == 19:
                yield {"deviation_mm": float(loss.detach())}

    def output(self, pushes: Pushes) -> Float[Tensor, "b 3"]:
        return self.scale * self.network((self.features(pushes) - self.centre) / self.spread)
