"""Solve LCPs one after the other on the CPU by pivoting; a serial numba kernel.

    find z with 0 <= z, w = M z + q >= 0, z.w = 0

Each element runs down a cascade until its residual, recomputed from the original data, is within tolerance:

1. symmetric Ruiz equilibration, rounded to powers of two so that the scaled data are exact: S = E M E, p = E q / s;
2. block principal pivoting (Newton-min with Kostreva's single-pivot safeguard) from an initial basis, or from p < 0 for
   n > 40, and by pivots on the diagonal of a tableau for n < 6 and, where the diagonal is positive, n < 16; elsewhere,
   where Lemke's method is faster, only to improve on what that found;
3. Lemke's method with the lexicographic rule on the condensed tableau; where it fails, with rows and columns scaled
   apart, other pivot tolerances and another covering vector (the tolerance has the size of the data's precision: below
   it a pivot is rounding noise). Rows that symmetric scaling leaves without a large entry are scaled apart at once;
4. a phase-one simplex method, whose optimum proves infeasibility, judged on the original data;
5. a primal-dual interior point, for problems on which pivoting takes exponentially many steps;
6. one size of q after the other, for problems that hold sizes far apart.

Every stage ends with refinement from the data at its basis. The kernel (folder kernel) is serial, works on plain arrays
and releases the GIL.

Source: Cottle, Pang, Stone, "The Linear Complementarity Problem" (1992), chapter 4; Judice and Pires (1994) for
block pivoting; Mehrotra (1992) for the predictor-corrector steps; Ruiz (2001) for the scaling.
"""

from functools import cache

import numpy as np
import torch
from torch import Tensor

from lcplearn.lcp.kernel.adjoint import adjoint_range
from lcplearn.lcp.kernel.calling import address_of
from lcplearn.lcp.kernel.cascade import solve_range
from lcplearn.lcp.kernel.islands import FEWEST_ROWS, islands_memory, solve_islands
from lcplearn.lcp.kernel.jit import APART, announce
from lcplearn.lcp.kernel.memory import scratch_size
from lcplearn.lcp.solution import LCPSolution
from lcplearn.lcp.threads import in_slices, slice_size

ADJOINT_SHARE = 0.3  # of the time of a solve; to decide on threads


def solve_batch(
    M: Tensor,
    q: Tensor,
    *,
    single_precision: bool,
    max_iter: int | None,
    tol: float | None = None,
    initial_basis: Tensor | None = None,
) -> tuple[LCPSolution, int]:
    """Solve a batch of LCPs, and count the UNSOLVED; an element's result does not depend on its neighbours by a bit.

    Args:
        M: [*batch, n, n], or [n, n] shared by the batch; contiguous float64 on the CPU, never written to.
        q: [*batch, n]; likewise.
        single_precision: the data were rounded to float32, so pivots below 1e-6 are noise and the tolerance is 2e-6.
        max_iter: pivots and interior-point steps allowed to an element; None lets each stage choose.
        tol: largest residual that is SOLVED; None is 1e-10, or 2e-6 for single precision.
        initial_basis: bool [*batch, n], where block pivoting starts.

    Status:
        SOLVED, INFEASIBLE (with certificate), UNSOLVED, MAX_ITERATIONS, NONFINITE_INPUT (z and w are NaN).

    Cost: O(n^3) per principal block, O(n^2) per Lemke pivot; memory O(B n + n^2).
    """
    shape = tuple(q.shape)  # numpy takes longer to read a torch.Size
    batch, n = shape[:-1], shape[-1]
    new, empty = torch.from_numpy, np.empty  # as `_empty`, whose calls are a tenth of a small solve
    z, w, certificate, residual = new(empty(shape)), new(empty(shape)), new(empty(shape)), new(empty(batch))
    basis, status, iterations = new(empty(shape, np.bool_)), new(empty(batch, np.int64)), new(empty(batch, np.int64))
    if initial_basis is not None:
        basis.copy_(initial_basis)
    if tol is None:
        tol = 2e-6 if single_precision else 1e-10
    budget = -1 if max_iter is None else max_iter
    announce(solve_range, "compiling the LCP kernel, once on a machine: about half a minute")
    shared, warm, count = M.dim() == 2, initial_basis is not None, status.numel()

    def solve(start: int, stop: int) -> int:
        row = start * n
        problem = (
            stop - start, n, shared, address(M, 0 if shared else row * n), address(q, row), tol, single_precision,
            budget, warm,
        )  # fmt: skip
        scratch = np.empty(scratch_size.py_func(n))
        fields = (
            address(z, row), address(w, row), address(basis, row), address(residual, start), address(status, start),
            address(iterations, start), address(certificate, row),
        )  # fmt: skip
        left = solve_range(*problem, True, scratch, *fields)
        if left and n >= FEWEST_ROWS and bool((status.view(-1)[start:stop] == APART).any()):
            announce(solve_islands, "compiling a stage for problems of several parts, once on a machine: about 5 s")
            memory = np.empty(islands_memory(n))
            left = solve_islands(solver_address(), *problem, scratch, memory, *fields)
        return left

    size = slice_size(count, count * _seconds(n))
    if size < count:
        solve(0, 0)  # compiles or loads: else threads would wait for that, and seem late
    unsolved = sum(in_slices(solve, count, size))
    return LCPSolution(z, w, basis, status, residual, iterations, certificate), unsolved


@cache
def solver_address() -> int:
    """Where the code of `solve_range` is, for compiled code that calls it."""
    places = (0,) * 7
    return address_of(solve_range, 1, 2, False, 0, 0, 1e-10, False, -1, False, False, np.empty(1), *places)


def _seconds(n: int) -> float:
    """Roughly what a problem takes, to decide on threads."""
    return 5e-8 * n + 5e-9 * n**2 + 1e-10 * n**3


def solve_adjoint(
    M: Tensor,
    z: Tensor,
    basis: Tensor,
    status: Tensor,
    grad_z: Tensor | None,
    grad_w: Tensor | None,
    need_M: bool,
    single_precision: bool = False,
) -> tuple[Tensor | None, Tensor]:
    """Gradients of a scalar with respect to M and q from those with respect to z and w, at the basis A.

    z_A = -M_AA^-1 q_A and w_I = M_IA z_A + q_I, so with M_AA' y_A = -(grad_z_A + M_IA' grad_w_I) and y_I = grad_w_I

        grad_q = y,   grad_M = y z'

    Args:
        M: [*batch, n, n] or [n, n]; grad_M has its shape, and for a shared M it is the sum over the batch.
        z, grad_z, grad_w: [*batch, n], a gradient of None is zero; all contiguous float64 on the CPU.
        basis: bool [*batch, n]; status: int64 [*batch]. What is not SOLVED gets zero gradients.
        need_M: whether grad_M is wanted; else None is returned for it.
        single_precision: the data were rounded to float32, so that pivots below 1e-7 n are noise.

    Returns:
        grad_M (or None) and grad_q [*batch, n]. Where M_AA is singular (redundant contacts, and the solver ended on an
        interior point), y solves the consistent part of the equations: the gradient of unique quantities is exact.
    """
    n, shared, count = z.shape[-1], M.dim() == 2, status.numel()
    summed = need_M and shared
    grad_q, grad_M = _empty(z.shape), _empty(M.shape) if need_M and not shared else None

    def solve(start: int, stop: int) -> Tensor | None:
        row = start * n
        part = _empty(M.shape) if summed else None
        adjoint_range(
            stop - start, n, shared, address(M, 0 if shared else row * n), address(z, row), address(basis, row),
            address(status, start), address(grad_z, row), address(grad_w, row), np.empty(n * n + 7 * n),
            single_precision, address(part) if summed else address(grad_M, row * n), address(grad_q, row),
        )  # fmt: skip
        return part

    size = slice_size(count, ADJOINT_SHARE * count * _seconds(n))
    if summed:
        size = max(size, n)  # the sums of slices then take no more memory than q
    if size < count:
        solve(0, 0)  # as in `solve_batch`
    for part in in_slices(solve, count, size, summed=summed):
        grad_M = part if grad_M is None else grad_M if part is None else grad_M + part
    return grad_M, grad_q


def _empty(shape: tuple[int, ...], dtype: type = np.float64) -> Tensor:
    """An uninitialised tensor on the CPU, in half the time that torch.empty takes."""
    return torch.from_numpy(np.empty(tuple(shape), dtype))


def address(x: Tensor | None, start: int = 0) -> int:
    """Where the numbers of a contiguous tensor are, from one of them on, for the kernel; 0 for None.

    The caller holds the tensor until the kernel returns.

    Raises:
        RuntimeError: The tensor has no memory.
    """
    if x is None:
        return 0
    result = x.data_ptr()
    if result == 0 and x.numel():
        raise RuntimeError("a tensor without memory (fake, traced or torch's implicit zero) reached the LCP kernel")
    return result + start * x.element_size() if start else result
