"""`solve_lcp`: check the arguments, choose a method, solve, judge."""

import math
import warnings
from functools import cache, partial
from types import ModuleType
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lcplearn.lcp.gradient import DifferentiableSolve
from lcplearn.lcp.interior_point import DEFAULT_MAX_ITER, Iterate, interior_point
from lcplearn.lcp.residuals import default_tolerance, judge
from lcplearn.lcp.solution import LCPSolution, Status

Method = Literal["auto", "diagonal", "pivoting", "interior_point"]


def solve_lcp(
    M: Float[Tensor, "*#batch n n"],
    q: Float[Tensor, "*#batch n"],
    *,
    method: Method = "auto",
    tol: float | None = None,
    max_iter: int | None = None,
    smoothing: float = 0.0,
    initial_basis: Bool[Tensor, "*#batch n"] | None = None,
    throw: bool = False,
) -> LCPSolution:
    """Solve a batch of linear complementarity problems, differentiably in M and q.

    Find z with  0 <= z,  w = M z + q >= 0,  z.w = 0.  M need not be symmetric; if it is positive semidefinite or a
    P-matrix, a solution that exists is found. Any other M gets a true status.

    Args:
        M, q: float32 or float64, of one dtype and device; batch dimensions broadcast, n may be 0. The arithmetic is
            float64 throughout; results come back in the caller's dtype.
        method: "diagonal" is the closed form z = max(0, -q / diag M) for M that the caller knows to be diagonal;
            "pivoting" is the CPU kernel (first call ever: 10-20 s of compilation); "interior_point" runs on any
            device; "auto" is pivoting on the CPU and interior_point elsewhere and for smoothing.
        tol: Largest residual (see `residuals.py`) that counts as solved; by default 1e-10 for float64 and 2e-6 for
            float32 data. Rounding raises it where M z cancels against q.
        max_iter: Limit on iterations; by default the method's own.
        smoothing: tau >= 0. Above 0 the solution is the point of the central path with z_i w_i = tau: value and
            gradient are both smooth in (M, q), and both biased.
        initial_basis: Where pivoting starts, for example the basis of the step before in a rollout. Off by default,
            since it chooses among the solutions of a problem that has several.
        throw: Raise `LCPError` naming the elements that are not SOLVED.

    Returns:
        `LCPSolution`; an element never depends on its neighbours in the batch.

    Status:
        SOLVED only where the recomputed residual says so; INFEASIBLE only with its certificate (from pivoting).

    Gradient:
        Implicit, with respect to M and q through z and w; the derivation is in `gradient.py`. At a kink
        (z_i = w_i = 0, see `LCPSolution.degenerate`) it is the one-sided derivative of the piece the solver ended on.
        Zero for an element that is not SOLVED. An M or q shared by the batch gets the sum over the batch.

    Raises:
        ValueError: An argument is wrong; the message names it.

    Source: Cottle, Pang, Stone, "The Linear Complementarity Problem" (1992); lcp notes, sections 1 to 2.
    """
    check_options(method, tol, max_iter, smoothing)
    batch = _check_tensors(M, q, initial_basis)
    if initial_basis is not None and method not in ("auto", "pivoting"):
        raise ValueError(f"initial_basis needs method 'pivoting' or 'auto'; got method {method!r}")
    n = q.shape[-1]
    if M.dim() > 2:
        M = M.expand(*batch, n, n)
    q = q.expand(*batch, n)
    if initial_basis is not None:
        initial_basis = initial_basis.expand(*batch, n)
    if method == "auto":
        method = "pivoting" if smoothing == 0 and q.device.type == "cpu" and pivoting_kernel() else "interior_point"
    run = _solve_by_pivoting if method == "pivoting" else partial(_solve_in_torch, method=method, smoothing=smoothing)
    solve = partial(run, tol=tol or default_tolerance(q.dtype), max_iter=max_iter)
    solution = LCPSolution(*DifferentiableSolve.apply(M, q, initial_basis, solve, smoothing > 0))
    if throw:
        solution.raise_if_unsolved()
    return solution


def check_options(method: str, tol: float | None, max_iter: int | None, smoothing: float) -> None:
    """Raise ValueError for options that no problem could use."""
    if method not in get_args(Method):
        raise ValueError(f"method must be one of {', '.join(get_args(Method))}; got {method!r}")
    if tol is not None and not 0 < tol < math.inf:
        raise ValueError(f"tol must be positive and finite, or None; got {tol!r}")
    if max_iter is not None and (not isinstance(max_iter, int) or max_iter < 1):
        raise ValueError(f"max_iter must be a positive integer, or None; got {max_iter!r}")
    if not 0 <= smoothing < math.inf:
        raise ValueError(f"smoothing must be finite and at least 0; got {smoothing!r}")
    if smoothing > 0 and method not in ("auto", "interior_point"):
        raise ValueError(f"smoothing needs method 'interior_point' or 'auto'; got method {method!r}")


def _check_tensors(M: Tensor, q: Tensor, initial_basis: Tensor | None) -> torch.Size:
    """Raise ValueError for tensors that are no batch of LCPs; return the common batch shape."""
    for name, x in (("M", M), ("q", q)):
        if not isinstance(x, Tensor):
            raise ValueError(f"{name} must be a torch.Tensor; got {type(x).__name__}")
        if x.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"{name} must be float32 or float64; got {x.dtype}")
    if M.dtype != q.dtype or M.device != q.device:
        raise ValueError(f"M and q must share dtype and device; got {M.dtype} on {M.device}, {q.dtype} on {q.device}")
    if M.dim() < 2 or M.shape[-1] != M.shape[-2]:
        raise ValueError(f"M must have shape [*batch, n, n]; got {list(M.shape)}")
    if q.dim() < 1 or q.shape[-1] != M.shape[-1]:
        raise ValueError(f"q must have shape [*batch, {M.shape[-1]}] to match M {list(M.shape)}; got {list(q.shape)}")
    try:
        batch = torch.broadcast_shapes(M.shape[:-2], q.shape[:-1])
    except RuntimeError:
        raise ValueError(
            f"batch dimensions of M {list(M.shape)} and q {list(q.shape)} must broadcast; they do not"
        ) from None
    if initial_basis is not None and (
        initial_basis.dtype != torch.bool or initial_basis.shape not in (q.shape, (*batch, q.shape[-1]))
    ):
        expected = [*batch, q.shape[-1]]
        raise ValueError(
            f"initial_basis must be bool of shape {expected}; got {initial_basis.dtype} {list(initial_basis.shape)}"
        )
    return batch


@cache
def pivoting_kernel() -> ModuleType | None:
    """The numba kernel, imported on first use; None, with one warning, where numba is missing."""
    try:
        from lcplearn.lcp import pivoting
    except ImportError as error:
        warnings.warn(f"solving by interior point, many times slower on the CPU: {error}", stacklevel=4)
        return None
    return pivoting


def _solve_by_pivoting(
    M: Tensor, q: Tensor, initial_basis: Tensor | None, *, tol: float, max_iter: int | None
) -> LCPSolution:
    """Run the CPU kernel, which judges for itself with the same residual. A shared M is not copied."""
    kernel = pivoting_kernel()
    if kernel is None:
        raise ValueError("method 'pivoting' needs numba; use 'interior_point' or 'auto'")
    dtype, shape, n = q.dtype, q.shape, q.shape[-1]
    result = kernel.solve_batch(
        M.detach().reshape(-1 if n else math.prod(M.shape[:-2]), n, n).double().contiguous().numpy(),
        q.detach().reshape(math.prod(shape[:-1]), n).double().contiguous().numpy(),
        single_precision=dtype == torch.float32,
        max_iter=max_iter,
        tol=tol,
        initial_basis=None if initial_basis is None else initial_basis.reshape(-1, n).numpy(),
    )
    z, w, basis, residual, status, iterations, certificate = map(torch.from_numpy, result)
    batch = shape[:-1]
    return LCPSolution(
        z=z.to(dtype).reshape(shape),
        w=w.to(dtype).reshape(shape),
        basis=basis.reshape(shape),
        status=status.reshape(batch),
        residual=residual.reshape(batch),
        iterations=iterations.reshape(batch),
        certificate=certificate.to(dtype).reshape(shape),
    )


def _solve_in_torch(
    M: Tensor,
    q: Tensor,
    initial_basis: Tensor | None,
    *,
    method: str,
    smoothing: float,
    tol: float,
    max_iter: int | None,
) -> LCPSolution:
    """Solve without derivatives: flatten the batch, set aside what needs no solver, run the method, judge."""
    del initial_basis
    dtype, shape, n = q.dtype, q.shape, q.shape[-1]
    count = math.prod(shape[:-1])
    M = M.detach().expand(*shape, n).reshape(count, n, n).double()
    q = q.detach().reshape(count, n).double()
    finite = M.isfinite().all(-1).all(-1) & q.isfinite().all(-1)
    end = Iterate(
        z=torch.zeros_like(q),
        w=q.clone(),
        basis=torch.zeros_like(q, dtype=torch.bool),
        iterations=torch.zeros(count, dtype=torch.int64, device=q.device),
        exhausted=torch.zeros(count, dtype=torch.bool, device=q.device),
    )
    # q >= 0 is solved by z = 0 whatever M is.
    todo = finite & ((q < 0).any(-1) | (smoothing > 0))
    if todo.any():
        if method == "diagonal":
            found = _solve_diagonal(M[todo], q[todo])
        else:
            found = interior_point(M[todo], q[todo], max_iter=max_iter or DEFAULT_MAX_ITER, smoothing=smoothing)
        for whole, part in zip(end, found, strict=True):
            whole[todo] = part
    residual, tolerance = judge(M, q, end.z, tol=tol, smoothing=smoothing)
    failed = torch.where(end.exhausted, Status.MAX_ITERATIONS.value, Status.UNSOLVED.value)
    status = torch.where(residual <= tolerance, Status.SOLVED.value, failed)
    status = torch.where(finite, status, Status.NONFINITE_INPUT.value)
    residual = torch.where(finite, residual, torch.inf)
    nan = torch.where(finite, 0.0, torch.nan).unsqueeze(-1)
    return LCPSolution(
        z=(end.z + nan).to(dtype).reshape(shape),
        w=(end.w + nan).to(dtype).reshape(shape),
        basis=end.basis.reshape(shape),
        status=status.reshape(shape[:-1]),
        residual=residual.reshape(shape[:-1]),
        iterations=end.iterations.reshape(shape[:-1]),
        certificate=torch.zeros(shape, dtype=dtype, device=q.device),
    )


def _solve_diagonal(M: Tensor, q: Tensor) -> Iterate:
    """Closed form for diagonal M; the judge, which sees all of M, catches one that is not."""
    diagonal = M.diagonal(dim1=-2, dim2=-1)
    basis = (q < 0) & (diagonal > 0)
    z = torch.where(basis, -q / diagonal, 0.0)
    zero = torch.zeros_like(q[:, 0])
    return Iterate(z, q.clamp_min(0), basis, zero.long(), zero > 0)
