"""Batched primal-dual interior point method for LCPs in plain torch: any device, and the smoothed solution.

On the equilibrated problem S = D M D, p = D q / s (powers of two, so that scaling rounds nothing) it follows the central
path w = S z + p, z_i w_i = mu, with Mehrotra's predictor and corrector: one factorisation of S + W/Z an iteration,
used twice, and one common step for z and w, which M couples. Elements that have finished leave the batch.
Close to a solution the complementary basis z > w is tried: solving on it gives exact zeros and a residual of rounding.
Derivation and choices: NOTES.md, section 2.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lcplearn.lcp.residuals import EPS, equilibrate

DEFAULT_MAX_ITER = 100
POLISH_BELOW = 1e-6  # try the basis once the merit is this small: earlier tries fail, later ones waste iterations
EXACT = 16 * EPS
CONVERGED = 50 * EPS
PATIENCE = 15  # iterations within which the merit has to halve
POLISH_ROUNDS = 3
RIDGE = 1e-9  # for singular blocks; the refinement rounds take its bias out again


class Iterate(NamedTuple):
    """Where the method ended, before judgement; `exhausted` marks elements stopped by max_iter alone."""

    z: Float[Tensor, "b n"]
    w: Float[Tensor, "b n"]
    basis: Bool[Tensor, "b n"]
    iterations: Int[Tensor, " b"]
    exhausted: Bool[Tensor, " b"]


@dataclass
class _Active:
    """Elements still being iterated on; `index` points back into the whole batch."""

    index: Int[Tensor, " b"]
    S: Float[Tensor, "b n n"]
    p: Float[Tensor, "b n"]
    tau: Float[Tensor, "b 1"]
    z: Float[Tensor, "b n"]
    w: Float[Tensor, "b n"]
    best: Float[Tensor, " b"]  # merit when it last halved
    since: Int[Tensor, " b"]  # iterations since then

    def keep(self, mask: Bool[Tensor, " b"]) -> "_Active":
        return _Active(**{name: value[mask] for name, value in vars(self).items()})


def interior_point(
    M: Float[Tensor, "b n n"], q: Float[Tensor, "b n"], *, max_iter: int, smoothing: float = 0.0
) -> Iterate:
    """Solve a batch of finite float64 LCPs (PSD or P matrices); what is returned still has to be judged.

    With `smoothing` = tau > 0: the point of the central path with z_i w_i = tau, and a basis that holds every index.
    """
    d = torch.exp2(torch.log2(equilibrate(M)).round())
    s = (d * q).abs().amax(-1, keepdim=True).clamp_min(smoothing**0.5)
    s = torch.where(s > 0, torch.exp2(torch.log2(s).round()), 1.0)
    end = _follow_path(d.unsqueeze(-1) * M * d.unsqueeze(-2), d * q / s, smoothing / s.square(), max_iter)
    return end._replace(z=end.z * d * s, w=end.w / d * s)


def _follow_path(S: Tensor, p: Tensor, tau: Tensor, max_iter: int) -> Iterate:
    """Iterate until each element has converged, stalled or run out of iterations."""
    ones = torch.ones_like(p)
    counter = torch.zeros(p.shape[0], dtype=torch.int64, device=p.device)
    end = Iterate(ones.clone(), ones.clone(), ones > 0, counter.clone(), counter > 0)
    a = _Active(
        index=torch.arange(p.shape[0], device=p.device), S=S, p=p, tau=tau, z=ones, w=ones,
        best=torch.full_like(p[:, 0], torch.inf), since=counter,
    )  # fmt: skip
    for iteration in range(max_iter + 1):
        r = _multiply(a.S, a.z) + a.p - a.w
        merit = torch.maximum((a.z * a.w - a.tau).abs().amax(-1), r.abs().amax(-1))
        halved = merit < 0.5 * a.best
        a.best, a.since = torch.where(halved, merit, a.best), torch.where(halved, 0, a.since + 1)
        finished = (merit <= CONVERGED) | (a.since > PATIENCE) | ~merit.isfinite()
        out_of_time = ~finished & (iteration == max_iter)
        finished = _store(end, a, finished | out_of_time, merit < POLISH_BELOW, iteration)
        end.exhausted[a.index] = out_of_time
        if finished.all():
            break
        a, r = a.keep(~finished), r[~finished]
        a.z, a.w = _predict_and_correct(a, r)
    return end


def _predict_and_correct(a: _Active, r: Tensor) -> tuple[Tensor, Tensor]:
    """One Mehrotra step: (S + W/Z) dz = right-hand side, dw = S dz + r."""
    factors, pivots, _ = torch.linalg.lu_factor_ex(a.S + torch.diag_embed(a.w / a.z))

    def direction(rhs: Tensor) -> tuple[Tensor, Tensor]:
        dz = torch.linalg.lu_solve(factors, pivots, rhs.unsqueeze(-1)).squeeze(-1)
        return dz, _multiply(a.S, dz) + r

    mu = (a.z * a.w).mean(-1, keepdim=True)
    dz, dw = direction(-r - a.w)
    step = _longest_step(a, dz, dw).clamp_max(1)
    mu_affine = ((a.z + step * dz) * (a.w + step * dw)).mean(-1, keepdim=True)
    target = torch.maximum((mu_affine / mu).clamp(0, 1) ** 3 * mu, a.tau)
    dz, dw = direction(-r - a.w + (target - dz * dw) / a.z)
    step = (torch.maximum(1 - mu, torch.full_like(mu, 0.99)) * _longest_step(a, dz, dw)).clamp_max(1)
    return a.z + step * dz, a.w + step * dw


def _longest_step(a: _Active, dz: Tensor, dw: Tensor) -> Tensor:
    """Distance along (dz, dw) to the boundary of z, w >= 0."""
    fastest = torch.maximum(-dz / a.z, -dw / a.w).amax(-1, keepdim=True)
    return 1 / fastest.clamp_min(EPS)


def _store(end: Iterate, a: _Active, finished: Tensor, near: Tensor, iteration: int) -> Tensor:
    """Write finished elements to `end`, polished where that is better; returns which elements are finished."""
    chosen = finished | (near & (a.tau.squeeze(-1) == 0))
    if not chosen.any():
        return finished
    c = a.keep(chosen)
    basis = (c.z > c.w) | (c.tau > 0)
    z, w = polish(c.S, c.p, c.z, basis)
    error = _natural(c.S, c.p, z)
    exact = error <= EXACT
    worse = ((c.tau > 0) | ~(error < _natural(c.S, c.p, c.z)).unsqueeze(-1)) & ~exact.unsqueeze(-1)
    finished = finished.clone()
    finished[chosen] |= exact & (c.tau.squeeze(-1) == 0)
    write = finished[chosen]
    index = c.index[write]
    end.z[index] = torch.where(worse, c.z, z)[write]
    end.w[index] = torch.where(worse, c.w, w)[write]
    end.basis[index] = basis[write]
    end.iterations[index] = iteration
    return finished


def polish(S: Tensor, p: Tensor, z: Tensor, basis: Tensor) -> tuple[Tensor, Tensor]:
    """Solve S_AA z_A = -p_A on the basis A, starting from z: exact zeros of z off A and of w on A.

    Corrections to the current z rather than a fresh solve: where S_AA is singular (every stick of a friction LCP) they
    leave the part of z in its null space alone and still converge to a consistent solution.
    """
    inside = basis.unsqueeze(-1) & basis.unsqueeze(-2)
    block = torch.where(inside, S, 0.0) + torch.diag_embed((~basis).to(S.dtype))
    factors, pivots, _ = torch.linalg.lu_factor_ex(block)
    diagonal = factors.diagonal(dim1=-2, dim2=-1).abs()
    singular = diagonal.amin(-1) <= 4 * S.shape[-1] * EPS * diagonal.amax(-1)
    if singular.any():
        ridge = RIDGE * singular.to(S.dtype).unsqueeze(-1) * basis
        factors, pivots, _ = torch.linalg.lu_factor_ex(block + torch.diag_embed(ridge))
    z = torch.where(basis, z, 0.0)
    for _ in range(POLISH_ROUNDS):
        r = torch.where(basis, _multiply(S, z) + p, 0.0)
        z = z - torch.linalg.lu_solve(factors, pivots, r.unsqueeze(-1)).squeeze(-1)
    z = z.clamp_min(0)
    return z, torch.where(basis, 0.0, (_multiply(S, z) + p).clamp_min(0))


def _natural(S: Tensor, p: Tensor, z: Tensor) -> Tensor:
    """Natural residual max |min(z, S z + p)|; infinity where it is not finite."""
    error = torch.minimum(z, _multiply(S, z) + p).abs().amax(-1)
    return torch.where(error.isfinite(), error, torch.inf)


def _multiply(S: Tensor, x: Tensor) -> Tensor:
    return (S @ x.unsqueeze(-1)).squeeze(-1)
