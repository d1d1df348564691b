"""Parameters of scenes: plain numbers, or tensors that broadcast over the batch."""

import torch
from jaxtyping import Float
from torch import Tensor

Number = float | Tensor  # a tensor may need a gradient


def as_tensor(value: Number, like: Tensor) -> Tensor:
    """The value in the dtype and on the device of like; a tensor is left as it is."""
    return value if isinstance(value, Tensor) else torch.as_tensor(value, dtype=like.dtype, device=like.device)


def stack_numbers(*values: Number, like: Tensor) -> Float[Tensor, "*batch k"]:
    """Numbers side by side in a new last dimension."""
    return torch.stack(torch.broadcast_tensors(*(as_tensor(x, like) for x in values)), dim=-1)


def matvec(matrix: Float[Tensor, "*#batch m n"], vector: Float[Tensor, "*#batch n"]) -> Float[Tensor, "..."]:
    """Matrix times vector, [*batch, m]."""
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)
