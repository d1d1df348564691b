"""A compiled step of a push as one node of torch's graph, with its adjoint."""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from lcplearn.scenes.contact_kernel.compiling import compiled, fingerprint, refuse_batched
from lcplearn.scenes.pushing_kernel import (
    AWAY,
    SLIDES,
    STICKS,
    dot,
    eliminate,
    equations,
    finger_mode,
    linearise,
    memory_of,
    place,
    settle_element,
)
from lcplearn.scenes.pushing_lcp import Bearing, Touch


@compiled
def _adjoint_element(
    points, loads, transfer, wrench, point, normal, tangent, normal_step, tangent_step, mu, creep, slip, load, side,
    finger, x, memory, y, twist_grad, force_grad, points_grad, loads_grad, transfer_grad, wrench_grad, point_grad,
    normal_grad, tangent_grad, numbers_grad,
):  # fmt: skip
    """Gradients from those with respect to twist and force: y'(right side - A x) at the equations that x solves.

    They stay 0, as those of what is not solved, where no pivot is left in A transposed: rounding decides it, as A had
    them all when it gave x.
    """
    along, across, weight, limit, passed, arms, steps, A, _, lifted = memory
    place(point, normal, tangent, normal_step, tangent_step, arms, steps)
    linearise(points, loads, transfer, slip, load, creep, along, across, weight, limit, passed, lifted)
    equations(along, across, weight, limit, passed, side, finger, wrench, normal, tangent, arms, steps, mu, creep, A)
    for i in range(5):
        for j in range(i):
            A[i, j], A[j, i] = A[j, i], A[i, j]
    for a in range(3):
        A[a, 5] = twist_grad[a]
    A[3, 5] = (normal[0] * force_grad[0] + normal[1] * force_grad[1]) / creep
    A[4, 5] = (tangent[0] * force_grad[0] + tangent[1] * force_grad[1]) / creep
    if not eliminate(A, y):
        return
    p, tau, turn = x[3], x[4], x[2]
    f, g = p * normal[0] + tau * tangent[0], p * normal[1] + tau * tangent[1]
    f_seen, g_seen = y[0] - y[2] * point[1], y[1] + y[2] * point[0]  # what the balance sees of a change of f and g
    for i in range(weight.size):
        seen, moved = dot(along[i], y), dot(along[i], x)
        by_along = turn * seen + y[2] * moved
        if side[i] != 0:
            by_along = y[2] * side[i] * (limit[i] + passed[i, 0] * f + passed[i, 1] * g)
            f_seen -= side[i] * seen * passed[i, 0]
            g_seen -= side[i] * seen * passed[i, 1]
            if not lifted[i]:
                loads_grad[i] = -side[i] * seen * creep
                transfer_grad[i, 0], transfer_grad[i, 1] = -side[i] * seen * f, -side[i] * seen * g
        by_across = weight[i] * (turn * dot(across[i], y) + y[2] * dot(across[i], x))
        points_grad[i, 0] = -by_along * along[i, 1] - by_across * across[i, 1]
        points_grad[i, 1] = by_along * along[i, 0] + by_across * across[i, 0]
    hold, grip = y[3] if finger != AWAY else 0.0, y[4] if finger == STICKS else 0.0
    for a in range(3):
        wrench_grad[a] = creep * y[a]
    point_grad[0] = y[2] * g - turn * (hold * normal[1] + grip * tangent[1])
    point_grad[1] = turn * (hold * normal[0] + grip * tangent[0]) - y[2] * f
    u, v = x[0] - turn * point[1], x[1] + turn * point[0]
    normal_grad[0] = p * (f_seen + force_grad[0] / creep) - hold * u
    normal_grad[1] = p * (g_seen + force_grad[1] / creep) - hold * v
    tangent_grad[0] = tau * (f_seen + force_grad[0] / creep) - grip * u
    tangent_grad[1] = tau * (g_seen + force_grad[1] / creep) - grip * v
    numbers_grad[0], numbers_grad[1] = hold, grip
    numbers_grad[2] = y[4] * finger * p if abs(finger) == SLIDES else 0.0


def _make_settle(sources: str) -> Any:
    def _settle(points, loads, transfer, wrench, point, normal, tangent, numbers, creep, iterations, state, out, flags):
        """For each element; `state` is slip, load, side, finger's state and x."""
        sources  # noqa: B018, for the cache
        slip, load, side, does, x = state
        new, twist, force = out
        memory = memory_of(loads.shape[1])
        for b in range(len(loads)):
            solved, settled, finger = settle_element(
                points[b], loads[b], transfer[b], wrench[b], point[b], normal[b], tangent[b], numbers[b, 0],
                numbers[b, 1], numbers[b, 2], creep, iterations, slip[b], load[b], side[b], memory, x[b],
            )  # fmt: skip
            new[b] = memory[8]
            twist[b] = x[b, :3]
            for d in range(2):
                force[b, d] = (x[b, 3] * normal[b, d] + x[b, 4] * tangent[b, d]) / creep
            does[b] = finger
            flags[b, 0], flags[b, 1], flags[b, 2] = solved, settled, finger_mode(x[b], finger)

    return compiled(_settle, cached=True)


def _make_adjoint(sources: str) -> Any:
    def _adjoint(points, loads, transfer, wrench, point, normal, tangent, numbers, creep, state, flags, given, grads):
        sources  # noqa: B018, for the cache
        slip, load, side, does, x = state
        twist_grad, force_grad = given
        memory, y = memory_of(loads.shape[1]), np.empty(5)
        for b in range(len(loads)):
            if flags[b, 0]:
                _adjoint_element(
                    points[b], loads[b], transfer[b], wrench[b], point[b], normal[b], tangent[b], numbers[b, 0],
                    numbers[b, 1], numbers[b, 2], creep, slip[b], load[b], side[b], does[b], x[b], memory, y,
                    twist_grad[b], force_grad[b], grads[0][b], grads[1][b], grads[2][b], grads[3][b], grads[4][b],
                    grads[5][b], grads[6][b], grads[7][b],
                )  # fmt: skip

    return compiled(_adjoint, cached=True)


_SOURCES = fingerprint("pushing_lcp.py", "pushing_step.py", "pushing_kernel.py", "pushing_node.py")
_settle, _adjoint = _make_settle(_SOURCES), _make_adjoint(_SOURCES)


class _Settle(torch.autograd.Function):
    """Bearing, touch and guess of the slip to twist, force, new slip and flags (solved, settled, mode)."""

    @staticmethod
    def forward(ctx: Any, slip: Tensor, creep: float, iterations: int, *inputs: Tensor) -> Any:
        arrays = tuple(as_array(x) for x in inputs)
        loads = arrays[1]
        batch, supports = loads.shape
        state = (
            as_array(slip).copy(),
            np.empty_like(loads),
            np.empty(loads.shape, np.int64),
            np.empty(batch, np.int64),
            np.empty((batch, 5)),
        )
        out = (np.empty((batch, supports, 2)), np.empty((batch, 3)), np.empty((batch, 2)))
        flags = np.empty((batch, 3), np.int64)
        _settle(*arrays, creep, iterations, state, out, flags)
        ctx.save_for_backward(*inputs)
        ctx.kept, ctx.creep = (state, flags), creep
        new, twist, force, told = (torch.from_numpy(x) for x in (*out, flags))
        ctx.mark_non_differentiable(new, told)
        return twist, force, new, told

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, twist_grad: Tensor, force_grad: Tensor, *_: Any) -> Any:
        refuse_batched((twist_grad, force_grad))
        arrays, (state, flags) = tuple(as_array(x) for x in ctx.saved_tensors), ctx.kept
        grads = tuple(np.zeros_like(x) for x in arrays)
        _adjoint(*arrays, ctx.creep, state, flags, (as_array(twist_grad), as_array(force_grad)), grads)
        return None, None, None, *(torch.from_numpy(x) for x in grads)


def settle(bearing: Bearing, touch: Touch, slip: Tensor, *, creep: float, iterations: int) -> tuple[Tensor, ...]:
    """Twist, force, new slip and flags (solved, settled, mode) of a step; what is not solved is not iterated on."""
    wrench = bearing.loads.new_zeros(len(slip), 3) if bearing.wrench is None else bearing.wrench
    numbers = torch.stack((touch.normal_step, touch.tangent_step, touch.friction), -1)
    return _Settle.apply(
        slip, creep, iterations, *bearing[:3], wrench, touch.point, touch.normal, touch.tangent, numbers
    )  # fmt: skip


def as_array(x: Tensor) -> Any:
    """For the kernel: numbers one after the other."""
    return np.ascontiguousarray(x.detach().numpy(), np.float64)
