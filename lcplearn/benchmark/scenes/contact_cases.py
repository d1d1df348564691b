"""Bodies in the plane and in space: rows as needed beside those of all corners, the exact cone beside polygons."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lcplearn.benchmark.engines.cases import HALF, MASS
from lcplearn.benchmark.engines.cases import SCENES as STICK_SCENES
from lcplearn.benchmark.harness.measuring import interleave
from lcplearn.benchmark.harness.study import Row
from lcplearn.scenes.planar_block import PlanarBlock
from lcplearn.scenes.planar_body import PlanarBody
from lcplearn.scenes.scene import Drive, Mode
from lcplearn.scenes.space import rotation_matrix
from lcplearn.scenes.spatial_body import SpatialBody, box_corners

MU, DT, RADIUS = 0.4, 0.01, 0.1  # [-], [s], [m] by which spins weigh in a distance of velocities
CURVED = next(scene for scene in STICK_SCENES if scene.name == "slide across a slope")
FACETS = (8, 16, 32)


class Contact(NamedTuple):
    """One way to step a body: rows of a contact, and the scene."""

    rows: int
    scene: Any


class BodyScene(NamedTuple):
    """A body in one or more formulations, and random states of it that touch the ground."""

    formulations: dict[str, Contact]
    states: Callable[[int, int], Tensor]


def _random(count: int, seed: int) -> Callable[..., Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return partial(torch.randn, generator=generator, dtype=torch.float64)


def hexagon_states(count: int, seed: int) -> Tensor:
    """Hexagons that stand on a corner or lie on an edge, slide, fall and spin."""
    normal = _random(count, seed)
    angle = torch.where(torch.arange(count) % 2 == 0, 0.0, normal(count))
    height = -(_turned_heights(_hexagon(), angle)).amin(-1)
    velocity = normal(count, 3) * torch.tensor([0.5, 0.1, 1.0], dtype=torch.float64)
    return torch.cat((torch.stack((0 * angle, height, angle), -1), velocity), -1)


def box_states(count: int, seed: int) -> Tensor:
    """Boxes that lie on a face, an edge or a corner, slide, fall and spin."""
    normal = _random(count, seed)
    kind = torch.arange(count) % 3
    axis = torch.stack((normal(count) * (kind == 2), normal(count) * (kind > 0), 0 * kind), -1)
    angle = axis.norm(dim=-1, keepdim=True)
    half = 0.5 * angle
    quaternion = torch.cat((half.cos(), half.sin() * axis / angle.clamp_min(1e-12)), -1)
    velocity = normal(count, 6) * torch.tensor([0.5, 0.5, 0.1, 1.0, 1.0, 1.0], dtype=torch.float64)
    state = torch.cat((torch.zeros(count, 3, dtype=torch.float64), quaternion, velocity), -1)
    corners = box_corners(torch.tensor(HALF, dtype=torch.float64))
    state[:, 2] = -(corners @ rotation_matrix(quaternion).mT)[..., 2].amin(-1)
    return state


def _hexagon() -> Tensor:
    angles = torch.arange(6, dtype=torch.float64) * (torch.pi / 3)
    return RADIUS * torch.stack((angles.cos(), angles.sin()), -1)


def _turned_heights(corners: Tensor, angle: Tensor) -> Tensor:
    return angle.sin()[:, None] * corners[:, 0] + angle.cos()[:, None] * corners[:, 1]


def body_scenes() -> dict[str, BodyScene]:
    """A hexagon in its plane, whose friction has one direction, and a box in space."""
    corners, inertia = box_corners(torch.tensor(HALF, dtype=torch.float64)), MASS / 3 * (HALF[0] ** 2 + HALF[2] ** 2)
    box = partial(SpatialBody, corners=corners, inertia=inertia, mu=MU, dt=DT, mass=MASS)
    hexagon = PlanarBody(corners=_hexagon(), inertia=0.4 * MASS * RADIUS**2, mu=MU, dt=DT, mass=MASS)
    polygons = {f"polygon of {2 * k}": Contact(2 * k + 2, box(polygon=k)) for k in (2, 4, 8)}
    return {
        "hexagon in its plane": BodyScene({"exact cone": Contact(3, hexagon)}, hexagon_states),
        "box in space": BodyScene({"exact cone": Contact(3, box()), **polygons}, box_states),
    }


@torch.no_grad()
def body_rows(name: str, batch: int, repeats: int, seed: int) -> list[Row]:
    """One step of each formulation on random states, a batch for the time, and at least 1000 for all else.

    Returns:
        formulation; rows that a step needs, in the mean, and full_rows, those of all corners; velocity_difference from
        the exact cone, rms over states [m/s]; step_us, CPU time of one body; solved, the share.
    """
    scene = body_scenes()[name]
    states, many, nothing = scene.states(batch, seed), scene.states(max(batch, 1000), seed), Drive(torch.zeros(()))
    steps = {key: contact.scene.advance for key, contact in scene.formulations.items()}
    space = scene.formulations["exact cone"].scene.space
    drive = nothing._replace(force=torch.zeros(space.nv, dtype=torch.float64))
    found = {key: advance(many, drive) for key, advance in steps.items()}
    timings = interleave({key: partial(advance, states, drive) for key, advance in steps.items()}, repeats)
    rows: list[Row] = []
    for key, (count, own) in scene.formulations.items():
        difference = space.split(found[key].state)[1] - space.split(found["exact cone"].state)[1]
        timing, touching = timings[key], (found[key].mode != int(Mode.SEPARATION)).double().sum(-1).mean()
        solved = found[key].solved
        rows.append({
            "formulation": key,
            "rows": count * float(touching),
            "full_rows": count * own.contacts,
            "velocity_difference": float(space.speed(difference, RADIUS).square().mean().sqrt()),
            "step_us": 1e6 * timing.cpu / batch,
            "solved": 1.0 if solved is None else float(solved.double().mean()),
        })  # fmt: skip
    return rows


@torch.no_grad()
def curve_rows(dt: float, repeats: int) -> list[Row]:
    """A block that slides across a slope and curves to a stop, by the exact disc of friction and by polygons.

    Returns:
        formulation, steps, seconds of a trajectory (CPU time), position_error, the largest at an instant [m],
        end_error [m].
    """
    steps = round(CURVED.duration / dt)
    gravity = CURVED.gravity
    drive = Drive(MASS * torch.tensor(gravity[:2], dtype=torch.float64))
    start = torch.tensor([0.0, 0.0, CURVED.speed, 0.0], dtype=torch.float64)
    block = partial(PlanarBlock, mass=MASS, mu=CURVED.mu, dt=dt, gravity=-gravity[2])
    blocks = {"exact cone": block(), **{f"polygon of {m}": block(form="facets", m=m) for m in FACETS}}

    def roll(scene: PlanarBlock) -> Tensor:
        states = [start]
        for _ in range(steps):
            states.append(scene.advance(states[-1], drive).state)
        return torch.stack(states)

    paths = {name: roll(scene)[:, :2].numpy() for name, scene in blocks.items()}
    timings = interleave({name: partial(roll, scene) for name, scene in blocks.items()}, repeats)
    exact = CURVED.solution(dt * np.arange(steps + 1), CURVED.mu)
    return [
        {
            "formulation": name,
            "steps": steps,
            "seconds": timings[name].cpu,
            "position_error": float(np.linalg.norm(path - exact, axis=-1).max()),
            "end_error": float(np.linalg.norm(path[-1] - exact[-1])),
        }
        for name, path in paths.items()
    ]
