"""Simulated recordings of bodies in the plane."""

import math
from typing import Any, Literal

import torch

from lcplearn.datasets.simulated import splits
from lcplearn.datasets.task import Task
from lcplearn.domains import NOT_NEGATIVE, POSITIVE, SHARE, check
from lcplearn.scenes.planar_block import PlanarBlock
from lcplearn.scenes.planar_body import PlanarBody, rectangle, turned
from lcplearn.scenes.scene import Drive, rollout
from lcplearn.scenes.space import PLANE, TABLE


def simulate_planar_block(
    *,
    seed: int = 0,
    trajectories: int = 20,
    length: int = 100,
    test_trajectories: int = 40,
    long_trajectories: int = 20,
    long_length: int = 1000,
    dt: float = 0.05,
    mu: float = 0.4,
    mass: float = 1.5,
    gravity: float = 9.81,
    noise: float = 0.0,
    switch_probability: float = 0.1,
    friction: Literal["physical"] | None = None,
) -> Task:
    """Record a block pushed about on a table in two directions.

    v_{k+1} = S(v_k + u_{k+1} dt/m, mu g dt). The force keeps a level drawn from N(0, (1.2 mu m g)^2) along each axis
    and changes it with switch_probability at each step; half of the trajectories start at rest. Velocities of train
    and validation are measured with noise; test and test_long are free of it.

    Args:
        seed: Seed; the splits draw independently.
        trajectories: Training trajectories; half as many validate.
        length: Steps of each but test_long's.
        test_trajectories: Trajectories for one-step errors.
        long_trajectories: Trajectories for long rollouts.
        long_length: Steps of each of them.
        dt: Step size [s].
        mu: Friction coefficient.
        mass: [kg].
        gravity: [m/s^2].
        noise: Standard deviation of measured velocities [m/s].
        switch_probability: Probability that the force changes its level at a step.
        friction: "physical" adds the friction force of each step [N], free of noise, for models that need it.

    Raises:
        ValueError: An argument is out of range.
    """
    check(NOT_NEGATIVE, noise=noise)
    check(SHARE, switch_probability=switch_probability)
    if friction not in (None, "physical"):
        raise ValueError(f"friction: expected 'physical' or None, got {friction!r}")
    block = PlanarBlock(mass=mass, mu=mu, dt=dt, gravity=gravity)
    sizes = {"train": (trajectories, length), "validation": (max(trajectories // 2, 1), length)}
    sizes |= {"test": (test_trajectories, length), "test_long": (long_trajectories, long_length)}
    recordings: dict[str, Any] = {}
    for split in splits(seed, sizes):
        drive = Drive(1.2 * mu * mass * gravity * split.levels(2, switch_probability))
        start = split.normal(2)
        start[: split.count // 2] = 0.0
        path = rollout(block, torch.cat((torch.zeros_like(start), start), dim=-1), drive)
        if friction:
            drive = Drive(drive.force, mass * path.velocities.diff(dim=1) / dt - drive.force)
        recordings[split.name] = split.recordings(path.states, drive, noise, 2)
    given, truth = {"gravity": gravity}, {"mu": mu, "mass": mass}
    return Task("planar_block", TABLE, dt, **recordings, given=given, truth=truth, scene=block)


def simulate_planar_body(
    *,
    seed: int = 0,
    trajectories: int = 60,
    length: int = 80,
    dt: float = 0.01,
    mu: float = 0.3,
    inertia: float = 7e-4,
    restitution: float = 0.3,
    mass: float = 0.4,
    half_width: float = 0.06,
    half_height: float = 0.04,
    gravity: float = 9.81,
    noise: float = 0.0,
) -> Task:
    """Record a rectangle tossed onto the ground in its vertical plane.

    Args:
        seed: Seed; the splits draw independently.
        trajectories: Training trajectories; half as many validate, and as many test.
        length: Steps of each.
        dt: Step size [s].
        mu: Friction coefficient.
        inertia: [kg m^2].
        restitution: From 0 to 1.
        mass: [kg].
        half_width: [m].
        half_height: [m].
        gravity: [m/s^2].
        noise: Standard deviation of measured velocities [m/s], over the half width of angular ones [rad/s].

    Raises:
        ValueError: An argument is out of range.
    """
    check(NOT_NEGATIVE, noise=noise)
    check(POSITIVE, half_width=half_width, half_height=half_height)
    corners = rectangle(half_width, half_height)
    body = PlanarBody(
        corners=corners, inertia=inertia, mu=mu, dt=dt, mass=mass, restitution=restitution, gravity=gravity
    )
    sizes = dict.fromkeys(("train", "validation", "test", "test_long"), (trajectories, length))
    sizes["validation"] = (max(trajectories // 2, 1), length)
    scale = torch.tensor([1.0, 1.0, 1.0 / half_width], dtype=torch.float64)
    recordings: dict[str, Any] = {}
    for split in splits(seed, sizes):
        uniform = split.uniform(2)
        angle = 2.0 * math.pi * uniform[:, 0]
        low = turned(corners, angle)[..., 1].amin(-1)
        position = torch.stack((torch.zeros_like(angle), 0.05 * uniform[:, 1] - low, angle), dim=-1)
        velocity = split.normal(3) * torch.tensor([1.0, 0.5, 8.0])
        drive = Drive(torch.zeros(split.count, length, 3, dtype=torch.float64))
        path = rollout(body, torch.cat((position, velocity), dim=-1), drive)
        recordings[split.name] = split.recordings(path.states, drive, noise * scale, 3)
    given = {"gravity": gravity, "mass": mass, "corners": corners.tolist()}
    truth = {"mu": mu, "inertia": inertia, "restitution": restitution}
    return Task("planar_body", PLANE, dt, **recordings, given=given, truth=truth, scene=body, positions=True)
