"""A block that slides on a table with dry friction: LCP Notes 2.1, 2.2 and 2.5 with the errata."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lcplearn.lcp.solve import solve_lcp
from lcplearn.scenes.checks import require_positive
from lcplearn.scenes.rollout import Block, Mode

Form = Literal["direct", "physical", "traditional"]


def slide(p: Float[Tensor, "*#batch"], c: Float[Tensor, "*#batch"] | float) -> Float[Tensor, "..."]:
    """Velocity of a block after friction has taken what it can.

    S(p, c) = sign(p) max(|p| - c, 0), the closed form of every friction LCP in this file.

    Args:
        p: Velocity that the block would have without friction [m/s].
        c: Largest velocity change that friction can cause in one step, mu g dt [m/s]; >= 0.

    Returns:
        Next velocity [m/s]; exactly 0 where |p| <= c.

    Gradient: With respect to p and c; at the kink |p| = c that of sticking, 0.

    Source: NOTES 5.4.
    """
    return torch.relu(p - c) - torch.relu(-p - c)


@dataclass(frozen=True)
class OneWayBlock(Block):
    """A block that friction can stop but nothing can push back.

    0 <= v_{k+1} ⟂ lambda' = (m/dt) v_{k+1} - (m/dt) v_k - u + mu m g >= 0, one row.

    z is the next velocity [m/s], w = mu m g - lambda the unused friction force [N]. Friction lambda is nonnegative
    as long as v_k + u dt/m >= 0; with a stronger backward force it goes below zero and holds the block still.

    Attributes:
        mass: Mass [kg]; > 0. Number or tensor that broadcasts over the batch, like mu.
        mu: Friction coefficient; >= 0.
        dt: Step size [s]; > 0.
        gravity: Gravitational acceleration [m/s^2].

    Source: LCP Notes 2.1, Remark 1; errata 2-4. Differs: 1. general mass, forces in newtons.
    """

    mass: float | Tensor
    mu: float | Tensor
    dt: float
    gravity: float = 9.81

    def __post_init__(self) -> None:
        require_positive(mass=self.mass, dt=self.dt)

    def lcp(self, velocity: Float[Tensor, "*#batch"], force: Float[Tensor, "*#batch"]) -> tuple[Tensor, Tensor]:
        """The LCP of one step.

        Args:
            velocity: Velocity before the step [m/s].
            force: External force along the table [N].

        Returns:
            M [1, 1] (with the batch dimensions of mass, if any) and q [*batch, 1].
        """
        inertia = self.mass / self.dt
        q = self.mu * self.mass * self.gravity - inertia * velocity - force
        return _matrix(inertia, [[1.0]], q), q.unsqueeze(-1)

    def closed_form(self, velocity: Float[Tensor, "*#batch"], force: Float[Tensor, "*#batch"]) -> Float[Tensor, "..."]:
        """Next velocity max(p - c, 0) [m/s], p = v_k + u dt/m, c = mu g dt."""
        return torch.relu(velocity + force * self.dt / self.mass - self.mu * self.gravity * self.dt)

    def next_velocity(
        self, velocity: Float[Tensor, "*#batch"], force: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "..."]:
        """Next velocity [m/s], from the LCP."""
        return solve_lcp(*self.lcp(velocity, force), method="diagonal").z[..., 0]

    def advance(self, state: Float[Tensor, "*#batch 2"], force: Float[Tensor, "*#batch 1"]) -> tuple[Tensor, Tensor]:
        """Next state [*batch, 2] and contact mode [*batch, 1]."""
        return _advance(state, self.next_velocity(state[..., 1], force[..., 0]), self.dt)


@dataclass(frozen=True)
class SlidingBlock(Block):
    """A block that slides both ways under dry friction and sticks exactly.

    v_{k+1} = S(p, c) with p = v_k + u dt/m and c = mu g dt, from one of three LCPs:

    direct:       z = (v+, v-), w = (lambda-', lambda+') the slack friction forces,
                  M = (m/dt) I, q = (mu m g - p m/dt, mu m g + p m/dt). Diagonal; one of the two friction
                  forces mu m g - w is fictitious whenever the block moves.
    physical:     the same z and q, M = (m/dt) [[1, -1], [-1, 1]]: w is the slack of the physical friction force F,
                  (mu m g + F, mu m g - F). Positive semidefinite.
    traditional:  z = (lambda+, lambda-, gamma), M = [[a, -a, 1], [-a, a, 1], [-1, -1, 0]], a = dt/m,
                  q = (p, -p, mu m g). Positive semidefinite, not a P-matrix: the forces are not unique at stick,
                  the velocity is.

    The velocity is the same in all three. direct and physical read it from z, v+ - v-; traditional from
    p + a (lambda+ - lambda-) held to the bounds |v| <= gamma of its rows, so that gamma = 0 gives exactly 0.

    Attributes:
        mass: Mass [kg]; > 0. Number or tensor that broadcasts over the batch, like mu.
        mu: Friction coefficient; >= 0. (A negative one makes the direct form's v+ and v- both positive.)
        dt: Step size [s]; > 0.
        gravity: Gravitational acceleration [m/s^2].
        form: Which LCP.

    Source: LCP Notes 2.2 (direct), 2.5 (traditional); errata 5-15 and 22-24. Differs: 1. general mass and dt, forces in
    newtons; 2. physical is the form that errata 15 puts in place of the direct one.
    """

    mass: float | Tensor
    mu: float | Tensor
    dt: float
    gravity: float = 9.81
    form: Form = "direct"

    def __post_init__(self) -> None:
        require_positive(mass=self.mass, dt=self.dt)
        if self.form not in ("direct", "physical", "traditional"):
            raise ValueError(f"form: expected 'direct', 'physical' or 'traditional', got {self.form!r}")

    def lcp(self, velocity: Float[Tensor, "*#batch"], force: Float[Tensor, "*#batch"]) -> tuple[Tensor, Tensor]:
        """The LCP of one step in this block's form.

        Args:
            velocity: Velocity before the step [m/s].
            force: External force along the table [N].

        Returns:
            M [n, n] (with the batch dimensions of mass, if any) and q [*batch, n]; n = 3 if traditional, else 2.
        """
        limit = self.mu * self.mass * self.gravity
        if self.form == "traditional":
            p = self._free_velocity(velocity, force)
            a = self.dt / self.mass
            ones = _matrix(1.0, [[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [-1.0, -1.0, 0.0]], p)
            M = _matrix(a, [[1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, 0.0]], p) + ones
            return M, torch.stack(torch.broadcast_tensors(p, -p, limit + torch.zeros_like(p)), dim=-1)
        inertia = self.mass / self.dt
        push = inertia * velocity + force  # p m/dt: what a friction force has to balance to stop the block
        pattern = [[1.0, 0.0], [0.0, 1.0]] if self.form == "direct" else [[1.0, -1.0], [-1.0, 1.0]]
        return _matrix(inertia, pattern, push), torch.stack((limit - push, limit + push), dim=-1)

    def closed_form(self, velocity: Float[Tensor, "*#batch"], force: Float[Tensor, "*#batch"]) -> Float[Tensor, "..."]:
        """Next velocity S(p, c) [m/s]."""
        return slide(self._free_velocity(velocity, force), self.mu * self.gravity * self.dt)

    def next_velocity(
        self, velocity: Float[Tensor, "*#batch"], force: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "..."]:
        """Next velocity [m/s], from the LCP of this block's form."""
        M, q = self.lcp(velocity, force)
        z = solve_lcp(M, q, method="diagonal" if self.form == "direct" else "auto").z
        if self.form != "traditional":
            return z[..., 0] - z[..., 1]
        v = self._free_velocity(velocity, force) + self.dt / self.mass * (z[..., 0] - z[..., 1])
        gamma = z[..., 2]
        return torch.minimum(torch.maximum(v, -gamma), gamma)

    def advance(self, state: Float[Tensor, "*#batch 2"], force: Float[Tensor, "*#batch 1"]) -> tuple[Tensor, Tensor]:
        """Next state [*batch, 2] and contact mode [*batch, 1]."""
        return _advance(state, self.next_velocity(state[..., 1], force[..., 0]), self.dt)

    def _free_velocity(self, velocity: Tensor, force: Tensor) -> Tensor:
        return velocity + force * self.dt / self.mass


def _advance(state: Tensor, next_velocity: Tensor, dt: float) -> tuple[Tensor, Int[Tensor, "... 1"]]:
    """Implicit Euler for the position; the mode is SLIP where the block moves after the step."""
    position = state[..., 0] + dt * next_velocity
    mode = torch.where(next_velocity == 0, int(Mode.STICK), int(Mode.SLIP))
    return torch.stack((position, next_velocity), dim=-1), mode.unsqueeze(-1)


def _matrix(factor: float | Tensor, pattern: list[list[float]], like: Tensor) -> Tensor:
    """factor [*batch] times a constant matrix, in the dtype and on the device of like."""
    constant = torch.tensor(pattern, dtype=like.dtype, device=like.device)
    return factor[..., None, None] * constant if isinstance(factor, Tensor) else factor * constant
