"""Rollouts of bodies in space on the CPU as one node of autograd."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lcplearn.scenes.contact_kernel.compiling import refuse_batched
from lcplearn.scenes.contact_kernel.slices import by_slices
from lcplearn.scenes.contact_kernel.steps import SECONDS
from lcplearn.scenes.spatial_adjoint import back_scratch, roll_back
from lcplearn.scenes.spatial_kernel import Options, Rolled, roll


def roll_out(options: Options, *given: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """States [B, T + 1, 13], modes [B, T, C] and whether each step is right [B, T]; for what is given see `roll`."""
    if torch.is_grad_enabled() and any(x.requires_grad for x in given):
        found: tuple[Tensor, Tensor, Tensor] = _Rollout.apply(options, *given)
        return found
    states, modes, solved = (torch.from_numpy(x) for x in roll(_arrays(given), options)[:3])
    return states, modes, solved


def _arrays(given: Sequence[Tensor]) -> list[NDArray]:
    return [x.detach().contiguous().numpy() for x in given]


class _Rollout(torch.autograd.Function):
    """Rollouts of a batch as one node."""

    @staticmethod
    def forward(ctx: Any, options: Options, *given: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        ctx.given, ctx.options = _arrays(given), options
        ctx.rolled = roll(ctx.given, options, keep=True)
        states, modes, solved = (torch.from_numpy(x) for x in ctx.rolled[:3])
        ctx.save_for_backward(*given, states, modes, solved)
        ctx.mark_non_differentiable(modes, solved)
        return states, modes, solved

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
        refuse_batched((gradient,))
        _ = ctx.saved_tensors  # raises where one was changed in place; the arrays are their memory
        return (None, *pull_back(ctx.given, ctx.options, ctx.rolled, gradient))


def pull_back(given: Sequence[NDArray], options: Options, rolled: Rolled, gradient: Tensor) -> list[Tensor]:
    """Gradients with respect to what `roll` was given, from that with respect to the states."""
    states_ = gradient.numpy().copy(order="C")
    results = [np.zeros(x.shape) for x in given[1:]]
    B, T, C = rolled.loads.shape
    arrays = (*given[1:], *rolled, states_, *results)
    by_slices(partial(roll_back, *options), arrays, B, T * SECONDS * C, back_scratch(C))
    return [torch.from_numpy(x) for x in (states_[:, 0], *results)]
