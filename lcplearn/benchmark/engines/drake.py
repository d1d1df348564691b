"""The scenes in Drake's MultibodyPlant: https://drake.mit.edu/doxygen_cxx names what is set here.

Bodies touch with small spheres at their corners, as Drake's contact of a box with a half space is a single point.
"""

import logging
from typing import Any, NamedTuple

import numpy as np

from lcplearn.benchmark.engines.cases import DROP, FINGER, FINGER_MASS, HALF, MASS, TILT, UPPER, StickScene
from lcplearn.benchmark.engines.engine import Path

_CORNER = 1e-7  # [m] radius of the spheres; they start this deep, so that they touch


class Settings(NamedTuple):
    """Options of the plant that differ from Drake's defaults; None is the default."""

    approximation: str | None = None
    stiction_tolerance: float | None = None  # [m/s]


def expressible(scene: StickScene) -> bool:
    """Whether Drake has what the scene needs: not a coefficient of restitution, nor a joint's breakaway torque."""
    return scene.kind not in ("ball", "joint")


class DrakeSimulation:
    """One scene as a diagram and its context."""

    def __init__(self, scene: StickScene, dt: float, mu: float, settings: Settings) -> None:
        import pydrake.all as drake

        logging.getLogger("drake").setLevel(logging.ERROR)  # it warns of what these scenes don't use

        self.engine: Any = drake
        self.scene, self.dt = scene, dt
        config = drake.MultibodyPlantConfig(time_step=dt)
        if settings.approximation is not None:
            config.discrete_contact_approximation = settings.approximation
        if settings.stiction_tolerance is not None:
            config.stiction_tolerance = settings.stiction_tolerance
        builder = drake.DiagramBuilder()
        self.plant, _ = drake.AddMultibodyPlant(config, builder)
        self.bodies = self._add_bodies(mu)
        self.plant.mutable_gravity_field().set_gravity_vector(list(scene.gravity))
        self.plant.Finalize()
        self.diagram = builder.Build()
        self._start()

    def _add_bodies(self, mu: float) -> list[Any]:
        drake, plant, scene = self.engine, self.plant, self.scene
        friction = drake.CoulombFriction(mu, mu)
        still = drake.RigidTransform()

        def box(name: str, mass: float, half: tuple[float, ...], solid: bool = False) -> Any:
            size = [2 * h for h in half]
            body = plant.AddRigidBody(name, drake.SpatialInertia.SolidBoxWithMass(mass, *size))
            for i, signs in enumerate(np.ndindex(2, 2, 2)):
                corner = [(2 * s - 1) * (h - _CORNER) for s, h in zip(signs, half, strict=True)]
                ball = drake.Sphere(_CORNER)
                plant.RegisterCollisionGeometry(body, drake.RigidTransform(corner), ball, f"{name}{i}", friction)
            if solid:
                plant.RegisterCollisionGeometry(body, still, drake.Box(*size), name, friction)
            return body

        bodies = [box("block", MASS, HALF, solid=scene.kind in ("pinch", "stack"))]
        if scene.kind == "stack":
            bodies.append(box("upper", MASS, UPPER))
        if scene.kind == "pinch":
            finger = box("finger", FINGER_MASS, FINGER)
            plant.AddJoint(drake.PrismaticJoint("slide", plant.world_frame(), finger.body_frame(), [1, 0, 0]))
            bodies.append(finger)
        normal = [1.0, 0.0, 0.0] if scene.kind in ("wall", "pinch") else [0.0, 0.0, 1.0]
        ground = drake.HalfSpace.MakePose(normal, [0.0, 0.0, 0.0])
        plant.RegisterCollisionGeometry(plant.world_body(), ground, drake.HalfSpace(), "ground", friction)
        return bodies

    def _start(self) -> None:
        drake, scene = self.engine, self.scene
        self.simulator = drake.Simulator(self.diagram)
        self.context = self.plant.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())
        x, _, z = HALF
        places = {"wall": [x - _CORNER, 0.0, 0.0], "pinch": [x - _CORNER, 0.0, 0.0]}
        turn = drake.RotationMatrix()
        place = places.get(scene.kind, [0.0, 0.0, z - _CORNER])
        if scene.kind == "edge":
            place = [0.0, 0.0, float(DROP + x * np.sin(TILT) + z * np.cos(TILT))]
            turn = drake.RotationMatrix.MakeYRotation(-float(TILT))
        self.plant.SetFreeBodyPose(self.context, self.bodies[0], drake.RigidTransform(turn, place))
        if scene.kind == "stack":
            pose = drake.RigidTransform([0.0, 0.0, 3 * z - 2 * _CORNER])
            self.plant.SetFreeBodyPose(self.context, self.bodies[1], pose)
        if scene.kind == "pinch":
            self.plant.GetJointByName("slide").set_translation(self.context, 2 * x + FINGER[0] - 2 * _CORNER)
        velocity = drake.SpatialVelocity([0.0, 0.0, 0.0], [scene.speed, 0.0, 0.0])
        self.plant.SetFreeBodySpatialVelocity(self.context, self.bodies[0], velocity)
        self.pushed = float("nan")
        self.simulator.Initialize()

    def _push(self, step: int) -> None:
        force = self.scene.push((step + 0.5) * self.dt)
        if force == self.pushed:
            return
        self.pushed = force
        applied = self.engine.ExternallyAppliedSpatialForce()
        applied.body_index = self.bodies[-1].index()
        sign = -1.0 if self.scene.kind in ("wall", "pinch") else 1.0
        applied.F_Bq_W = self.engine.SpatialForce(np.array([0.0, 0.0, 0.0, sign * force, 0.0, 0.0]))
        self.plant.get_applied_spatial_force_input_port().FixValue(self.context, [applied])

    def path(self, steps: int) -> Path:
        self._start()
        tracked = self.bodies[1] if self.scene.kind == "stack" else self.bodies[0]
        position, energy, depth = np.zeros((steps + 1, 3)), np.zeros(steps + 1), np.zeros(steps + 1)
        for step in range(steps + 1):
            if step:
                self._push(step - 1)
                self.simulator.AdvanceTo(step * self.dt)
            position[step] = self.plant.EvalBodyPoseInWorld(self.context, tracked).translation()
            energy[step] = self.plant.CalcPotentialEnergy(self.context) + self.plant.CalcKineticEnergy(self.context)
            contact = self.plant.get_contact_results_output_port().Eval(self.context)
            pairs = range(contact.num_point_pair_contacts())
            depth[step] = max((contact.point_pair_contact_info(i).point_pair().depth for i in pairs), default=0.0)
        return Path(position - position[0], energy, depth)

    def run(self, steps: int) -> None:
        self._start()
        for step in range(steps):
            self._push(step)
            if not self.scene.pushes:
                break
            self.simulator.AdvanceTo((step + 1) * self.dt)
        self.simulator.AdvanceTo(steps * self.dt)

    def run_many(self, steps: int, batch: int) -> bool:
        return False

    def end_slope(self, steps: int) -> np.ndarray | None:
        return None
