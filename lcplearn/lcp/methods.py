"""The methods behind one signature, without derivatives: choose, solve, judge."""

import math
import warnings
from collections.abc import Callable
from functools import cache
from types import ModuleType
from typing import NamedTuple

import torch
from torch import Tensor

from lcplearn.lcp.interior_point import DEFAULT_MAX_ITER, Iterate, follow_path, interior_point
from lcplearn.lcp.residuals import judge
from lcplearn.lcp.solution import LCPSolution, Status


class TorchMethod(NamedTuple):
    """A method that runs on any device.

    Attributes:
        solve: Takes float64 M [b, n, n], q [b, n], all finite, n > 0, and the keywords max_iter and smoothing.
        general: Whether it solves every solvable problem with a positive semidefinite or P-matrix.
        smooths: Whether it knows the smoothed problem.
    """

    solve: Callable[..., Iterate]
    general: bool = True
    smooths: bool = False


def diagonal(M: Tensor, q: Tensor, *, max_iter: int, smoothing: float) -> Iterate:
    """Closed form for diagonal M; the judge, which sees all of M, catches one that is not."""
    M = M.diagonal(dim1=-2, dim2=-1)
    basis = (q < 0) & (M > 0)
    zero = torch.zeros(len(q), dtype=torch.int64, device=q.device)
    return Iterate(torch.where(basis, -q / M, 0.0), q.clamp_min(0), basis, zero, zero > 0)


TORCH_METHODS = {
    "interior_point": TorchMethod(interior_point, smooths=True),
    "diagonal": TorchMethod(diagonal, general=False),
}


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
    if options.method != "auto":
        return _solve_in_torch(TORCH_METHODS[options.method], M, q, options)
    if q.is_cpu or options.smoothing:
        return _solve_in_torch(TORCH_METHODS["interior_point"], M, q, options)
    return solve_without_waiting(M, q, options)


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
        raise ValueError("method: expected 'auto' or 'interior_point', for numba is missing; got 'pivoting'")
    if not q.is_cpu:
        raise ValueError(f"M, q: expected the CPU, where method 'pivoting' runs; got {q.device}")
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
        found = _solve_in_torch(TORCH_METHODS["interior_point"], M, q.reshape(-1, n)[lost].double(), options)
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


def solve_without_waiting(M: Tensor, q: Tensor, options: Options) -> LCPSolution:
    """Follow the path on an accelerator, ask it once who is not SOLVED, and solve those few on the CPU."""
    solution = _solve_in_torch(TorchMethod(follow_path), M, q, options)
    n = q.shape[-1]
    status = solution.status.flatten()
    left = torch.nonzero((status != Status.SOLVED) & (status != Status.NONFINITE_INPUT)).squeeze(-1)
    if not len(left):
        return solution
    M = M if M.dim() == 2 else M.reshape(-1, n, n)[left]
    rest = solve(M.detach().cpu(), q.detach().reshape(-1, n)[left].cpu(), None, options)
    return LCPSolution(
        *(
            whole.reshape(-1, *part.shape[1:]).index_copy(0, left, part.to(whole.device)).reshape(whole.shape)
            for whole, part in zip(solution, rest, strict=True)
        )
    )


def _solve_in_torch(method: TorchMethod, M: Tensor, q: Tensor, options: Options) -> LCPSolution:
    """Flatten the batch, run the method, judge; what needs no solver is masked, so that nothing waits for values."""
    if q.device.type not in ("cpu", "cuda"):
        raise ValueError(f"M, q: expected the CPU or a CUDA device, which have float64; got {q.device}")
    _, tol, max_iter, smoothing = options
    shape, n = q.shape, q.shape[-1]
    count = math.prod(shape[:-1])
    M = M.detach().expand(*shape, n).reshape(count, n, n).double()
    q64 = q.detach().reshape(count, n).double()
    finite = M.isfinite().all(-1).all(-1) & q64.isfinite().all(-1)
    easy = ~finite if smoothing else ~finite | (q64 >= 0).all(-1)  # z = 0 whatever M is
    row = easy.unsqueeze(-1)
    solver = method.solve if n else diagonal
    z, w, basis, iterations, exhausted = solver(
        torch.where(row.unsqueeze(-1), torch.eye(n, dtype=M.dtype, device=M.device), M),
        torch.where(row, 1.0, q64),
        max_iter=max_iter or DEFAULT_MAX_ITER,
        smoothing=smoothing,
    )
    end = Iterate(
        z=torch.where(row, 0.0, z),
        w=torch.where(row, q64, w),
        basis=basis & ~row,
        iterations=torch.where(easy, 0, iterations),
        exhausted=exhausted & ~easy,
    )
    residual, tolerance = judge(M, q64, end.z, tol=tol, smoothing=smoothing)
    return _pack(q, end, finite, residual, residual <= tolerance)


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
