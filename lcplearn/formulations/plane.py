"""Friction on a table in two directions: models that stick exactly, and some that cannot."""

from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from lcplearn.domains import NOT_NEGATIVE, check, positive
from lcplearn.formulations.formulation import Formulation
from lcplearn.formulations.networks import log_parameter, network
from lcplearn.lcp.solve import solve_lcp
from lcplearn.scenes.numbers import matvec
from lcplearn.scenes.planar_block import facet_normals, slide_in_plane, slide_on_facets
from lcplearn.scenes.scene import STICK_SPEED, Drive, Mode, Step
from lcplearn.scenes.space import TABLE, Space


class TableFormulation(Formulation):
    """What moves on a table: subclasses implement `next_velocity`.

    Args:
        dt: Time step [s].
        space: Must be `TABLE`.
    """

    def __init__(self, *, dt: float, space: Space = TABLE) -> None:
        super().__init__(space=space, dt=dt)
        if space != TABLE:
            raise ValueError(f"space: expected TABLE (x, y), got {', '.join(space.positions)}")

    def next_velocity(
        self, inputs: Float[Tensor, "*batch 4"], friction: Float[Tensor, "*batch 2"] | None
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"] | None]:
        """Velocity after a step from velocity and impulse (v, u dt), and whether the LCP, if any, was solved."""
        raise NotImplementedError

    def advance(self, state: Float[Tensor, "*batch 4"], drive: Drive) -> Step:
        position, velocity = TABLE.split(state)
        inputs = torch.cat((velocity, self.dt * drive.force), dim=-1)
        moved, solved = self.next_velocity(inputs, drive.friction)
        mode = torch.where(TABLE.speed(moved) < STICK_SPEED, int(Mode.STICK), int(Mode.SLIP)).unsqueeze(-1)
        return Step(torch.cat((TABLE.advance(position, moved, self.dt), moved), dim=-1), mode, None, solved)


class PlanarFriction(TableFormulation):
    """Predict v' = S(b, l) = b max(0, 1 - l / |b|), the closed form of the friction cone, of a learned b and l > 0.

    It sticks exactly wherever |b| <= l, whatever errors the learned values have. b is affine in velocity and impulse
    (v, u dt) and l a number: the structured model. With depth > 0 both come from a network: the radial ReLU.

    With facets a polygon stands for the disc, for comparison: its velocity is a staircase, its gradients are poor, and
    what it learns is biased.

    The slack formulation has no counterpart in two directions: with more than two facets z is no function of the
    slacks, so that what is measured does not determine the velocity.

    Args:
        dt: Time step [s].
        space: Must be `TABLE`.
        initial_limit: l at the start, over dt [m/s^2]; low, because a block that never slips has no gradient.
        facets: Of a polygon in place of the disc; 0 is the disc.
        gravity: Acceleration of gravity [m/s^2], which makes a friction coefficient of l.
        depth: Hidden layers of a network for b and l; 0 for none.
        width: Units of a hidden layer.
        activation: "relu" or "tanh".

    Source: NOTES 5.7.
    """

    def __init__(
        self,
        *,
        dt: float,
        space: Space = TABLE,
        gravity: float = 9.81,
        initial_limit: float = 1.0,
        facets: int = 0,
        depth: int = 0,
        width: int = 64,
        activation: str = "tanh",
    ) -> None:
        super().__init__(space=space, dt=dt)
        if facets and facets < 3:
            raise ValueError(f"facets: expected 0 or at least 3, got {facets}")
        self.given, self.gravity, self.facets = {"gravity": positive("gravity", gravity)}, gravity, facets
        self.weight, self.bias = _frictionless()
        self.log_limit = log_parameter("initial_limit", initial_limit * dt)
        self.net = network(4, 3, width=width, depth=depth, activation=activation) if depth else None

    def next_velocity(
        self, inputs: Float[Tensor, "*batch 4"], friction: Float[Tensor, "*batch 2"] | None
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"] | None]:
        b, log_limit = nn.functional.linear(inputs, self.weight, self.bias), self.log_limit
        if self.net is not None:
            change = self.net(inputs)
            b, log_limit = b + change[..., :2], log_limit + change[..., 2]
        if not self.facets:
            return slide_in_plane(b, log_limit.exp()), None
        moved, solution = slide_on_facets(b, log_limit.exp().expand(b.shape[:-1]), self.facets)
        return moved, solution.solved

    def physical_parameters(self) -> dict[str, float]:
        """`mu`, and `mass` from the mean effect of an impulse; none from a network."""
        if self.net is not None:
            return {}
        mobility = float(self.weight.detach()[:, 2:].diagonal().mean())
        mu = float(self.log_limit.detach().exp()) / (self.gravity * self.dt)
        told = mobility > 0.0 and mobility != 1.0  # without any force it stays where it started, and tells nothing
        return {"mu": mu} | ({"mass": 1.0 / mobility} if told else {})


class PlanarDirect(TableFormulation):
    """Predict the velocity from measured friction y: v' = b + G y dt, with b affine in velocity and impulse.

    Args:
        dt: Time step [s].
        space: Must be `TABLE`.
    """

    needs_friction: ClassVar[bool] = True

    def __init__(self, *, dt: float, space: Space = TABLE) -> None:
        super().__init__(dt=dt, space=space)
        self.weight, self.bias = _frictionless()
        self.G = nn.Parameter(torch.zeros(2, 2, dtype=torch.float64))

    def next_velocity(
        self, inputs: Float[Tensor, "*batch 4"], friction: Float[Tensor, "*batch 2"] | None
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"] | None]:
        if friction is None:
            raise ValueError("friction: expected measured friction [N], two a step, for PlanarDirect, got none")
        free = nn.functional.linear(inputs, self.weight, self.bias)
        return free + nn.functional.linear(self.dt * friction, self.G), None


class PlanarTraditional(TableFormulation):
    """Read the velocity from the impulses of an LCP whose matrices are learned, free: v' = b + A y.

    0 <= (y, gamma)  ⊥  F (v, u dt) + f + G (y, gamma) >= 0 with an impulse y along each of m directions and a slip
    speed gamma. It starts at the block of `initial_mu` and unit mass, plus noise. Sticking needs b + A y = 0, which
    any error in them destroys.

    Args:
        dt: Time step [s].
        space: Must be `TABLE`.
        gravity: Acceleration of gravity [m/s^2].
        m: Number of directions; >= 3.
        initial_mu: Friction coefficient at the start; > 0.
        initial_noise: Standard deviation of the noise on the initial entries of F and G; >= 0.
    """

    def __init__(
        self,
        *,
        dt: float,
        space: Space = TABLE,
        gravity: float = 9.81,
        m: int = 8,
        initial_mu: float = 0.1,
        initial_noise: float = 0.03,
    ) -> None:
        super().__init__(dt=dt, space=space)
        check(NOT_NEGATIVE, initial_noise=initial_noise)
        if m < 3:
            raise ValueError(f"m: expected at least 3 directions, got {m}")
        self.given = {"gravity": positive("gravity", gravity)}
        self.weight, self.bias = _frictionless()
        D = facet_normals(m, self.bias)
        limit = D.new_tensor([positive("initial_mu", initial_mu) * gravity * dt])
        zero, one = D.new_zeros(m), D.new_ones(m)
        G = torch.cat((torch.cat((D.mT @ D, one[:, None]), dim=-1), torch.cat((-one, zero[:1]))[None]), dim=0)
        F = torch.cat((-D.mT @ self.weight.detach(), zero[None, :4]), dim=0)
        noise = [initial_noise * torch.randn_like(x) for x in (G, F)]
        self.A = nn.Parameter(-D)
        self.G, self.F = nn.Parameter(G + noise[0]), nn.Parameter(F + noise[1])
        self.f = nn.Parameter(torch.cat((zero, limit)))

    def next_velocity(
        self, inputs: Float[Tensor, "*batch 4"], friction: Float[Tensor, "*batch 2"] | None
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"] | None]:
        solution = solve_lcp(self.G, nn.functional.linear(inputs, self.F, self.f))
        return nn.functional.linear(inputs, self.weight, self.bias) + matvec(
            self.A, solution.z[..., :-1]
        ), solution.solved


def _frictionless() -> tuple[nn.Parameter, nn.Parameter]:
    """Weights and bias of v' = v + u dt, the frictionless motion of a unit mass."""
    one = torch.eye(2, dtype=torch.float64)
    return nn.Parameter(torch.cat((one, one), dim=-1)), nn.Parameter(one.new_zeros(2))
