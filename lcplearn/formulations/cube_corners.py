"""A tossed cube whose corners are learned: 24 coordinates from a rough start."""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.formulations.identified import Identified, Number
from lcplearn.scenes.spatial_body import box_corners
from lcplearn.scenes.tossed_cube import TossedCube

# Of the corners of `box_corners`: the six faces of four corners, two for each axis, and the three faces at each corner.
FACES = [[corner for corner in range(8) if (corner >> (2 - axis)) & 1 == side] for axis in range(3) for side in (0, 1)]
MEETING = [[2 * axis + ((corner >> (2 - axis)) & 1) for axis in range(3)] for corner in range(8)]


class CubeCorners(Identified):
    """Learn the corners of a tossed body, sharp ones, and other numbers of `TossedCube`.

    Args:
        dt: Time step [s].
        given: Known numbers, the half width among them: corners start at those of a cube, with noise.
        learn: Starts of the other learned numbers.
        noise: Standard deviation of the noise, over the half width.
        ground: Height of the ground [m], known: where the recorded faces lie.
        seed: Of the noise.
        flat: Whether faces are flat: see `flatten`. With four free corners a face stands on three of them, and the
            body goes on rocking where the recorded one is at rest.
        fixed, clip: As in `Identified`.
    """

    def __init__(
        self,
        *,
        dt: float,
        given: Mapping[str, Any],
        learn: Mapping[str, Number],
        noise: float = 0.3,
        ground: float = 0.0,
        seed: int = 0,
        flat: bool = True,
        fixed: Mapping[str, Any] | None = None,
        clip: float | None = None,
    ) -> None:
        if "half_width" not in given:
            raise ValueError(f"given: expected the half_width of a cube, got {', '.join(given) or 'none'}")
        half_width, generator = given["half_width"], torch.Generator().manual_seed(seed)
        cube = box_corners(torch.full((3,), half_width, dtype=torch.float64))
        start = cube + noise * half_width * torch.randn(8, 3, generator=generator, dtype=torch.float64)
        known, learned = {**given, "ground": ground}, {**learn, "corners": start.tolist()}
        super().__init__(scene=TossedCube, dt=dt, given=known, learn=learned, fixed=fixed, clip=clip)
        self.flat = flat

    def bound(self, free: Mapping[str, Tensor]) -> dict[str, Tensor]:
        numbers = super().bound(free)
        return numbers | {"corners": flatten(numbers["corners"])} if self.flat else numbers


def flatten(corners: Float[Tensor, "*batch 8 3"]) -> Float[Tensor, "*batch 8 3"]:
    """The body with six flat faces whose planes n x = 1 fit the four corners of each face best."""
    faces = corners[..., torch.tensor(FACES), :]
    planes = torch.linalg.solve(faces.mT @ faces, faces.sum(-2))
    meeting = planes[..., torch.tensor(MEETING), :]
    return torch.linalg.solve(meeting, torch.ones_like(meeting[..., 0]))
