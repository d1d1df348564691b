"""Batched primal-dual interior point method for LCPs in plain torch: any device, and the smoothed solution.

On the equilibrated problem S = D M D, p = D q / s (powers of two, so that scaling rounds nothing) it follows the
central path w = S z + p, z_i w_i = mu, with Mehrotra's predictor and corrector: one factorisation of S + W/Z an
iteration, used twice, and one common step for z and w, which M couples. After each round of a few iterations the
complementary basis z > w is tried: solving on it gives exact zeros and a residual of rounding.

An accelerator runs thousands of small operations in a row, but waits at each question that the CPU asks it. So rounds
ask nothing: an element that is finished stays as it is under a mask. `follow_path` is such rounds and nothing else;
`interior_point` asks then who is left, and goes on with those (on the CPU, where asking is free, after each round).
Derivation and choices: NOTES.md, section 2.
"""

from typing import NamedTuple, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lcplearn.lcp.residuals import EPS, equilibrate, judge, multiply, two_sided_scales

DEFAULT_MAX_ITER = 100
ROUND = 4  # iterations between two tries of the basis
ROUNDS_AT_ONCE = 3  # before an accelerator is asked who is left (docs/devices.md)
EXACT = 16 * EPS
CONVERGED = 50 * EPS
NOISE = 64 * EPS  # of the terms that a w is the sum of: smaller ones are zero
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


class _Problem(NamedTuple):
    """Equilibrated; in the caller's units z is z d s and w is w s / d."""

    S: Float[Tensor, "b n n"]
    p: Float[Tensor, "b n"]
    tau: Float[Tensor, "b 1"]
    d: Float[Tensor, "b n"]
    s: Float[Tensor, "b 1"]


class _Path(NamedTuple):
    """Where elements are on their path; `active` are those that neither arrived nor stalled."""

    z: Float[Tensor, "b n"]
    w: Float[Tensor, "b n"]
    gap: Float[Tensor, " b"]  # complementarity gap when it last halved
    since: Int[Tensor, " b"]  # iterations since then
    active: Bool[Tensor, " b"]
    iterations: Int[Tensor, " b"]


class _Best(NamedTuple):
    """Best point so far of each element by the judge's residual, its zeros exact."""

    z: Float[Tensor, "b n"]
    w: Float[Tensor, "b n"]
    basis: Bool[Tensor, "b n"]
    error: Float[Tensor, " b"]


Batch = TypeVar("Batch", _Problem, _Path, _Best)


def interior_point(
    M: Float[Tensor, "b n n"], q: Float[Tensor, "b n"], *, max_iter: int, smoothing: float = 0.0
) -> Iterate:
    """Solve a batch of finite float64 LCPs (PSD or P matrices); what is returned still has to be judged.

    With `smoothing` = tau > 0: the point of the central path with z_i w_i = tau, and a basis that holds every index.
    """
    problem = part = _scale(M, q, smoothing)
    path, best = some_path, some_best = _start(problem)
    index = torch.arange(len(q), device=q.device)
    while len(index):
        for _ in range(1 if q.is_cpu else ROUNDS_AT_ONCE):
            some_path, some_best = _run_round(part, some_path, some_best, max_iter, smoothing > 0)
        path, best = _put(path, index, some_path), _put(best, index, some_best)
        going = (some_best.error > EXACT) & some_path.active & (some_path.iterations < max_iter)
        left = torch.nonzero(going).squeeze(-1)
        index, part = index[left], _take(part, left)
        some_path, some_best = _take(some_path, left), _take(some_best, left)
    if not smoothing:
        rough = torch.nonzero(best.error > EXACT).squeeze(-1)
        part, some_path, some_best = _take(problem, rough), _take(path, rough), _take(best, rough)
        some_best = _better(part, some_best, some_path.z, some_path.z > some_path.w)
        best = _put(best, rough, _rescue(part, some_best))
    return _in_units_of_caller(problem, path, best, max_iter)


def follow_path(
    M: Float[Tensor, "b n n"], q: Float[Tensor, "b n"], *, max_iter: int, smoothing: float = 0.0
) -> Iterate:
    """The same without its last resort and without a question, in ROUND * ROUNDS_AT_ONCE iterations."""
    problem = _scale(M, q, smoothing)
    path, best = _start(problem)
    for _ in range(ROUNDS_AT_ONCE):
        path, best = _run_round(problem, path, best, max_iter, smoothing > 0)
    if not smoothing:
        best = _better(problem, best, path.z, path.z > path.w)
    return _in_units_of_caller(problem, path, best, max_iter)


def _scale(M: Tensor, q: Tensor, smoothing: float) -> _Problem:
    d = torch.exp2(torch.log2(equilibrate(M)).round())
    s = (d * q).abs().amax(-1, keepdim=True).clamp_min(smoothing**0.5)
    s = torch.where(s > 0, torch.exp2(torch.log2(s).round()), 1.0)
    return _Problem(d.unsqueeze(-1) * M * d.unsqueeze(-2), d * q / s, smoothing / s.square(), d, s)


def _start(problem: _Problem) -> tuple[_Path, _Best]:
    ones, infinite = torch.ones_like(problem.p), torch.full_like(problem.p[:, 0], torch.inf)
    zero = torch.zeros_like(infinite, dtype=torch.int64)
    return _Path(ones, ones, infinite, zero, zero == 0, zero), _Best(ones, ones, ones > 0, infinite)


def _in_units_of_caller(problem: _Problem, path: _Path, best: _Best, max_iter: int) -> Iterate:
    z, w = best.z * problem.d * problem.s, best.w / problem.d * problem.s
    return Iterate(z, w, best.basis, path.iterations, path.active & (path.iterations == max_iter))


def _take(x: Batch, index: Tensor) -> Batch:
    return type(x)(*(field[index] for field in x))


def _put(x: Batch, index: Tensor, part: Batch) -> Batch:
    return type(x)(*(whole.index_copy(0, index, new) for whole, new in zip(x, part, strict=True)))


def _run_round(problem: _Problem, path: _Path, best: _Best, max_iter: int, smoothed: bool) -> tuple[_Path, _Best]:
    """A few iterations, then a try of the basis; nothing here depends on values, so nothing waits for them."""
    for _ in range(ROUND):
        path = _iterate(problem, path, max_iter, smoothed)
    if smoothed:
        error = torch.where(_on_path(problem, path), torch.zeros_like(best.error), torch.inf)
        return path, _Best(path.z, path.w, best.basis, error)
    basis = path.z > path.w
    best = _better(problem, best, solve_on_basis(problem.S, problem.p, path.z, basis), basis)
    return path._replace(active=path.active & (best.error > EXACT)), best


def _iterate(problem: _Problem, path: _Path, max_iter: int, smoothed: bool) -> _Path:
    """One Mehrotra step of the elements that are active and may take one."""
    S, p, tau, *_ = problem
    r = multiply(S, path.z) + p - path.w
    gap = (path.z * path.w - tau).abs().amax(-1)
    halved = gap < 0.5 * path.gap
    since = torch.where(halved, 0, path.since + 1)
    active = path.active & (since <= PATIENCE)
    if smoothed:
        active = active & ~_on_path(problem, path)
    z, w = _predict_and_correct(problem, path, r)
    active = active & (z.isfinite() & w.isfinite()).all(-1)
    go = active & (path.iterations < max_iter)
    return _Path(
        torch.where(go.unsqueeze(-1), z, path.z),
        torch.where(go.unsqueeze(-1), w, path.w),
        torch.where(halved, gap, path.gap),
        since,
        active,
        path.iterations + go,
    )


def _on_path(problem: _Problem, path: _Path) -> Bool[Tensor, " b"]:
    """Whether z w = tau and w = S z + p, to rounding."""
    gap = (path.z * path.w - problem.tau).abs().amax(-1)
    infeasibility = (multiply(problem.S, path.z) + problem.p - path.w).abs().amax(-1)
    return (gap <= ON_PATH * problem.tau.squeeze(-1)) & (infeasibility <= CONVERGED)


def _predict_and_correct(problem: _Problem, path: _Path, r: Tensor) -> tuple[Tensor, Tensor]:
    """One Mehrotra step: (S + W/Z) dz = right-hand side, dw = S dz + r."""
    S, _, tau, *_ = problem
    z, w, *_ = path
    factors, pivots, _ = torch.linalg.lu_factor_ex(S + torch.diag_embed(w / z))

    def direction(rhs: Tensor) -> tuple[Tensor, Tensor]:
        dz = torch.linalg.lu_solve(factors, pivots, rhs.unsqueeze(-1)).squeeze(-1)
        return dz, multiply(S, dz) + r

    def longest_step(dz: Tensor, dw: Tensor) -> Tensor:
        """Distance along (dz, dw) to the boundary of z, w >= 0."""
        return 1 / torch.maximum(-dz / z, -dw / w).amax(-1, keepdim=True).clamp_min(EPS)

    mu = (z * w).mean(-1, keepdim=True)
    dz, dw = direction(tau / z - r - w)
    step = longest_step(dz, dw).clamp_max(1)
    mu_affine = ((z + step * dz) * (w + step * dw)).mean(-1, keepdim=True)
    excess = mu - tau
    centering = torch.where(excess == 0, 0.0, (mu_affine - tau) / excess).clamp(0, 1) ** 3
    target = tau + centering * excess
    dz, dw = direction((target - dz * dw) / z - r - w)
    step = (torch.maximum(1 - mu, torch.full_like(mu, 0.99)) * longest_step(dz, dw)).clamp_max(1)
    return z + step * dz, w + step * dw


def _better(problem: _Problem, best: _Best, z: Tensor, basis: Tensor) -> _Best:
    """The better of what is held and z on the basis, its zeros made exact."""
    S, p, *_ = problem
    basis = basis & (z > 0)
    z = torch.where(basis, z, 0.0)
    w = multiply(S, z) + p
    w = torch.where(basis | (w <= NOISE * (p.abs() + multiply(S.abs(), z))), 0.0, w)
    error = judge(S, p, z, tol=EXACT).residual
    better = error < best.error
    row = better.unsqueeze(-1)
    return _Best(
        torch.where(row, z, best.z),
        torch.where(row, w, best.w),
        torch.where(row, basis, best.basis),
        torch.where(better, error, best.error),
    )


def _rescue(problem: _Problem, best: _Best) -> _Best:
    """Correct the bases of elements that are not solved to rounding.

    First by block pivoting on the problem itself, then on proximal ones (S + delta I, p - delta z): positive definite
    where S is semidefinite, so that block pivoting succeeds, and their solutions are one of the original problem in
    the limit.
    """
    for delta in PROXIMAL_WEIGHTS:
        rough = torch.nonzero(best.error > EXACT).squeeze(-1)
        if not len(rough):
            break
        part, held = _take(problem, rough), _take(best, rough)
        eye = torch.eye(part.p.shape[-1], dtype=part.p.dtype, device=part.p.device)
        shifted = part._replace(S=part.S + delta * eye, p=part.p - delta * held.z)
        z, basis = _correct_basis(shifted, held)
        held = _better(part, held, z, basis)
        held = _better(part, held, solve_on_basis(part.S, part.p, z, basis), basis)
        best = _put(best, rough, held)
    return best


def _correct_basis(problem: _Problem, start: _Best) -> tuple[Tensor, Tensor]:
    """The best z and basis that block principal pivoting from a basis finds.

    Flips every member with a wrong sign; if that stops lowering their number, only the last one (finite for P).
    Source: Judice and Pires, "A block principal pivoting algorithm for large-scale strictly monotone LCPs" (1994).
    """
    index = torch.arange(len(start.z), device=start.z.device)
    z, basis = start.z, start.basis
    found = held = _Best(z, z, basis, torch.full_like(start.error, torch.inf))
    fewest = held.error
    patience = torch.full_like(index, FLIP_PATIENCE)
    member = torch.arange(z.shape[-1], device=z.device)
    for _ in range(3 * z.shape[-1] + 20):
        S, p, *_ = problem
        z = solve_on_basis(S, p, z, basis)
        held = _better(problem, held, z, basis)
        found = _put(found, index, held)
        omega = p.abs() + multiply(S.abs(), z.abs())
        w = multiply(S, z) + p
        wrong = torch.where(basis, z < -8 * EPS * z.abs().amax(-1, keepdim=True), w < -8 * EPS * omega)
        count = wrong.sum(-1)
        go_on = torch.nonzero((count > 0) & (held.error > EXACT) & z.isfinite().all(-1)).squeeze(-1)
        if not len(go_on):
            break
        patience = torch.where(count < fewest, FLIP_PATIENCE, patience - 1)
        fewest = torch.minimum(fewest, count)
        last = member == torch.where(wrong, member, -1).amax(-1, keepdim=True)
        basis = basis ^ (wrong & (last | (patience >= 0).unsqueeze(-1)))
        problem, held = _take(problem, go_on), _take(held, go_on)
        z, basis, index, patience, fewest = (x[go_on] for x in (z, basis, index, patience, fewest))
    return found.z, found.basis


def solve_on_basis(S: Tensor, p: Tensor, z: Tensor, basis: Tensor) -> Tensor:
    """z with S_AA z_A = -p_A on the basis A and z = 0 off it, of any sign, starting from a z near it.

    Corrections to the current z rather than a fresh solve: where S_AA is singular (every stick of a friction LCP) they
    leave the part of z in its null space alone and still converge to a consistent solution.
    """
    inside = basis.unsqueeze(-1) & basis.unsqueeze(-2)
    block = torch.where(inside, S, 0.0)
    rows, columns = two_sided_scales(block)
    block = rows.unsqueeze(-1) * block * columns.unsqueeze(-2) + torch.diag_embed((~basis).to(S.dtype))
    factors, _, _ = torch.linalg.lu_factor_ex(block)
    diagonal = factors.diagonal(dim1=-2, dim2=-1).abs()
    singular = diagonal.amin(-1, keepdim=True) <= 4 * S.shape[-1] * EPS * diagonal.amax(-1, keepdim=True)
    ridge = RIDGE * (basis & singular).to(S.dtype)
    factors, pivots, _ = torch.linalg.lu_factor_ex(block + torch.diag_embed(ridge))
    z = torch.where(basis, z, 0.0)
    for _ in range(REFINEMENTS):
        r = torch.where(basis, rows * (multiply(S, z) + p), 0.0)
        z = z - columns * torch.linalg.lu_solve(factors, pivots, r.unsqueeze(-1)).squeeze(-1)
    return z
