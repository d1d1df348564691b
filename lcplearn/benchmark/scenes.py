"""`benchmark scenes`: what rows that a scene does not need cost, and which dt and formulation give a wanted error."""

import time
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from lcplearn.benchmark.measuring import interleave
from lcplearn.benchmark.scene_cases import (
    DURATION,
    HEIGHT,
    SCENES,
    Step,
    energy,
    exact,
    random_states,
    start,
)
from lcplearn.benchmark.scene_figures import error_time, time_bars
from lcplearn.benchmark.study import Options, Row, Study, Table

KEY = ("part", "scene", "formulation", "dt", "batch")
COLUMNS = (
    "rows", "velocity_difference", "step_us", "step_low_us", "step_high_us", "full_over_this", "steps", "seconds",
    "position_error", "end_error", "energy_error", "penetration",
)  # fmt: skip
BLANK: Row = dict.fromkeys(COLUMNS, "")
STEP_SIZES = tuple(10.0 ** (-k / 3) for k in range(3, 13))  # [s] 0.1 to 1e-4
BATCHES = (1, 100, 10_000)


def run(options: Options) -> None:
    """Measure and report."""
    study = Study("scenes", options, KEY, COLUMNS)
    for key in study.remaining(plan(options.quick), seconds=expected_seconds):
        part, scene, formulation, dt, batch = key
        if part == "step":
            row = step_row(str(scene), str(formulation), float(dt), int(batch), 15 if options.quick else 51)
        else:
            row = motion_row(str(scene), str(formulation), float(dt), 3 if options.quick else 7)
        study.add(key, BLANK | row)
    report(study)


def plan(quick: bool) -> Iterable[tuple[Any, ...]]:
    """Keys of all rows."""
    for scene, formulations in SCENES.items():
        for formulation in formulations:
            for batch in BATCHES[: 2 if quick else 3]:
                yield "step", scene, formulation, 0.01, batch
            for dt in STEP_SIZES[: 7 if quick else 10 : 2 if quick else 1]:
                yield "motion", scene, formulation, dt, 1


def expected_seconds(part: Any, scene: Any, formulation: Any, dt: Any, batch: Any) -> float:
    """Rough cost of a row of the full run."""
    return 1.0 + 1e-4 * batch if part == "step" else 8 * 2e-4 * DURATION / dt


def step_row(scene: str, formulation: str, dt: float, batch: int, repeats: int) -> Row:
    """Compare one step of a formulation with the full one on random states.

    Returns:
        rows; velocity_difference, the largest [m/s]; step_us, time of a step of one block, with quartiles;
        full_over_this, CPU time of a full step over one of this formulation, in turns in one process.
    """
    states = random_states(scene, batch, seed=0)
    chosen, full = (SCENES[scene][name].build(dt) for name in (formulation, "full"))
    many = random_states(scene, max(batch, 1000), seed=1)
    difference = (chosen(many)[:, 1] - full(many)[:, 1]).abs().max()
    calls = {"full": lambda: full(states), "this": lambda: chosen(states)}
    timings = interleave(calls, repeats)
    timing = timings["this"]
    return {
        "rows": SCENES[scene][formulation].rows,
        "velocity_difference": float(difference),
        "step_us": timing.wall / batch * 1e6,
        "step_low_us": timing.low / batch * 1e6,
        "step_high_us": timing.high / batch * 1e6,
        "full_over_this": timings["full"].over(timing)[0],
    }


def motion_row(scene: str, formulation: str, dt: float, repeats: int) -> Row:
    """Follow one block for a second and compare with the exact motion.

    Returns:
        seconds of one trajectory (CPU time, median); position_error, the largest at an instant [m]; end_error [m]
        (where a slide stops; how high the first bounce goes; where a fall rests); energy_error, the largest over the
        energy at the start (free fall: lost before impact); penetration, the deepest [m].
    """
    step = SCENES[scene][formulation].build(dt)
    count = round(DURATION / dt)
    path = roll(step, start(scene), count)
    seconds = []
    for _ in range(repeats):
        began = time.process_time()
        roll(step, start(scene), count)
        seconds.append(time.process_time() - began)
    return {
        "rows": SCENES[scene][formulation].rows,
        "steps": count,
        "seconds": sorted(seconds)[len(seconds) // 2],
        **motion_errors(scene, path, dt),
    }


@torch.no_grad()
def roll(step: Step, state: Tensor, count: int) -> Tensor:
    """States [count + 1, 2] of one block."""
    states = [state]
    for _ in range(count):
        states.append(step(states[-1]))
    return torch.cat(states)


def motion_errors(scene: str, path: Tensor, dt: float) -> dict[str, float]:
    """Errors of one trajectory against the exact one; see `motion_row`."""
    x, v = path.unbind(-1)
    at = dt * torch.arange(len(x), dtype=x.dtype)
    x_exact, v_exact = exact(scene, at)
    before = energy(scene, x[:1], v[:1])
    if scene in ("falling block", "bouncing block"):
        # free fall only: at impact the energy jumps, half a step sooner or later than that of the exact motion
        landed = torch.cat((torch.tensor([False]), (v.diff() > 0) | (x[1:] <= 0))).cumsum(0) > 0
        lost = (energy(scene, x, v) - before)[~landed].abs()
    else:
        lost = (energy(scene, x, v) - energy(scene, x_exact, v_exact)).abs()
    end = (x[-1] - x_exact[-1]).abs()
    if scene == "bouncing block":
        bounce = (v > 0).nonzero()
        first = int(bounce[0, 0]) if len(bounce) else 0
        falls = (v[first:] < 0).nonzero()
        peak = x[first : first + int(falls[0, 0]) if len(falls) else None].max()
        end = (peak - 0.25 * HEIGHT).abs()
    return {
        "position_error": float((x - x_exact).abs().max()),
        "end_error": float(end),
        "energy_error": float(lost.max() / before[0]),
        "penetration": float((-x).clamp(min=0).max()) if scene in ("falling block", "bouncing block") else 0.0,
    }


def report(study: Study) -> None:
    """Tables and one picture a scene."""
    steps = [row for row in study.rows if row["part"] == "step"]
    motions = [row for row in study.rows if row["part"] == "motion"]
    batches = sorted({float(row["batch"]) for row in steps})
    table = []
    for scene, formulations in SCENES.items():
        for name, formulation in formulations.items():
            own = {float(r["batch"]): r for r in steps if (r["scene"], r["formulation"]) == (scene, name)}
            difference = max(float(row["velocity_difference"]) for row in own.values())
            cells = [own[batch][column] for column in ("step_us", "full_over_this") for batch in batches]
            table.append((scene, name, formulation.rows, difference, *cells))
    heads = [f"step [us], batch {batch:g}" for batch in batches] + [
        f"full / this, batch {batch:g}" for batch in batches
    ]
    study.say(
        "What do rows cost that a scene does not need?",
        "Rows of the LCP that each formulation builds, the largest difference of its velocity from that of the full "
        "contact LCP (4 rows: normal, two friction directions, slip speed), time of a step of one block, and how many "
        "times longer the full one takes.",
        table=Table(("scene", "formulation", "rows", "velocity difference [m/s]", *heads), table),
        figure=time_bars(steps),
    )
    for scene in SCENES:
        of_scene = [row for row in motions if row["scene"] == scene]
        study.say(
            f"Which step size and formulation for a {scene}?",
            END_ERROR[scene],
            table=_wanted(of_scene),
            figure=error_time(scene, of_scene),
        )
    study.finish()


END_ERROR = {
    "sliding block": "A block slides to rest from 2 m/s; the end error is that of its stopping distance.",
    "one-way block": "A block slides to rest from 2 m/s; the end error is that of its stopping distance.",
    "falling block": "A block falls 1 m and stays; the energy error is what is lost before impact.",
    "bouncing block": "A block falls 1 m and bounces with restitution 0.5; the end error is that of its first peak.",
}


def _wanted(rows: list[Row]) -> Table:
    """For each wanted position error the largest dt that reaches it, and the time of a trajectory with it."""
    names = list(dict.fromkeys(str(row["formulation"]) for row in rows))
    table = []
    for wanted in (1e-1, 1e-2, 1e-3, 1e-4):
        good = [row for row in rows if float(row["position_error"]) <= wanted]
        dt = max((float(row["dt"]) for row in good), default=float("nan"))
        found = {row["formulation"]: float(row["seconds"]) * 1e3 for row in good if row["dt"] == dt}
        if found:
            table.append((wanted, dt, *(found.get(name, float("nan")) for name in names)))
    return Table(("position error [m]", "dt [s]", *(f"{name} [ms]" for name in names)), table)
