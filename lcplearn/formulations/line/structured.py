"""LCP in the loop with the zeros and ones of the friction problem kept: the models that stick exactly."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import softplus

from lcplearn.datasets.recordings import Windows
from lcplearn.domains import positive
from lcplearn.formulations.line.formulation import LineFormulation, Numbers, Pairs, Prediction, first_step
from lcplearn.formulations.networks import features, log_parameter, network
from lcplearn.lcp.solve import solve_lcp
from lcplearn.scenes.violation import violation


class FrictionLCP(LineFormulation):
    """Solve the two-row friction LCP of a learned free velocity b, inverse mass a and impulse limit c.

    0 <= (v+, v-)  ⊥  (c - b / a + v+ / a,  c + b / a + v- / a) >= 0,   v_{k+1} = v+ - v- = S(b, a c)

    with S(b, l) = sign(b) max(|b| - l, 0). Only b, a > 0 and c > 0 are learned, so the block sticks exactly wherever
    |b| <= a c, whatever errors the learned values have. Subclasses say what b, a and c are.

    Softened to a temperature T, T softplus((+-b - a c) / T) replaces (v+, v-): its gradient with respect to c is
    nowhere zero, so training may start with it where no sample is predicted to slip (the plateau) and anneal it to 0.

    Source: Pfrommer's "LCP Notes" (2019), section 3.2; NOTES 6.3.
    """

    def free_velocity(self, velocity: Numbers, force: Numbers) -> Numbers:
        """b: the velocity after a step without friction [m/s]."""
        raise NotImplementedError

    def inverse_mass(self) -> Float[Tensor, ""]:
        """a: velocity change per friction impulse [1/kg]; > 0."""
        raise NotImplementedError

    def impulse_limit(self, velocity: Numbers) -> Float[Tensor, "*#batch"]:
        """c: the largest friction impulse of one step [N s]; > 0."""
        raise NotImplementedError

    def velocity_limit(self, velocity: Numbers) -> Float[Tensor, "*#batch"]:
        """a c: the largest change of velocity that friction can make in one step [m/s]."""
        return self.inverse_mass() * self.impulse_limit(velocity)

    def predict(self, velocity: Numbers, force: Numbers, friction: Pairs | None = None) -> Prediction:
        b = self.free_velocity(velocity, force)
        signed = torch.stack((b, -b), dim=-1)
        if self.temperature > 0.0:
            excess = signed - self.velocity_limit(velocity)[..., None]
            parts = self.temperature * softplus(excess / self.temperature)
            return parts[..., 0] - parts[..., 1], None
        a = self.inverse_mass()
        M = torch.eye(2, dtype=b.dtype, device=b.device) / a
        q = self.impulse_limit(velocity)[..., None] - signed / a
        solution = solve_lcp(M, q, method="diagonal")
        return solution.z[..., 0] - solution.z[..., 1], solution

    def errors(self) -> dict[str, Callable[[Windows], Tensor]]:
        """Beside the usual: violation, how badly the best friction explains a measured step."""
        return super().errors() | {"violation": self._violation_error}

    def _violation_error(self, windows: Windows) -> Float[Tensor, " B"]:
        before, force, _ = first_step(windows)
        after = windows.states[:, 1, 1]
        return violation(after, after - self.free_velocity(before, force), self.velocity_limit(before))


class Structured(FrictionLCP):
    """Learn b, a and c of the friction LCP, each affine, constant or a network.

    b = b_v v + b_u u + b_0 (+ net(v, u dt)),   a = exp(log a),   c = exp(log c) (or exp(log c + net(v)))

    Only the product a c has an effect on the motion. Read-outs: mass = 1 / b_u and mu = a c / (g dt); no mass where b_u
    has not moved from its start, as without any force.

    Args:
        dt: Time step [s].
        gravity: Acceleration of gravity [m/s^2].
        initial_mu: Friction coefficient at the start; > 0. Well below the expected one: if no sample is predicted to
            slip, the prediction loss has no gradient.
        initial_mass: Mass at the start [kg]; > 0.
        learn_b: False keeps b = v + u dt / initial_mass: what changes the velocity is then friction alone, and a block
            at rest stays there.
        b_network: Add a network of (v, u dt) to the affine free velocity.
        c_network: Learn the impulse limit by a network of the velocity.
        width: Units of the networks' hidden layers.
        depth: Hidden layers of the networks.
    """

    def __init__(
        self,
        *,
        dt: float,
        gravity: float = 9.81,
        initial_mu: float = 0.1,
        initial_mass: float = 1.0,
        learn_b: bool = True,
        b_network: bool = False,
        c_network: bool = False,
        width: int = 64,
        depth: int = 2,
    ) -> None:
        super().__init__(dt=dt, gravity=gravity)
        mass, mu = positive("initial_mass", initial_mass), positive("initial_mu", initial_mu)
        self.start = 1.0 / mass  # of b_u
        self.log_a = log_parameter("initial_mass", self.start)
        self.log_c = log_parameter("initial_mu", mu * mass * gravity * dt)
        self.b_weight = nn.Parameter(torch.tensor([1.0, self.start], dtype=torch.float64))
        self.b_bias = nn.Parameter(torch.zeros((), dtype=torch.float64))
        self.b_weight.requires_grad_(learn_b)
        self.b_bias.requires_grad_(learn_b)
        self.b_net = network(2, 1, width=width, depth=depth, activation="tanh") if b_network else None
        self.c_net = network(1, 1, width=width, depth=depth, activation="tanh") if c_network else None

    def free_velocity(self, velocity: Numbers, force: Numbers) -> Numbers:
        inputs = features(velocity, force, self.dt)
        b = inputs @ self.b_weight + self.b_bias
        return b if self.b_net is None else b + self.b_net(inputs)[..., 0]

    def inverse_mass(self) -> Float[Tensor, ""]:
        return self.log_a.exp()

    def impulse_limit(self, velocity: Numbers) -> Float[Tensor, "*#batch"]:
        log_c = self.log_c if self.c_net is None else self.log_c + self.c_net(velocity[..., None])[..., 0]
        return log_c.exp()

    def physical_parameters(self) -> dict[str, float]:
        values = {}
        if self.c_net is None:
            values["mu"] = (self.log_a + self.log_c).exp().item() / (self.gravity * self.dt)
        b_u = self.b_weight[1].item()
        if self.b_net is None and b_u != self.start:  # without any force it stays there, and tells nothing
            values["mass"] = 1.0 / b_u
        return values
