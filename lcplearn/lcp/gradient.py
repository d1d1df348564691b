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

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lcplearn.lcp.residuals import two_sided_scales
from lcplearn.lcp.solution import LCPSolution, Status

ForwardSolve = Callable[[Tensor, Tensor, Tensor | None], LCPSolution]

# By precision of the data: pivots below the first (times n) call a block singular, singular values below the second
# are dropped. Rank-deficient contact matrices rounded to float32 are full rank at 1e-7 only by rounding.
RANK_TOLERANCES = {torch.float64: (1e-15, 1e-9), torch.float32: (1e-7, 1e-5)}


class DifferentiableSolve(torch.autograd.Function):
    """Run `solve(M, q, initial_basis)` and give z and w of its solution their implicit derivative.

    M is [*batch, n, n], or [n, n] shared by the batch of q [*batch, n]; its gradient is then the sum over the batch.
    """

    @staticmethod
    def forward(M: Tensor, q: Tensor, initial_basis: Tensor | None, solve: ForwardSolve, smoothed: bool) -> Any:
        return tuple(solve(M, q, initial_basis))

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        M, _, _, _, ctx.smoothed = inputs
        z, w, basis, status, *_ = output
        ctx.mark_non_differentiable(*output[2:])
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(M, z, w, basis, status)
        ctx.save_for_forward(M, z, w, basis, status)

    @staticmethod
    def backward(ctx: Any, grad_z: Tensor | None, grad_w: Tensor | None, *_: Any) -> Any:
        M, z, w, basis, status = ctx.saved_tensors
        if (grad_z is None and grad_w is None) or not any(ctx.needs_input_grad[:2]):
            return None, None, None, None, None
        solved = (status == Status.SOLVED).unsqueeze(-1)
        g_z = torch.zeros_like(z) if grad_z is None else torch.where(solved, grad_z, 0.0)
        g_w = torch.zeros_like(w) if grad_w is None else torch.where(solved, grad_w, 0.0)
        z = torch.where(solved, z, 0.0)
        h_I = torch.where(basis, 0.0, g_w)
        rhs = -g_z - (M.mT @ h_I.unsqueeze(-1)).squeeze(-1)
        K = M.mT
        if ctx.smoothed:
            damping = _damping(z, w, solved)
            K, rhs = K + torch.diag_embed(damping), rhs + damping * g_w
        grad_q = torch.where(basis, basis_solve(K, basis & solved, rhs), h_I)
        grad_M = (grad_q.unsqueeze(-1) * z.unsqueeze(-2)).sum_to_size(M.shape) if ctx.needs_input_grad[0] else None
        return grad_M, grad_q if ctx.needs_input_grad[1] else None, None, None, None

    @staticmethod
    def jvp(ctx: Any, dM: Tensor | None, dq: Tensor | None, *_: Any) -> Any:
        M, z, w, basis, status = ctx.saved_tensors
        solved = (status == Status.SOLVED).unsqueeze(-1)
        z = torch.where(solved, z, 0.0)
        e = torch.zeros_like(z) if dq is None else torch.where(solved, dq, 0.0)
        if dM is not None:
            e = e + torch.where(solved, (dM @ z.unsqueeze(-1)).squeeze(-1), 0.0)
        K = M + torch.diag_embed(_damping(z, w, solved)) if ctx.smoothed else M
        dz = basis_solve(K, basis & solved, -e)
        dw = e + (M @ dz.unsqueeze(-1)).squeeze(-1)
        if not ctx.smoothed:
            dw = torch.where(basis, 0.0, dw)
        return dz, torch.where(solved, dw, 0.0), None, None, None, None, None

    @staticmethod
    def vmap(info: Any, in_dims: Any, M: Tensor, q: Tensor, initial_basis: Tensor | None, solve: Any, smoothed: bool) -> Any:
        if in_dims[0] is not None or M.dim() > 2:
            M = _batch_first(M, in_dims[0], info.batch_size)
        q = _batch_first(q, in_dims[1], info.batch_size)
        if M.dim() == 3 and q.dim() > 2:  # one shared matrix for each element that vmap sees
            M = M.reshape(info.batch_size, *(1,) * (q.dim() - 2), *M.shape[1:]).expand(*q.shape, q.shape[-1])
        if initial_basis is not None:
            initial_basis = _batch_first(initial_basis, in_dims[2], info.batch_size)
        return DifferentiableSolve.apply(M, q, initial_basis, solve, smoothed), (0,) * len(LCPSolution._fields)


def _damping(z: Tensor, w: Tensor, solved: Tensor) -> Tensor:
    """The diagonal w / z that smoothing adds."""
    return torch.where(solved, w, 0.0) / torch.where(solved, z, 1.0)


def basis_solve(K: Tensor, basis: Tensor, rhs: Tensor) -> Tensor:
    """x with K_AA x_A = rhs_A and x = 0 off the basis A; smallest least-squares solution where K_AA is singular."""
    return _BasisSolve.apply(K, basis, rhs)


class _BasisSolve(torch.autograd.Function):
    """Its derivative is the same solve: dx = K_AA^-1 (drhs - dK x), so that second derivatives come for free."""

    @staticmethod
    def forward(K: Tensor, basis: Tensor, rhs: Tensor) -> Tensor:
        return _solve_block(K.double(), basis, rhs.double(), *RANK_TOLERANCES[K.dtype]).to(rhs.dtype)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.save_for_backward(inputs[0], inputs[1], output)
        ctx.save_for_forward(inputs[0], inputs[1], output)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:
        K, basis, x = ctx.saved_tensors
        y = basis_solve(K.mT, basis, grad)
        grad_K = (-y.unsqueeze(-1) * x.unsqueeze(-2)).sum_to_size(K.shape) if ctx.needs_input_grad[0] else None
        return grad_K, None, y

    @staticmethod
    def jvp(ctx: Any, dK: Tensor | None, _: Any, drhs: Tensor | None) -> Tensor:
        K, basis, x = ctx.saved_tensors
        e = torch.zeros_like(x) if drhs is None else drhs
        return basis_solve(K, basis, e if dK is None else e - (dK @ x.unsqueeze(-1)).squeeze(-1))

    @staticmethod
    def vmap(info: Any, in_dims: Any, *tensors: Tensor) -> Any:
        K, basis, rhs = (_batch_first(x, dim, info.batch_size) for x, dim in zip(tensors, in_dims, strict=True))
        K = K.reshape(info.batch_size, *(1,) * (rhs.dim() + 1 - K.dim()), *K.shape[1:])
        return _BasisSolve.apply(K, basis, rhs), 0


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
        least_squares = torch.linalg.pinv(block[singular], rtol=rank_tolerance) @ b[singular]
        x[singular] = least_squares.squeeze(-1)
    return torch.where(basis, columns * x, 0.0)


def _batch_first(x: Tensor, dim: int | None, size: int) -> Tensor:
    return x.expand(size, *x.shape) if dim is None else x.movedim(dim, 0)
