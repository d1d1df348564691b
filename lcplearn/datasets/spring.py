"""Simulated recordings of a block on a spring."""

from typing import Any

import torch

from lcplearn.datasets.simulated import splits
from lcplearn.datasets.task import Task
from lcplearn.domains import NOT_NEGATIVE, check
from lcplearn.scenes.scene import Drive
from lcplearn.scenes.spring_block import SpringBlock


def simulate_spring_block(
    *,
    seed: int = 0,
    trajectories: int = 20,
    length: int = 100,
    long_length: int = 1000,
    dt: float = 0.05,
    mass: float = 1.5,
    stiffness: float = 40.0,
    mu: float = 0.2,
    gravity: float = 9.81,
    noise: float = 0.0,
    initial_stretch: float = 0.3,
    force_std: float = 4.0,
) -> Task:
    """Record a block on a spring that is let go from a stretch and pushed now and then.

    The force is drawn anew from N(0, force_std^2) every ten steps. Mass and gravity are given, stiffness and friction
    coefficient are the truth. test and test_long have no measurement noise.

    Args:
        seed: Seed; the splits draw independently.
        trajectories: Training trajectories; a quarter of that validates, twice that is for the test.
        length: Steps of a trajectory.
        long_length: Steps of the ten long ones.
        dt: Step size [s]; > 0.
        mass: Mass [kg]; > 0.
        stiffness: Of the spring [N/m]; >= 0.
        mu: Friction coefficient; >= 0.
        gravity: Gravitational acceleration [m/s^2].
        noise: Standard deviation of measured positions [m] and velocities [m/s].
        initial_stretch: Standard deviation of the position at the start [m].
        force_std: Standard deviation of the force [N].

    Raises:
        ValueError: An argument is out of range.
    """
    check(NOT_NEGATIVE, noise=noise, initial_stretch=initial_stretch, force_std=force_std)
    block = SpringBlock(mass=mass, mu=mu, stiffness=stiffness, dt=dt, gravity=gravity)
    sizes = {"train": (trajectories, length), "validation": (max(1, trajectories // 4), length)}
    sizes |= {"test": (2 * trajectories, length), "test_long": (10, long_length)}
    recordings: dict[str, Any] = {}
    for split in splits(seed, sizes):
        start = split.normal(2) * torch.tensor([initial_stretch, 0.0], dtype=torch.float64)
        levels = force_std * split.normal(-(-split.steps // 10), 1)
        drive = Drive(levels.repeat_interleave(10, dim=1)[:, : split.steps])
        path = block.rollout(start, drive.force)
        recordings[split.name] = split.recordings(path.states, drive, noise, 2)
    given, truth = {"mass": mass, "gravity": gravity}, {"stiffness": stiffness, "mu": mu}
    return Task("spring_block", block.space, dt, **recordings, given=given, truth=truth, scene=block, positions=True)
