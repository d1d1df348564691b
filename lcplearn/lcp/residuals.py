"""The only judge of a solution: a scale-free residual recomputed from the original data.

With w = M z + q, the residual of z is the larger of two, where 0/0 counts as 0:

(a) max_i |min(z~_i, w~_i)| / max_i |q~_i| in equilibrated coordinates z = D z~, w~ = D w, q~ = D q, with D from
    symmetric Ruiz scaling of M, so that D M D has entries of size 1;
(b) max_i |min(z_i / max_j |z_j|, w_i / omega_i)| with omega_i = |q_i| + sum_j |M_ij| |z_j|.

Both are unchanged under z -> b/a z for (a M, b q), (a) also under a congruence after which the scaling finds the same
D M D (it stops as soon as entries are of size 1, so not always: NOTES.md, section 1). Neither alone will do: (a) does
not see tiny decoupled rows, (b) accepts z = t (1, 1) with large t for M = [[1, -1], [-1, 1]], q = -1. Sizes below
2.2e-308 count as 2.2e-308, since smaller doubles have no precision.

(c) A w that is rounding noise verifies nothing: rows with |w_i| <= 8 eps omega_i count with eps d_i omega_i / max |q~|
where that is above 1e-10. M = [[2, -2], [1, -1]], q = (-2, -2) has no solution, but with z = 1e18 (1, 1) the sum
q + M z comes out as exactly 0 if q is added first.

With smoothing tau the condition z_i w_i = tau replaces z_i w_i = 0, and its smoothed minimum replaces min: the root
s(z, w) = (z + w - sqrt((z - w)^2 + 4 tau)) / 2 is zero exactly where z, w > 0 and z w = tau (Chen-Harker-Kanzow-Smale).
The size of q in (a) is then at least sqrt(tau), that of z~ and w~ for q = 0; in (b) |w_i - tau / z_i| takes the place
of w_i, since without a central path (M = 0, q = 0) z grows until (a) no longer sees that w_i = 0.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

EPS = torch.finfo(torch.float64).eps
TINY = torch.finfo(torch.float64).tiny
RUIZ_SWEEPS = 4


class Judgement(NamedTuple):
    """Residual of each element, and the largest residual that counts as SOLVED."""

    residual: Float[Tensor, "*batch"]
    tolerance: Float[Tensor, "*batch"]


def default_tolerance(dtype: torch.dtype) -> float:
    """Tolerance by the precision of the data: float32 data carry an error of 6e-8 before anything is solved."""
    return 2e-6 if dtype == torch.float32 else 1e-10


def multiply(M: Float[Tensor, "*#batch n n"], x: Float[Tensor, "*#batch n"]) -> Float[Tensor, "*#batch n"]:
    """M x, summed in an order that does not depend on the batch, unlike `@`.

    An element's rounding must not depend on its neighbours: it chooses between the solutions where there are several.
    """
    return (M * x.unsqueeze(-2)).sum(-1)


def equilibrate(M: Float[Tensor, "*batch n n"]) -> Float[Tensor, "*batch n"]:
    """Positive d such that rows and columns of d_i M_ij d_j have largest entries near 1 (symmetric Ruiz scaling).

    Rows and columns of zeros keep d_i = 1. An element is left alone once all its maxima are near 1: each further sweep
    would cost a solver of small problems as much as several pivots.
    Source: Ruiz, "A scaling algorithm to equilibrate both rows and columns norms in matrices" (2001).
    """
    size = torch.maximum(M.abs(), M.mT.abs())
    d = torch.ones_like(M[..., 0])
    for _ in range(RUIZ_SWEEPS):
        largest = (size * d.unsqueeze(-2)).amax(-1) * d
        largest = torch.where(largest > 0, largest, 1.0)
        even = ((largest - 1.3).abs() <= 0.83).all(-1, keepdim=True)  # no product of roots of small integers
        d = torch.where(even, d, d / largest.clamp_min(torch.finfo(M.dtype).tiny).sqrt())
    return d


def two_sided_scales(A: Float[Tensor, "*batch n n"]) -> tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"]]:
    """Row and column scales r_i A_ij c_j with largest entries near 1: a rank decision must not depend on units."""
    size = A.abs()
    rows, columns = torch.ones_like(A[..., 0]), torch.ones_like(A[..., 0])
    for _ in range(RUIZ_SWEEPS):
        scaled = rows.unsqueeze(-1) * size * columns.unsqueeze(-2)
        row, column = scaled.amax(-1), scaled.amax(-2)
        rows = torch.where(row > 0, rows / row.sqrt(), rows)
        columns = torch.where(column > 0, columns / column.sqrt(), columns)
    return rows, columns


def smoothed_minimum(a: Tensor, b: Tensor, tau: float) -> Tensor:
    """min(a, b), or for tau > 0 the root that is zero where a b = tau, written without cancellation near it."""
    if tau == 0:
        return torch.minimum(a, b)
    root = torch.sqrt((a - b).square() + 4 * tau)
    return torch.where(a + b > 0, 2 * (a * b - tau) / (a + b + root), (a + b - root) / 2)


def judge(
    M: Float[Tensor, "*batch n n"],
    q: Float[Tensor, "*batch n"],
    z: Float[Tensor, "*batch n"],
    *,
    tol: float,
    smoothing: float = 0.0,
) -> Judgement:
    """Residual of z and what it is held against, for float64 data.

    The tolerance is `tol`, raised only to what rounding of M z + q allows: 10 eps max(D |M| z) / max |q~|, and at most
    to 1e-6. A non-finite z has residual infinity.
    """
    if M.shape[-1] == 0:
        zero = torch.zeros(q.shape[:-1], dtype=q.dtype, device=q.device)
        return Judgement(zero, zero + tol)
    Mz, absMz = multiply(M, z), multiply(M.abs(), z.abs())
    w = Mz + q
    d = equilibrate(M)
    q_size = (d * q).abs().amax(-1).clamp_min(max(TINY, smoothing**0.5))
    natural = smoothed_minimum(z / d, d * w, smoothing).abs().amax(-1)
    z_size = z.abs().amax(-1, keepdim=True).clamp_min(TINY)
    omega = q.abs() + absMz
    off_path = (w - smoothing / z.clamp_min(TINY)).abs() if smoothing else w
    share = torch.maximum(z / z_size, (M.abs() * z.unsqueeze(-2) / omega.clamp_min(TINY).unsqueeze(-1)).amax(-2))
    rows = torch.minimum(share, off_path / omega.clamp_min(TINY)).abs().amax(-1)
    residual = torch.maximum(natural / q_size, rows)
    noise = torch.where(w.abs() <= 8 * EPS * omega, EPS * d * omega, 0.0).amax(-1) / q_size
    residual = torch.where(noise > 1e-10, torch.maximum(residual, noise), residual)
    residual = torch.where(residual.isfinite(), residual, torch.inf)
    rounding = 10 * EPS * (d * absMz).amax(-1) / q_size
    return Judgement(residual, rounding.clamp(max=1e-6).clamp(min=tol))
