"""Which mode comes next? A Markov chain over stick, slip and separation against models that know the forces."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lcplearn.scenes import Mode, slide

MODES = len(Mode)


class ModeData(NamedTuple):
    """Recordings of a block on which a normal force changes too.

    Attributes:
        velocity: [N, T + 1], [m/s].
        force, support: Force along the table and the table's support, of each step [N]; [N, T].
        mode: `Mode` of each step, [N, T].
    """

    velocity: Tensor
    force: Tensor
    support: Tensor
    mode: Tensor


class Score(NamedTuple):
    """Share of steps whose mode was foretold: of all, and of those where it changes; NaN where there are none."""

    everywhere: float
    at_changes: float


def chain(modes: Int[Tensor, "N T"], order: int) -> Float[Tensor, "..."]:
    """Fit P(mode | the last `order` modes), maximum likelihood.

    Args:
        modes: Observed modes.
        order: 0, 1 or 2.

    Returns:
        Probabilities, [MODES] * (order + 1); histories that never occurred are uniform.

    Source: Pfrommer, LCP Notes (2019), section 4.
    """
    columns = [modes[:, order - k : modes.shape[1] - k] for k in range(order, -1, -1)]
    index = sum(column * MODES ** (order - i) for i, column in enumerate(columns))
    counts = torch.bincount(torch.as_tensor(index).reshape(-1), minlength=MODES ** (order + 1)).double()
    counts = counts.reshape([MODES] * (order + 1))
    total = counts.sum(-1, keepdim=True)
    return torch.where(total > 0, counts / total, 1.0 / MODES)


def foretell(probabilities: Float[Tensor, "..."], modes: Int[Tensor, "N T"]) -> Int[Tensor, "N T_minus_order"]:
    """The most probable mode of each step but the first `order`, from the modes before it."""
    order = probabilities.ndim - 1
    best = probabilities.argmax(-1)
    if order == 0:
        return best.expand_as(modes)
    return best[tuple(modes[:, order - k : modes.shape[1] - k] for k in range(order, 0, -1))]


def entropy(modes: Int[Tensor, "N T"], order: int) -> float:
    """H(mode | the last `order` modes) [bits]: what stays unknown about the next mode."""
    conditional = chain(modes, order)
    steps = modes.shape[1] - order
    columns = [modes[:, order - k : modes.shape[1] - k] for k in range(order, -1, -1)]
    probability = conditional[tuple(columns)]
    return float(-probability.log2().sum() / (len(modes) * steps))


def score(predicted: Int[Tensor, "N S"], modes: Int[Tensor, "N T"]) -> Score:
    """Compare predictions of the last S steps with what happened."""
    actual = modes[:, modes.shape[1] - predicted.shape[1] :]
    right = predicted == actual
    changes = torch.zeros_like(modes, dtype=torch.bool)
    changes[:, 1:] = modes[:, 1:] != modes[:, :-1]
    changes = changes[:, modes.shape[1] - predicted.shape[1] :]
    share = float(right[changes].double().mean()) if changes.any() else float("nan")
    return Score(float(right.double().mean()), share)


def simulate_modes(
    *, seed: int, count: int, steps: int, mass: float = 1.5, mu: float = 0.4, dt: float = 0.05, gravity: float = 9.81
) -> ModeData:
    """A block pushed along a table and pulled off it at random.

    Both forces keep a level and change it with probability 0.08 a step. The pull lifts the block 14 % of the time;
    without support it moves without friction (SEPARATION).

    Args:
        seed: Seed.
        count: Trajectories.
        steps: Steps of each.
        mass: Mass [kg].
        mu: Friction coefficient.
        dt: Step size [s].
        gravity: Gravitational acceleration [m/s^2].

    Returns:
        The recordings, free of noise.
    """
    generator = torch.Generator().manual_seed(seed)

    def levels(std: float) -> Tensor:
        level = std * torch.randn(count, steps, generator=generator, dtype=torch.float64)
        switch = torch.rand(count, steps, generator=generator, dtype=torch.float64) < 0.08
        switch[:, 0] = True
        return level.gather(1, torch.where(switch, torch.arange(steps), 0).cummax(dim=1).values)

    weight = mass * gravity
    support = torch.relu(weight + levels(weight / 1.08))  # P(N(0, 1) < -1.08) = 0.14
    force = levels(1.0 * mu * weight)
    velocity = [torch.zeros(count, dtype=torch.float64)]
    for k in range(steps):
        p = velocity[-1] + dt * force[:, k] / mass
        velocity.append(slide(p, mu * dt * support[:, k] / mass))
    velocities = torch.stack(velocity, dim=1)
    mode = torch.where(velocities[:, 1:] == 0, int(Mode.STICK), int(Mode.SLIP))
    mode = torch.where(support == 0, int(Mode.SEPARATION), mode)
    return ModeData(velocities, force, support, mode)


def modes_from_forces(data: ModeData, *, mass: float, mu: float, dt: float) -> Int[Tensor, "N T"]:
    """The mode that the friction LCP gives each step, from velocity and forces and a (learned) mass and mu."""
    p = data.velocity[:, :-1] + dt * data.force / mass
    after = slide(p, mu * dt * data.support / mass)
    mode = torch.where(after == 0, int(Mode.STICK), int(Mode.SLIP))
    return torch.where(data.support == 0, int(Mode.SEPARATION), mode)
