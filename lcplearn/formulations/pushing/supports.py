"""Pushes by mechanics: known support points, Coulomb friction under each, a few numbers to learn."""

import math
from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from lcplearn.formulations.pushing.gauss_newton import least_deviation
from lcplearn.formulations.pushing.push_model import PushModel, PushPrediction, jacobian
from lcplearn.scenes.pushed_object import Grip, PushedObject, PushPath, plane_fit, rotate
from lcplearn.scenes.pushes import Outcome, Pushes

GAUSS = (0.5 - math.sqrt(1.0 / 12.0), 0.5 + math.sqrt(1.0 / 12.0))  # two points of Gauss and Legendre on an edge
INNER = ((2 / 3, 1 / 6, 1 / 6), (1 / 6, 2 / 3, 1 / 6), (1 / 6, 1 / 6, 2 / 3))  # three, of degree two, in a triangle
FLOOR = 1e-4  # m; below this an error does not matter, which makes the loss smooth
NOISE = 1e-3  # m; what these mechanics leave over
HEIGHT = 1e-2  # m; scale of the height
# Before any push is seen: logarithm of mu_c, height [HEIGHT] (a finger pushes at the order of a centimetre), logit of
# the rim's share; and their spread.
EXPECTED, SPREAD = (math.log(0.3), 1.0, 0.0), (0.5, 1.0, 2.0)


class Latent(NamedTuple):
    """What may differ from push to push beside the model's numbers; zero for none.

    Attributes:
        offset: Of the centre of pressure, in units of the object's radius.
        log_mu: Added to the logarithm of the finger's friction.
        shift: Of the finger, along the inward normal and the tangent of the touched edge [radius].
        wrench: Further force and torque on the object, in units of mu * weight (* radius).
    """

    offset: Float[Tensor, "b 2"]
    log_mu: Float[Tensor, " b"]
    shift: Float[Tensor, "b 2"]
    wrench: Float[Tensor, "b 3"]

    def take(self, index: Tensor) -> "Latent":
        """Some of them."""
        return Latent(*(part[index] for part in self))


class Supports(PushModel):
    """Supports with loads and Coulomb friction; what is learned are at most three numbers and a mu for each surface.

    The finger's friction mu_c, the height at which the finger pushes, and, where the whole face bears, the share of
    the load at its rim are learned from end poses. mu of a surface does not move an object differently: it is learned
    from the size of the force, apart for pushes on three feet and on the whole face.

    Args:
        vertices, com, mass: The object.
        height: Learn the height of the finger; 0 otherwise.
        rim: Learn the rim's share; that of a uniform pressure, 0, otherwise.
        steps: Steps of a push.
        law: Friction under the supports, see `PushedObject`; "ellipsoid" learns mu_c alone.
        surfaces: Names of the surfaces that the model knows already, from a checkpoint.
    """

    def __init__(
        self,
        *,
        vertices: Sequence[Sequence[float]],
        com: Sequence[float],
        mass: float,
        height: bool = True,
        rim: bool = True,
        steps: int = 15,
        law: Literal["cone", "ellipsoid"] = "cone",
        surfaces: Sequence[str] = (),
    ) -> None:
        super().__init__(vertices=vertices, com=com, mass=mass)
        if law not in ("cone", "ellipsoid"):
            raise ValueError(f"law: expected 'cone' or 'ellipsoid', which have a gradient, got {law!r}")
        if law == "ellipsoid" and (height or rim):
            raise ValueError("law: an ellipsoid has no loads: expected height=False and rim=False")
        self.arguments |= {"height": height, "rim": rim, "steps": steps, "law": law, "surfaces": list(surfaces)}
        corners = torch.tensor(self.arguments["vertices"], dtype=torch.float64)
        self.object = PushedObject(corners, self.com, mass, steps=steps, law=law)
        if rim and len(corners) != 3:
            raise ValueError("rim: expected a triangle, whose face is the only one with points of pressure here")
        # Logarithm of mu_c, height in units of HEIGHT, logit of the rim's share.
        self.numbers = nn.Parameter(torch.tensor((math.log(0.3), 0.0, 0.0), dtype=torch.float64))
        self.learned = torch.tensor((True, height, rim)).nonzero()[:, 0]
        self.mu: Tensor
        # Of each surface, under feet and under the whole face.
        self.register_buffer("mu", torch.full((len(surfaces), 2), 0.3, dtype=torch.float64))

    @property
    def surfaces(self) -> list[str]:
        """Names of the surfaces whose mu is learned, in the order of `mu`."""
        return self.arguments["surfaces"]

    def physical_parameters(self) -> dict[str, float]:
        log_mu_c, height, rim = self.numbers.tolist()
        found = {"mu_c": math.exp(log_mu_c)}
        if self.arguments["height"]:
            found["height_mm"] = 1e3 * HEIGHT * height
        if self.arguments["rim"]:
            found["rim"] = 1.0 / (1.0 + math.exp(-rim))
        for name, (feet, face) in zip(self.surfaces, self.mu.tolist(), strict=True):
            found |= {f"mu_{name}": feet, f"mu_{name}_face": face}
        return found

    def predict(self, pushes: Pushes, latent: Latent | None = None) -> PushPrediction:
        return self.roll(pushes, self.numbers.expand(len(pushes.surface), -1), latent)

    def fit(self, pushes: Pushes, outcome: Outcome) -> Iterator[dict[str, float]]:
        """Numbers from poses, through the rollout, then mu from forces; twice, as mu moves poses by the height."""
        new = [name for name in dict.fromkeys(pushes.surface) if name not in self.surfaces]
        self.arguments["surfaces"] = self.surfaces + new
        self.mu = torch.cat((self.mu, torch.full((len(new), 2), 0.3, dtype=torch.float64)))
        true, learned = self.motion(pushes, outcome.pose), self.learned

        def linearise(x: Tensor) -> tuple[Tensor, Tensor]:
            numbers = self.numbers.detach().clone()
            numbers[learned] = x
            each = numbers.expand(len(true), -1).clone().requires_grad_()
            motion = self.motion(pushes, self.roll(pushes, each).pose)
            return (motion - true).detach(), jacobian(motion, each)[..., learned]

        for _ in range(2):
            found = least_deviation(
                linearise,
                self.numbers.detach()[learned].clone(),
                floor=FLOOR,
                expected=torch.tensor(EXPECTED, dtype=torch.float64)[learned],
                spread=torch.tensor(SPREAD, dtype=torch.float64)[learned],
                noise=NOISE,
            )
            for x, loss in found:
                with torch.no_grad():
                    self.numbers[learned] = x
                yield {"deviation_mm": 1e3 * loss} | self.physical_parameters()
            self._fit_mu(pushes, outcome)

    @torch.no_grad()
    def _fit_mu(self, pushes: Pushes, outcome: Outcome) -> None:
        """Forces are proportional to mu: the one whose forces sum up to the measured ones.

        Where a surface has no push on feet, or none on the whole face, one mu stands for both.
        """
        force = self.predict(pushes).force
        assert force is not None
        on = self.surface(pushes)
        for k in on.unique():
            kinds = {face: (on == k) & (pushes.whole_face == bool(face)) for face in (0, 1)}
            for face, mine in kinds.items():
                if bool(mine.any()):
                    measured, predicted = (f[mine].norm(dim=-1).sum() for f in (outcome.force, force))
                    self.mu[k, face] *= measured / predicted
            for face, mine in kinds.items():
                if not bool(mine.any()):
                    self.mu[k, face] = self.mu[k, 1 - face]

    def surface(self, pushes: Pushes) -> Int[Tensor, " b"]:
        """Number of each push's surface.

        Raises:
            ValueError: One is not learned.
        """
        unknown = sorted(set(pushes.surface) - set(self.surfaces))
        if unknown:
            raise ValueError(f"surface: expected {' or '.join(self.surfaces)}, as learned, got {', '.join(unknown)}")
        return torch.tensor([self.surfaces.index(name) for name in pushes.surface], dtype=torch.long)

    def roll(self, pushes: Pushes, numbers: Float[Tensor, "b 3"], latent: Latent | None = None) -> PushPrediction:
        """Predict with numbers of its own for each push."""
        parts, order = [], []
        for whole_face in (False, True):
            index = (pushes.whole_face == whole_face).nonzero()[:, 0]
            if len(index) == 0 and pushes.surface:
                continue
            part = pushes.take(index)
            grip = self.grip(part, numbers[index], None if latent is None else latent.take(index))
            path = self.object.rollout(part.push, grip)
            parts.append((path.poses[:, -1], self._mean_force(part, path), (path.solved & path.settled).all(-1)))
            order.append(index)
        back = torch.cat(order).argsort()
        return PushPrediction(*(torch.cat(column)[back] for column in zip(*parts, strict=True)))

    def path(self, pushes: Pushes) -> PushPath:
        """The whole way of pushes that all rest on points, or all on the whole face."""
        return self.object.rollout(pushes.push, self.grip(pushes, self.numbers.expand(len(pushes.surface), -1)))

    def _mean_force(self, pushes: Pushes, path: PushPath) -> Tensor:
        """Over the second half of the finger's way, as recordings are averaged over the second half of their time."""
        touch, steps = self.object.first_touch(pushes.push)[:, None], path.forces.shape[1]
        ends = touch + (1.0 - touch) * torch.arange(steps + 1, dtype=touch.dtype) / steps
        share = ends.clamp_min(0.5).diff(dim=-1) / 0.5
        return (share[..., None] * path.forces).sum(1)

    def grip(self, pushes: Pushes, numbers: Float[Tensor, "b 3"], latent: Latent | None = None) -> Grip:
        """How pushes that all rest on points, or all on the whole face, stand and are touched."""
        log_mu_c, height, rim = numbers.unbind(-1)
        points, weights = pushes.points, torch.full_like(pushes.points[..., 0], 1.0 / 3.0)
        if bool(pushes.whole_face.any()):
            points, weights = self._face(rim.sigmoid())
        loads, levers = plane_fit(points, self.com, weights)
        mu = self.mu[self.surface(pushes), pushes.whole_face.long()]
        if latent is None:
            return Grip(points, loads, levers, mu, log_mu_c.exp(), height * HEIGHT)
        radius = self.object.radius
        loads = loads + radius * (levers @ latent.offset[..., None])[..., 0]
        loads = torch.maximum(loads, 0.02 * loads.detach().amax(-1, keepdim=True))
        normal, tangent = self.edge(pushes)
        shift = radius * (normal * latent.shift[:, :1] + tangent * latent.shift[:, 1:])
        return Grip(
            points, loads / loads.sum(-1, keepdim=True), levers, mu, (log_mu_c + latent.log_mu).exp(), height * HEIGHT,
            shift, latent.wrench,
        )  # fmt: skip

    def edge(self, pushes: Pushes) -> tuple[Tensor, Tensor]:
        """Inward normal and tangent of the edge that is touched first, in the world."""
        touch = self.object.first_touch(pushes.push)[:, None]
        finger = pushes.push.start + touch * (pushes.push.end - pushes.push.start)
        angle = pushes.push.pose[:, 2]
        edge = self.object.outside(rotate(-angle, finger - pushes.push.pose[:, :2])).argmax(-1)
        tangents, inward = self.object.edges()
        return rotate(angle, inward[edge]), rotate(angle, tangents[edge])

    def _face(self, rim: Tensor) -> tuple[Tensor, Tensor]:
        """Points and weights of the whole face: the learned share on its rim, the rest inside, both uniform."""
        corners = self.object.vertices
        sides = corners.roll(-1, 0) - corners
        inside = torch.tensor(INNER, dtype=torch.float64) @ corners
        within = torch.full((len(rim), len(INNER)), 1.0 / len(INNER), dtype=torch.float64)
        if not self.arguments["rim"]:
            return inside.expand(len(rim), -1, 2), within
        border = torch.cat([corners + x * sides for x in GAUSS])
        length = sides.norm(dim=-1).repeat(len(GAUSS))
        weights = torch.cat((rim[:, None] * length / length.sum(), (1.0 - rim[:, None]) * within), -1)
        return torch.cat((border, inside)).expand(len(rim), -1, 2), weights
