"""A tossed cube with a small network for what its numbers miss."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.domains import REAL, Domain
from lcplearn.scenes.contact import closing_speed
from lcplearn.scenes.contact_violation import Touch
from lcplearn.scenes.numbers import as_tensor, matvec
from lcplearn.scenes.scene import Drive, Step, Trajectory
from lcplearn.scenes.space import POSE
from lcplearn.scenes.tossed_cube import IMPACT_SPEED, TossedCube

REACH = 0.1  # [half widths] corners that would end a step below this height feel the force
SHAPES = {"friction": (1, 1), "restitution": (1, 1), "force": (3, 2)}  # inputs and outputs of the network


@dataclass(frozen=True)
class CorrectedCube(TossedCube):
    """`TossedCube`, of which a network corrects one thing.

    The network has one hidden layer and is 0 at 0: net(x) = outer (tanh(W x + b) - tanh b). With s = 10 half widths/s,

    - friction: mu and mu_impact times exp(net(c / s)), with c the closing speed of the fastest corner that lands;
    - restitution e: the logit of e plus net(c / s);
    - force: a drag on each corner that would end a step at a height phi below `REACH`, m g net_1 along the normal and
      m g net_2 along its slip, each times v / sqrt(s^2 + v^2) of its velocity v there and 1 - phi / reach (at most 1);
      x = (phi / reach, v_n / s, |slip| / s). It may be negative, and then drives.

    The network knows neither the direction of a slip nor which corner it is: what follows turns with the body about the
    vertical, and with the names of its corners. What does not move feels no force from it. With outer = 0 it is the
    `TossedCube`, to the last bit.

    Attributes:
        corrects: What the network corrects: friction, restitution or force.
        hidden: Weights and, in the last column, biases of the hidden layer, [*batch, units, inputs + 1].
        outer: Weights of the output layer, [*batch, outputs, units].
    """

    numbers: ClassVar[Mapping[str, Domain]] = {
        **TossedCube.numbers,
        "hidden": REAL,
        "outer": REAL._replace(unit=0.3),
    }

    corrects: str = "friction"
    hidden: Tensor = field(kw_only=True)
    outer: Tensor = field(kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.corrects not in SHAPES:
            raise ValueError(f"corrects: expected one of {', '.join(SHAPES)}, got {self.corrects!r}")
        inputs, outputs = SHAPES[self.corrects]
        units = self.hidden.shape[-2] if self.hidden.ndim > 1 else 0
        for name, shape in (("hidden", [units, inputs + 1]), ("outer", [outputs, units])):
            got = list(getattr(self, name).shape)
            if got[-2:] != shape:
                raise ValueError(f"{name}: expected shape [*batch, {shape[0]}, {shape[1]}], got {got}")

    def fused_rollout(self, state: Tensor, drive: Drive) -> Trajectory | None:
        """None: the network is asked before each step."""
        return None

    def substep(self, state: Float[Tensor, "*#batch 13"], drive: Drive) -> Step:
        """As `TossedCube.substep`, corrected for the state at its start."""
        position, velocity = POSE.split(state)
        touch, dt = self.body.touch_at(position), self.dt / self.substeps
        approach = matvec(touch.normal, velocity)
        if self.corrects == "force":
            wrench = self._wrench(touch, touch.gap + dt * approach, approach, velocity)
            return super().substep(state, drive._replace(force=drive.force + wrench))
        free = approach - dt * self.gravity
        fastest = closing_speed(touch.gap, approach, free, dt, self.restitution_law).amax(-1)
        corrected: dict[str, Any] = {**self.law(fastest)}
        return TossedCube.substep(replace(self, **corrected), state, drive)

    def law(self, closing: Float[Tensor, "*#batch"]) -> dict[str, Tensor]:
        """mu and mu_impact, or restitution, corrected for a closing speed [m/s].

        Raises:
            ValueError: It is a force that is corrected.
        """
        if self.corrects == "force":
            raise ValueError("corrects: expected friction or restitution for a law, got force")
        share = closing / (IMPACT_SPEED * self.half_width)
        change = self._network(share[..., None, None])[..., 0, 0]
        if self.corrects == "restitution":
            e = as_tensor(self.restitution, closing)
            return {"restitution": e / (e + (1.0 - e) * (-change).exp())}
        frictions = {"mu": self.mu} | ({} if self.mu_impact is None else {"mu_impact": self.mu_impact})
        return {name: as_tensor(value, closing) * change.exp() for name, value in frictions.items()}

    def _wrench(self, touch: Touch, height: Tensor, approach: Tensor, velocity: Tensor) -> Tensor:
        """Force in world and torque in body coordinates [*batch, 6]."""
        reach, speed = REACH * self.half_width, IMPACT_SPEED * self.half_width
        slip = matvec(touch.tangents, velocity.unsqueeze(-2))
        inputs = (height / reach, approach / speed, torch.linalg.vector_norm(slip, dim=-1) / speed)
        near = (1.0 - height / reach).clamp(0.0, 1.0) * self.mass * self.gravity
        drag = -near.unsqueeze(-1) * self._network(torch.stack(inputs, dim=-1))
        up = drag[..., 0] * approach / (speed**2 + approach**2).sqrt()
        along = drag[..., 1:] * slip / (speed**2 + slip.square().sum(-1, keepdim=True)).sqrt()
        return matvec(touch.normal.mT, up) + matvec(touch.tangents.flatten(-3, -2).mT, along.flatten(-2))

    def _network(self, x: Float[Tensor, "*#batch K inputs"]) -> Float[Tensor, "... K outputs"]:
        weights, bias = self.hidden[..., :-1], self.hidden[..., -1].unsqueeze(-2)
        return (torch.tanh(x @ weights.mT + bias) - torch.tanh(bias)) @ self.outer.mT
