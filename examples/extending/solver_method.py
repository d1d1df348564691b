"""A solver method of one's own: one function, and one line that gives it a name.

Projected Gauss-Seidel (Cryer 1971) converges for symmetric positive definite M. The layer judges its answers as it
judges all: what is wrong is not SOLVED. The gradient comes along, for it only needs the basis where a method ended.

    python -m extending.solver_method     in examples/
"""

import torch
from torch import Tensor

import lcplearn
from lcplearn.lcp.interior_point import Iterate
from lcplearn.lcp.methods import TORCH_METHODS, TorchMethod


def projected_gauss_seidel(M: Tensor, q: Tensor, *, max_iter: int, smoothing: float) -> Iterate:
    """Sweep over the rows, each solved for its own z_i >= 0.

    Args:
        M: float64 [b, n, n], finite.
        q: float64 [b, n], finite.
        max_iter: Sweeps.
        smoothing: 0, as the table below does not say that it smooths.
    """
    z = torch.zeros_like(q)
    diagonal = M.diagonal(dim1=-2, dim2=-1)
    for _ in range(max_iter):
        for i in range(q.shape[-1]):
            rest = q[:, i] + (M[:, i] * z).sum(-1) - diagonal[:, i] * z[:, i]
            z[:, i] = (-rest / diagonal[:, i]).clamp_min(0.0)
    w = (M @ z.unsqueeze(-1)).squeeze(-1) + q
    basis = z > 0
    sweeps = torch.full((len(q),), max_iter, device=q.device)
    return Iterate(z, torch.where(basis, 0.0, w), basis, sweeps, torch.zeros_like(sweeps, dtype=torch.bool))


# general=False: it does not solve every solvable problem with a positive semidefinite or P-matrix.
TORCH_METHODS["gauss_seidel"] = TorchMethod(projected_gauss_seidel, general=False)


def main() -> tuple[float, float]:
    """Solve what it can solve and what it can't; return the shares that are SOLVED, none of them wrongly."""
    generator = torch.Generator().manual_seed(0)
    A = torch.randn(100, 5, 5, generator=generator, dtype=torch.float64)
    q = torch.randn(100, 5, generator=generator, dtype=torch.float64)
    skew = 4.0 * (A - A.mT)
    shares = []
    for name, M in (("symmetric", A @ A.mT + torch.eye(5)), ("far from symmetric", torch.eye(5) + skew)):
        found = lcplearn.solve_lcp(M, q, method="gauss_seidel", max_iter=500)
        truth = lcplearn.solve_lcp(M, q)  # both have one solution for each
        torch.testing.assert_close(found.z[found.solved], truth.z[found.solved], rtol=1e-8, atol=1e-8)
        shares.append(float(found.solved.double().mean()))
        print(f"{name}: {shares[-1]:.0%} SOLVED, all as by pivoting")
    return shares[0], shares[1]


if __name__ == "__main__":
    main()
