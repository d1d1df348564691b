"""The solve as operators that torch.compile and torch.export see as one node each: numba can't be traced.

Only traced code comes here; eager code, and torch.func outside torch.compile, use the functions in `gradient.py`.
Not differentiable twice and not in forward mode: both raise.
"""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

from lcplearn.lcp.gradient import adjoint, batch_inputs
from lcplearn.lcp.methods import Options, pivots, solve
from lcplearn.lcp.solution import LCPSolution

FIELDS = len(LCPSolution._fields)


def traced_solve(M: Tensor, q: Tensor, initial_basis: Tensor | None, options: Options) -> LCPSolution:
    """`differentiable_solve` for code under a tracer."""
    if unpack_dual(M).tangent is not None or unpack_dual(q).tangent is not None:
        raise NotImplementedError("solve_lcp has no forward mode (jvp, jacfwd) in compiled code; call it uncompiled")
    return LCPSolution(*_solve(M, q, initial_basis, *options))


@torch.library.custom_op("lcplearn::solve", mutates_args=())
def _solve(
    M: Tensor, q: Tensor, initial_basis: Tensor | None, method: str, tol: float, max_iter: int | None, smoothing: float
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    with torch.no_grad():
        solution = solve(M, q, initial_basis, Options(method, tol, max_iter, smoothing))
        return solution[:]


@_solve.register_fake
def _(M: Tensor, q: Tensor, *_: Any) -> tuple[Tensor, ...]:
    integers = q.new_empty(q.shape[:-1], dtype=torch.int64)
    return LCPSolution(
        z=q.new_empty(q.shape),
        w=q.new_empty(q.shape),
        basis=q.new_empty(q.shape, dtype=torch.bool),
        status=integers,
        residual=q.new_empty(q.shape[:-1], dtype=torch.float64),
        iterations=torch.empty_like(integers),
        certificate=q.new_empty(q.shape),
    )[:]


@_solve.register_vmap
def _(info: Any, in_dims: Any, M: Tensor, q: Tensor, initial_basis: Tensor | None, *options: Any) -> Any:
    batched = batch_inputs(info.batch_size, in_dims[:3], M, q, initial_basis)
    return _solve(*batched, *options), (0,) * FIELDS


@torch.library.custom_op("lcplearn::adjoint", mutates_args=())
def _adjoint(
    M: Tensor,
    q: Tensor,
    z: Tensor,
    w: Tensor,
    basis: Tensor,
    status: Tensor,
    grad_z: Tensor | None,
    grad_w: Tensor | None,
    need_M: bool,
    smoothing: float,
    in_kernel: bool,
) -> tuple[Tensor, Tensor]:
    del q  # an argument so that torch knows that the backward depends on it, and refuses to differentiate it silently
    with torch.no_grad():
        grad_M, grad_q = adjoint((M, z, w, basis, status), grad_z, grad_w, need_M, smoothing, in_kernel)
        return M.new_empty(0) if grad_M is None else grad_M, grad_q


@_adjoint.register_fake
def _(M: Tensor, q: Tensor, *rest: Any) -> tuple[Tensor, Tensor]:
    need_M = rest[6]
    return M.new_empty(M.shape if need_M else 0), q.new_empty(q.shape)


def _setup_context(ctx: Any, inputs: Any, output: Any) -> None:
    M, q, _, *options = inputs
    ctx.smoothing, ctx.in_kernel = options[-1], pivots(q, Options(*options))
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(M, q, *output[:4])


def _backward(ctx: Any, grad_z: Tensor | None, grad_w: Tensor | None, *_: Any) -> Any:
    grad_M = grad_q = None
    if grad_z is not None or grad_w is not None:
        need_M, need_q, *_ = ctx.needs_input_grad
        grad_M, grad_q = _adjoint(*ctx.saved_tensors, grad_z, grad_w, need_M, ctx.smoothing, ctx.in_kernel)
        grad_M, grad_q = grad_M if need_M else None, grad_q if need_q else None
    return grad_M, grad_q, *(None,) * 5


_solve.register_autograd(_backward, setup_context=_setup_context)
