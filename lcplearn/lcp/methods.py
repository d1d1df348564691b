"""The methods behind one signature, without derivatives: choose, solve, judge."""

import math
import warnings
from functools import cache
from types import ModuleType
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from lcplearn.lcp.interior_point import DEFAULT_MAX_ITER, Iterate, interior_point
from lcplearn.lcp.residuals import judge
from lcplearn.lcp.solution import LCPSolution, Status

Method = Literal["auto", "diagonal", "pivoting", "interior_point"]


class Options(NamedTuple):
    """How to solve: the checked keywords of `solve_lcp`."""

    method: str
    tol: float
    max_iter: int | None
    smoothing: float


def solve(M: Tensor, q: Tensor, initial_basis: Tensor | None, options: Options) -> LCPSolution:
    """Solve q [*batch, n] with M [*batch, n, n], or [n, n] shared by the batch. Gradient mode must be off."""
    if pivots(q, options):
        return _solve_by_pivoting(M, q, initial_basis, options)
    return _solve_in_torch(M, q, options)


def pivots(q: Tensor, options: Options) -> bool:
    """Whether the CPU kernel solves: where it was asked for, and on the CPU for "auto" and "diagonal".

    Its first basis, q < 0, is the closed form of a diagonal problem, in a tenth of the time of torch operations.
    """
    if options.method in ("auto", "diagonal"):
        return q.is_cpu and options.smoothing == 0 and pivoting_kernel() is not None
    return options.method == "pivoting"


@cache
def pivoting_kernel() -> ModuleType | None:
    """The numba kernel, imported on first use; None, with one warning, where numba is missing."""
    try:
        from lcplearn.lcp import pivoting
    except ImportError as error:
        warnings.warn(f"solving in torch (interior point, many times slower) on the CPU: {error}", stacklevel=2)
        return None
    return pivoting


def plain(x: Tensor) -> Tensor:
    """The same tensor if the kernel can read its memory as it is, contiguous and float64; else a copy."""
    if x.is_neg() or x.dtype is not torch.float64:
        x = x.resolve_neg().double()
    return x.contiguous()


def _solve_by_pivoting(M: Tensor, q: Tensor, initial_basis: Tensor | None, options: Options) -> LCPSolution:
    """Run the CPU kernel, which judges for itself with the same residual."""
    kernel = pivoting_kernel()
    if kernel is None:
        raise ValueError("method 'pivoting' needs numba; use 'interior_point' or 'auto'")
    if not q.is_cpu:
        raise ValueError(f"method 'pivoting' runs on the CPU; got M and q on {q.device}")
    single = q.dtype is torch.float32
    solution, unsolved = kernel.solve_batch(
        plain(M),
        plain(q),
        single_precision=single,
        max_iter=options.max_iter,
        tol=options.tol,
        initial_basis=initial_basis,
    )
    if unsolved and options.method == "auto":
        solution = _rescued(solution, M, q, options)
    return _rounded(solution) if single else solution


def _rescued(solution: LCPSolution, M: Tensor, q: Tensor, options: Options) -> LCPSolution:
    """The solution with its UNSOLVED elements solved by the interior point, where that can."""
    n = q.shape[-1]
    lost = torch.nonzero(solution.status.reshape(-1) == Status.UNSOLVED.value).squeeze(-1)
    M = M.expand(*q.shape, n).reshape(-1, n, n)[lost].double()
    hopeful = _may_be_monotone(M)
    M, lost = M[hopeful], lost[hopeful]
    if len(lost):
        found = _solve_in_torch(M, q.reshape(-1, n)[lost].double(), options)
        for whole, part in zip(solution, found, strict=True):
            whole.reshape(-1, *part.shape[1:])[lost[found.solved]] = part[found.solved]
    return solution


def _may_be_monotone(M: Tensor) -> Tensor:
    """Whether each pair of rows could be one of a copositive matrix or of a P-matrix.

    The interior point rarely solves another, and takes a thousand times as long as the kernel to find that out.
    """
    d = M.diagonal(dim1=-2, dim2=-1)
    product = d.unsqueeze(-1) * d.unsqueeze(-2)
    copositive = M + M.mT >= -2.0001 * product.clamp_min(0).sqrt()
    return ((d >= 0).unsqueeze(-1) & (copositive | (M * M.mT <= product))).all(-1).all(-1)


def _rounded(solution: LCPSolution) -> LCPSolution:
    """The solution in float32; what overflows there is not SOLVED."""
    limit = torch.finfo(torch.float32).max
    overflow = (solution.status == 0) & (torch.maximum(solution.z, solution.w) > limit).any(-1)
    return solution._replace(
        z=solution.z.clamp(-limit, limit).float(),
        w=solution.w.clamp(-limit, limit).float(),
        status=torch.where(overflow, Status.UNSOLVED.value, solution.status),
        residual=torch.where(overflow, torch.inf, solution.residual),
        certificate=solution.certificate.float(),
    )


def _solve_in_torch(M: Tensor, q: Tensor, options: Options) -> LCPSolution:
    """Flatten the batch, set aside what needs no solver, run the method, judge."""
    if q.device.type not in ("cpu", "cuda"):
        raise ValueError(f"M and q must be on the CPU or a CUDA device, which have float64; got {q.device}")
    method, tol, max_iter, smoothing = options
    shape, n = q.shape, q.shape[-1]
    count = math.prod(shape[:-1])
    M = M.detach().expand(*shape, n).reshape(count, n, n).double()
    q64 = q.detach().reshape(count, n).double()
    finite = M.isfinite().all(-1).all(-1) & q64.isfinite().all(-1)
    end = Iterate(
        z=torch.zeros_like(q64),
        w=q64.clone(),
        basis=torch.zeros_like(q64, dtype=torch.bool),
        iterations=torch.zeros(count, dtype=torch.int64, device=q.device),
        exhausted=torch.zeros(count, dtype=torch.bool, device=q.device),
    )
    # q >= 0 is solved by z = 0 whatever M is.
    todo = finite & ((q64 < 0).any(-1) | (smoothing > 0 and n > 0))
    if todo.any():
        if method == "diagonal":
            found = _diagonal(M[todo], q64[todo])
        else:
            found = interior_point(M[todo], q64[todo], max_iter=max_iter or DEFAULT_MAX_ITER, smoothing=smoothing)
        for whole, part in zip(end, found, strict=True):
            whole[todo] = part
    residual, tolerance = judge(M, q64, end.z, tol=tol, smoothing=smoothing)
    return _pack(q, end, finite, residual, residual <= tolerance)


def _diagonal(M: Tensor, q: Tensor) -> Iterate:
    """Closed form for diagonal M; the judge, which sees all of M, catches one that is not."""
    diagonal = M.diagonal(dim1=-2, dim2=-1)
    basis = (q < 0) & (diagonal > 0)
    z = torch.where(basis, -q / diagonal, 0.0)
    zero = torch.zeros_like(q[:, 0])
    return Iterate(z, q.clamp_min(0), basis, zero.long(), zero > 0)


def _pack(q: Tensor, end: Iterate, finite: Tensor, residual: Tensor, solved: Tensor) -> LCPSolution:
    """The solution in the shape and type of q, with the status of each element; none that overflows is SOLVED."""
    nan = torch.where(finite, 0.0, torch.nan).unsqueeze(-1)
    limit = torch.finfo(q.dtype).max
    z, w = ((x.clamp(-limit, limit) + nan).to(q.dtype) for x in (end.z, end.w))
    in_range = finite & (torch.maximum(end.z, end.w) <= limit).all(-1)
    status = torch.where(end.exhausted, Status.MAX_ITERATIONS.value, Status.UNSOLVED.value)
    status = torch.where(solved & in_range, Status.SOLVED.value, status)
    status = torch.where(finite, status, Status.NONFINITE_INPUT.value)
    batch = q.shape[:-1]
    return LCPSolution(
        z=z.reshape(q.shape),
        w=w.reshape(q.shape),
        basis=end.basis.reshape(q.shape),
        status=status.reshape(batch),
        residual=torch.where(in_range, residual.nan_to_num(torch.inf), torch.inf).reshape(batch),
        iterations=end.iterations.reshape(batch),
        certificate=torch.zeros_like(q),
    )
