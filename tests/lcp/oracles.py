"""Ground truth for small LCPs, and families with a planted solution."""

from itertools import product

import numpy as np
import torch
from torch import Tensor


def has_solution(M: np.ndarray, q: np.ndarray) -> bool:
    """Whether the LCP has a solution, by enumeration of all 3^n patterns (z_i > 0, w_i > 0, both zero).

    A solvable LCP has a solution that is a vertex: the columns of M for z_i > 0, seen in the rows where w = 0, are
    independent, so that least squares finds it. Integer data with n <= 6 leave nothing close to the tolerance.
    """
    if (q >= 0).all():
        return True
    for pattern in product((0, 1, 2), repeat=len(q)):
        positive, tight = np.array(pattern) == 2, np.array(pattern) >= 1
        z = np.zeros(len(q))
        if positive.any():
            z[positive] = np.linalg.lstsq(M[np.ix_(tight, positive)], -q[tight], rcond=1e-10)[0]
        if natural_residual(M, q, z) < 1e-9:
            return True
    return False


def natural_residual(M: np.ndarray, q: np.ndarray, z: np.ndarray) -> float:
    return float(np.abs(np.minimum(z, M @ z + q)).max(initial=0.0))


def planted(M: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """q for which M has a strictly complementary solution z = O(1), half of it zero; returns (q, z)."""
    shape = M.shape[:-1]
    active = torch.rand(shape, generator=generator) < 0.5
    z = torch.where(active, torch.rand(shape, generator=generator) + 0.1, 0.0)
    w = torch.where(active, 0.0, torch.rand(shape, generator=generator) + 0.1)
    return w - (M @ z.unsqueeze(-1)).squeeze(-1), z


def random_family(name: str, batch: int, n: int, generator: torch.Generator) -> Tensor:
    """A batch of matrices [batch, n, n] of a named class."""

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    if name == "positive definite":
        A = normal(batch, n, n)
        return A @ A.mT / n + 0.1 * torch.eye(n)
    if name == "semidefinite":
        A = normal(batch, n, max(n // 2, 1))
        return A @ A.mT / n
    if name == "condition 1e10":
        Q = torch.linalg.qr(normal(batch, n, n))[0]
        return Q * torch.logspace(0, -10, n) @ Q.mT
    if name == "nonsymmetric definite":
        A, K = normal(batch, n, n), normal(batch, n, n)
        return A @ A.mT / n + (K - K.mT) / n**0.5 + 0.01 * torch.eye(n)
    if name == "nonsymmetric P":  # strictly diagonally dominant by rows: P, but not PSD
        A = normal(batch, n, n) * 3
        A = A - torch.diag_embed(A.diagonal(dim1=-2, dim2=-1))
        return A + torch.diag_embed(A.abs().sum(-1) * 1.05 + 0.01)
    raise ValueError(name)


FAMILIES = ("positive definite", "semidefinite", "condition 1e10", "nonsymmetric definite", "nonsymmetric P")
