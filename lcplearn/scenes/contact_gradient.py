"""The gradient of a contact step: Coulomb's law, linearised at the modes that were found.

With loads lambda and friction forces f, together y, of the contacts that are loaded, and v(y) = free + mass^-1 J' y,

    n v - target + compliance lambda = 0
    T v = 0                               where a contact sticks
    f + mu lambda d = 0,  d = Tv / |Tv|   where it slips; and where mu = 0, with d = 0 if nothing slips

are r(y, parameters) = 0. Its derivative K = dr/dy gives dy = -K^-1 dr: here as one Newton step y - K^-1 r with K
constant, whose value is y and whose gradient is that. Where contacts are redundant K is singular, and the smallest
solution is taken: the gradient of the velocity is exact, as no force that K does not see moves anything.

Source: implicit function theorem; NOTES 5.7.
"""

import torch
from torch import Tensor

from lcplearn.scenes.friction_lcp import CREEPS, Answer, Problem
from lcplearn.scenes.numbers import matvec

RANK = 1e-10  # singular values below this share of the largest are those of redundant contacts


def attach_gradient(problem: Problem, found: Answer, buckets: list[tuple[Tensor, Tensor]]) -> Answer:
    """The answer as it is, with its gradient; buckets are elements [b] and their loaded contacts [b, K]."""
    # In flight nothing depends on the contacts: with a derivative of 0, not with none.
    velocity = problem.free + 0.0 * (problem.target + problem.mu + problem.compliance).nan_to_num().sum(
        -1, keepdim=True
    )
    load, friction = torch.zeros_like(found.normal), torch.zeros_like(found.friction)
    for elements, contacts in buckets:
        parts = _newton_step(problem.pick(elements, contacts), found.pick(elements, contacts))
        place = (elements.unsqueeze(-1), contacts)
        velocity = velocity.index_put((elements,), parts[0])
        load, friction = load.index_put(place, parts[1]), friction.index_put(place, parts[2])

    def valued(value: Tensor, derivative: Tensor) -> Tensor:
        known = found.solved.reshape(-1, *(1,) * (value.dim() - 1))
        return value + torch.where(known, derivative - derivative.detach(), 0.0)

    return found._replace(
        velocity=valued(found.velocity, velocity),
        normal=valued(found.normal, load),
        friction=valued(found.friction, friction),
    )


def _newton_step(part: Problem, found: Answer) -> tuple[Tensor, Tensor, Tensor]:
    """Velocity, loads and friction forces after a Newton step on r."""
    T, K = part.directions, part.mu.shape[-1]
    rows = torch.cat((part.normal.unsqueeze(-2), part.tangents), dim=-2)  # [b, K, 1 + T, nv]
    y = torch.cat((found.normal.unsqueeze(-1), found.friction), dim=-1)
    velocity = part.free + torch.einsum("bctv,bct->bv", rows, y) / part.mass
    speed = torch.einsum("bctv,bv->bct", rows, velocity)
    slip = speed[..., 1:]
    with torch.no_grad():
        size = torch.linalg.vector_norm(slip, dim=-1)
        limit = (part.mu * y[..., 0]).unsqueeze(-1)
        still = found.sticks | (size <= CREEPS * part.speed_scale())
        sticks = still & (limit[..., 0] > 0.0)  # what has no friction is held by nothing
        slips = ~sticks.unsqueeze(-1)
        # in units of speed, like the other rows
        unit = (part.normal.square() / part.mass.unsqueeze(-2)).sum(-1, keepdim=True)
    moves = ~still.unsqueeze(-1)
    direction = slip / torch.linalg.vector_norm(torch.where(moves, slip, 1.0), dim=-1, keepdim=True).clamp_min(1e-300)
    direction = torch.where(moves, direction, 0.0)
    limit = part.mu.unsqueeze(-1) * y[..., :1].detach()
    law = torch.where(slips, unit * (y[..., 1:].detach() + limit * direction), slip)
    opening = speed[..., 0] - part.target + part.compliance * y[..., 0]
    r = torch.cat((opening.unsqueeze(-1), law), dim=-1).flatten(1)
    with torch.no_grad():
        A = torch.einsum("bctv,bdsv->bctds", rows / part.mass[:, None, None], rows)
        identity = torch.eye(K, dtype=A.dtype, device=A.device)
        slope = A.clone()
        if T:
            d = direction
            turning = torch.eye(T, dtype=A.dtype, device=A.device) - d.unsqueeze(-1) * d.unsqueeze(-2)
            speed_floor = torch.where(still, 1.0, size).unsqueeze(-1)
            turning = (unit * limit / speed_floor).unsqueeze(-1) * turning
            moving = torch.einsum("bcut,bctds->bcuds", turning, A[:, :, 1:])
            own = torch.einsum("bct,cd->bctd", unit * part.mu.unsqueeze(-1) * d, identity)
            moving[..., 0] += own
            moving[..., 1:] += torch.einsum("bc,ts,cd->bctds", unit[..., 0], torch.eye(T, dtype=A.dtype), identity)
            slope[:, :, 1:] = torch.where(slips[..., None, None], moving, slope[:, :, 1:])
        slope[:, :, 0, :, 0] += torch.diag_embed(part.compliance)
        inverse = _inverse(slope.flatten(3).flatten(1, 2))
    y = y - matvec(inverse, r).reshape(y.shape)
    velocity = part.free + torch.einsum("bctv,bct->bv", rows, y) / part.mass
    return velocity, y[..., 0], y[..., 1:]


def _inverse(K: Tensor) -> Tensor:
    """Inverse, or pseudoinverse where K is singular."""
    inverse = torch.linalg.inv_ex(K).inverse
    identity = torch.eye(K.shape[-1], dtype=K.dtype, device=K.device)
    good = ((K @ inverse - identity).abs().amax((-2, -1)) < 1e-8).unsqueeze(-1).unsqueeze(-1)
    if good.all():
        return inverse
    finite = torch.where(K.isfinite().all(-1).all(-1)[:, None, None], K, identity)
    return torch.where(good, inverse, torch.linalg.pinv(finite, rtol=RANK))
