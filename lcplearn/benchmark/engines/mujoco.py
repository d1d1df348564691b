"""The scenes in MuJoCo: https://mujoco.readthedocs.io/en/stable/modeling.html names what is set here."""

from typing import Any, NamedTuple

import numpy as np

from lcplearn.benchmark.engines.cases import (
    ARM,
    DROP,
    FINGER,
    FINGER_MASS,
    HALF,
    HEIGHT,
    MASS,
    RADIUS,
    RESTITUTION,
    TILT,
    UPPER,
    StickScene,
)
from lcplearn.benchmark.engines.engine import Path

_CONTACT = 0.3  # time step over that of the spring that gives the ball its restitution: a bounce takes ten steps


class Settings(NamedTuple):
    """Options of a model that differ from MuJoCo's defaults."""

    cone: str = "pyramidal"
    impratio: float = 1.0
    noslip: int = 0
    stiff: bool = False  # contacts as stiff as the time step allows: a time constant of two steps


def model(scene: StickScene, dt: float, mu: float, settings: Settings) -> Any:
    """The scene's `mujoco.MjModel`."""
    import mujoco

    gravity = " ".join(map(repr, scene.gravity))
    option = (
        f'<option timestep="{dt!r}" gravity="{gravity}" cone="{settings.cone}" impratio="{settings.impratio!r}" '
        f'noslip_iterations="{settings.noslip}"><flag energy="enable"/></option>'
    )
    contact = f'<default><geom friction="{mu!r} 0 0" {_solref(scene, dt, settings)}/></default>'
    return mujoco.MjModel.from_xml_string(
        f"<mujoco>{option}{contact}<worldbody>{_bodies(scene, mu)}</worldbody></mujoco>"
    )


def _solref(scene: StickScene, dt: float, settings: Settings) -> str:
    if not settings.stiff:
        return ""
    if scene.kind == "ball":  # stiffness and damping of a spring that gives back so much of the speed
        log = np.log(RESTITUTION)
        stiffness = (_CONTACT / dt) ** 2
        damping = 2.0 * float(np.sqrt(stiffness) * -log / np.sqrt(np.pi**2 + log**2))
        return f'solref="{-stiffness!r} {-damping!r}"'
    return f'solref="{2 * dt!r} 1"'


def _bodies(scene: StickScene, mu: float) -> str:
    ground = '<geom type="plane" size="9 9 1"/>'
    wall = '<geom type="plane" size="9 9 1" zaxis="1 0 0"/>'

    def box(half: tuple[float, ...], mass: float = MASS) -> str:
        return f'<geom type="box" size="{" ".join(map(repr, half))}" mass="{mass}"/>'

    def free(geom: str, *position: float, turn: str = "") -> str:
        return f'<body pos="{" ".join(map(repr, position))}" {turn}><freejoint/>{geom}</body>'

    x, _, z = HALF
    if scene.kind == "wall":
        return wall + free(box(HALF), x, 0.0, 0.0)
    if scene.kind == "pinch":
        place = f'pos="{2 * x + FINGER[0]!r} 0 0"'
        slide = f'<body {place}><joint type="slide" axis="1 0 0"/>{box(FINGER, FINGER_MASS)}</body>'
        return wall + free(box(HALF), x, 0.0, 0.0) + slide
    if scene.kind == "stack":
        return ground + free(box(HALF), 0.0, 0.0, z) + free(box(UPPER), 0.0, 0.0, 3 * z)
    if scene.kind == "edge":
        height = DROP + x * np.sin(TILT) + z * np.cos(TILT)
        return ground + free(box(HALF), 0.0, 0.0, float(height), turn=f'euler="0 {-float(np.degrees(TILT))!r} 0"')
    if scene.kind == "joint":
        link = f'<geom type="sphere" size="0.02" pos="{ARM} 0 0" mass="{MASS}" contype="0"/>'
        return f'<body><joint type="hinge" axis="0 0 1" frictionloss="{mu!r}"/>{link}</body>'
    if scene.kind == "ball":
        return ground + free(f'<geom type="sphere" size="{RADIUS}" mass="{MASS}"/>', 0.0, 0.0, RADIUS + HEIGHT)
    return ground + free(box(HALF), 0.0, 0.0, z)


class MujocoSimulation:
    """One scene as a model and its data."""

    def __init__(self, scene: StickScene, dt: float, mu: float, settings: Settings) -> None:
        import mujoco

        self.engine, self.scene, self.dt = mujoco, scene, dt
        self.model = model(scene, dt, mu, settings)
        self.data = mujoco.MjData(self.model)

    def _start(self) -> None:
        self.engine.mj_resetData(self.model, self.data)
        self.data.qvel[0] = self.scene.speed
        self.engine.mj_forward(self.model, self.data)

    def _push(self, step: int) -> None:
        force = self.scene.push((step + 0.5) * self.dt)
        if self.scene.kind == "joint":
            self.data.qfrc_applied[0] = force
        elif self.scene.kind in ("wall", "pinch"):
            self.data.xfrc_applied[-1, 0] = -force
        else:
            self.data.xfrc_applied[1, 0] = force

    def path(self, steps: int) -> Path:
        self._start()
        position, energy, depth = np.zeros((steps + 1, 3)), np.zeros(steps + 1), np.zeros(steps + 1)
        for step in range(steps + 1):
            if step:
                self._push(step - 1)
                self.engine.mj_step(self.model, self.data)
            data = self.data
            position[step] = self._position()
            self.engine.mj_energyPos(self.model, data)
            self.engine.mj_energyVel(self.model, data)
            energy[step] = data.energy.sum()
            depth[step] = max(-data.contact.dist.min(), 0.0) if data.ncon else 0.0
        start = np.array([0.0, 0.0, RADIUS]) if self.scene.kind == "ball" else position[0]
        return Path(position - start, energy, depth)

    def _position(self) -> np.ndarray:
        if self.scene.kind == "joint":
            return np.array([ARM * self.data.qpos[0], 0.0, 0.0])
        return self.data.qpos[7:10].copy() if self.scene.kind == "stack" else self.data.qpos[:3].copy()

    def run(self, steps: int) -> None:
        self._start()
        if not self.scene.pushes:
            self.engine.mj_step(self.model, self.data, nstep=steps)
            return
        for step in range(steps):
            self._push(step)
            self.engine.mj_step(self.model, self.data)

    def run_many(self, steps: int, batch: int) -> bool:
        from mujoco import rollout

        self._start()
        size = self.engine.mj_stateSize(self.model, self.engine.mjtState.mjSTATE_FULLPHYSICS)
        state = np.empty(size)
        self.engine.mj_getState(self.model, self.data, state, self.engine.mjtState.mjSTATE_FULLPHYSICS)
        rollout.rollout(self.model, self.data, np.tile(state, (batch, 1)), nstep=steps)
        return True

    def end_slope(self, steps: int) -> np.ndarray | None:
        return None
