"""Simulated recordings of bodies in the plane."""

import math
from typing import Any

import torch

from lcplearn.datasets.recordings import Recordings
from lcplearn.datasets.task import Task
from lcplearn.domains import NOT_NEGATIVE, check
from lcplearn.scenes.planar_block import PlanarBlock
from lcplearn.scenes.planar_body import PlanarBody, rectangle, turned
from lcplearn.scenes.scene import Drive, rollout
from lcplearn.scenes.space import PLANE, TABLE

_SPLITS = ("train", "validation", "test", "test_long")


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

    Raises:
        ValueError: An argument is out of range.
    """
    check(NOT_NEGATIVE, noise=noise)
    block = PlanarBlock(mass=mass, mu=mu, dt=dt, gravity=gravity)
    counts = (trajectories, max(trajectories // 2, 1), test_trajectories, long_trajectories)
    recordings: dict[str, Any] = {}
    for split, (name, count) in enumerate(zip(_SPLITS, counts, strict=True)):
        draw = torch.Generator().manual_seed(len(_SPLITS) * seed + split)
        steps = long_length if name == "test_long" else length
        levels = torch.randn(count, steps, 2, generator=draw, dtype=torch.float64)
        switch = torch.rand(count, steps, generator=draw, dtype=torch.float64) < switch_probability
        switch[:, 0] = True
        last = torch.where(switch, torch.arange(steps), 0).cummax(dim=1).values
        force = 1.2 * mu * mass * gravity * levels.gather(1, last.unsqueeze(-1).expand(-1, -1, 2))
        start = torch.randn(count, 2, generator=draw, dtype=torch.float64)
        start[: count // 2] = 0.0
        path = rollout(block, torch.cat((torch.zeros_like(start), start), dim=-1), Drive(force))
        recordings[name] = _measured(path.positions, path.velocities, Drive(force), noise, name, draw)
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
    corners = rectangle(half_width, half_height)
    body = PlanarBody(
        corners=corners, inertia=inertia, mu=mu, dt=dt, mass=mass, restitution=restitution, gravity=gravity
    )
    counts = (trajectories, max(trajectories // 2, 1), trajectories, trajectories)
    recordings: dict[str, Any] = {}
    for split, (name, count) in enumerate(zip(_SPLITS, counts, strict=True)):
        draw = torch.Generator().manual_seed(len(_SPLITS) * seed + split)
        uniform = torch.rand(count, 2, generator=draw, dtype=torch.float64)
        angle = 2.0 * math.pi * uniform[:, 0]
        low = turned(corners, angle)[..., 1].amin(-1)
        position = torch.stack((torch.zeros(count, dtype=torch.float64), 0.05 * uniform[:, 1] - low, angle), dim=-1)
        velocity = torch.randn(count, 3, generator=draw, dtype=torch.float64) * torch.tensor([1.0, 0.5, 8.0])
        drive = Drive(torch.zeros(count, length, 3, dtype=torch.float64))
        path = rollout(body, torch.cat((position, velocity), dim=-1), drive)
        scale = torch.tensor([1.0, 1.0, 1.0 / half_width], dtype=torch.float64)
        recordings[name] = _measured(path.positions, path.velocities, drive, noise * scale, name, draw)
    given = {"gravity": gravity, "mass": mass, "corners": corners.tolist()}
    truth = {"mu": mu, "inertia": inertia, "restitution": restitution}
    return Task("planar_body", PLANE, dt, **recordings, given=given, truth=truth, scene=body)


def _measured(
    positions: torch.Tensor,
    velocities: torch.Tensor,
    drive: Drive,
    noise: float | torch.Tensor,
    name: str,
    draw: torch.Generator,
) -> Recordings:
    """Recordings whose velocities have noise, except in test and test_long."""
    error = torch.randn(velocities.shape, generator=draw, dtype=torch.float64)
    measured = velocities + (noise if name in ("train", "validation") else 0.0) * error
    steps = torch.full((len(positions),), positions.shape[1] - 1)
    true = torch.cat((positions, velocities), dim=-1)
    return Recordings(torch.cat((positions, measured), dim=-1), drive, steps, true)
