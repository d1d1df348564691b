"""Scenes in the formulations that can step them, and the motions whose exact solution is known."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.benchmark.problems.families import stewart_trinkle
from lcplearn.lcp.solve import solve_lcp
from lcplearn.scenes import BouncingBlock, FallingBlock, Mode, OneWayBlock, SlidingBlock
from lcplearn.scenes.scene import Drive, Moving
from lcplearn.scenes.scene import Step as SceneStep
from lcplearn.scenes.space import LINE, Space

MASS, MU, GRAVITY, RESTITUTION = 1.5, 0.4, 9.81, 0.5
SPEED, HEIGHT, DURATION = 2.0, 1.0, 1.0  # [m/s], [m], [s]: slides 0.51 m to rest in 0.51 s; lands after 0.45 s

State = Float[Tensor, "B 2"]
Step = Callable[[State], State]


def _full_matrix() -> Tensor:
    """M of the LCP that does not look at what a scene needs: normal, two friction directions, slip speed."""
    up, along = np.array([[[1.0, 0.0]]]), np.array([[[0.0, 1.0], [0.0, -1.0]]])
    problem = stewart_trinkle(np.eye(2)[None] / MASS, up, along, np.array([[MU]]), np.zeros((1, 2)))
    return torch.from_numpy(problem.M[0])


FULL = _full_matrix()


def full_velocity(normal: Float[Tensor, " B"], sideways: Float[Tensor, " B"]) -> tuple[Tensor, Tensor]:
    """Change of the normal velocity by contact, and the velocity along the ground after the step [m/s].

    normal is the velocity with which the gap would open, v_n + gap / dt (or v_n + e v_n before), sideways that along
    the ground without friction. Like `SlidingBlock`'s traditional form, the latter is held to |v| <= gamma, so that
    sticking is exact.
    """
    z = solve_lcp(FULL, torch.stack((normal, sideways, -sideways, torch.zeros_like(normal)), dim=-1)).z
    slip = sideways + (z[..., 1] - z[..., 2]) / MASS
    return z[..., 0] / MASS, torch.minimum(torch.maximum(slip, -z[..., 3]), z[..., 3])


class Formulation(NamedTuple):
    """One way to step a scene: rows of its LCP (0: closed form), and dt -> step(state) -> state without force."""

    rows: int
    build: Callable[[float], Step]


def _stepper(make: Callable[[float], Any]) -> Callable[[float], Step]:
    def build(dt: float) -> Step:
        scene, none = make(dt), torch.zeros(1, dtype=torch.float64)
        return lambda state: scene.step(state, none)

    return build


@dataclass(frozen=True)
class _FullBlock(Moving):
    """A block that the full LCP moves, with what a scene does besides: without it the full LCP would seem faster."""

    space: ClassVar[Space] = LINE
    contacts: ClassVar[int] = 1

    move: Callable[[State, float], State]
    dt: float

    def advance(self, state: Tensor, drive: Drive) -> SceneStep:
        state = self.move(state, self.dt)
        mode = torch.where(state[..., 1] == 0, int(Mode.STICK), int(Mode.SLIP))
        return SceneStep(state, mode.unsqueeze(-1))


def _full(move: Callable[[State, float], State]) -> Formulation:
    return Formulation(len(FULL), _stepper(lambda dt: _FullBlock(move, dt)))


def _sliding(form: str) -> Callable[[float], Step]:
    return _stepper(lambda dt: SlidingBlock(mass=MASS, mu=MU, dt=dt, form=form))  # type: ignore[arg-type]


def _slide_closed(make: Callable[[float], Any]) -> Callable[[float], Step]:
    def build(dt: float) -> Step:
        block = make(dt)

        def step(state: State) -> State:
            velocity = block.closed_form(state[:, 1], torch.zeros_like(state[:, 1]))
            return torch.stack((state[:, 0] + dt * velocity, velocity), dim=-1)

        return step

    return build


def _slide_full(state: State, dt: float) -> State:
    down = torch.full_like(state[:, 1], -GRAVITY * dt)  # rests on the ground, gap 0
    _, velocity = full_velocity(down, state[:, 1])
    return torch.stack((state[:, 0] + dt * velocity, velocity), dim=-1)


def _fall_closed(dt: float) -> Step:
    block = FallingBlock(mass=MASS, dt=dt)

    def step(state: State) -> State:
        gap = block.closed_form(state[:, 0], state[:, 1], torch.zeros_like(state[:, 0]))
        velocity = torch.where(gap > 0, state[:, 1] - GRAVITY * dt, (gap - state[:, 0]) / dt)
        return torch.stack((gap, velocity), dim=-1)

    return step


def _fall_full(state: State, dt: float) -> State:
    gap, velocity = state.unbind(-1)
    free = velocity - GRAVITY * dt
    change, _ = full_velocity(free + gap / dt, torch.zeros_like(gap))
    return torch.stack((gap + dt * (free + change), free + change), dim=-1)


def _bounce_closed(dt: float) -> Step:
    def step(state: State) -> State:
        gap, velocity = state.unbind(-1)
        free = velocity - GRAVITY * dt
        touches = (gap + dt * velocity <= 0) & (free < -RESTITUTION * velocity)
        after = torch.where(touches, -RESTITUTION * velocity, free)
        return torch.stack((gap + dt * after, after), dim=-1)

    return step


def _bounce_full(state: State, dt: float) -> State:
    gap, velocity = state.unbind(-1)
    free = velocity - GRAVITY * dt
    change, _ = full_velocity(free + RESTITUTION * velocity, torch.zeros_like(gap))
    after = free + torch.where(gap + dt * velocity <= 0, change, 0.0)
    return torch.stack((gap + dt * after, after), dim=-1)


SCENES: dict[str, dict[str, Formulation]] = {
    "sliding block": {
        "closed form": Formulation(0, _slide_closed(lambda dt: SlidingBlock(mass=MASS, mu=MU, dt=dt))),
        "direct": Formulation(2, _sliding("direct")),
        "physical slack": Formulation(2, _sliding("physical")),
        "traditional": Formulation(3, _sliding("traditional")),
        "full": _full(_slide_full),
    },
    "one-way block": {
        "closed form": Formulation(0, _slide_closed(lambda dt: OneWayBlock(mass=MASS, mu=MU, dt=dt))),
        "direct": Formulation(1, _stepper(lambda dt: OneWayBlock(mass=MASS, mu=MU, dt=dt))),
        "full": _full(_slide_full),
    },
    "falling block": {
        "closed form": Formulation(0, _fall_closed),
        "direct": Formulation(1, _stepper(lambda dt: FallingBlock(mass=MASS, dt=dt))),
        "full": _full(_fall_full),
    },
    "bouncing block": {
        "closed form": Formulation(0, _bounce_closed),
        "direct": Formulation(1, _stepper(lambda dt: BouncingBlock(mass=MASS, restitution=RESTITUTION, dt=dt))),
        "full": _full(_bounce_full),
    },
}


def random_states(scene: str, count: int, seed: int) -> State:
    """States of a scene that its scene-minimal LCP covers, at rest and at kinks among them."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(count, generator=generator, dtype=torch.float64)
    v = torch.randn(count, generator=generator, dtype=torch.float64)
    if scene in ("falling block", "bouncing block"):
        touches = torch.arange(count) % 3 == 0
        return torch.stack((torch.where(touches, 0.0, 0.02 * x), v * (torch.arange(count) % 4 > 0)), dim=-1)
    if scene == "one-way block":  # nothing pushes it backwards (NOTES.md, section 5.3)
        v = v.abs()
    slow = torch.where(torch.arange(count) % 2 == 0, 0.05, 1.0)
    return torch.stack((x, v * slow * (torch.arange(count) % 5 > 0)), dim=-1)


def start(scene: str) -> State:
    """Start of the motion whose exact solution is known: sliding at 2 m/s, or dropped from 1 m."""
    row = [HEIGHT, 0.0] if scene in ("falling block", "bouncing block") else [0.0, SPEED]
    return torch.tensor([row], dtype=torch.float64)


def exact(scene: str, time: Float[Tensor, " T"]) -> tuple[Float[Tensor, " T"], Float[Tensor, " T"]]:
    """Exact position [m] and velocity [m/s] at some times of at most 1 s."""
    if scene in ("falling block", "bouncing block"):
        landing = (2 * HEIGHT / GRAVITY) ** 0.5
        rebound = RESTITUTION * GRAVITY * landing if scene == "bouncing block" else 0.0
        x, v = HEIGHT - 0.5 * GRAVITY * time**2, -GRAVITY * time
        begin = landing
        while rebound > 1e-3:  # later bounces are below a micrometre
            after = time - begin
            up = after >= 0
            x = torch.where(up, rebound * after - 0.5 * GRAVITY * after**2, x)
            v = torch.where(up, rebound - GRAVITY * after, v)
            begin, rebound = begin + 2 * rebound / GRAVITY, RESTITUTION * rebound
        rests = time >= begin
        return torch.where(rests, 0.0, x), torch.where(rests, 0.0, v)
    deceleration = MU * GRAVITY
    moving = torch.clamp(time, max=SPEED / deceleration)
    return SPEED * moving - 0.5 * deceleration * moving**2, SPEED - deceleration * moving


def energy(scene: str, x: Tensor, v: Tensor) -> Tensor:
    """Kinetic and, off the ground, potential energy [J]."""
    height = x if scene in ("falling block", "bouncing block") else torch.zeros_like(x)
    return MASS * (0.5 * v**2 + GRAVITY * height)
