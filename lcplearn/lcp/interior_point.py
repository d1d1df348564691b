"""Batched primal-dual interior point method for LCPs in plain torch: any device, and the smoothed solution.

On the equilibrated problem S = D M D, p = D q / s (powers of two, so that scaling rounds nothing) it follows the
central path w = S z + p, z_i w_i = mu, with Mehrotra's predictor and corrector: one factorisation of S + W/Z an
iteration, used twice, and one common step for z and w, which M couples. Finished elements leave the batch.
Close to a solution the complementary basis z > w is tried: solving on it gives exact zeros and a residual of rounding.
Derivation and choices: NOTES.md, section 2.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lcplearn.lcp.residuals import EPS, equilibrate, judge, multiply, two_sided_scales

DEFAULT_MAX_ITER = 100
POLISH_BELOW = 1e-6  # try the basis once the merit is this small: earlier tries fail, later ones waste iterations
EXACT = 16 * EPS
CONVERGED = 50 * EPS
ON_PATH = 1e-11  # relative error of z_i w_i = tau
PATIENCE = 15  # iterations within which the complementarity gap has to halve
REFINEMENTS = 3
RIDGE = 1e-9  # for singular blocks; refinement takes its bias out again
PROXIMAL_WEIGHTS = (0.0, 1e-3, 1e-4, 1e-5, 1e-6, 0.0)
FLIP_PATIENCE = 4  # rounds of block flips that may fail to lower the number of wrong signs


class Iterate(NamedTuple):
    """Where a method ended, before judgement; `exhausted` marks elements stopped by max_iter alone."""

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
    gap: Float[Tensor, " b"]  # complementarity gap when it last halved
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
    S, p, tau = d.unsqueeze(-1) * M * d.unsqueeze(-2), d * q / s, smoothing / s.square()
    best, iterations, exhausted = _follow_path(S, p, tau, max_iter)
    for delta in PROXIMAL_WEIGHTS if not smoothing else ():
        _improve(best, S, p, delta)
    return Iterate(best.z * d * s, best.w / d * s, best.basis, iterations, exhausted)


class _Best(NamedTuple):
    """Best point so far of each element, by the judge's residual; updated in place."""

    z: Float[Tensor, "b n"]
    w: Float[Tensor, "b n"]
    basis: Bool[Tensor, "b n"]
    error: Float[Tensor, " b"]

    def offer(self, index: Tensor, S: Tensor, p: Tensor, z: Tensor, basis: Tensor) -> Tensor:
        """Take points that are better than those held, their zeros made exact; returns their residual."""
        basis = basis & (z > 0)
        z = torch.where(basis, z, 0.0)
        w = multiply(S, z) + p
        noise = 8 * EPS * (p.abs() + multiply(S.abs(), z))
        w = torch.where(basis | (w <= noise), 0.0, w)
        error = judge(S, p, z, tol=EXACT).residual
        better = error < self.error[index]
        for held, offered in zip(self, (z, w, basis, error), strict=True):
            held[index[better]] = offered[better]
        return error


def _follow_path(S: Tensor, p: Tensor, tau: Tensor, max_iter: int) -> tuple[_Best, Tensor, Tensor]:
    """Iterate until each element has converged, stalled or run out of iterations."""
    ones, infinite = torch.ones_like(p), torch.full_like(p[:, 0], torch.inf)
    index = torch.arange(p.shape[0], device=p.device)
    best = _Best(ones.clone(), ones.clone(), ones > 0, infinite.clone())
    iterations, exhausted = torch.zeros_like(index), index < 0
    smoothed = bool((tau > 0).any())
    a = _Active(index, S, p, tau, z=ones, w=ones, gap=infinite, since=iterations.clone())
    for iteration in range(max_iter + 1):
        r = multiply(a.S, a.z) + a.p - a.w
        gap, infeasibility = (a.z * a.w - a.tau).abs().amax(-1), r.abs().amax(-1)
        halved = gap < 0.5 * a.gap
        a.gap, a.since = torch.where(halved, gap, a.gap), torch.where(halved, 0, a.since + 1)
        finished = a.since > PATIENCE
        if smoothed:
            finished |= (gap <= ON_PATH * a.tau.squeeze(-1)) & (infeasibility <= CONVERGED)
        else:
            finished |= _try_basis(best, a, torch.maximum(gap, infeasibility) < POLISH_BELOW)
        z, w = _predict_and_correct(a, r)
        finished |= ~(z.isfinite() & w.isfinite()).all(-1)
        out_of_time = ~finished & (iteration == max_iter)
        stop = finished | out_of_time
        iterations[a.index], exhausted[a.index] = iteration, out_of_time
        if stop.any():
            c = a.keep(stop)
            if smoothed:
                best.z[c.index], best.w[c.index] = c.z, c.w
            else:
                best.offer(c.index, c.S, c.p, c.z, c.z > c.w)
            a, z, w = a.keep(~stop), z[~stop], w[~stop]
        if not len(a.index):
            break
        a.z, a.w = z, w
    return best, iterations, exhausted


def _try_basis(best: _Best, a: _Active, near: Bool[Tensor, " b"]) -> Bool[Tensor, " b"]:
    """Solve on the basis z > w of elements near their solution; True for those that this solves to rounding."""
    exact = torch.zeros_like(near)
    if near.any():
        c = a.keep(near)
        basis = c.z > c.w
        exact[near] = best.offer(c.index, c.S, c.p, solve_on_basis(c.S, c.p, c.z, basis), basis) <= EXACT
    return exact


def _predict_and_correct(a: _Active, r: Tensor) -> tuple[Tensor, Tensor]:
    """One Mehrotra step: (S + W/Z) dz = right-hand side, dw = S dz + r."""
    factors, pivots, _ = torch.linalg.lu_factor_ex(a.S + torch.diag_embed(a.w / a.z))

    def direction(rhs: Tensor) -> tuple[Tensor, Tensor]:
        dz = torch.linalg.lu_solve(factors, pivots, rhs.unsqueeze(-1)).squeeze(-1)
        return dz, multiply(a.S, dz) + r

    mu = (a.z * a.w).mean(-1, keepdim=True)
    dz, dw = direction(a.tau / a.z - r - a.w)
    step = _longest_step(a, dz, dw).clamp_max(1)
    mu_affine = ((a.z + step * dz) * (a.w + step * dw)).mean(-1, keepdim=True)
    excess = mu - a.tau
    centering = torch.where(excess == 0, 0.0, (mu_affine - a.tau) / excess).clamp(0, 1) ** 3
    target = a.tau + centering * excess
    dz, dw = direction((target - dz * dw) / a.z - r - a.w)
    step = (torch.maximum(1 - mu, torch.full_like(mu, 0.99)) * _longest_step(a, dz, dw)).clamp_max(1)
    return a.z + step * dz, a.w + step * dw


def _longest_step(a: _Active, dz: Tensor, dw: Tensor) -> Tensor:
    """Distance along (dz, dw) to the boundary of z, w >= 0."""
    fastest = torch.maximum(-dz / a.z, -dw / a.w).amax(-1, keepdim=True)
    return 1 / fastest.clamp_min(EPS)


def _improve(best: _Best, S: Tensor, p: Tensor, delta: float) -> None:
    """Correct the basis of elements that are not solved to rounding yet, in place.

    With delta > 0 on the proximal problem (S + delta I, p - delta z): positive definite where S is semidefinite, so
    that block pivoting succeeds, and its solution is one of the original problem in the limit.
    """
    rough = torch.nonzero(best.error > EXACT).squeeze(-1)
    if not len(rough):
        return
    S, p, z = S[rough], p[rough], best.z[rough]
    shifted = _Best(z.clone(), z.clone(), best.basis[rough], torch.full_like(best.error[rough], torch.inf))
    _correct_basis(S + delta * torch.eye(p.shape[-1], dtype=p.dtype, device=p.device), p - delta * z, shifted)
    for z in (shifted.z, solve_on_basis(S, p, shifted.z, shifted.basis)):
        best.offer(rough, S, p, z, shifted.basis)


def _correct_basis(S: Tensor, p: Tensor, best: _Best) -> None:
    """Improve `best` in place by block principal pivoting from its basis.

    Flips every member with a wrong sign; if that stops lowering their number, only the last one (finite for P).
    Source: Judice and Pires, "A block principal pivoting algorithm for large-scale strictly monotone LCPs" (1994).
    """
    index = torch.arange(p.shape[0], device=p.device)
    z, basis = best.z.clone(), best.basis.clone()
    fewest = torch.full_like(p[:, 0], torch.inf)
    patience = torch.full_like(index, FLIP_PATIENCE)
    member = torch.arange(p.shape[-1], device=p.device)
    for _ in range(3 * p.shape[-1] + 20):
        z = solve_on_basis(S, p, z, basis)
        w = multiply(S, z) + p
        error = best.offer(index, S, p, z, basis)
        omega = p.abs() + multiply(S.abs(), z.abs())
        wrong = torch.where(basis, z < -8 * EPS * z.abs().amax(-1, keepdim=True), w < -8 * EPS * omega)
        count = wrong.sum(-1)
        go_on = (count > 0) & (error > EXACT) & z.isfinite().all(-1)
        if not go_on.any():
            break
        patience = torch.where(count < fewest, FLIP_PATIENCE, patience - 1)
        fewest = torch.minimum(fewest, count)
        last = member == torch.where(wrong, member, -1).amax(-1, keepdim=True)
        basis = basis ^ (wrong & (last | (patience >= 0).unsqueeze(-1)))
        S, p, z, basis, index, patience, fewest = (x[go_on] for x in (S, p, z, basis, index, patience, fewest))


def solve_on_basis(S: Tensor, p: Tensor, z: Tensor, basis: Tensor) -> Tensor:
    """z with S_AA z_A = -p_A on the basis A and z = 0 off it, of any sign, starting from a z near it.

    Corrections to the current z rather than a fresh solve: where S_AA is singular (every stick of a friction LCP) they
    leave the part of z in its null space alone and still converge to a consistent solution.
    """
    inside = basis.unsqueeze(-1) & basis.unsqueeze(-2)
    block = torch.where(inside, S, 0.0)
    rows, columns = two_sided_scales(block)
    block = rows.unsqueeze(-1) * block * columns.unsqueeze(-2) + torch.diag_embed((~basis).to(S.dtype))
    factors, pivots, _ = torch.linalg.lu_factor_ex(block)
    diagonal = factors.diagonal(dim1=-2, dim2=-1).abs()
    singular = diagonal.amin(-1) <= 4 * S.shape[-1] * EPS * diagonal.amax(-1)
    if singular.any():
        ridge = RIDGE * singular.to(S.dtype).unsqueeze(-1) * basis
        factors, pivots, _ = torch.linalg.lu_factor_ex(block + torch.diag_embed(ridge))
    z = torch.where(basis, z, 0.0)
    for _ in range(REFINEMENTS):
        r = torch.where(basis, rows * (multiply(S, z) + p), 0.0)
        z = z - columns * torch.linalg.lu_solve(factors, pivots, r.unsqueeze(-1)).squeeze(-1)
    return z
