"""Random contact problems, and a judge of their solutions that knows Coulomb's law and no LCP."""

import math

import torch
from torch import Tensor

from lcplearn.scenes.contact import Contacts, ContactStep
from lcplearn.scenes.space import rotation_matrix
from lcplearn.scenes.spatial_body import box_corners

DT = 0.01


def violation(contacts: Contacts, free: Tensor, mass: Tensor, step: ContactStep) -> Tensor:
    """Largest violation [*batch] of non-penetration, complementarity and Coulomb's law over *all* contacts [m/s, N s].

    The velocity is recomputed from the impulses.
    """
    rows = torch.cat((contacts.normal.unsqueeze(-2), contacts.tangents), dim=-2)
    impulse = torch.cat((step.normal_impulse.unsqueeze(-1), step.friction_impulse), dim=-1)
    velocity = free + torch.einsum("...ctv,...ct->...v", rows, impulse) / mass
    speeds = torch.einsum("...ctv,...v->...ct", rows, velocity)
    load, friction, slip = step.normal_impulse, step.friction_impulse, speeds[..., 1:]
    opening = speeds[..., 0] + contacts.gap / DT - contacts.bounce + contacts.compliance * load
    limit = contacts.mu * load
    size, speed = torch.linalg.vector_norm(friction, dim=-1), torch.linalg.vector_norm(slip, dim=-1)
    # opposite and at full strength where it slips: f |v| + limit v = 0
    opposed = (friction * speed.unsqueeze(-1) + limit.unsqueeze(-1) * slip).abs().sum(-1)
    wrong = (torch.minimum(load, opening).abs(), torch.relu(size - limit), opposed)
    moved = (velocity - step.velocity).abs().amax(-1)
    return torch.stack([x.amax(-1) for x in wrong] + [moved]).amax(0)


def polygons(count: int, seed: int, corners: int = 6) -> tuple[Contacts, Tensor, Tensor]:
    """Irregular polygons on or just above the ground, a third flat on an edge, a fifth pushed from rest."""
    draw = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=draw)

    around = (torch.arange(corners) + 0.4 * (uniform(count, corners) - 0.5)) * (2.0 * math.pi / corners)
    points = 0.5 * (0.8 + 0.4 * uniform(count, corners, 1)) * torch.stack((around.cos(), around.sin()), dim=-1)
    edge = points[:, 1] - points[:, 0]
    angle = torch.where(uniform(count) < 0.3, -torch.atan2(edge[:, 1], edge[:, 0]), 2.0 * math.pi * uniform(count))
    c, s = angle.cos()[:, None], angle.sin()[:, None]
    lever = torch.stack((c * points[..., 0] - s * points[..., 1], s * points[..., 0] + c * points[..., 1]), dim=-1)
    above = torch.where(uniform(count, 1) < 0.6, 0.0, 0.05 * uniform(count, 1))
    gap = lever[..., 1] - lever[..., 1].amin(-1, keepdim=True) + above
    one, zero = torch.ones(count, corners), torch.zeros(count, corners)
    mass = (0.5 + uniform(count, 1)) * torch.tensor([1.0, 1.0, 0.1])
    free = _free(mass, draw, torch.tensor([1.0, 1.0, 2.0]), torch.tensor([0.0, -9.81 * DT, 0.0]))
    contacts = Contacts(
        gap=gap,
        normal=torch.stack((zero, one, lever[..., 0]), dim=-1),
        tangents=torch.stack((one, zero, -lever[..., 1]), dim=-1).unsqueeze(-2),
        mu=1.2 * uniform(count, 1).expand(count, corners),
        bounce=zero,
        compliance=zero,
    )
    return contacts, free, mass


def boxes(count: int, seed: int, compliance: float = 0.0) -> tuple[Contacts, Tensor, Tensor]:
    """Boxes of random sizes on or just above the ground, a third flat on a face, a fifth pushed from rest."""
    draw = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=draw)

    half, yaw = 0.3 + 0.4 * uniform(count, 3), math.pi * uniform(count)
    flat = torch.stack((yaw.cos(), 0.0 * yaw, 0.0 * yaw, yaw.sin()), dim=-1)
    quaternion = torch.where(uniform(count, 1) < 0.35, flat, torch.randn(count, 4, generator=draw))
    turn = rotation_matrix(quaternion / quaternion.norm(dim=-1, keepdim=True))
    above = torch.where(uniform(count, 1) < 0.6, 0.0, 0.05 * uniform(count, 1))
    mass = (0.5 + uniform(count, 1)).expand(count, 6).clone()
    mass[:, 3:] *= (half.square().sum(-1, keepdim=True) - half.square()) / 3.0
    free = _free(mass, draw, torch.ones(6), torch.tensor([0.0, 0.0, -9.81 * DT, 0.0, 0.0, 0.0]))
    mu, soft = 1.2 * uniform(count, 1), torch.tensor(compliance)
    return _box_contacts(half, turn, above, mu, soft), free, mass


def resting_boxes(count: int, seed: int, still: bool = False) -> tuple[Contacts, Tensor, Tensor]:
    """Boxes on the ground, almost flat, almost at rest, or in it and without any free velocity (still).

    Angles, depths and speeds are drawn from 1 down to 1e-10. Corners then contradict each other at all these scales.
    """
    draw = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=draw)

    half, yaw = 0.02 + 0.06 * uniform(count, 3), math.pi * uniform(count)
    flat = torch.stack((yaw.cos(), 0.0 * yaw, 0.0 * yaw, yaw.sin()), dim=-1)
    quaternion = flat + 10.0 ** (-8.0 * uniform(count, 1)) * torch.randn(count, 4, generator=draw)
    turn = rotation_matrix(quaternion / quaternion.norm(dim=-1, keepdim=True))
    depth = torch.where(uniform(count, 1) < 0.5 * (not still), 0.0, 0.005 * 10.0 ** (-10.0 * uniform(count, 1)))
    mass = torch.full((count, 6), 0.3)
    mass[:, 3:] *= (half.square().sum(-1, keepdim=True) - half.square()) / 3.0
    speed = 10.0 ** (-10.0 * uniform(count, 1)) * torch.tensor([1.0, 1.0, 0.3, 20.0, 20.0, 20.0])
    free = speed * torch.randn(count, 6, generator=draw) - torch.tensor([0.0, 0.0, 9.81 * DT, 0.0, 0.0, 0.0])
    mu = torch.where(uniform(count, 1) < 0.2, 0.0, 10.0 ** (2.5 * uniform(count, 1) - 2.0))
    compliance = torch.where(uniform(count, 1) < 0.5, 0.0, 1e-3)
    return _box_contacts(half, turn, -depth, mu, compliance), 0.0 * free if still else free, mass


def _box_contacts(half: Tensor, turn: Tensor, above: Tensor, mu: Tensor, compliance: Tensor) -> Contacts:
    """The corners of boxes, the lowest of them at a height above the ground."""
    count, corners = len(half), box_corners(half)
    height = (corners @ turn.mT)[..., 2]
    linear = torch.eye(3).expand(count, 8, 3, 3)
    angular = torch.linalg.cross(
        corners.unsqueeze(-2).expand(count, 8, 3, 3), turn.unsqueeze(-3).expand(count, 8, 3, 3)
    )
    rows = torch.cat((linear, angular), dim=-1)
    return Contacts(
        gap=height - height.amin(-1, keepdim=True) + above,
        normal=rows[..., 2, :],
        tangents=rows[..., :2, :],
        mu=mu.expand(count, 8),
        bounce=torch.zeros(count, 8),
        compliance=compliance.expand(count, 8),
    )


def _free(mass: Tensor, draw: torch.Generator, spread: Tensor, fall: Tensor) -> Tensor:
    count, nv = mass.shape
    moving = (torch.rand(count, 1, generator=draw) > 0.2).double()
    push = torch.randn(count, nv, generator=draw) * 5.0 * DT / mass.sqrt()
    return moving * spread * torch.randn(count, nv, generator=draw) + push + fall
