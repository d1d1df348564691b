"""How badly the best contact impulses explain a recorded step: a convex problem, whose solve needs no gradient."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.lcp.solve import solve_lcp

DIRECTIONS = 4  # of friction, the first along the recorded slip
NEAREST = 4  # contacts that are considered, those of least gap
WEIGHT = 0.03  # of the costs of impulses; larger ones let the shape give way instead of the impulses
DEPTH_WEIGHT = 1e-3  # of overlap, which noise of measured poses makes: more of it shrinks the shape
SOFTENING = 1e-3  # of the impulses, relative to 1 / mass: makes the minimiser unique


class Touch(NamedTuple):
    """Contacts as a recorded state has them.

    Attributes:
        gap: [m].
        normal: Jacobian of the normal speed.
        tangents: Jacobians of the slip along two orthonormal directions.
        mu: Friction coefficient.
    """

    gap: Float[Tensor, "*#batch C"]
    normal: Float[Tensor, "*#batch C nv"]
    tangents: Float[Tensor, "*#batch C 2 nv"]
    mu: Float[Tensor, "*#batch C"]


def contact_violation(
    touch: Touch,
    velocity: Float[Tensor, "*batch nv"],
    change: Float[Tensor, "*batch nv"],
    inertia: Float[Tensor, "*#batch nv"],
    metric: Float[Tensor, " nv"],
    dt: float,
) -> Float[Tensor, "*batch"]:
    """Find the impulses that explain a step best, and return how badly they do.

    With d the change of velocity beyond that of known forces, J the Jacobians of normals and friction directions, W
    the inverse inertia, phi and u gap and slip after the step, impulses lambda in the friction cone, per unit of mass:

        min 1/2 |d - W J' lambda|^2_G + k sum_i [lambda_n max(phi, 0) / dt + mu lambda_n |u| + lambda_t . u]
            + k_depth sum_i max(0, -phi)^2 / dt^2

    The impulses should explain d, act where there is contact, oppose the slip with all that is allowed; and the
    recorded body should not be in the ground. The added terms are linear in the impulses and at least 0 in the cone:
    an LCP with a positive semidefinite matrix of 24 rows. The metric G is fixed: with one that is learned the inertia
    makes the residual small by itself.

    Args:
        touch: Contacts after the step.
        velocity: Velocity after the step.
        change: d.
        inertia: Diagonal of the mass matrix over the mass.
        metric: Diagonal of G.
        dt: Step size [s].

    Returns:
        The minimum [m^2/s^2]; 0 where the LCP was not solved.

    Gradient:
        The partial derivative at fixed impulses and multipliers (envelope theorem).

    Source: the idea: Pfrommer, Halm, Posa, "ContactNets", CoRL 2020; NOTES 6.
    """
    touch = _nearest(touch)
    slip = (touch.tangents @ velocity[..., None, :, None]).squeeze(-1)
    rows = torch.cat((touch.normal.unsqueeze(-2), _directions(slip) @ touch.tangents), dim=-2)  # [*batch, K, 1 + 4, nv]
    speeds = (rows[..., 1:, :] @ velocity[..., None, :, None]).squeeze(-1)
    slip_speed = (slip.square().sum(-1) + 1e-12).sqrt()
    normal_cost = torch.relu(touch.gap) / dt + touch.mu * slip_speed
    cost = WEIGHT * torch.cat((normal_cost.unsqueeze(-1), speeds), dim=-1)
    root = metric.sqrt()
    effect, wanted = (rows * (root / inertia)[..., None, None, :]).flatten(-3, -2), root * change
    with torch.no_grad():
        impulse, multiplier, solved = _best(effect, wanted, cost, touch.mu)
    residual = wanted - (impulse.flatten(-2).unsqueeze(-2) @ effect).squeeze(-2)
    beyond_cone = impulse[..., 1:].sum(-1) - touch.mu * impulse[..., 0]
    value = (
        0.5 * residual.square().sum(-1)
        + 0.5 * SOFTENING * impulse.square().sum((-2, -1))
        + (impulse * cost).sum((-2, -1))
        + (multiplier * beyond_cone).sum(-1)
        + DEPTH_WEIGHT * (torch.relu(-touch.gap) / dt).square().sum(-1)
    )
    return torch.where(solved, value, 0.0)


def _nearest(touch: Touch) -> Touch:
    count = min(NEAREST, touch.gap.shape[-1])
    index = touch.gap.detach().topk(count, dim=-1, largest=False).indices
    nv = touch.normal.shape[-1]
    return Touch(
        gap=touch.gap.gather(-1, index),
        normal=touch.normal.gather(-2, index.unsqueeze(-1).expand(*index.shape, nv)),
        tangents=touch.tangents.gather(-3, index[..., None, None].expand(*index.shape, 2, nv)),
        mu=touch.mu.gather(-1, index),
    )


def _directions(slip: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 4 2"]:
    """Four directions at right angles, the first along the slip; constants for the gradient."""
    slip = slip.detach()
    length = slip.norm(dim=-1, keepdim=True)
    along = torch.where(length > 1e-10, slip / length.clamp(min=1e-10), slip.new_tensor([1.0, 0.0]))
    across = torch.stack((-along[..., 1], along[..., 0]), dim=-1)
    return torch.stack((along, across, -along, -across), dim=-2)


def _best(effect: Tensor, wanted: Tensor, cost: Tensor, mu: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Impulses [*batch, K, 5], multipliers of the cone [*batch, K], and whether the LCP was solved."""
    K, rows = cost.shape[-2:]
    size = K * rows
    quadratic = effect @ effect.mT + SOFTENING * torch.eye(size, dtype=cost.dtype)
    linear = cost.flatten(-2) - (effect @ wanted.unsqueeze(-1)).squeeze(-1)
    cone = torch.zeros(*mu.shape, K, rows, dtype=cost.dtype)  # of contact i: sum lambda_t - mu lambda_n <= 0
    contact = torch.arange(K)
    cone[..., contact, contact, 1:] = 1.0
    cone[..., contact, contact, 0] = -mu
    cone = cone.flatten(-2)
    M = torch.cat(
        (
            torch.cat((quadratic, cone.mT), dim=-1),
            torch.cat((-cone, torch.zeros(*mu.shape, K, dtype=cost.dtype)), dim=-1),
        ),
        dim=-2,
    )
    solution = solve_lcp(M, torch.cat((linear, torch.zeros_like(mu)), dim=-1))
    return solution.z[..., :size].unflatten(-1, (K, rows)), solution.z[..., size:], solution.solved
