"""LCP in the loop with free matrices: it can slide, but it can't keep a block at rest."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lcplearn.domains import NOT_NEGATIVE, check, positive
from lcplearn.formulations.line.formulation import LineFormulation, Numbers, Pairs, Prediction
from lcplearn.formulations.networks import features
from lcplearn.lcp.solve import solve_lcp

# The friction LCP's [[D D', 1], [-1', 0]], D = (1, -1), in (lambda+ dt, lambda- dt, gamma), unit mass (NOTES 5.6).
SYMMETRIC = [[1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, 0.0]]
SKEW = [[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [-1.0, -1.0, 0.0]]


class FreeLCP(LineFormulation):
    """Solve a three-row LCP whose matrix and vector are learned, and read the velocity from its impulses.

    0 <= (y+, y-, gamma)  ⊥  f(v, u) + G (y+, y-, gamma) >= 0,   v_{k+1} = b(v, u) + a (y+ - y-)

    with f and b affine in (v, u dt). All start at the sliding block of `initial_mu` and unit mass, plus noise:
    from a random start only about one in eight finds the block at all. Sticking needs b + a (y+ - y-) = 0, which holds
    only while f, G, b and a agree exactly; any error in them, such as noise leaves, loses it.

    Args:
        dt: Time step [s].
        gravity: Acceleration of gravity [m/s^2].
        initial_mu: Friction coefficient at the start; > 0.
        initial_noise: Standard deviation of the noise on the initial entries of f and G; >= 0.

    Source: Pfrommer's "LCP Notes" (2019), sections 2.5 and 3.1.3; NOTES 6.2.
    """

    def __init__(
        self, *, dt: float, gravity: float = 9.81, initial_mu: float = 0.1, initial_noise: float = 0.03
    ) -> None:
        super().__init__(dt=dt, gravity=gravity)
        check(NOT_NEGATIVE, initial_noise=initial_noise)
        self.initial_noise = initial_noise
        limit = positive("initial_mu", initial_mu) * gravity * dt
        self.f_weight = self.noisy([[1.0, 1.0], [-1.0, -1.0], [0.0, 0.0]])
        self.f_bias = self.noisy([0.0, 0.0, limit])
        self.b_weight = nn.Parameter(torch.ones(2, dtype=torch.float64))
        self.b_bias = nn.Parameter(torch.zeros((), dtype=torch.float64))
        self.a = nn.Parameter(torch.ones((), dtype=torch.float64))
        self.start_matrix()

    def start_matrix(self) -> None:
        """Make the parameters of G."""
        raise NotImplementedError

    def noisy(self, values: list[float] | list[list[float]]) -> nn.Parameter:
        """Make a parameter of `values` plus the initial noise."""
        exact = torch.tensor(values, dtype=torch.float64)
        return nn.Parameter(exact + self.initial_noise * torch.randn_like(exact))

    def matrix(self) -> Float[Tensor, "3 3"]:
        """G, from the learned parameters."""
        raise NotImplementedError

    def predict(self, velocity: Numbers, force: Numbers, friction: Pairs | None = None) -> Prediction:
        inputs = features(velocity, force, self.dt)
        solution = solve_lcp(self.matrix(), inputs @ self.f_weight.mT + self.f_bias)
        impulse = self.a * (solution.z[..., 0] - solution.z[..., 1])
        return inputs @ self.b_weight + self.b_bias + impulse, solution


class Traditional(FreeLCP):
    """Learn G without any constraint; the LCP may have no solution or several."""

    def start_matrix(self) -> None:
        self.G = self.noisy((torch.tensor(SYMMETRIC) + torch.tensor(SKEW)).tolist())

    def matrix(self) -> Float[Tensor, "3 3"]:
        return self.G


class PSD(FreeLCP):
    """Learn G = L L' + shift I, symmetric positive definite: always solvable, but it can't be the friction matrix.

    The friction matrix is positive semidefinite, but not symmetric (NOTES 6.2).

    Args:
        dt: Time step [s].
        gravity: Acceleration of gravity [m/s^2].
        initial_mu: Friction coefficient at the start; > 0.
        initial_noise: Standard deviation of the noise on the initial entries of f and L; >= 0.
        shift: Lower bound of the eigenvalues of G; > 0.
    """

    def __init__(
        self,
        *,
        dt: float,
        gravity: float = 9.81,
        initial_mu: float = 0.1,
        initial_noise: float = 0.03,
        shift: float = 1e-3,
    ) -> None:
        super().__init__(dt=dt, gravity=gravity, initial_mu=initial_mu, initial_noise=initial_noise)
        self.shift = positive("shift", shift)

    def start_matrix(self) -> None:
        self.L = self.noisy([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])  # L L' = SYMMETRIC

    def matrix(self) -> Float[Tensor, "3 3"]:
        return self.L @ self.L.mT + self.shift * torch.eye(3, dtype=self.L.dtype, device=self.L.device)


class PSDSkew(PSD):
    """Learn G = L L' + H - H' + shift I: always solvable, and it can come close to the friction matrix.

    With shift > 0 the symmetric part is positive definite, so the LCP has one solution for every f. Arguments are those
    of `PSD`; H, too, starts with noise.
    """

    def start_matrix(self) -> None:
        super().start_matrix()
        self.H = self.noisy([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])  # H - H' = SKEW

    def matrix(self) -> Float[Tensor, "3 3"]:
        return super().matrix() + self.H - self.H.mT
