"""`benchmark engines`, the Stick Bench: scenes with an exact answer, ours beside every installed engine."""

import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from lcplearn.benchmark.engines.cases import ARM, MARGIN, SCENES, StickScene, pushed_block
from lcplearn.benchmark.engines.catalogue import ENGINES, installed, missing_engines
from lcplearn.benchmark.engines.engine import Engine, Path, Simulation
from lcplearn.benchmark.engines.exact import slope
from lcplearn.benchmark.engines.figures import error_time, margin_lines
from lcplearn.benchmark.harness.study import Options, Row, Study, Table, Value

KEY = ("part", "scene", "engine", "dt")
COLUMNS = (
    "creep_um_s", "position_error", "penetration", "energy_gain", "step_us", "many_us", "slope", "slope_error", "says",
)  # fmt: skip
MARGINS = (1.05, 1.2, 2.0, 10.0, 100.0)
MARGIN_DT = 2e-3  # [s] MuJoCo's default; every engine has about the same
MU_STEP = 1e-3  # by which mu is changed, relative to it, where an engine has no gradient of its own
TIMED, BATCH, TIMED_MANY = 100, 256, 10  # steps that are timed; copies, and steps of them
REPEATS = 3


def run(options: Options) -> None:
    """Measure, print and draw."""
    study = Study("engines", options, KEY, COLUMNS)
    if missing_engines():
        print(missing_engines())
    engines = {engine.name: engine for engine in ENGINES if installed(engine)}
    scenes = {scene.name: scene for scene in (*SCENES, *map(pushed_block, MARGINS))}
    for key in study.remaining(plan(engines.values(), options.quick), seconds=1.0 if options.quick else 4.0):
        part, name, engine, dt = key
        measure = motion_row if part == "motion" else creep_row
        study.add(key, measure(scenes[str(name)], engines[str(engine)], float(dt)))
    _say(study)
    study.finish()


def plan(engines: Iterable[Engine], quick: bool) -> Iterable[tuple[Value, ...]]:
    """Every scene in every engine at its step sizes, two of them in a quick run; and pushed blocks by their margin."""
    for scene in SCENES:
        for engine in engines:
            sizes = engine.step_sizes[:2] if quick else engine.step_sizes
            yield from (("motion", scene.name, engine.name, dt) for dt in sizes)
    for margin in MARGINS[:: 3 if quick else 1]:
        for engine in engines:
            yield "margin", pushed_block(margin).name, engine.name, MARGIN_DT


def creep_row(scene: StickScene, engine: Engine, dt: float) -> Row:
    """Creep alone."""
    simulation = engine.build(scene, dt, scene.mu)
    if simulation is None:
        return {"says": "not expressible"}
    return {"creep_um_s": creep(scene, simulation.path(round(scene.duration / dt)), dt)}


def motion_row(scene: StickScene, engine: Engine, dt: float) -> Row:
    """How a scene goes in an engine, against the exact solution.

    Returns:
        creep_um_s [um/s], see `creep`; position_error, the largest at an instant [m]; penetration, the deepest [m];
        energy_gain, most energy that appears from nowhere [J]; step_us, many_us: CPU time of a step, of one scene alone
        and of one in a batch; slope, of the end with respect to mu [m], by the engine's gradient or a difference of
        two runs, where the end depends on mu, and slope_error, its relative distance from the exact one.
    """
    simulation = engine.build(scene, dt, scene.mu)
    if simulation is None:
        return {"says": "not expressible"}
    steps = round(scene.duration / dt)
    path = simulation.path(steps)
    exact = scene.solution(dt * np.arange(steps + 1), scene.mu)
    error = np.abs(path.position[:, scene.axes] - exact)
    row: Row = {
        "creep_um_s": creep(scene, path, dt),
        "position_error": float(np.nanmax(error)),
        "penetration": float(path.depth.max()),
        "energy_gain": energy_gain(scene, path, dt),
        **times(simulation, min(steps, TIMED)),
    }
    return row | (slopes(scene, engine, simulation, dt) if scene.mu_matters else {})


def creep(scene: StickScene, path: Path, dt: float) -> float:
    """Speed [um/s] along the judged axes in the second half of the intervals of rest; the largest, NaN without any."""
    speeds = [np.nan]
    for begin, end in scene.rests:
        first, last = round((begin + end) / 2 / dt), min(round(end / dt), len(path.position) - 1)
        moved = path.position[last, scene.axes] - path.position[first, scene.axes]
        speeds.append(1e6 * float(np.abs(moved).max()) / ((last - first) * dt))
    return float(np.nanmax(speeds)) if scene.rests else float("nan")


def energy_gain(scene: StickScene, path: Path, dt: float) -> float:
    """Largest energy above that of the start and of what pushed [J]; NaN where the push moves what is not seen."""
    if scene.kind in ("wall", "pinch"):
        return float("nan")
    x = path.position[:, 0] / (ARM if scene.kind == "joint" else 1.0)
    force = np.array([scene.push((step + 0.5) * dt) for step in range(len(x) - 1)])
    work = np.concatenate(([0.0], np.cumsum(force * np.diff(x))))
    return float((path.energy - path.energy[0] - work).max())


def times(simulation: Simulation, steps: int) -> dict[str, float]:
    """CPU time of a step [us]: alone, and in a batch (as alone, where the engine has no batches)."""
    alone = _seconds(lambda: simulation.run(steps)) / steps
    many = alone
    if simulation.run_many(1, 2):
        many = _seconds(lambda: simulation.run_many(TIMED_MANY, BATCH)) / (TIMED_MANY * BATCH)
    return {"step_us": 1e6 * alone, "many_us": 1e6 * many}


def _seconds(call: Callable[[], Any]) -> float:
    samples = []
    for _ in range(REPEATS):
        began = time.process_time()
        call()
        samples.append(time.process_time() - began)
    return min(samples)


def slopes(scene: StickScene, engine: Engine, simulation: Simulation, dt: float) -> Row:
    """Derivative of the end of the first judged axis with respect to mu, and its error."""
    steps, axis = round(scene.duration / dt), scene.axes[0]
    exact = float(slope(scene.solution, dt * np.arange(steps + 1), scene.mu)[-1, 0])
    own = simulation.end_slope(steps)
    if own is None:
        ends, h = [], MU_STEP * scene.mu
        for mu in (scene.mu - h, scene.mu + h):
            moved = engine.build(scene, dt, mu)
            ends.append(np.nan if moved is None else moved.path(steps).position[-1, axis])
        found = float(ends[1] - ends[0]) / (2 * h)
    else:
        found = float(own[axis])
    return {"slope": found, "slope_error": abs(found - exact) / abs(exact)}


def _say(study: Study) -> None:
    rows = [row for row in study.rows if row["part"] == "motion" and row["says"] == ""]
    names = [engine.name for engine in ENGINES if any(row["engine"] == engine.name for row in rows)]
    settings = "; ".join(f"{engine.name}: {engine.settings}" for engine in ENGINES if engine.name in names)
    study.say(
        "Who sticks?",
        "Creep [um/s] of a body that friction holds with 1.05 times the force that is needed (or that came to rest): "
        f"the largest over the engine's step sizes. {settings}. {missing_engines()}".strip(),
        table=_by_scene(rows, names, "creep_um_s", max),
        figure=margin_lines([row for row in study.rows if row["part"] == "margin" and row["says"] == ""], MARGIN),
    )
    study.say(
        "How far from the exact motion?",
        "Largest position error [m] at the finest step size of each engine; where bodies rest, the drift.",
        table=_by_scene(_finest(rows), names, "position_error", min),
    )
    study.say(
        "Whose gradient with respect to mu is right?",
        "Relative error of the derivative of the end with respect to mu, where the end depends on it, at the finest "
        "step size. Ours by backpropagation, of engines by a difference of two runs.",
        table=_by_scene(_finest(rows), names, "slope_error", min),
    )
    for scene in SCENES:
        own = [row for row in rows if row["scene"] == scene.name]
        table = [tuple(row[column] for column in ("engine", "dt", *COLUMNS[:-1])) for row in own]
        heads = ("engine", "dt [s]", "creep [um/s]", "position error [m]", "penetration [m]", "energy gain [J]",
                 "step [us]", f"step, batch {BATCH} [us]", "slope [m]", "slope error")  # fmt: skip
        study.say(f"{scene.name[0].upper()}{scene.name[1:]}", table=Table(heads, table), figure=error_time(scene, own))


def _finest(rows: list[Row]) -> list[Row]:
    finest: dict[tuple[Value, Value], Row] = {}
    for row in rows:
        key = row["scene"], row["engine"]
        if key not in finest or float(row["dt"]) < float(finest[key]["dt"]):
            finest[key] = row
    return list(finest.values())


def _by_scene(rows: list[Row], names: list[str], column: str, choose: Callable[[list[float]], float]) -> Table:
    table: list[list[Value]] = []
    for scene in SCENES:
        cells: list[Value] = [scene.name]
        for name in names:
            of_both = (r[column] for r in rows if (r["scene"], r["engine"]) == (scene.name, name))
            own = [float(value) for value in of_both if isinstance(value, float) and value == value]
            cells.append(choose(own) if own else float("nan"))
        if any(isinstance(cell, float) and cell == cell for cell in cells):
            table.append(cells)
    return Table(("scene", *names), table)
