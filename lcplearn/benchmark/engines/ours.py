"""The scenes in lcplearn, twice: with the rows that each needs, and as the rigid boxes that engines make of them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lcplearn.benchmark.engines.cases import (
    ARM,
    DROP,
    FINGER_MASS,
    HALF,
    HEIGHT,
    MASS,
    RESTITUTION,
    TILT,
    UPPER,
    StickScene,
)
from lcplearn.benchmark.engines.engine import Path
from lcplearn.scenes import BouncingBlock, SlidingBlock
from lcplearn.scenes.contact import Contacts, contact_step
from lcplearn.scenes.planar_block import PlanarBlock
from lcplearn.scenes.planar_body import PlanarBody, PlanarStack, rectangle
from lcplearn.scenes.scene import Drive, Step, rollout
from lcplearn.scenes.space import Space, rotation_matrix
from lcplearn.scenes.spatial_body import SpatialBody, box_corners

GRAVITY = 9.81  # [m/s^2]
_X, _Y, _Z = HALF
INERTIA = (MASS / 3 * (_Y**2 + _Z**2), MASS / 3 * (_X**2 + _Z**2), MASS / 3 * (_X**2 + _Y**2))  # [kg m^2]
LIFT = DROP + _X * float(np.sin(TILT)) + _Z * float(np.cos(TILT))  # [m] height of a tilted box


class Reading(NamedTuple):
    """Position [n, 3] [m], energy [n] [J] and overlap [n] [m] of states [n, ..]."""

    position: Tensor
    energy: Tensor
    depth: Tensor


class Setup(NamedTuple):
    """A scene of ours: how to make it for a mu, where it starts, what acts, how to read it.

    Attributes:
        make: mu to the scene.
        start: State.
        force: What always acts [nv].
        push: What a push of 1 N adds to it [nv].
        read: Reads states.
    """

    make: Callable[[Any], Any]
    start: Tensor
    force: Tensor
    push: Tensor
    read: Callable[[Tensor], Reading]


def minimal(scene: StickScene, dt: float) -> Setup | None:
    """What the scene needs and no more."""
    build = {"wall": _wall, "pinch": _pinch, "stack": _stack, "edge": _edge, "joint": _joint, "ball": _ball}
    return build.get(scene.kind, _block)(scene, dt)


def body(scene: StickScene, dt: float) -> Setup | None:
    """A box with eight corners in space; None for scenes that have more than one body or no ground."""
    if scene.kind not in ("block", "edge"):
        return None
    corners, gravity = box_corners(_row(*HALF)), _row(*scene.gravity)
    tilt, height = (TILT, LIFT) if scene.kind == "edge" else (0.0, _Z)
    quaternion = (float(np.cos(tilt / 2)), 0.0, -float(np.sin(tilt / 2)), 0.0)
    start = _row(0.0, 0.0, height, *quaternion, scene.speed, 0.0, 0.0, 0.0, 0.0, 0.0)

    def read(states: Tensor) -> Reading:
        position, v, w = states[:, :3], states[:, 7:10], states[:, 10:]
        kinetic = 0.5 * (MASS * v * v + _row(*INERTIA) * w * w).sum(-1)
        lowest = (corners @ rotation_matrix(states[:, 3:7]).mT)[..., 2].amin(-1) + position[:, 2]
        return Reading(position - start[:3], kinetic - MASS * position @ gravity, torch.relu(-lowest))

    def make(mu: Any) -> SpatialBody:
        return SpatialBody(
            corners=corners, inertia=(INERTIA[0], INERTIA[1], INERTIA[2]), mu=mu, dt=dt, mass=MASS, gravity=gravity
        )

    return Setup(make, start, torch.zeros(6, dtype=torch.float64), _row(1, 0, 0, 0, 0, 0), read)


def _row(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _block(scene: StickScene, dt: float) -> Setup:
    """A point mass on a table: its closed form."""
    gx, gy, gz = scene.gravity
    force = MASS * _row(gx, gy)

    def read(states: Tensor) -> Reading:
        zero = torch.zeros_like(states[:, :1])
        energy = 0.5 * MASS * states[:, 2:].square().sum(-1) - states[:, :2] @ force
        return Reading(torch.cat((states[:, :2], zero), -1), energy, zero[:, 0])

    return Setup(lambda mu: PlanarBlock(mass=MASS, mu=mu, dt=dt, gravity=-gz), _row(0.0, 0.0, scene.speed, 0.0),
                 force, _row(1.0, 0.0), read)  # fmt: skip


def _wall(scene: StickScene, dt: float) -> Setup:
    """x and z of a block that is pressed to a wall."""
    normal, tangents, mass = _row(1.0, 0.0)[None], _row(0.0, 1.0)[None, None], _row(MASS, MASS)

    def read(states: Tensor) -> Reading:
        x, z, vx, vz = states.unbind(-1)
        energy = MASS * (0.5 * (vx * vx + vz * vz) + GRAVITY * z)
        return Reading(torch.stack((x, torch.zeros_like(x), z), -1), energy, torch.relu(-x))

    weight = _row(0.0, -MASS * GRAVITY)
    return Setup(lambda mu: FixedContacts(normal, tangents, mass, mu, dt), torch.zeros(4, dtype=torch.float64),
                 weight, _row(-1.0, 0.0), read)  # fmt: skip


def _pinch(scene: StickScene, dt: float) -> Setup:
    """x and z of a block and x of a finger that presses it to a wall."""
    normal, tangents = _row(1, 0, 0, -1, 0, 1).reshape(2, 3), _row(0, 1, 0, 0, 1, 0).reshape(2, 1, 3)
    mass = _row(MASS, MASS, FINGER_MASS)

    def read(states: Tensor) -> Reading:
        q, v = states.split(3, dim=-1)
        energy = 0.5 * (mass * v * v).sum(-1) + MASS * GRAVITY * q[:, 1]
        position = torch.stack((q[:, 0], torch.zeros_like(q[:, 0]), q[:, 1]), -1)
        return Reading(position, energy, torch.relu(-(q @ normal.T)).amax(-1))

    weight = _row(0.0, -MASS * GRAVITY, 0.0)
    return Setup(lambda mu: FixedContacts(normal, tangents, mass, mu, dt), torch.zeros(6, dtype=torch.float64),
                 weight, _row(0.0, 0.0, -1.0), read)  # fmt: skip


def _stack(scene: StickScene, dt: float) -> Setup:
    """Two rectangles in the plane; the upper one is read."""
    lower, upper, gravity = (_X, _Z), (UPPER[0], UPPER[2]), _row(scene.gravity[0], scene.gravity[2])
    start = torch.zeros(12, dtype=torch.float64)
    start[1], start[3] = _Z, 2 * _Z + UPPER[2]
    spread = [MASS / 3 * (a * a + b * b) for a, b in (lower, upper)]
    mass = _row(MASS, MASS, MASS, MASS, *spread)

    def read(states: Tensor) -> Reading:
        q, v = states.split(6, dim=-1)
        energy = 0.5 * (mass * v * v).sum(-1) - MASS * (q[:, :2] + q[:, 2:4]) @ gravity
        x, z = (q - start[:6])[:, 2:4].unbind(-1)
        return Reading(torch.stack((x, torch.zeros_like(x), z), -1), energy, torch.relu(-z))

    def make(mu: Any) -> PlanarStack:
        return PlanarStack(lower=lower, upper=upper, masses=(MASS, MASS), mu=(mu, mu), dt=dt, gravity=gravity)

    nothing = torch.zeros(6, dtype=torch.float64)
    return Setup(make, start, nothing, nothing, read)


def _edge(scene: StickScene, dt: float) -> Setup:
    """A rectangle in the plane that lands on a corner."""
    corners, start = rectangle(_X, _Z), _row(0.0, LIFT, float(TILT), 0.0, 0.0, 0.0)

    def read(states: Tensor) -> Reading:
        q, v = states.split(3, dim=-1)
        energy = 0.5 * (_row(MASS, MASS, INERTIA[1]) * v * v).sum(-1) + MASS * GRAVITY * q[:, 1]
        cosine, sine = q[:, 2:].cos(), q[:, 2:].sin()
        lowest = (sine * corners[:, 0] + cosine * corners[:, 1]).amin(-1) + q[:, 1]
        position = torch.stack((q[:, 0], torch.zeros_like(q[:, 0]), q[:, 1] - LIFT), -1)
        return Reading(position, energy, torch.relu(-lowest))

    def make(mu: Any) -> PlanarBody:
        return PlanarBody(corners=corners, inertia=INERTIA[1], mu=mu, dt=dt, mass=MASS)

    return Setup(make, start, torch.zeros(3, dtype=torch.float64), _row(1.0, 0.0, 0.0), read)


def _joint(scene: StickScene, dt: float) -> Setup:
    """A sliding block, with inertia and torque in place of mass and force."""
    inertia = MASS * ARM**2

    def read(states: Tensor) -> Reading:
        zero = torch.zeros_like(states[:, 0])
        return Reading(torch.stack((ARM * states[:, 0], zero, zero), -1), 0.5 * inertia * states[:, 1].square(), zero)

    return Setup(lambda mu: SlidingBlock(inertia, mu / (inertia * GRAVITY), dt), _row(0.0, 0.0),
                 _row(0.0), _row(1.0), read)  # fmt: skip


def _ball(scene: StickScene, dt: float) -> Setup:
    """The gap under the ball."""

    def read(states: Tensor) -> Reading:
        gap, velocity = states.unbind(-1)
        zero = torch.zeros_like(gap)
        energy = MASS * (0.5 * velocity.square() + GRAVITY * gap)
        return Reading(torch.stack((zero, zero, gap), -1), energy, torch.relu(-gap))

    return Setup(lambda mu: BouncingBlock(mass=MASS, restitution=RESTITUTION, dt=dt), _row(HEIGHT, 0.0),
                 _row(0.0), _row(1.0), read)  # fmt: skip


@dataclass(frozen=True)
class FixedContacts:
    """Bodies whose contacts keep their directions: what may move, and what may touch, are matrices.

    Attributes:
        normal, tangents: Jacobians [C, nv], [C, T, nv] of gaps and slips.
        mass: Diagonal of the mass matrix [nv].
    """

    normal: Tensor
    tangents: Tensor
    mass: Tensor
    mu: Any
    dt: float

    @property
    def space(self) -> Space:
        """A position and a velocity for each mass."""
        names = range(len(self.mass))
        return Space(tuple(f"x{i}_m" for i in names), tuple(f"x{i}_velocity_m_s" for i in names))

    @property
    def contacts(self) -> int:
        """How many may touch."""
        return len(self.normal)

    def advance(self, state: Tensor, drive: Drive) -> Step:
        """Advance a state by one step; gaps are linear in the positions."""
        position, velocity = state.split(len(self.mass), dim=-1)
        gap = position @ self.normal.T
        mu, nothing = torch.as_tensor(self.mu, dtype=gap.dtype).expand(len(self.normal)), torch.zeros_like(gap)
        contacts = Contacts(gap, self.normal, self.tangents, mu, nothing, nothing)
        found = contact_step(contacts, velocity + self.dt * drive.force / self.mass, self.mass, self.dt)
        state = torch.cat((position + self.dt * found.velocity, found.velocity), dim=-1)
        return Step(state, found.mode, None, found.solved & found.settled)


class OurSimulation:
    """A scene of ours by its rollout: one compiled call for a body in space, else step after step from Python."""

    def __init__(self, scene: StickScene, dt: float, mu: float, setup: Setup) -> None:
        self.dt, self.mu, self.setup = dt, mu, setup
        self.scene, self.stepped = scene, setup.make(mu)
        self.drives: dict[int, Drive] = {}

    def _states(self, stepped: Any, steps: int, start: Tensor) -> Tensor:
        if steps not in self.drives:
            pushes = [[self.scene.push((step + 0.5) * self.dt)] for step in range(steps)]
            self.drives[steps] = Drive(self.setup.force + torch.tensor(pushes, dtype=torch.float64) * self.setup.push)
        path = rollout(stepped, start, self.drives[steps])
        return path.states

    @torch.no_grad()
    def path(self, steps: int) -> Path:
        return Path(*(x.numpy() for x in self.setup.read(self._states(self.stepped, steps, self.setup.start))))

    @torch.no_grad()
    def run(self, steps: int) -> None:
        self._states(self.stepped, steps, self.setup.start)

    @torch.no_grad()
    def run_many(self, steps: int, batch: int) -> bool:
        self._states(self.stepped, steps, self.setup.start.expand(batch, -1))
        return True

    def end_slope(self, steps: int) -> np.ndarray | None:
        mu = torch.tensor(self.mu, dtype=torch.float64, requires_grad=True)
        position = self.setup.read(self._states(self.setup.make(mu), steps, self.setup.start)[-1:]).position[0]
        if not position.requires_grad:
            return np.zeros(3)
        slopes = (torch.autograd.grad(x, mu, retain_graph=True, allow_unused=True)[0] for x in position)
        return np.array([0.0 if x is None else float(x) for x in slopes])


def simulation(
    make: Callable[[StickScene, float], Setup | None], scene: StickScene, dt: float, mu: float
) -> OurSimulation | None:
    """A scene by `minimal` or `body`."""
    setup = make(scene, dt)
    return None if setup is None else OurSimulation(scene, dt, mu, setup)
