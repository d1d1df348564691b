"""How badly friction can explain a measured step: a loss that solves no LCP."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import relu

VIOLATION_WIDTH = 2.0  # [m/s] speed from which friction must be fully used; least biased for noise of 0.01 m/s


def violation(
    after: Float[Tensor, "*#batch"], unexplained: Float[Tensor, "*#batch"], limit: Float[Tensor, "*#batch"] | float
) -> Float[Tensor, "..."]:
    """Find the friction that explains a step best, and return how badly it does.

    min over y of  (r - y)^2 + k (y + sign(v') l)^2 + max(0, |y| - l)^2,   k = min(|v'| / width, 1)

    The friction y (a change of velocity) should explain the step's remainder r = v' - b, oppose a fast motion with
    all that is allowed, and never exceed the limit l. No LCP is solved or differentiated.

    Args:
        after: Measured velocity v' after the step [m/s].
        unexplained: r, its difference to the predicted free velocity [m/s].
        limit: l = a c, the largest change of velocity by friction [m/s].

    Returns:
        The minimum [m^2/s^2].

    Gradient:
        With respect to r and l, at fixed y: the derivative through the minimiser vanishes (envelope theorem).

    Source: NOTES 6.5.
    """
    gate = (after.abs() / VIOLATION_WIDTH).clamp(max=1.0)
    sliding = -torch.sign(after) * limit
    with torch.no_grad():
        # Convex and piecewise quadratic: the minimiser without the last term, or, where that is beyond the limit,
        # the one with it on the same side.
        inside = (unexplained + gate * sliding) / (1.0 + gate)
        beyond = (unexplained + gate * sliding + torch.sign(inside) * limit) / (2.0 + gate)
        y = torch.where(inside.abs() <= limit, inside, beyond)
    return (unexplained - y).square() + gate * (y - sliding).square() + relu(y.abs() - limit).square()
