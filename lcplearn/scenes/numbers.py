"""Parameters of scenes: plain numbers, or tensors that broadcast over the batch; and who may look at them."""

import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.lcp.methods import pivoting_kernel
from lcplearn.lcp.torch_internals import forward_mode, traced, transformed

Number = float | Tensor  # a tensor may need a gradient


def compiled_code_may_see(device: torch.device) -> bool:
    """Whether numbers there are plain memory: on the CPU, not traced, mapped or in forward mode; and numba is there."""
    return device.type == "cpu" and not (traced() or transformed() or forward_mode()) and pivoting_kernel() is not None


def as_tensor(value: Number, like: Tensor) -> Tensor:
    """The value in the dtype and on the device of like; a tensor is left as it is."""
    return value if isinstance(value, Tensor) else torch.as_tensor(value, dtype=like.dtype, device=like.device)


def stack_numbers(*values: Number, like: Tensor) -> Float[Tensor, "*batch k"]:
    """Numbers side by side in a new last dimension."""
    if not any(isinstance(x, Tensor) for x in values):
        return torch.tensor(values, dtype=like.dtype, device=like.device)
    return torch.stack(torch.broadcast_tensors(*(as_tensor(x, like) for x in values)), dim=-1)


def common_batch(*shapes: torch.Size) -> torch.Size:
    """As torch.broadcast_shapes, which takes 20 us."""
    some = {shape for shape in shapes if shape}
    return torch.broadcast_shapes(*some) if len(some) > 1 else some.pop() if some else torch.Size()


def one_batch(x: Tensor, batch: torch.Size, *shape: int) -> Tensor:
    """Values [B, *shape] in float64 of what broadcasts to [*batch, *shape]."""
    if x.shape != (*batch, *shape):
        x = x.expand(*batch, *shape)
    return (x if len(batch) == 1 else x.reshape(batch.numel(), *shape)).double()


def matvec(matrix: Float[Tensor, "*#batch m n"], vector: Float[Tensor, "*#batch n"]) -> Float[Tensor, "..."]:
    """Matrix times vector, [*batch, m]."""
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)
