"""Does a block that should stick still stick when its LCP is perturbed? From the LCP Notes (2019), 3.2."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from lcplearn.lcp.solve import solve_lcp
from lcplearn.scenes import SlidingBlock, slide
from lcplearn.scenes.scene import STICK_SPEED

BLOCK = SlidingBlock(mass=1.0, mu=0.4, dt=1.0)
LIMIT = 0.4 * 9.81  # [N] largest friction force of BLOCK
NEARLY = 1e-3  # [m/s] a block slower than this looks at rest
SIGMAS = tuple(10.0**k for k in range(-8, 0))
PUSHES = ("u = 0", "u != 0")
TRADITIONAL_ENTRIES = ("M11", "M12", "M13", "M21", "M22", "M23", "M31", "M32", "M33", "q1", "q2", "q3")


class Outcome(NamedTuple):
    """Velocity after the step [m/s] of N perturbed blocks, and whether their LCPs were solved."""

    velocity: Float[Tensor, " N"]
    solved: Tensor


Form = Callable[[Generator, Tensor, float, str], Outcome]


def perturb(generator: Generator, values: Float[Tensor, "N k"], sigma: float, entries: str) -> Float[Tensor, "N k"]:
    """Add N(0, sigma^2) to all entries of each sample, to one of them at random, or to the one of a given number.

    Args:
        generator: Source of the noise.
        values: The entries of each sample.
        sigma: Standard deviation of the noise, in the units of each entry.
        entries: "all", "one", or the number of an entry.

    Returns:
        The perturbed entries.
    """
    noise = sigma * torch.randn(values.shape, generator=generator, dtype=values.dtype)
    if entries == "all":
        return values + noise
    chosen = torch.randint(values.shape[-1], values.shape[:1], generator=generator)
    if entries != "one":
        chosen = torch.full_like(chosen, int(entries))
    return values + noise * torch.nn.functional.one_hot(chosen, values.shape[-1])


def _perturbed_lcp(
    generator: Generator, M: Tensor, q: Tensor, sigma: float, entries: str
) -> tuple[Float[Tensor, "N n n"], Float[Tensor, "N n"]]:
    count, n = q.shape
    values = torch.cat((M.expand(count, n, n).reshape(count, n * n), q), dim=-1)
    values = perturb(generator, values, sigma, entries)
    return values[:, : n * n].reshape(count, n, n), values[:, n * n :]


def _traditional(generator: Generator, force: Tensor, sigma: float, entries: str) -> tuple[Any, Tensor]:
    block = SlidingBlock(BLOCK.mass, BLOCK.mu, BLOCK.dt, form="traditional")
    solution = solve_lcp(*_perturbed_lcp(generator, *block.lcp(torch.zeros_like(force), force), sigma, entries))
    return solution, force + solution.z[:, 0] - solution.z[:, 1]


def traditional(generator: Generator, force: Tensor, sigma: float, entries: str) -> Outcome:
    """Velocity from the friction forces, v = p + lambda+ - lambda-: they must balance p exactly."""
    solution, velocity = _traditional(generator, force, sigma, entries)
    return Outcome(velocity, solution.solved)


def traditional_bounded(generator: Generator, force: Tensor, sigma: float, entries: str) -> Outcome:
    """The same, held to |v| <= gamma as `SlidingBlock` reads it."""
    solution, velocity = _traditional(generator, force, sigma, entries)
    gamma = solution.z[:, 2]
    return Outcome(torch.minimum(torch.maximum(velocity, -gamma), gamma), solution.solved)


def _slack_parts(force: Tensor) -> tuple[Tensor, Tensor]:
    """f(v, u) = (p - c, -p - c) and G = I: the slack form (NOTES.md, section 6.2)."""
    return torch.stack((force - LIMIT, -force - LIMIT), dim=-1), torch.eye(2, dtype=force.dtype)


def slack_affine(generator: Generator, force: Tensor, sigma: float, entries: str) -> Outcome:
    """(v+, v-) = f + G lambda' with the true slack friction known."""
    f, G = _slack_parts(force)
    slack = torch.stack((LIMIT - force, LIMIT + force), dim=-1)
    G, f = _perturbed_lcp(generator, G, f, sigma, entries)
    parts = f + (G @ slack.unsqueeze(-1)).squeeze(-1)
    return Outcome(parts[:, 0] - parts[:, 1], torch.ones_like(force, dtype=torch.bool))


def slack_relu(generator: Generator, force: Tensor, sigma: float, entries: str) -> Outcome:
    """The same with negative parts cut off."""
    f, G = _slack_parts(force)
    slack = torch.stack((LIMIT - force, LIMIT + force), dim=-1)
    G, f = _perturbed_lcp(generator, G, f, sigma, entries)
    parts = torch.relu(f + (G @ slack.unsqueeze(-1)).squeeze(-1))
    return Outcome(parts[:, 0] - parts[:, 1], torch.ones_like(force, dtype=torch.bool))


def slack(generator: Generator, force: Tensor, sigma: float, entries: str) -> Outcome:
    """0 <= lambda' ⟂ f + G lambda' >= 0, the velocity from w: slack as its own LCP."""
    f, G = _slack_parts(force)
    solution = solve_lcp(*_perturbed_lcp(generator, G, f, sigma, entries))
    return Outcome(solution.w[:, 0] - solution.w[:, 1], solution.solved)


def direct(generator: Generator, force: Tensor, sigma: float, entries: str) -> Outcome:
    """0 <= (v+, v-) ⟂ M (v+, v-) + q >= 0, the velocity from z."""
    solution = solve_lcp(*_perturbed_lcp(generator, *BLOCK.lcp(torch.zeros_like(force), force), sigma, entries))
    return Outcome(solution.z[:, 0] - solution.z[:, 1], solution.solved)


def structured(generator: Generator, force: Tensor, sigma: float, entries: str) -> Outcome:
    """v = S(b, a c) with noise on b, a and c only: the zeros and ones of the friction LCP are kept."""
    values = torch.stack((force, torch.ones_like(force), torch.full_like(force, LIMIT)), dim=-1)
    b, a, c = perturb(generator, values, sigma, entries).unbind(-1)
    return Outcome(slide(b, a * c), torch.ones_like(force, dtype=torch.bool))


FORMS: dict[str, Form] = {
    "traditional": traditional,
    "traditional, |v| <= gamma": traditional_bounded,
    "slack, known": slack_affine,
    "slack + relu": slack_relu,
    "slack": slack,
    "direct": direct,
    "structured": structured,
}


def stick_share(form: str, push: str, entries: str, sigma: float, *, samples: int, seed: int) -> dict[str, float]:
    """Share of blocks that stick although their LCP is perturbed; without noise all of them do.

    A block of 1 kg at rest, mu = 0.4, dt = 1 s, pushed with 0.1 to 0.9 of what friction can hold (or not at all).

    Args:
        form: One of `FORMS`.
        push: "u = 0" or "u != 0".
        entries: What is perturbed: "all", "one" (at random) or the number of an entry.
        sigma: Standard deviation of the noise; entries of M and q are of size 1 to 4.
        samples: Number of blocks.
        seed: Seed of pushes and noise.

    Returns:
        Shares: sticks (|v| < 1e-12 m/s), nearly_sticks (|v| < 1e-3 m/s), solved.

    Source: Pfrommer, LCP Notes (2019), section 3.2; NOTES.md, section 8.
    """
    generator = torch.Generator().manual_seed(seed)
    size = 0.1 + 0.8 * torch.rand(samples, generator=generator, dtype=torch.float64)
    sign = torch.randint(2, (samples,), generator=generator) * 2 - 1
    force = LIMIT * size * sign if push == "u != 0" else torch.zeros_like(size)
    velocity, solved = FORMS[form](generator, force, sigma, entries)
    speed = torch.where(solved, velocity.abs(), torch.inf)
    return {
        "sticks": float((speed < STICK_SPEED).double().mean()),
        "nearly_sticks": float((speed < NEARLY).double().mean()),
        "solved": float(solved.double().mean()),
    }


def plan(sigmas: tuple[float, ...] = SIGMAS) -> Iterator[tuple[str, str, str, float]]:
    """(form, push, entries, sigma) of the whole study; single named entries for the traditional form."""
    for push in PUSHES:
        for form in FORMS:
            for entries in ("one", "all"):
                yield from ((form, push, entries, sigma) for sigma in sigmas)
        for entry in range(len(TRADITIONAL_ENTRIES)):
            yield "traditional", push, str(entry), sigmas[len(sigmas) // 2]
