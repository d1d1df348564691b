"""`solve_lcp`: check the arguments, solve, differentiably."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lcplearn.lcp.compiled import traced_solve
from lcplearn.lcp.gradient import differentiable_solve
from lcplearn.lcp.methods import TORCH_METHODS, Options
from lcplearn.lcp.residuals import default_tolerance
from lcplearn.lcp.solution import LCPSolution
from lcplearn.lcp.torch_internals import traced

DTYPES = frozenset((torch.float32, torch.float64))


def solve_lcp(
    M: Float[Tensor, "*#batch n n"],
    q: Float[Tensor, "*#batch n"],
    *,
    method: str = "auto",
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
        M: float32 or float64 matrices. The arithmetic is float64 throughout; results come back in the caller's dtype.
        q: Vectors of the dtype and device of M; batch dimensions broadcast, n may be 0.
        method: "diagonal" is the closed form z = max(0, -q / diag M) for M that the caller knows to be diagonal (one
            that is not is solved by pivoting on the CPU, and never wrongly SOLVED elsewhere);
            "pivoting" is the CPU kernel (the first call ever compiles it: half a minute); "interior_point" runs on
            any device; "auto" is pivoting on the CPU, and on a CUDA device the path of the interior point, whose few
            leftovers are solved on the CPU. For smoothing it is interior_point.
        tol: Largest residual (see `residuals.py`) that counts as solved; by default 1e-10 for float64 and 2e-6 for
            float32 data. Rounding raises it where M z cancels against q.
        max_iter: Limit on iterations; by default the method's own.
        smoothing: tau >= 0. Above 0 the solution is the point of the central path with z_i w_i = tau: value and
            gradient are both smooth in (M, q), and both biased.
        initial_basis: Where pivoting starts, for example the basis of the step before in a rollout. Off by default,
            since it chooses among the solutions of a problem that has several. Unused where "auto" does not pivot.
        throw: Raise `LCPError` naming the elements that are not SOLVED.

    Returns:
        `LCPSolution`; an element never depends on its neighbours in the batch.

    Status:
        SOLVED only where the recomputed residual says so; INFEASIBLE only with its certificate (from pivoting).

    Gradient:
        Implicit, with respect to M and q through z and w; the derivation is in `gradient.py`. At a kink
        (z_i = w_i = 0, see `LCPSolution.degenerate`) it is the derivative of the piece the solver ended on: one-sided
        where one member is degenerate; where several are, their piece may be valid in no direction.
        Zero for an element that is not SOLVED. An M or q shared by the batch gets the sum over the batch.
        Forward mode, higher derivatives and torch.func work in eager code. torch.compile sees a solve as one operator
        with a first derivative in reverse mode; asking it for more raises.

    Raises:
        ValueError: An argument is wrong; the message names it.

    Example:
        >>> M = torch.tensor([[2.0, 1.0], [1.0, 2.0]], dtype=torch.float64)
        >>> q = torch.tensor([[-1.0, 1.0], [1.0, 1.0]], dtype=torch.float64, requires_grad=True)
        >>> solution = solve_lcp(M, q)
        >>> solution.z.tolist()
        [[0.5, 0.0], [0.0, 0.0]]
        >>> if not solution.solved.all():  # an element that is not SOLVED has a zero gradient
        ...     solution.raise_if_unsolved()
        >>> solution.z.sum().backward()
        >>> q.grad.tolist()
        [[-0.5, 0.0], [0.0, 0.0]]

    Source: Cottle, Pang, Stone, "The Linear Complementarity Problem" (1992); NOTES 1 and 3.
    """
    if not (method == "auto" and tol is None and max_iter is None and smoothing == 0):
        check_options(method, tol, max_iter, smoothing)
    _check_tensors(M, q)
    if M.dim() > 2 and M.shape[:-1] != q.shape:
        M, q = _broadcast(M, q)
    if initial_basis is not None:
        if method not in ("auto", "pivoting"):
            raise ValueError(f"method: expected auto or pivoting for initial_basis; got {method!r}")
        initial_basis = _expand_basis(initial_basis, q)
    tol = default_tolerance(q.dtype) if tol is None else float(tol)
    options = Options(method, tol, max_iter, float(smoothing))
    run = traced_solve if traced() else differentiable_solve
    solution = run(M, q, initial_basis, options)
    if throw:
        solution.raise_if_unsolved()
    return solution


def method_names() -> tuple[str, ...]:
    """What `solve_lcp` takes for its method; a name that joins TORCH_METHODS is among them."""
    return ("auto", "pivoting", *TORCH_METHODS)


def check_options(method: str, tol: float | None, max_iter: int | None, smoothing: float) -> None:
    """Raise ValueError for options that no problem could use."""
    if method not in method_names():
        raise ValueError(f"method: expected one of {', '.join(method_names())}; got {method!r}")
    if tol is not None and not (_is_number(tol) and 0 < tol < math.inf):
        raise ValueError(f"tol: expected a positive finite number, or None; got {tol!r}")
    if max_iter is not None and not (type(max_iter) is int and 0 < max_iter < 2**63):
        raise ValueError(f"max_iter: expected a positive integer, or None; got {max_iter!r}")
    if not (_is_number(smoothing) and 0 <= smoothing < math.inf):
        raise ValueError(f"smoothing: expected a finite number of at least 0; got {smoothing!r}")
    smoothing_methods = ["auto", *(name for name, entry in TORCH_METHODS.items() if entry.smooths)]
    if smoothing > 0 and method not in smoothing_methods:
        raise ValueError(f"method: expected one of {', '.join(smoothing_methods)} for smoothing; got {method!r}")


def _is_number(x: object) -> bool:
    """Whether x is an int or a float, and not, say, a tensor, whose gradient would be dropped silently."""
    return isinstance(x, (int, float)) and not isinstance(x, bool)


def _check_tensors(M: Tensor, q: Tensor) -> None:
    """Raise ValueError for tensors that are no LCPs, whatever their batch dimensions."""
    for name, x in (("M", M), ("q", q)):
        if not isinstance(x, Tensor):
            raise ValueError(f"{name}: expected a torch.Tensor; got {type(x).__name__}")
        if x.layout is not torch.strided:
            raise ValueError(f"{name}: expected a dense tensor; got {x.layout}")
        if x.dtype not in DTYPES:
            raise ValueError(f"{name}: expected float32 or float64; got {x.dtype}")
    if M.dtype is not q.dtype or M.device != q.device:
        raise ValueError(f"M, q: expected one dtype and device; got {M.dtype} on {M.device}, {q.dtype} on {q.device}")
    M_shape, q_shape = M.shape, q.shape
    if len(M_shape) < 2 or M_shape[-1] != M_shape[-2]:
        raise ValueError(f"M: expected shape [*batch, n, n]; got {list(M_shape)}")
    if len(q_shape) < 1 or q_shape[-1] != M_shape[-1]:
        raise ValueError(f"q: expected shape [*batch, {M_shape[-1]}] to match M {list(M_shape)}; got {list(q_shape)}")


def _broadcast(M: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
    """M [*batch, n, n], or [n, n] where it is shared by the whole batch, and q [*batch, n]."""
    n = q.shape[-1]
    try:
        batch = torch.broadcast_shapes(M.shape[:-2], q.shape[:-1])
    except RuntimeError:
        raise ValueError(
            f"M, q: expected batch dimensions that broadcast; got {list(M.shape)} and {list(q.shape)}"
        ) from None
    shared = M.shape[:-2].numel() == 1
    return M.reshape(n, n) if shared else M.expand(*batch, n, n), q.expand(*batch, n)


def _expand_basis(basis: Tensor, q: Tensor) -> Tensor:
    """The initial basis of each element; ValueError if it is not a bool for each unknown."""
    if not isinstance(basis, Tensor):
        found = type(basis).__name__
    elif basis.dtype != torch.bool or basis.device != q.device or not _expands(basis.shape, q.shape):
        found = f"{basis.dtype} {list(basis.shape)} on {basis.device}"
    else:
        return basis.expand(q.shape)
    raise ValueError(f"initial_basis: expected a bool tensor of shape {list(q.shape)} on {q.device}; got {found}")


def _expands(shape: torch.Size, target: torch.Size) -> bool:
    try:
        return torch.broadcast_shapes(shape, target) == target and shape[-1:] == target[-1:]
    except RuntimeError:
        return False
