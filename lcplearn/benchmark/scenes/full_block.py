"""The full contact LCP of a block on the ground: what a scene would build that did not look at what it needs."""

import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.lcp.solve import solve_lcp

FULL_ROWS = 4  # normal, two friction directions, slip speed


def full_lcp(
    normal: Float[Tensor, " B"], sideways: Float[Tensor, " B"], *, mass: float, mu: float
) -> tuple[Float[Tensor, "4 4"], Float[Tensor, "B 4"]]:
    """Stewart and Trinkle's LCP of one contact of a block that can move up and sideways.

    z = (p_n, p_+, p_-, gamma), impulses [N s] and slip speed [m/s]; w = (approach, slip excess twice, unused friction).

    Args:
        normal: Velocity with which the gap would open without contact, v_n + gap / dt (or v_n + e v_n before) [m/s].
        sideways: Velocity along the ground without friction [m/s].
        mass: Mass [kg].
        mu: Friction coefficient.

    Returns:
        M and q.

    Source: Stewart and Trinkle 1996.
    """
    a = 1.0 / mass
    M = torch.tensor(
        [[a, 0.0, 0.0, 0.0], [0.0, a, -a, 1.0], [0.0, -a, a, 1.0], [mu, -1.0, -1.0, 0.0]], dtype=normal.dtype
    )
    return M, torch.stack((normal, sideways, -sideways, torch.zeros_like(normal)), dim=-1)


def full_velocity(
    normal: Float[Tensor, " B"], sideways: Float[Tensor, " B"], *, mass: float, mu: float
) -> tuple[Float[Tensor, " B"], Float[Tensor, " B"]]:
    """Change of the normal velocity by contact, and the velocity along the ground after the step [m/s].

    Like `SlidingBlock`'s traditional form, the latter is held to |v| <= gamma, so that sticking is exact.
    """
    z = solve_lcp(*full_lcp(normal, sideways, mass=mass, mu=mu)).z
    slip = sideways + (z[..., 1] - z[..., 2]) / mass
    return z[..., 0] / mass, torch.minimum(torch.maximum(slip, -z[..., 3]), z[..., 3])
