"""Simulated recordings: nothing to download, and the truth is known."""

from typing import Any, Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.datasets.simulated import splits
from lcplearn.datasets.task import Task
from lcplearn.domains import NOT_NEGATIVE, SHARE, check
from lcplearn.scenes.falling_block import FallingBlock
from lcplearn.scenes.scene import Drive
from lcplearn.scenes.sliding_block import SlidingBlock
from lcplearn.scenes.space import LINE

FrictionLabels = Literal["physical", "lcp", "slack", "measured_slack"]

_FORCE_PER_LIMIT = 1.2  # standard deviation of the force over mu m g: the block rests 34-60 % of the time


def simulate_sliding_block(
    *,
    seed: int = 0,
    trajectories: int = 20,
    length: int = 100,
    validation_trajectories: int = 10,
    test_trajectories: int = 40,
    test_length: int = 100,
    long_trajectories: int = 20,
    long_length: int = 1000,
    dt: float = 0.05,
    mu: float = 0.4,
    mass: float = 1.5,
    gravity: float = 9.81,
    noise: float = 0.0,
    friction: FrictionLabels | None = None,
    force_std: float | None = None,
    switch_probability: float = 0.1,
    jitter: float = 0.05,
    initial_speed: float = 1.0,
    share_from_rest: float = 0.5,
    share_at_rest: float | None = None,
) -> Task:
    """Record a block pushed to and fro on a table with dry friction.

    v_{k+1} = S(v_k + u_{k+1} dt/m, mu g dt), measured with noise N(0, noise^2).

    The force keeps a level drawn from N(0, force_std^2), changes it with switch_probability at each step, and has
    independent noise of jitter * force_std on top. test and test_long have no measurement noise.

    Args:
        seed: Seed; the splits draw independently, so that the size of one does not change another.
        trajectories: Training trajectories.
        length: Steps of a training or validation trajectory.
        validation_trajectories: Validation trajectories.
        test_trajectories: Trajectories for one-step errors.
        test_length: Steps of each of them.
        long_trajectories: Trajectories for long rollouts.
        long_length: Steps of each of them.
        dt: Step size [s]; > 0.
        mu: Friction coefficient; >= 0.
        mass: Mass [kg]; > 0.
        gravity: Gravitational acceleration [m/s^2].
        noise: Standard deviation of the measured velocity [m/s].
        friction: Kind of friction labels, see `friction_labels`; None for none. Labels are free of noise.
        force_std: Standard deviation of the force level [N]; None for 1.2 mu m g.
        switch_probability: Probability that the force changes its level at a step.
        jitter: Standard deviation of the force around its level, over force_std.
        initial_speed: Standard deviation of the velocity at the start [m/s].
        share_from_rest: Share of the trajectories that start at rest, rounded to whole ones.
        share_at_rest: Share of the time that the training trajectories are to be at rest; sets force_std by
            bisection, as closely as the drawn forces allow. None to leave it to force_std.

    Returns:
        The recordings and the truth; positions start at 0.

    Raises:
        ValueError: An argument is out of range.
    """
    check(NOT_NEGATIVE, noise=noise, force_std=force_std, jitter=jitter, initial_speed=initial_speed)
    check(SHARE, switch_probability=switch_probability, share_from_rest=share_from_rest)
    if friction is not None and friction not in get_args(FrictionLabels):
        raise ValueError(f"friction: expected one of {', '.join(get_args(FrictionLabels))}, got {friction!r}")
    block = SlidingBlock(mass=mass, mu=mu, dt=dt, gravity=gravity)
    sizes = {"train": (trajectories, length), "validation": (validation_trajectories, length)}
    sizes |= {"test": (test_trajectories, test_length), "test_long": (long_trajectories, long_length)}
    recordings: dict[str, Any] = {}
    for split in splits(seed, sizes):
        levels = split.levels(1, switch_probability) + jitter * split.normal(split.steps, 1)
        moving = torch.arange(split.count) >= round(share_from_rest * split.count)
        start = split.normal(1)[:, 0] * initial_speed * moving
        if split.name == "train":  # the first
            std = _force_std(block, start, levels[..., 0], force_std, share_at_rest)
        forces = std * levels
        velocities = _slide(block, start, forces[..., 0])
        labels = None if friction is None else friction_labels(block, velocities[:, :-1], forces[..., 0], friction)
        moved = torch.nn.functional.pad(dt * velocities[:, 1:].cumsum(dim=1), (1, 0))
        states = torch.stack((moved, velocities), dim=-1)
        recordings[split.name] = split.recordings(states, Drive(forces, labels), noise, 1)
    given, truth = {"gravity": gravity}, {"mu": mu, "mass": mass}
    return Task("sliding_block", LINE, dt, **recordings, given=given, truth=truth, scene=block)


def friction_labels(
    block: SlidingBlock, velocity: Float[Tensor, "*#batch"], force: Float[Tensor, "*#batch"], kind: FrictionLabels
) -> Float[Tensor, "... 2"]:
    """Friction of a step in the pairs that a learning problem may take as known.

    With F the physical friction force on the block and lambda-', lambda+' the slacks of the direct LCP:

    physical:        (max(F, 0), max(-F, 0))
    lcp:             (lambda+, lambda-) = (mu m g - lambda+', mu m g - lambda-'), one of them fictitious in motion
    slack:           (lambda-', lambda+')
    measured_slack:  (mu m g - max(-F, 0), mu m g - max(F, 0))

    lcp fits the affine law of `Direct` and slack that of `Slack`; physical and measured_slack are what could be
    measured, and fit neither.

    Args:
        block: The block.
        velocity: Velocity before the step [m/s].
        force: External force [N].
        kind: Which pair.

    Returns:
        The pair [N].

    Source: NOTES 6.2.
    """
    limit = block.mu * block.mass * block.gravity
    if kind in ("lcp", "slack"):
        slack = torch.relu(SlidingBlock(block.mass, block.mu, block.dt, block.gravity).lcp(velocity, force)[1])
        return slack if kind == "slack" else (limit - slack).flip(-1)
    acting = (block.closed_form(velocity, force) - velocity) * block.mass / block.dt - force
    if kind == "physical":
        return torch.stack((torch.relu(acting), torch.relu(-acting)), dim=-1)
    return torch.stack((limit - torch.relu(-acting), limit - torch.relu(acting)), dim=-1)


def simulate_falling_block(
    *,
    seed: int = 0,
    trajectories: int = 40,
    length: int = 50,
    long_length: int = 200,
    dt: float = 0.02,
    mass: float = 1.0,
    gravity: float = 9.81,
    noise: float = 0.0,
    initial_height: float = 1.0,
    initial_speed: float = 1.0,
) -> Task:
    """Record a block dropped onto the ground, where it stays.

    The start is drawn from N(0, initial_speed^2) for the velocity and uniformly up to initial_height for the gap; no
    force acts but gravity and contact, so that gravity is to be found and the mass is given. Only the velocity has
    measurement noise.

    Args:
        seed: Seed; the splits draw independently.
        trajectories: Training trajectories; as many test, a quarter of that validates, half of that is long.
        length: Steps of each but the long ones.
        long_length: Steps of these.
        dt: Step size [s]; > 0.
        mass: Mass [kg]; > 0.
        gravity: Gravitational acceleration [m/s^2].
        noise: Standard deviation of the measured velocity [m/s].
        initial_height: Largest gap at the start [m].
        initial_speed: Standard deviation of the velocity at the start [m/s].

    Returns:
        The recordings and the truth; positions are gaps.

    Raises:
        ValueError: An argument is out of range.
    """
    check(NOT_NEGATIVE, noise=noise, initial_height=initial_height, initial_speed=initial_speed)
    block = FallingBlock(mass=mass, dt=dt, gravity=gravity)
    sizes = {"train": (trajectories, length), "validation": (max(1, trajectories // 4), length)}
    sizes |= {"test": (trajectories, length), "test_long": (max(1, trajectories // 2), long_length)}
    recordings: dict[str, Any] = {}
    for split in splits(seed, sizes):
        start = torch.stack((initial_height * split.uniform(), initial_speed * split.normal()), dim=-1)
        drive = Drive(torch.zeros(split.count, split.steps, 1, dtype=torch.float64))
        path = block.rollout(start, drive.force)
        recordings[split.name] = split.recordings(path.states, drive, noise, 1)
    given, truth = {"mass": mass}, {"gravity": gravity}
    return Task("falling_block", LINE, dt, **recordings, given=given, truth=truth, scene=block, positions=True)


def _slide(block: SlidingBlock, start: Float[Tensor, " N"], forces: Float[Tensor, "N T"]) -> Float[Tensor, "N T+1"]:
    velocities = [start]
    for force in forces.unbind(1):
        velocities.append(block.closed_form(velocities[-1], force))
    return torch.stack(velocities, dim=1)


def _force_std(
    block: SlidingBlock, start: Tensor, levels: Tensor, force_std: float | None, share_at_rest: float | None
) -> float:
    limit = float(block.mu * block.mass * block.gravity)
    if share_at_rest is None:
        if force_std is None and limit == 0:
            raise ValueError("force_std: expected a number [N] where mu is 0, got None")
        return _FORCE_PER_LIMIT * limit if force_std is None else force_std
    if force_std is not None or not 0 < share_at_rest < 1 or limit == 0:
        raise ValueError(
            "share_at_rest: expected between 0 and 1, with mu > 0 and without force_std, "
            f"got {share_at_rest} with mu = {block.mu} and force_std = {force_std}"
        )
    low, high = -3.0, 3.0  # log10(force_std / limit): always at rest in the end, never at rest
    for _ in range(30):
        middle = (low + high) / 2
        at_rest = _slide(block, start, limit * 10**middle * levels)[:, 1:] == 0
        low, high = (middle, high) if at_rest.double().mean() > share_at_rest else (low, middle)
    return limit * 10**low
