"""What tells one push from another, for functions that are learned over pushes."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.formulations.pushing.push_model import RADIUS
from lcplearn.scenes.pushed_object import PushedObject, rotate
from lcplearn.scenes.pushes import Pushes


class Features(NamedTuple):
    """What is known of a push; lengths in units of RADIUS, axes of the object where not said otherwise.

    Attributes:
        body: First contact, from the centre of mass.
        direction: Of the finger.
        world: Centre of mass in the world.
        heading: Cosine and sine of the object's angle in the world.
        edge: Number of the edge.
        geometry: The support points, sorted; -1 where the whole face bears.
        surface: Number of the surface.
    """

    body: Float[Tensor, "b 2"]
    direction: Float[Tensor, "b 2"]
    world: Float[Tensor, "b 2"]
    heading: Float[Tensor, "b 2"]
    edge: Float[Tensor, "b 1"]
    geometry: Float[Tensor, "b 6"]
    surface: Float[Tensor, "b 1"]


WIDTHS = (2, 2, 2, 2, 1, 6, 1)


def features(pushes: Pushes, thing: PushedObject, surface: Tensor | None = None) -> Features:
    """Of all pushes of an object; `surface` numbers the surfaces, all the same by default."""
    push, angle = pushes.push, pushes.push.pose[:, 2]
    contact = push.start + thing.first_touch(push)[:, None] * (push.end - push.start)
    body = rotate(-angle, contact - push.pose[:, :2])
    direction = rotate(-angle, push.end - push.start)
    centre = push.pose[:, :2] + rotate(angle, thing.com)
    corners = pushes.points.nan_to_num(-1.0)
    order = (1e4 * corners[..., 0] + corners[..., 1]).argsort(-1)
    number = torch.zeros_like(angle) if surface is None else surface.to(angle.dtype)
    return Features(
        (body - thing.com) / RADIUS,
        direction / direction.norm(dim=-1, keepdim=True).clamp_min(1e-12),  # a finger that rests has none
        centre / RADIUS,
        torch.stack((angle.cos(), angle.sin()), -1),
        thing.outside(body).argmax(-1, keepdim=True).to(angle.dtype),
        corners.gather(1, order[..., None].expand(-1, -1, 2)).flatten(1),
        number[:, None],
    )


def near(a: Tensor, b: Tensor, length: Tensor | float) -> Tensor:
    """Gaussian kernel of two sets of vectors."""
    return (-0.5 * (a[:, None] - b).square().sum(-1) / length**2).exp()


def same(a: Tensor, b: Tensor) -> Tensor:
    """Whether two vectors are equal, as 0 or 1."""
    return ((a[:, None] - b).abs() < 1e-6).all(-1).to(torch.float64)
