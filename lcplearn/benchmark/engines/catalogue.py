"""The engines of the Stick Bench: a further one, or a further setting, is one entry."""

from functools import partial
from importlib.util import find_spec

from lcplearn.benchmark.engines import drake, mujoco, ours
from lcplearn.benchmark.engines.cases import StickScene
from lcplearn.benchmark.engines.engine import Engine, Simulation


def _mujoco(settings: mujoco.Settings, scene: StickScene, dt: float, mu: float) -> Simulation:
    return mujoco.MujocoSimulation(scene, dt, mu, settings)


def _drake(settings: drake.Settings, scene: StickScene, dt: float, mu: float) -> Simulation | None:
    if not drake.expressible(scene):
        return None
    try:
        return drake.DrakeSimulation(scene, dt, mu, settings)
    except RuntimeError:  # newer Drakes have no TAMSI
        if settings.approximation != "tamsi":
            raise
        return None


ENGINES: tuple[Engine, ...] = (
    Engine("lcplearn", "", "rows as each scene needs", partial(ours.simulation, ours.minimal),
           (1e-2, 4e-3, 1e-3)),
    Engine("lcplearn body", "", "a box with eight corners in space", partial(ours.simulation, ours.body)),
    Engine("MuJoCo", "mujoco", "defaults", partial(_mujoco, mujoco.Settings())),
    Engine("MuJoCo elliptic", "mujoco", "cone=elliptic", partial(_mujoco, mujoco.Settings("elliptic"))),
    Engine("MuJoCo noslip", "mujoco", "cone=elliptic, impratio=100, noslip_iterations=10",
           partial(_mujoco, mujoco.Settings("elliptic", 100.0, 10))),
    Engine("MuJoCo stiff", "mujoco", "the same with solref=2 dt (the ball: a spring with its restitution)",
           partial(_mujoco, mujoco.Settings("elliptic", 100.0, 10, True))),
    Engine("Drake", "pydrake", "defaults (lagged)", partial(_drake, drake.Settings())),
    Engine("Drake tuned", "pydrake", "stiction_tolerance=1e-6", partial(_drake, drake.Settings(None, 1e-6))),
    Engine("Drake TAMSI", "pydrake", "discrete_contact_approximation=tamsi (deprecated), stiction_tolerance=1e-6",
           partial(_drake, drake.Settings("tamsi", 1e-6))),
)  # fmt: skip


def installed(engine: Engine) -> bool:
    """Whether the engine's package is there."""
    return not engine.package or find_spec(engine.package) is not None


def missing_engines() -> str:
    """A sentence on engines that are left out, or nothing."""
    missing = sorted({engine.package for engine in ENGINES if not installed(engine)})
    return f"Not installed (pip install 'lcplearn[engines]'): {', '.join(missing)}." if missing else ""
