"""Small building blocks shared by the formulations: features of (v, u), affine maps and networks, in float64."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lcplearn.domains import positive

ACTIVATIONS: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh}


def features(velocity: Float[Tensor, "*batch"], force: Float[Tensor, "*batch"], dt: float) -> Float[Tensor, "*batch 2"]:
    """Stack velocity [m/s] and impulse of the applied force, u dt [N s].

    The impulse rather than the force, so that an affine map's coefficient is 1 / mass: of order one whatever dt is.
    """
    impulse = force * dt
    shape = torch.broadcast_shapes(velocity.shape, impulse.shape)
    return torch.stack((velocity.expand(shape), impulse.expand(shape)), dim=-1)


def network(inputs: int, outputs: int, *, width: int, depth: int, activation: str) -> nn.Sequential:
    """Fully connected network with `depth` hidden layers of `width` units.

    Args:
        inputs: Number of inputs.
        outputs: Number of outputs; the last layer is affine.
        width: Units of a hidden layer; >= 1.
        depth: Hidden layers; 0 is an affine map.
        activation: "relu" or "tanh".

    Raises:
        ValueError: width below one, negative depth, or an unknown activation.
    """
    if width < 1 or depth < 0:
        raise ValueError(f"width, depth: expected at least 1 and at least 0, got {width} and {depth}")
    if activation not in ACTIVATIONS:
        raise ValueError(f"activation: expected one of {', '.join(ACTIVATIONS)}, got {activation!r}")
    layers: list[nn.Module] = []
    for _ in range(depth):
        layers += [nn.Linear(inputs, width, dtype=torch.float64), ACTIVATIONS[activation]()]
        inputs = width
    return nn.Sequential(*layers, nn.Linear(inputs, outputs, dtype=torch.float64))


def log_parameter(name: str, value: float) -> nn.Parameter:
    """Logarithm of a positive quantity as a parameter, so that training can't make the quantity negative."""
    return nn.Parameter(torch.tensor(positive(name, value), dtype=torch.float64).log())
