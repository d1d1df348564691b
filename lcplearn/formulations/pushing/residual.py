"""Mechanics with a learned residual: what the supports miss, as a Gaussian process inside the rollout."""

from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.formulations.pushing.features import WIDTHS, Features, features
from lcplearn.formulations.pushing.process import LATENTS, Process, Terms
from lcplearn.formulations.pushing.push_model import PushModel, PushPrediction, jacobian
from lcplearn.formulations.pushing.supports import Latent, Supports
from lcplearn.scenes.pushes import Outcome, Pushes

MM = 1e3
# Which functions vary: a choice that has not been compared with others here (docs/pushes.md).
INSIDE: Terms = {
    "offset": ("all", "configuration"),
    "log_mu": ("configuration", "contact"),
    "normal": ("all", "configuration", "edge", "contact", "place"),
    "tangent": ("all", "edge", "place"),
    "wrench": ("all", "configuration", "contact", "contact*configuration"),
    "motion": ("contact", "contact*configuration"),
}
BESIDE: Terms = {"motion": ("all", "contact", "contact*configuration", "configuration")}


class Residual(PushModel):
    """Supports whose loads, finger friction, finger position and wrench vary from push to push.

    Two Gaussian processes over contact, direction, place and configuration are learned from what `Supports` leaves.
    The first is inside the rollout: end poses are linear in its latents through the rollout's Jacobian, and its
    posterior mean goes into the rollout itself. The second corrects end poses alone. The prediction is the mean of
    both, or the second where the latents leave a push without an equilibrium. Forces
    are those of the supports.

    Args:
        vertices, com, mass: The object.
        steps: Steps of a push.
        learning_steps: Steps of Adam on the marginal likelihood.
        surfaces: Names of the surfaces that the model knows already, from a checkpoint.
        known: Number of pushes that it was fitted to, from a checkpoint.
    """

    def __init__(
        self,
        *,
        vertices: Sequence[Sequence[float]],
        com: Sequence[float],
        mass: float,
        steps: int = 15,
        learning_steps: int = 40,
        surfaces: Sequence[str] = (),
        known: int = 0,
    ) -> None:
        super().__init__(vertices=vertices, com=com, mass=mass)
        self.base = Supports(vertices=vertices, com=com, mass=mass, steps=steps, surfaces=surfaces)
        self.arguments |= {"steps": steps, "learning_steps": learning_steps}
        self.arguments |= {"surfaces": list(surfaces), "known": known}
        self.features: Tensor
        self.register_buffer("features", torch.zeros(known, sum(WIDTHS)))
        self.inside = Process(INSIDE, known, learning_steps)
        self.beside = Process(BESIDE, known, learning_steps)

    def physical_parameters(self) -> dict[str, float]:
        return self.base.physical_parameters()

    def fit(self, pushes: Pushes, outcome: Outcome) -> Iterator[dict[str, float]]:
        """The supports' numbers first, then the processes on what they leave."""
        yield from self.base.fit(pushes, outcome)
        count = len(pushes.surface)
        self.arguments |= {"surfaces": self.base.surfaces, "known": count}
        latent = torch.zeros(count, 8, dtype=torch.float64, requires_grad=True)
        motion = MM * self.motion(pushes, self.base.predict(pushes, _latent(latent)).pose)
        left = (MM * self.motion(pushes, outcome.pose) - motion).detach()
        correction = torch.eye(3, dtype=torch.float64).expand(count, 3, 3)
        through = torch.cat((jacobian(motion, latent).detach(), correction), -1)
        found = self._features(pushes)
        self.features = torch.cat(found, -1).float()
        yield from self.inside.fit(found, through, left)
        yield from self.beside.fit(found, through, left)

    def predict(self, pushes: Pushes) -> PushPrediction:
        known, found = Features(*self.features.double().split(WIDTHS, -1)), self._features(pushes)
        inside, beside = self.inside.mean(found, known), self.beside.mean(found, known)
        varied, plain = self.base.predict(pushes, _latent(inside)), self.base.predict(pushes)
        correction = LATENTS["motion"][0]
        one = self.motion(pushes, varied.pose) + inside[:, correction] / MM
        two = self.motion(pushes, plain.pose) + beside[:, correction] / MM
        # A learned wrench may leave a push without an equilibrium.
        motion = torch.where(varied.solved[:, None], (one + two) / 2.0, two)
        return PushPrediction(self.pose(pushes, motion), plain.force, plain.solved)

    def _features(self, pushes: Pushes) -> Features:
        found = features(pushes, self.base.object, self.base.surface(pushes))
        return Features(*(part.float().double() for part in found))


def _latent(x: Float[Tensor, "b m"]) -> Latent:
    return Latent(x[:, :2], x[:, 2], x[:, 3:5], x[:, 5:8])
