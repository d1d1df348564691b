"""What must hold of every result, checked without the code that is tested."""

from itertools import product
from typing import Any, NamedTuple

import numpy as np
import torch

from lcplearn import solve_lcp
from lcplearn.benchmark.fuzz.cases import Batch
from lcplearn.lcp.solution import LCPSolution, Status

EPS = np.finfo(np.float64).eps
ENUMERATED = 5  # largest n whose 3^n patterns are tried
TINY = 1e-307  # below it doubles lose digits, and no z can be right to many
HUGE = 1e150  # products of two such numbers, or quotients, overflow
HUGE_FLOAT32 = 1e15
EXTREME = 1e-3  # residual that is allowed to data beyond HUGE, which lose digits to underflow


class Finding(NamedTuple):
    """Something wrong: which check, what was seen, and the elements to replay."""

    check: str
    message: str
    elements: list[int]


def check(batch: Batch) -> list[Finding]:
    """All checks on one batch."""
    findings = []
    M, q = torch.from_numpy(batch.M), torch.from_numpy(batch.q)
    for method in ("pivoting", "interior_point"):
        solution = solve_lcp(M, q, method=method)
        findings += _check_solution(method, batch, solution)
        findings += _check_gradient(method, M, q, method=method)
        if method == "pivoting":
            findings += _check_alone(M, q, solution)
            findings += _check_solvable(batch, solution)
    with np.errstate(over="ignore", invalid="ignore"):
        single = batch._replace(M=batch.M.astype(np.float32), q=batch.q.astype(np.float32))
    M, q = torch.from_numpy(single.M), torch.from_numpy(single.q)
    solution = solve_lcp(M, q)
    findings += _check_solution("pivoting float32", single, solution)
    findings += _check_gradient("smoothed float32", M, q, smoothing=1e-10)
    return findings


class Residual(NamedTuple):
    """The two parts of the residual of `residuals.py`, and what rounding to double may add to each."""

    natural: float
    rows: float
    rounding_natural: float
    rounding_rows: float

    def exceeds(self, allowed: float) -> bool:
        return (
            self.natural > 2 * allowed + self.rounding_natural
            or self.rows > 2 * allowed + self.rounding_rows
            or not np.isfinite([self.natural, self.rows]).all()
        )


def residual(M: np.ndarray, q: np.ndarray, z: np.ndarray) -> Residual:
    """Recompute the residual in extended precision."""
    with np.errstate(all="ignore"):
        M, q, z = (np.asarray(x, dtype=np.longdouble) for x in (M, q, z))
        size = np.maximum(np.abs(M), np.abs(M.T))
        d = np.ones_like(q)
        for _ in range(4):
            largest = (size * d).max(1) * d
            largest = np.where(largest > 0, largest, 1)
            if (np.abs(largest - 1.3) <= 0.83).all():  # near enough to 1, as in `residuals.equilibrate`
                break
            d = d / np.sqrt(largest)
        w, omega = M @ z + q, np.abs(q) + np.abs(M) @ z
        w = np.where(np.abs(w) < TINY, 0, w)
        scale = np.abs(d * q).max()
        natural = _over(np.abs(np.minimum(z / d, d * w)), scale).max()
        weight = np.maximum(_over(z, z.max()), _over(np.abs(M) * z, omega[:, None]).max(0, initial=0.0))
        rows = np.abs(np.minimum(weight, _over(w, omega))).max()
        rounding = 4 * len(q) * EPS
        return Residual(float(natural), float(rows), float(rounding * (1 + _over(d * omega, scale).max())), rounding)


def _over(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.where(a == 0, 0, a / np.where(a == 0, 1, b))


def _check_solution(method: str, batch: Batch, solution: LCPSolution) -> list[Finding]:
    """Statuses against a residual, certificates and signs of our own."""
    fields = [x.detach().numpy() for x in solution]
    findings = []
    for b in range(len(batch.q)):
        z, w, basis, status, _, _, certificate = (field[b] for field in fields)
        M, q = batch.M[b], batch.q[b]
        name, wrong = Status(int(status)).name, None
        finite = bool(np.isfinite(M).all() and np.isfinite(q).all())
        if (status == Status.NONFINITE_INPUT) == finite:
            wrong = "nonfinite input", f"status {name} for data that are {'' if finite else 'not '}finite"
        elif not finite:
            continue
        elif not np.isfinite([z, w]).all():
            if status == Status.SOLVED or _within(M, q, HUGE_FLOAT32 if M.dtype == np.float32 else HUGE):
                wrong = "not finite", f"status {name} with z={z}, w={w}"
        elif (z < 0).any():
            wrong = "sign", f"z={z}"
        elif status == Status.SOLVED:
            wrong = _wrong_solution(M, q, z, w, basis)
        elif status == Status.INFEASIBLE:
            wrong = _wrong_certificate(batch.kind, M, q, certificate)
        if wrong:
            findings.append(Finding(f"{method}: {wrong[0]}", wrong[1], [b]))
    return findings


def _wrong_solution(
    M: np.ndarray, q: np.ndarray, z: np.ndarray, w: np.ndarray, basis: np.ndarray
) -> tuple[str, str] | None:
    if (z[~basis] != 0).any() or (w[basis] != 0).any():
        return "basis", f"basis={basis} with z={z}, w={w}"
    with np.errstate(all="ignore"):
        ratio = float((np.abs(M).astype(np.longdouble) @ z).max() / max(np.abs(q).max(), TINY))
    if M.dtype == np.float32:
        if not _within(M, q, HUGE_FLOAT32):
            return None
        allowed = max(2e-6, _rounding_float32(M, ratio))  # z was judged before it was rounded to float32
    else:
        allowed = max(1e-10, min(1e-6, 10 * EPS * ratio)) if _within(M, q, HUGE) else EXTREME
    r = residual(M, q, z)
    return ("wrong SOLVED", f"{r}, allowed {allowed:.3g}, z={z}") if r.exceeds(allowed) else None


def _wrong_certificate(kind: str, M: np.ndarray, q: np.ndarray, certificate: np.ndarray) -> tuple[str, str] | None:
    M, q, u = (x.astype(np.longdouble) for x in (M, q, certificate))
    with np.errstate(all="ignore"):
        no_more_than = 1.01e-12 * (np.abs(M).T @ u) + TINY
        proof = (u >= 0).all() and (M.T @ u <= no_more_than).all() and q @ u <= -0.99e-9 * (np.abs(q) @ u) < 0
    if not proof and certificate.dtype == np.float64:  # rounded to float32 it need not be one any more
        return "certificate", f"u={certificate}"
    if kind.endswith("integers") and len(q) <= ENUMERATED:
        z = enumerate_solution(M.astype(np.float64), q.astype(np.float64))
        return None if z is None else ("wrong INFEASIBLE", f"z={z} solves it")
    return None


def _within(M: np.ndarray, q: np.ndarray, huge: float) -> bool:
    """Whether all sizes are between 1 / huge and huge, zeros aside."""
    size = np.abs(np.concatenate([M.ravel(), q])).astype(np.float64)
    size = size[size > 0]
    return not len(size) or bool(size.max() < huge and size.min() > 1 / huge)


def _rounding_float32(M: np.ndarray, ratio: float) -> float:
    """Residual that rounding z to float32 may cause, for terms that are `ratio` times as large as q."""
    size = np.maximum(np.abs(M), np.abs(M.T)).max(1).astype(np.float64)
    size = size[size > 0]
    spread = float(np.sqrt(size.max() / size.min())) if len(size) else 1.0
    return 1e-4 * (1 + ratio) * spread


def _check_alone(M: torch.Tensor, q: torch.Tensor, solution: LCPSolution) -> list[Finding]:
    """An element alone, and the batch backwards, must give the same bits."""
    findings = []
    backwards = solve_lcp(M.flip(0), q.flip(0), method="pivoting")
    alone = [solve_lcp(M[b], q[b], method="pivoting") for b in (0, len(q) // 2)]
    for name in LCPSolution._fields:
        whole = getattr(solution, name)
        same = torch.isclose(getattr(backwards, name).flip(0), whole, rtol=0, atol=0, equal_nan=True)
        wrong = torch.nonzero(~same.reshape(len(q), -1).all(1)).flatten().tolist()
        for b, one in zip((0, len(q) // 2), alone, strict=True):
            if not torch.isclose(getattr(one, name), whole[b], rtol=0, atol=0, equal_nan=True).all():
                wrong.append(b)
        if wrong:
            findings.append(Finding("batch dependence", f"{name} of elements {wrong}", list(range(len(q)))))
    return findings


def _check_solvable(batch: Batch, solution: LCPSolution) -> list[Finding]:
    """Positive semidefinite and friction problems with a solution must be SOLVED."""
    if not batch.solvable:
        return []
    missed = torch.nonzero(solution.status != Status.SOLVED).flatten().tolist()
    return [Finding("missed", f"status {Status(int(solution.status[b])).name}", [b]) for b in missed]


def _check_gradient(name: str, M: torch.Tensor, q: torch.Tensor, **options: Any) -> list[Finding]:
    """Gradients are finite, unless true ones (grad_q z', or z / w with smoothing) overflow, and zero where unsolved."""
    M, q = M.clone().requires_grad_(), q.clone().requires_grad_()
    solution = solve_lcp(M, q, **options)
    loss = torch.where(solution.solved, (solution.z + solution.w).sum(-1), 0.0).sum()
    try:
        gradients = torch.autograd.grad(loss, (M, q)) if loss.requires_grad else ()
    except RuntimeError as error:  # LinAlgError is one
        return [Finding(f"{name}: gradient raises", str(error), list(range(len(q))))]
    huge = np.sqrt(HUGE_FLOAT32 if M.dtype == torch.float32 else HUGE)  # h z' is of size q / M^2
    findings = []
    for of, gradient in zip("Mq", gradients, strict=False):
        flat = gradient.reshape(len(q), -1)
        for b in torch.nonzero(~flat.isfinite().all(1)).flatten().tolist():
            z, w, limit = solution.z[b].detach().double(), solution.w[b].detach().double(), torch.finfo(M.dtype).max
            steepest = float((z / w).max()) if options.get("smoothing") else float(gradients[1][b].abs().max())
            true = np.log(steepest) + (float(z.max().log()) if of == "M" else 0.0)  # the gradient's size
            overflows = np.isfinite(steepest) and true > np.log(limit)
            if _within(M[b].detach().numpy(), q[b].detach().numpy(), huge) and not overflows:
                findings.append(Finding(f"{name}: gradient not finite", f"with respect to {of}", [b]))
        for b in torch.nonzero((flat != 0).any(1) & ~solution.solved).flatten().tolist():
            findings.append(Finding(f"{name}: gradient of unsolved", f"with respect to {of}", [b]))
    return findings


def enumerate_solution(M: np.ndarray, q: np.ndarray) -> np.ndarray | None:
    """A solution by trying all 3^n patterns (z_i > 0, w_i > 0, both zero), or None; for small integer data."""
    for pattern in product((0, 1, 2), repeat=len(q)):
        positive, tight = np.array(pattern) == 2, np.array(pattern) >= 1
        z = np.zeros(len(q))
        if positive.any():
            z[positive] = np.linalg.lstsq(M[np.ix_(tight, positive)], -q[tight], rcond=1e-10)[0]
        if np.abs(np.minimum(z, M @ z + q)).max() < 1e-9:
            return z
    return None
