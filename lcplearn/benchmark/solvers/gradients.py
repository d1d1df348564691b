"""How wrong a gradient is: slopes of unique quantities along a line of problems, against the truth.

Forces may not be unique where contacts are redundant or stick; velocities are. So the loss is c.(A z) with an A for
which A z is unique, and the data move along a line that keeps the problem solvable:

    M(t) = M * (1 + t F) * (1 + t H),   q(t) = q + t dq    (products entry by entry)

Where a solution was planted the line plants z + t dz too, and the slope c.(A dz) is known. Elsewhere the reference
extrapolates central differences of the float64 pivoting solution (Richardson, three steps), and is used where it agrees
with itself at half the steps: elsewhere a kink is near.
"""

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch

from lcplearn import solve_lcp
from lcplearn.benchmark.problems.families import Problems

STEP = 4e-3  # relative to the data: truncation (of sixth order) and rounding (eps * condition / STEP) both stay small
AGREEMENT = 1e-7
SAME_BRANCH, SAME_BRANCH_MOVED = 1e-6, 1e-2  # distance from the reference; smoothing and float32 move a solution
_IMPULSE_SHARE = {"F2": 2 / 3, "F3": 3 / 4, "F4": 5 / 6}  # of the rows of a friction LCP; the others bound friction


class Line(NamedTuple):
    """A loss of what is unique, c.(A z), a line through the data, and its slope [B] where planted."""

    A: np.ndarray
    c: np.ndarray
    F: np.ndarray
    H: np.ndarray
    dq: np.ndarray
    slope: np.ndarray | None


def line(family: str, problems: Problems, seed: int) -> Line:
    """A random line for problems of a family of `problems.RANDOM_FAMILIES`, or "redundant contacts"."""
    rng = np.random.default_rng(seed)
    if problems.z is not None:
        return _planted_line(rng, problems.M, problems.q, problems.z, unique=family.startswith("F6"))
    M, q, _ = problems
    B, n = q.shape
    if family.startswith("F1"):  # z itself is unique
        c, dq = rng.standard_normal((2, B, n))
        return Line(np.broadcast_to(np.eye(n), M.shape), c, rng.standard_normal((B, 1, 1)) + 0 * M, 0 * M, dq * q, None)
    m = round(n * _IMPULSE_SHARE.get(family[:2], 1.0))
    A = np.zeros_like(M)
    A[:, :m, :m] = M[:, :m, :m]
    F = np.where(A != 0, rng.standard_normal((B, 1, 1)), 0.0)  # all masses
    F[:, m:, :m] = np.where(M[:, m:, :m] > 0, rng.standard_normal((B, n - m, m)), 0.0)  # mu; the -1 are no data
    dq = (A @ rng.standard_normal((B, n, 1)))[..., 0]  # of the velocity: within the range of what carries the impulses
    dq *= np.abs(q).max(1, keepdims=True) / np.maximum(np.abs(dq).max(1, keepdims=True), 1e-300)
    dq[:, m:] = q[:, m:] * rng.standard_normal((B, n - m))
    return Line(A, rng.standard_normal((B, n)), F, 0 * M, dq, None)


def _planted_line(rng: np.random.Generator, M: np.ndarray, q: np.ndarray, z: np.ndarray, unique: bool) -> Line:
    """Scale rows and columns of M, which keeps a P-matrix one, and move z and w; all of M if only M z is `unique`."""
    B, n = q.shape
    w = np.where(z > 0, 0.0, (M @ z[..., None])[..., 0] + q)
    dz, dw = z * rng.standard_normal((B, n)), w * rng.standard_normal((B, n))
    A = M if unique else np.broadcast_to(np.eye(n), M.shape)
    rows, columns = rng.standard_normal((2, B, n)) * (1.0 - unique)
    F, H = rows[:, :, None] + 0 * M + unique, columns[:, None, :] + 0 * M
    c = rng.standard_normal((B, n))
    dq = dw - (M @ dz[..., None] + (M * (F + H)) @ z[..., None])[..., 0]
    return Line(A, c, F, H, dq, np.einsum("bm,bmn,bn->b", c, A, dz))


class Reference(NamedTuple):
    """What gradients are held against: the line, true slopes [B], where they can be trusted [B], and A z [B, n]."""

    line: Line
    slope: np.ndarray
    trusted: np.ndarray
    unique: np.ndarray


def reference(family: str, problems: Problems, seed: int) -> Reference:
    """True slopes along a random line."""
    path, (M, q, z) = line(family, problems, seed), problems
    if path.slope is not None and z is not None:
        return Reference(path, path.slope, path.slope != 0, np.einsum("bmn,bn->bm", path.A, z))

    def unique(t: float) -> np.ndarray:
        at = M * (1 + t * path.F) * (1 + t * path.H), q + t * path.dq
        result = solve_lcp(*map(torch.from_numpy, at))
        return np.where(result.solved.numpy()[:, None], (path.A @ result.z.numpy()[..., None])[..., 0], np.nan)

    slopes = [((unique(h) - unique(-h)) * path.c).sum(1) / (2 * h) for h in (STEP, STEP / 2, STEP / 4, STEP / 8)]
    for order in (4, 16):
        slopes = [(order * fine - coarse) / (order - 1) for coarse, fine in pairwise(slopes)]
    coarse, fine = slopes
    trusted = (np.abs(coarse - fine) <= AGREEMENT * np.abs(fine)) & (fine != 0)
    return Reference(path, fine, trusted, unique(0.0))


def gradient_errors(problems: Problems, truth: Reference, dtype: torch.dtype, **options: Any) -> np.ndarray:
    """Relative error of the slope by the gradients of `solve_lcp(..., **options)`, where there is a truth for it.

    Left out are elements that are not solved or end in another of several solutions (friction with large mu has them):
    their gradient is that of another branch.
    """
    path = truth.line
    M, q = (torch.from_numpy(x).to(dtype).requires_grad_() for x in problems[:2])
    solution = solve_lcp(M, q, **options)
    weights = torch.from_numpy(np.einsum("bm,bmn->bn", path.c, path.A)).to(dtype)
    grads = torch.autograd.grad((weights * solution.z).sum(), (M, q))
    grad_M, grad_q = (grad.double().numpy() for grad in grads)
    slope = (grad_M * problems.M * (path.F + path.H)).sum((1, 2)) + (grad_q * path.dq).sum(1)
    unique = (path.A @ solution.z.detach().double().numpy()[..., None])[..., 0]
    solved = solution.solved.numpy()
    near = SAME_BRANCH_MOVED if options.get("smoothing") or dtype == torch.float32 else SAME_BRANCH
    distance = np.abs(unique - truth.unique).max(1) / np.maximum(np.abs(truth.unique).max(1), 1e-300)
    error = np.abs(slope - truth.slope) / np.where(truth.trusted, np.abs(truth.slope), 1.0)
    return error[truth.trusted & solved & (distance < near)]
