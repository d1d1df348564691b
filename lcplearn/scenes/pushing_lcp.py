"""The LCP of one quasi-static push: dry friction under the supports of an object, and a finger that touches it.

No inertia, and more supports than velocities: neither the velocity nor the support forces can be eliminated from
force balance alone. A small creep in each support, velocity = facets' multipliers + creep * force, makes it possible;
forces are scaled by it, so that M does not depend on it.

Everything is free of units: lengths in units of the object's radius, a finger step is 1, forces in units of
mu * weight of the object.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor


class Touch(NamedTuple):
    """Where the finger meets the object, in the object's axes about its centre of mass.

    Attributes:
        point: Contact point.
        normal, tangent: Unit vectors; the normal points into the object.
        normal_step, tangent_step: Motion of the finger during the step along both, less the gap that is still open.
        friction: Friction coefficient between finger and object.
    """

    point: Float[Tensor, "b 2"]
    normal: Float[Tensor, "b 2"]
    tangent: Float[Tensor, "b 2"]
    normal_step: Float[Tensor, " b"]
    tangent_step: Float[Tensor, " b"]
    friction: Float[Tensor, " b"]


class Bearing(NamedTuple):
    """What bears the object during a step.

    Attributes:
        points: Support points, in the object's axes about its centre of mass.
        loads: Share of the weight on each when the finger exerts no force.
        transfer: How much a finger force adds to each share.
        wrench: Further force and torque on the object.
    """

    points: Float[Tensor, "b k 2"]
    loads: Float[Tensor, "b k"]
    transfer: Float[Tensor, "b k 2"]
    wrench: Float[Tensor, "b 3"] | None


class PushLCP(NamedTuple):
    """An LCP (M, q), and how its solution is read: `twist` and `force`."""

    M: Float[Tensor, "b n n"]
    q: Float[Tensor, "b n"]
    compliance: Float[Tensor, "b 3 3"]
    facets: Float[Tensor, "b m 3"]
    finger_wrench: Float[Tensor, "b 3 2"]
    finger_force: Float[Tensor, "b 2 2"]
    drift: Float[Tensor, "b 3"]

    def twist(self, z: Float[Tensor, "b n"]) -> Float[Tensor, "b 3"]:
        """Velocity of the centre of mass and angular velocity, in the object's axes."""
        facets = self.facets.shape[1]
        pushed = self.facets.mT @ z[:, :facets, None] + self.finger_wrench @ z[:, facets:-1, None]
        return (self.compliance @ pushed)[..., 0] + self.drift

    def force(self, z: Float[Tensor, "b n"], creep: float) -> Float[Tensor, "b 2"]:
        """Force of the finger on the object, in the object's axes."""
        return (self.finger_force @ z[:, self.facets.shape[1] : -1, None])[..., 0] / creep


def aligned_lcp(
    bearing: Bearing,
    touch: Touch,
    slip: Float[Tensor, "b k 2"],
    load: Float[Tensor, "b k"],
    *,
    creep: float,
) -> PushLCP:
    """The exact friction cone, linearised at a slip: two facets a support along it, the cone's curvature across.

    Across the slip Coulomb's law f = -c v/|v| reads f_s = -(c/|v|) v_s, linear with the speed and the load c of the
    last iterate. At the fixed point of slip and load, the solution and its gradient are those of the cone.

    Args:
        bearing, touch: The step.
        slip: Velocity of each support at the last iterate; detached.
        load: Share of the weight on each at the last iterate; detached.
        creep: Velocity of a support under a force of one, > 0.
    """
    slip, load = slip.detach(), load.detach()
    smallest = SMALLEST_LOAD * bearing.loads.detach().amax(-1, keepdim=True)
    lifted = load < smallest  # a support bears no negative load: it keeps a little, whatever the finger adds
    limit = torch.where(lifted, smallest, bearing.loads)
    transfer = torch.where(lifted[..., None], 0.0, bearing.transfer)
    load = torch.maximum(load, smallest)

    speed = slip.norm(dim=-1)
    direction = slip / speed.clamp_min(1e-12)[..., None]
    direction = torch.where((speed > 1e-12)[..., None], direction, direction.new_tensor((1.0, 0.0)))
    across = torch.stack((-direction[..., 1], direction[..., 0]), -1)
    along_rows, across_rows = _rows(bearing.points, direction), _rows(bearing.points, across)
    weight = creep * load / torch.maximum(speed, creep * load)
    stiffness = along_rows.mT @ along_rows + across_rows.mT @ (weight[..., None] * across_rows)
    facets = torch.stack((along_rows, -along_rows), 2).flatten(1, 2)
    gram = facets.new_tensor(((1.0, -1.0), (-1.0, 1.0)))
    compliance = torch.linalg.inv_ex(stiffness).inverse
    return _assemble(bearing, touch, facets, gram.expand(*load.shape, 2, 2), compliance, limit, transfer, creep)


def polygon_lcp(
    bearing: Bearing, touch: Touch, facets: int, turn: Float[Tensor, " k"] | float = 0.0, *, creep: float
) -> PushLCP:
    """The friction disc as a polygon of equal area.

    Do not differentiate it: without inertia the velocity is a staircase in friction and loads, flat almost everywhere
    (a slope of -0.002 where the true one is -1.26), and no status tells. Use it to compare values only.

    Args:
        bearing, touch: The step; loads must be positive, also with what the finger adds.
        facets: Sides of the polygon.
        turn: Angle by which each support's polygon is turned [rad].
        creep: Velocity of a support under a force of one, > 0.
    """
    points = bearing.points
    turn = torch.as_tensor(turn, dtype=points.dtype).expand(points.shape[1])
    angles = turn[:, None] + torch.arange(facets, dtype=points.dtype) * (2.0 * math.pi / facets)
    normals = torch.stack((angles.cos(), angles.sin()), -1).expand(*points.shape[:2], facets, 2)
    rows = _rows(points[:, :, None], normals).flatten(1, 2)
    axes = torch.eye(2, dtype=points.dtype).expand(*points.shape[:2], 2, 2)
    whole = _rows(points[:, :, None], axes).flatten(1, 2)
    apothem = math.sqrt(math.pi / (facets * math.tan(math.pi / facets)))
    compliance = torch.linalg.inv_ex(whole.mT @ whole).inverse
    return _assemble(
        bearing,
        touch,
        rows,
        normals @ normals.mT,
        compliance,
        apothem * bearing.loads,
        apothem * bearing.transfer,
        creep,
    )


def ellipsoid_lcp(touch: Touch, arm: Float[Tensor, " b"]) -> PushLCP:
    """The friction of the whole table as one ellipsoid of force and torque: fx^2 + fy^2 + (torque / arm)^2 <= 1.

    The twist is normal to it where it slides; its scale is free, as that of the forces is: `force` is known up to a
    factor that puts it onto the ellipsoid.

    Args:
        touch: The step.
        arm: Largest torque over largest force.

    Source: Howe and Cutkosky, "Practical force-motion models for sliding manipulation", 1996.
    """
    compliance = torch.diag_embed(torch.stack((torch.ones_like(arm), torch.ones_like(arm), arm**-2), -1))
    batch = len(arm)
    nothing = arm.new_zeros(batch, 0, 2)
    bearing = Bearing(nothing, nothing[..., 0], nothing, None)
    gram = arm.new_zeros(batch, 0, 1, 1)
    return _assemble(bearing, touch, arm.new_zeros(batch, 0, 3), gram, compliance, nothing[..., 0], nothing, 1.0)


SMALLEST_LOAD = 0.02  # of the largest load of the object at rest


def _assemble(
    bearing: Bearing,
    touch: Touch,
    facets: Float[Tensor, "b m 3"],
    gram: Float[Tensor, "b k m_k m_k"],
    compliance: Float[Tensor, "b 3 3"],
    limit: Float[Tensor, "b k"],
    transfer: Float[Tensor, "b k 2"],
    creep: float,
) -> PushLCP:
    """z = (facets' multipliers, normal force, tangential force + mu * normal force, sliding speed of the finger)."""
    batch, supports, sides, _ = gram.shape
    mu, one = touch.friction, torch.ones_like(touch.friction)
    force = torch.stack((touch.normal - mu[:, None] * touch.tangent, touch.tangent), -1)
    wrench = _rows(touch.point[:, None], force.mT).mT
    seen = _rows(touch.point[:, None], torch.stack((touch.normal, touch.tangent), 1)).mT  # whose velocity counts
    moved = facets @ compliance
    blocks = facets.new_zeros(batch, supports, sides, supports, sides)
    index = torch.arange(supports)
    blocks[:, index, :, index, :] = gram.transpose(0, 1)

    size = supports * sides
    M = facets.new_zeros(batch, size + 3, size + 3)
    M[:, :size, :size] = blocks.flatten(3, 4).flatten(1, 2) - moved @ facets.mT
    M[:, :size, size:-1] = (transfer @ force).repeat_interleave(sides, 1) - moved @ wrench
    M[:, size:-1, :size] = (moved @ seen).mT
    M[:, size:-1, size:-1] = seen.mT @ compliance @ wrench
    M[:, -2, -1] = 1.0
    M[:, -1, size:-1] = torch.stack((2.0 * mu, -one), -1)

    drift = facets.new_zeros(batch, 3)
    if bearing.wrench is not None:
        drift = creep * (compliance @ bearing.wrench[..., None])[..., 0]
    steps = torch.stack((touch.normal_step, touch.tangent_step), -1)
    q = torch.cat(
        (
            creep * limit.repeat_interleave(sides, 1) - (facets @ drift[..., None])[..., 0],
            (seen.mT @ drift[..., None])[..., 0] - steps,
            torch.zeros_like(one)[:, None],
        ),
        -1,
    )
    return PushLCP(M, q, compliance, facets, wrench, force, drift)


def _rows(points: Float[Tensor, "*#b 2"], directions: Float[Tensor, "*#b 2"]) -> Float[Tensor, "*b 3"]:
    """What a twist (vx, vy, omega) moves these points along these directions; also the wrench of unit forces there."""
    torque = points[..., :1] * directions[..., 1:] - points[..., 1:] * directions[..., :1]
    return torch.cat((directions, torque), -1)
