"""A tossed cube whose corners are learned: 24 coordinates from a rough start."""

from collections.abc import Mapping
from typing import Any

import torch

from lcplearn.formulations.identified import Identified, Number
from lcplearn.scenes.spatial_body import box_corners
from lcplearn.scenes.tossed_cube import TossedCube


class CubeCorners(Identified):
    """Learn the corners of a tossed body, sharp ones, and other numbers of `TossedCube`.

    Args:
        dt: Time step [s].
        given: Known numbers, the half width among them: corners start at those of a cube, with noise.
        learn: Starts of the other learned numbers.
        noise: Standard deviation of the noise, over the half width.
        ground: Height of the ground [m], known: where the recorded faces lie.
        seed: Of the noise.
        clip: As in `Identified`.
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
        clip: float | None = None,
    ) -> None:
        half_width, generator = given["half_width"], torch.Generator().manual_seed(seed)
        cube = box_corners(torch.full((3,), half_width, dtype=torch.float64))
        start = cube + noise * half_width * torch.randn(8, 3, generator=generator, dtype=torch.float64)
        known = {**given, "ground": ground}
        super().__init__(scene=TossedCube, dt=dt, given=known, learn={**learn, "corners": start.tolist()}, clip=clip)
