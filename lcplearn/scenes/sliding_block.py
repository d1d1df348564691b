"""A block that slides on a table with dry friction."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import softplus

from lcplearn.domains import NOT_NEGATIVE, POSITIVE, Domain, check, check_numbers
from lcplearn.lcp.solution import LCPSolution
from lcplearn.lcp.solve import solve_lcp
from lcplearn.scenes.numbers import as_tensor
from lcplearn.scenes.scene import Drive, Mode, Moving, Step
from lcplearn.scenes.space import LINE, Space
from lcplearn.scenes.violation import violation

Form = Literal["direct", "physical", "traditional"]
NUMBERS = {"mass": POSITIVE, "mu": NOT_NEGATIVE, "gravity": NOT_NEGATIVE}


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
class OneWayBlock(Moving):
    """A block that friction can stop but nothing can push back.

    0 <= v_{k+1} ⟂ lambda' = (m/dt) v_{k+1} - (m/dt) v_k - u + mu m g >= 0, one row.

    z is the next velocity [m/s], w = mu m g - lambda the unused friction force [N]. Friction lambda is nonnegative
    as long as v_k + u dt/m >= 0; with a stronger backward force it goes below zero and holds the block still.

    Attributes:
        mass: Mass [kg]; > 0. Number or tensor that broadcasts over the batch, like mu.
        mu: Friction coefficient; >= 0.
        dt: Step size [s]; > 0.
        gravity: Gravitational acceleration [m/s^2]; >= 0.

    Gradient: With respect to the state, the force and all numbers; at the kink p = c that of one side.

    Status: `Step.solved`.

    Raises:
        ValueError: A number is out of its domain; the message names it.

    Source: Pfrommer's "LCP Notes" (2019), section 2.1, with general mass and forces in newtons; NOTES 5.3.
    """

    space: ClassVar[Space] = LINE
    contacts: ClassVar[int] = 1
    numbers: ClassVar[Mapping[str, Domain]] = NUMBERS

    mass: float | Tensor
    mu: float | Tensor
    dt: float
    gravity: float | Tensor = 9.81

    def __post_init__(self) -> None:
        check_numbers(self)

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
        return self._solve(velocity, force).z[..., 0]

    def advance(self, state: Float[Tensor, "*#batch 2"], drive: Drive) -> Step:
        """Next position and velocity, and contact mode: STICK or SLIP."""
        position, velocity = state.unbind(-1)
        solution = self._solve(velocity, drive.force[..., 0])
        return move(position, solution.z[..., 0], solution, self.dt)

    def _solve(self, velocity: Tensor, force: Tensor) -> LCPSolution:
        return solve_lcp(*self.lcp(velocity, force), method="diagonal")


@dataclass(frozen=True)
class SlidingBlock(Moving):
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
        mu: Friction coefficient; >= 0. (A negative one would make the direct form's v+ and v- both positive.)
        dt: Step size [s]; > 0.
        gravity: Gravitational acceleration [m/s^2]; >= 0.
        form: Which LCP.
        temperature: Softening T of the threshold [m/s]; >= 0. At 0 the LCP is solved. Above 0,
            T softplus((+-p - c) / T) replaces (v+, v-): its gradient with respect to mu is nowhere zero, so that
            training may start with it where no sample is predicted to slip, and anneal it to 0.

    Gradient: Of the state, with respect to the state before, the force and all numbers: exact, and at the kink
        |p| = c that of one side. Forces at stick are not unique and have no gradient worth following.

    Status: `Step.solved`; None with a temperature, where no LCP is solved.

    Raises:
        ValueError: A number is out of its domain, or form is none of the three; the message names it.

    Source: Pfrommer's "LCP Notes" (2019), sections 2.2 (direct) and 2.5 (traditional), with general mass and dt and
    forces in newtons; NOTES 5.4 to 5.6.
    """

    space: ClassVar[Space] = LINE
    contacts: ClassVar[int] = 1
    numbers: ClassVar[Mapping[str, Domain]] = NUMBERS

    mass: float | Tensor
    mu: float | Tensor
    dt: float
    gravity: float | Tensor = 9.81
    form: Form = "direct"
    temperature: float = 0.0

    def __post_init__(self) -> None:
        check_numbers(self)
        check(NOT_NEGATIVE, temperature=self.temperature)
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
        return self._solve(velocity, force)[0]

    def advance(self, state: Float[Tensor, "*#batch 2"], drive: Drive) -> Step:
        """Next position and velocity, and contact mode: STICK or SLIP."""
        position, velocity = state.unbind(-1)
        return move(position, *self._solve(velocity, drive.force[..., 0]), dt=self.dt)

    def violation(
        self, state: Float[Tensor, "*#batch 2"], drive: Drive, after: Float[Tensor, "*#batch 2"]
    ) -> Float[Tensor, "..."]:
        """How badly the best friction explains a measured step [m^2/s^2]; see `lcplearn.scenes.violation`."""
        free = self._free_velocity(state[..., 1], drive.force[..., 0])
        return violation(after[..., 1], after[..., 1] - free, self.mu * self.gravity * self.dt)

    def _solve(self, velocity: Tensor, force: Tensor) -> tuple[Tensor, LCPSolution | None]:
        if self.temperature > 0.0:
            p = self._free_velocity(velocity, force)
            excess = torch.stack((p, -p), dim=-1) - as_tensor(self.mu * self.gravity * self.dt, p)[..., None]
            parts = self.temperature * softplus(excess / self.temperature)
            return parts[..., 0] - parts[..., 1], None
        M, q = self.lcp(velocity, force)
        solution = solve_lcp(M, q, method="diagonal" if self.form == "direct" else "auto")
        z = solution.z
        if self.form != "traditional":
            return z[..., 0] - z[..., 1], solution
        v = self._free_velocity(velocity, force) + self.dt / self.mass * (z[..., 0] - z[..., 1])
        gamma = z[..., 2]
        held = torch.minimum(torch.maximum(v, -gamma), gamma)
        return torch.where(gamma == 0.0, 0.0, held), solution  # at rest a tie of bounds would have a gradient

    def _free_velocity(self, velocity: Tensor, force: Tensor) -> Tensor:
        return velocity + force * self.dt / self.mass


def move(position: Tensor, velocity: Tensor, solution: LCPSolution | None, dt: float) -> Step:
    """Implicit Euler for the position from the velocity after the step; the mode is SLIP where that is not 0."""
    mode = torch.where(velocity == 0, int(Mode.STICK), int(Mode.SLIP))
    state = torch.stack((position + dt * velocity, velocity), dim=-1)
    return Step(state, mode.unsqueeze(-1), solution, None if solution is None else solution.solved)


def _matrix(factor: float | Tensor, pattern: list[list[float]], like: Tensor) -> Tensor:
    """factor [*batch] times a constant matrix, in the dtype and on the device of like."""
    constant = torch.tensor(pattern, dtype=like.dtype, device=like.device)
    return factor[..., None, None] * constant if isinstance(factor, Tensor) else factor * constant
