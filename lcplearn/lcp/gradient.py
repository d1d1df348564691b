"""The implicit derivative of an LCP's solution, for any number of derivatives, forward and reverse.

Derivation. Near a solution whose basis A stays the same, w_A = 0 and z_I = 0 (I: all other members), so that

    M_AA z_A + q_A = 0,        w_I = M_IA z_A + q_I.

Differentiating with e = dq + dM z:  dz_A = -M_AA^-1 e_A,  dz_I = 0,  dw_I = e_I + M_IA dz_A,  dw_A = 0.
For a loss with gradients g_z, g_w this gives dL = h.e, hence grad_q = h and grad_M = h z', where

    h_I = g_w,I        M_AA' h_A = -(g_z + M' h_I)_A

with the *transposed* block: M is not symmetric in friction problems. On the smoothed path z_i w_i = tau every index
counts as basic and z_i dw_i + w_i dz_i = 0 adds w_i / z_i to the diagonal:  (M + W/Z)' h = -(g_z - (w/z) g_w).

At a kink (z_i = w_i = 0) this is the derivative of the piece the solver ended on, one-sided: valid in every direction
that keeps the basis complementary. Where M_AA is singular (redundant contacts, or an interior point at stick) h is the
least-squares solution of smallest norm in equilibrated coordinates: exact for losses of what is unique, such as
velocities, and a bounded choice for what is not, such as the split of redundant forces.
"""

from typing import Any

import torch
from torch import Tensor

from lcplearn.lcp.methods import Options, pivoting_kernel, pivots, plain, solve
from lcplearn.lcp.residuals import EPS, multiply, two_sided_scales
from lcplearn.lcp.solution import LCPSolution, Status
from lcplearn.lcp.torch_internals import forward_mode, mapped_by_autograd, traced, transformed

# By precision of the data: pivots below the first (times n) call a block singular; of one that is, what is below the
# second is dropped (here singular values, in the kernel pivots of its complete pivoting). Rank-deficient contact
# matrices rounded to float32 are full rank at 1e-7 only by rounding.
RANK_TOLERANCES = {torch.float64: (EPS, 1e-11), torch.float32: (1e-7, 1e-5)}


def differentiable_solve(M: Tensor, q: Tensor, initial_basis: Tensor | None, options: Options) -> LCPSolution:
    """Solve, and give z and w of the solution their implicit derivative.

    M is [*batch, n, n], or [n, n] shared by the batch of q [*batch, n]; its gradient is then the sum over the batch.
    """
    if transformed():
        return LCPSolution(*_TransformableSolve.apply(M, q, initial_basis, options))
    if not ((torch.is_grad_enabled() and (M.requires_grad or q.requires_grad)) or forward_mode()):
        return solve(M, q, initial_basis, options)  # an autograd.Function takes longer than a small solve
    z, w, solution = _EagerSolve.apply(M, q, initial_basis, options)
    return LCPSolution(z, w, *solution[2:])


class _EagerSolve(torch.autograd.Function):
    """Derivatives outside torch.func. Without `setup_context`, whose dispatch takes longer than a small solve."""

    @staticmethod
    def forward(ctx: Any, M: Tensor, q: Tensor, initial_basis: Tensor | None, options: Options) -> Any:
        solution = solve(M, q, initial_basis, options)
        _save(ctx, M, solution, options)
        return solution.z, solution.w, solution

    @staticmethod
    def backward(ctx: Any, grad_z: Tensor | None, grad_w: Tensor | None, _: Any) -> Any:
        if grad_z is None and grad_w is None:
            return None, None, None, None
        need_M, need_q, *_ = ctx.needs_input_grad
        grad_M, grad_q = adjoint(ctx.saved_tensors, grad_z, grad_w, need_M, ctx.smoothing, ctx.in_kernel)
        return grad_M, grad_q if need_q else None, None, None

    @staticmethod
    def jvp(ctx: Any, dM: Tensor | None, dq: Tensor | None, *_: Any) -> Any:
        return *tangent(ctx.saved_tensors, dM, dq, ctx.smoothing), None


class _TransformableSolve(torch.autograd.Function):
    """The same for torch.func: grad, jacrev, vmap, jvp and their compositions."""

    @staticmethod
    def forward(M: Tensor, q: Tensor, initial_basis: Tensor | None, options: Options) -> Any:
        return tuple(solve(M, q, initial_basis, options))

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        M, _, _, options = inputs
        ctx.mark_non_differentiable(*output[2:])
        _save(ctx, M, LCPSolution(*output), options)

    @staticmethod
    def backward(ctx: Any, grad_z: Tensor | None, grad_w: Tensor | None, *_: Any) -> Any:
        return _EagerSolve.backward(ctx, grad_z, grad_w, None)

    @staticmethod
    def jvp(ctx: Any, dM: Tensor | None, dq: Tensor | None, *_: Any) -> Any:
        return *tangent(ctx.saved_tensors, dM, dq, ctx.smoothing), *(None,) * (len(LCPSolution._fields) - 2)

    @staticmethod
    def vmap(info: Any, in_dims: Any, *inputs: Any) -> Any:
        batched = batch_inputs(info.batch_size, in_dims[:3], *inputs[:3])
        return _TransformableSolve.apply(*batched, inputs[3]), (0,) * len(LCPSolution._fields)


def _save(ctx: Any, M: Tensor, solution: LCPSolution, options: Options) -> None:
    z, w, basis, status, *_ = solution
    saved = M, z, w, basis, status
    ctx.smoothing, ctx.in_kernel = options.smoothing, pivots(z, options)
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*saved)
    if forward_mode():
        ctx.save_for_forward(*saved)


def batch_inputs(
    size: int, in_dims: tuple[int | None, ...], M: Tensor, q: Tensor, initial_basis: Tensor | None
) -> tuple[Tensor, Tensor, Tensor | None]:
    """The inputs of a solve mapped over `in_dims`, as one larger batch; a matrix that nothing maps stays shared."""
    if in_dims[0] is not None or M.dim() > 2:
        M = _batch_first(M, in_dims[0], size)
    q = _batch_first(q, in_dims[1], size)
    if M.dim() == 3 and q.dim() > 2:  # one shared matrix for each element that vmap sees
        M = M.reshape(size, *(1,) * (q.dim() - 2), *M.shape[1:]).expand(*q.shape, q.shape[-1])
    if initial_basis is not None:
        initial_basis = _batch_first(initial_basis, in_dims[2], size)
    return M, q, initial_basis


def adjoint(
    saved: tuple[Tensor, ...],
    grad_z: Tensor | None,
    grad_w: Tensor | None,
    need_M: bool,
    smoothing: float,
    in_kernel: bool,
) -> tuple[Tensor | None, Tensor]:
    """Gradients with respect to M (or None) and q from those with respect to z and w (None is zero).

    `saved` holds M, z, w, basis and status; `in_kernel` asks for the kernel's adjoint wherever it can be used.
    """
    M, z, w, basis, status = saved
    basis, status = basis.bool(), status.long()  # hooks on saved tensors may give back others
    if in_kernel and not _differentiated(grad_z, grad_w):
        return _adjoint_in_kernel(M, z, basis, status, grad_z, grad_w, need_M)
    grad_z = torch.zeros_like(z) if grad_z is None else grad_z
    grad_w = torch.zeros_like(w) if grad_w is None else grad_w
    dtype = z.dtype
    M, z, w, grad_z, grad_w = (x.double() for x in (M, z, w, grad_z, grad_w))
    solved = (status == Status.SOLVED).unsqueeze(-1)
    g_z, g_w, z = (torch.where(solved, x, 0.0) for x in (grad_z, grad_w, z))
    if smoothing:
        basis, damping = _damping(z, w, basis & solved)
    h_I = torch.where(basis, 0.0, g_w)
    rhs = -g_z - multiply(M.mT, h_I)
    K = M.mT
    if smoothing:
        K, rhs = K + torch.diag_embed(damping), rhs + damping * g_w
    grad_q = torch.where(basis, _solve_on_basis(K, basis & solved, rhs, dtype), h_I)
    grad_M = (grad_q.unsqueeze(-1) * z.unsqueeze(-2)).sum_to_size(M.shape).to(dtype) if need_M else None
    return grad_M, grad_q.to(dtype)


def _differentiated(grad_z: Tensor | None, grad_w: Tensor | None) -> bool:
    """Whether somebody differentiates, maps or traces the backward: then it has to be made of torch's operations."""
    if torch.is_grad_enabled() or forward_mode() or traced() or transformed():
        return True
    return any(x is not None and mapped_by_autograd(x) for x in (grad_z, grad_w))


def _adjoint_in_kernel(
    M: Tensor,
    z: Tensor,
    basis: Tensor,
    status: Tensor,
    grad_z: Tensor | None,
    grad_w: Tensor | None,
    need_M: bool,
) -> tuple[Tensor | None, Tensor]:
    kernel: Any = pivoting_kernel()
    single = z.dtype is torch.float32
    grad_M, grad_q = kernel.solve_adjoint(
        plain(M),
        plain(z),
        basis.contiguous(),
        status.contiguous(),
        None if grad_z is None else plain(grad_z),
        None if grad_w is None else plain(grad_w),
        need_M,
        single_precision=single,
    )
    if not single:
        return grad_M, grad_q
    return None if grad_M is None else grad_M.float(), grad_q.float()


def tangent(saved: tuple[Tensor, ...], dM: Tensor | None, dq: Tensor | None, smoothing: float) -> tuple[Tensor, Tensor]:
    """Directional derivatives of z and w along dM and dq (None is zero)."""
    M, z, w, basis, status = saved
    dtype = z.dtype
    M, z, w = M.double(), z.double(), w.double()
    solved = (status == Status.SOLVED).unsqueeze(-1)
    z = torch.where(solved, z, 0.0)
    e = torch.zeros_like(z) if dq is None else torch.where(solved, dq.double(), 0.0)
    if dM is not None:
        e = e + torch.where(solved, multiply(dM.double(), z), 0.0)
    K = M
    if smoothing:
        basis, damping = _damping(z, w, basis & solved)
        K = M + torch.diag_embed(damping)
    dz = _solve_on_basis(K, basis & solved, -e, dtype)
    dw = e + multiply(M, dz)
    if not smoothing:
        dw = torch.where(basis, 0.0, dw)
    return dz.to(dtype), torch.where(solved, dw, 0.0).to(dtype)


def _damping(z: Tensor, w: Tensor, basis: Tensor) -> tuple[Tensor, Tensor]:
    """The diagonal w / z that smoothing adds, and where it is finite: a member with z = 0 is nonbasic in the limit."""
    quotient = torch.where(basis, w, 0.0) / torch.where(basis, z, 1.0)
    basis = basis & quotient.isfinite()
    return basis, torch.where(basis, w, 0.0) / torch.where(basis, z, 1.0)


def _solve_on_basis(K: Tensor, basis: Tensor, rhs: Tensor, dtype: torch.dtype) -> Tensor:
    """x with K_AA x_A = rhs_A and x = 0 off the basis A; smallest least-squares solution where K_AA is singular."""
    return _BasisSolve.apply(K, basis, rhs, RANK_TOLERANCES[dtype])


class _BasisSolve(torch.autograd.Function):
    """Its derivative is the same solve: dx = K_AA^-1 (drhs - dK x), so that second derivatives come for free."""

    @staticmethod
    def forward(K: Tensor, basis: Tensor, rhs: Tensor, rank_tolerances: tuple[float, float]) -> Tensor:
        return _solve_block(K, basis, rhs, *rank_tolerances)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        K, basis, _, ctx.rank_tolerances = inputs
        ctx.save_for_backward(K, basis, output)
        ctx.save_for_forward(K, basis, output)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:
        K, basis, x = ctx.saved_tensors
        y = _BasisSolve.apply(K.mT, basis, grad, ctx.rank_tolerances)
        grad_K = (-y.unsqueeze(-1) * x.unsqueeze(-2)).sum_to_size(K.shape) if ctx.needs_input_grad[0] else None
        return grad_K, None, y, None

    @staticmethod
    def jvp(ctx: Any, dK: Tensor | None, _: Any, drhs: Tensor | None, *__: Any) -> Tensor:
        K, basis, x = ctx.saved_tensors
        e = torch.zeros_like(x) if drhs is None else drhs
        e = e if dK is None else e - multiply(dK, x)
        return _BasisSolve.apply(K, basis, e, ctx.rank_tolerances)

    @staticmethod
    def vmap(info: Any, in_dims: Any, *inputs: Any) -> Any:
        K, basis, rhs = (_batch_first(x, d, info.batch_size) for x, d in zip(inputs[:3], in_dims[:3], strict=True))
        K = K.reshape(info.batch_size, *(1,) * (rhs.dim() + 1 - K.dim()), *K.shape[1:])
        return _BasisSolve.apply(K, basis, rhs, inputs[3]), 0


def _solve_block(K: Tensor, basis: Tensor, rhs: Tensor, pivot_tolerance: float, rank_tolerance: float) -> Tensor:
    n = K.shape[-1]
    if rhs.numel() == 0:
        return torch.zeros_like(rhs)
    block = torch.where(basis.unsqueeze(-1) & basis.unsqueeze(-2), K, 0.0)
    rows, columns = two_sided_scales(block)
    block = rows.unsqueeze(-1) * block * columns.unsqueeze(-2)
    b = torch.where(basis, rows * rhs, 0.0).unsqueeze(-1)
    factors, pivots, _ = torch.linalg.lu_factor_ex(block + torch.diag_embed((~basis).to(K.dtype)))
    diagonal = factors.diagonal(dim1=-2, dim2=-1).abs()
    singular = ~(diagonal.amin(-1) > n * pivot_tolerance)
    x = torch.linalg.lu_solve(factors, pivots, b).squeeze(-1)
    if singular.any():
        finite = block[singular].isfinite().all(-1, keepdim=True).all(-2, keepdim=True)
        rest = torch.where(finite, block[singular], 0.0)  # pinv would raise, for the whole batch
        least_squares = torch.linalg.pinv(rest, rtol=rank_tolerance) @ b[singular]
        x[singular] = least_squares.squeeze(-1)
    return torch.where(basis, columns * x, 0.0)


def _batch_first(x: Tensor, dim: int | None, size: int) -> Tensor:
    return x.expand(size, *x.shape) if dim is None else x.movedim(dim, 0)
