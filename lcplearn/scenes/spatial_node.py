"""Rollouts of bodies in space on the CPU as one node of autograd."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lcplearn.scenes.contact_kernel.compiling import refuse_batched
from lcplearn.scenes.spatial_adjoint import back_scratch, roll_back
from lcplearn.scenes.spatial_kernel import Options, Rolled, roll


def roll_out(options: Options, *given: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """States [B, T + 1, 13], modes [B, T, C] and whether each step is right [B, T]; for what is given see `roll`."""
    if torch.is_grad_enabled() and any(x.requires_grad for x in given):
        found: tuple[Tensor, Tensor, Tensor] = _Rollout.apply(options, *given)
        return found
    states, modes, solved = (torch.from_numpy(x) for x in roll(given, options)[:3])
    return states, modes, solved


class _Rollout(torch.autograd.Function):
    """Rollouts of a batch as one node."""

    @staticmethod
    def forward(ctx: Any, options: Options, *given: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        rolled = tuple(torch.from_numpy(x) for x in roll(given, options, keep=True))
        ctx.options = options
        ctx.save_for_backward(*given, *rolled)
        states, modes, solved = rolled[:3]
        ctx.mark_non_differentiable(modes, solved)
        return states, modes, solved

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
        refuse_batched((gradient,))
        given, rolled = ctx.saved_tensors[:6], ctx.saved_tensors[6:]
        return (None, *pull_back(given, ctx.options, Rolled(*(x.detach().numpy() for x in rolled)), gradient))


def pull_back(given: Sequence[Tensor], options: Options, rolled: Rolled, gradient: Tensor) -> list[Tensor]:
    """Gradients with respect to what `roll` was given, from that with respect to the states."""
    states_ = gradient.detach().clone(memory_format=torch.contiguous_format)
    results = [torch.zeros_like(x, memory_format=torch.contiguous_format) for x in given[1:]]
    values = [x.detach().contiguous().numpy() for x in given[1:]]
    scratch = np.empty(back_scratch(given[2].shape[1]))
    roll_back(scratch, *options, *values, *rolled, states_.numpy(), *(x.numpy() for x in results))
    return [states_[:, 0], *results]
