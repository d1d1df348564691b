"""What all simulated recordings share: splits that draw independently, forces that hold a level, measurement noise."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Generator, Tensor
from torch.nn.functional import pad

from lcplearn.datasets.recordings import Recordings
from lcplearn.scenes.scene import Drive


@dataclass(frozen=True)
class Split:
    """One part of the recordings, to be drawn.

    Attributes:
        name: "train", "validation", "test" or "test_long".
        count: Number of trajectories.
        steps: Steps of each.
        generator: Its own: the size of one part does not change another.
    """

    name: str
    count: int
    steps: int
    generator: Generator

    def normal(self, *shape: int) -> Float[Tensor, "N ..."]:
        """Draw from N(0, 1) for each trajectory."""
        return torch.randn(self.count, *shape, generator=self.generator, dtype=torch.float64)

    def uniform(self, *shape: int) -> Float[Tensor, "N ..."]:
        """Draw uniformly from 0 to 1 for each trajectory."""
        return torch.rand(self.count, *shape, generator=self.generator, dtype=torch.float64)

    def levels(self, axes: int, switch_probability: float) -> Float[Tensor, "N T axes"]:
        """Levels from N(0, 1) that are held, and drawn anew with some probability at each step."""
        levels = self.normal(self.steps, axes)
        switch = self.uniform(self.steps) < switch_probability
        switch[:, 0] = True
        # each step takes the level drawn at the last switch before it
        last = torch.where(switch, torch.arange(self.steps), 0).cummax(dim=1).values
        return levels.gather(1, last.unsqueeze(-1).expand(-1, -1, axes))

    def recordings(
        self, states: Float[Tensor, "N instants columns"], drive: Drive, noise: float | Tensor, noisy: int
    ) -> Recordings:
        """Measure the last `noisy` columns of the states with noise, except in test and test_long."""
        error = noise * self.normal(self.steps + 1, noisy)
        exact = self.name.startswith("test")
        measured = states if exact else states + pad(error, (states.shape[-1] - noisy, 0))
        return Recordings(measured, drive, torch.full((self.count,), self.steps), states)


def splits(seed: int, sizes: dict[str, tuple[int, int]]) -> Iterator[Split]:
    """The parts of a data set, by name with trajectories and steps of each.

    Raises:
        ValueError: A part is empty.
    """
    for number, (name, (count, steps)) in enumerate(sizes.items()):
        if count < 1 or steps < 1:
            raise ValueError(f"{name}: expected at least 1 trajectory of 1 step, got {count} of {steps}")
        yield Split(name, count, steps, torch.Generator().manual_seed(len(sizes) * seed + number))
