"""`benchmark scenes`: what rows that a scene does not need cost, and which dt and formulation give a wanted error."""

from collections.abc import Iterable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from lcplearn.benchmark.harness.measuring import interleave
from lcplearn.benchmark.harness.study import Options, Row, Study, Table
from lcplearn.benchmark.scenes.cases import (
    DURATION,
    HEIGHT,
    SCENES,
    Step,
    energy,
    exact,
    random_states,
    start,
)
from lcplearn.benchmark.scenes.compiled import COMPILED, compiled_rows
from lcplearn.benchmark.scenes.contact_cases import CURVED, DT, MU, body_rows, body_scenes, curve_rows
from lcplearn.benchmark.scenes.figures import cone_lines, curve_lines, error_time, time_bars
from lcplearn.benchmark.scenes.fused import WHAT, fused_rows

KEY = ("part", "scene", "dt", "batch")
COLUMNS = (
    "formulation", "rows", "full_rows", "velocity_difference", "step_us", "step_low_us", "step_high_us",
    "full_over_this", "torch_us", "steps", "seconds", "position_error", "end_error", "energy_error", "penetration",
    "solved",
)  # fmt: skip
STEP_SIZES = tuple(10.0 ** (-k / 3) for k in range(3, 13))  # [s] 0.1 to 1e-4
BATCHES = (1, 100, 10_000)
BODY_BATCHES = (1, 64, 1000)
FUSED_BATCHES = (1, 64)


def run(options: Options) -> None:
    """Measure and report."""
    study = Study("scenes", options, KEY, COLUMNS)
    for key in study.remaining(plan(options.quick), seconds=expected_seconds):
        part, scene, dt, batch = key
        if part == "step":
            rows = [*step_rows(str(scene), float(dt), int(batch), 15 if options.quick else 51, options.seed).values()]
        elif part == "motion":
            rows = [*motion_rows(str(scene), float(dt), 3 if options.quick else 7).values()]
        elif part == "body":
            rows = body_rows(str(scene), int(batch), 3 if options.quick else 7, options.seed)
        elif part == "fused":
            rows = fused_rows(str(scene), int(batch), 3 if options.quick else 15, options.seed)
        elif part == "compiled":
            rows = compiled_rows(str(scene), int(batch), 3 if options.quick else 31)
        else:
            rows = curve_rows(float(dt), 1 if options.quick else 5)
        study.add(key, *rows)
    report(study)


def plan(quick: bool) -> Iterable[tuple[Any, ...]]:
    """Keys of all rows."""
    for scene in SCENES:
        yield from (("step", scene, 0.01, batch) for batch in BATCHES[: 2 if quick else 3])
        yield from (("motion", scene, dt, 1) for dt in STEP_SIZES[: 7 if quick else 10 : 2 if quick else 1])
    for scene in body_scenes():
        yield from (("body", scene, DT, batch) for batch in BODY_BATCHES[: 2 if quick else 3])
    for what in WHAT[:1] if quick else WHAT:
        yield from (("fused", what, DT, batch) for batch in FUSED_BATCHES)
    yield from (("compiled", scene, DT, 1) for scene in (() if quick else COMPILED))
    yield from (("curve", CURVED.name, dt, 1) for dt in STEP_SIZES[: 7 if quick else 10 : 2 if quick else 1])


def expected_seconds(part: Any, scene: Any, dt: Any, batch: Any) -> float:
    """Rough cost of a key of the full run."""
    if part == "body":
        return 2.0 + 5e-3 * float(batch)
    if part in ("fused", "compiled"):
        return 20.0
    if part == "curve":
        return 24 * 1e-4 * CURVED.duration / float(dt)
    each = 0.3 + 1e-4 * batch if part == "step" else 8 * 8e-5 * DURATION / dt
    return each * len(SCENES[scene])


def step_rows(scene: str, dt: float, batch: int, repeats: int, seed: int) -> dict[str, Row]:
    """Compare one step of each formulation with the full one on random states, in turns in one process.

    Returns:
        By formulation: rows; velocity_difference, the largest [m/s]; step_us, time of a step of one block, with
        quartiles; full_over_this, CPU time of a full step over one of this formulation.
    """
    states = random_states(scene, batch, seed)
    many = random_states(scene, max(batch, 1000), seed + 1)
    steps = {name: formulation.build(dt) for name, formulation in SCENES[scene].items()}
    calls = {name: partial(step, states) for name, step in steps.items()}
    for call in calls.values():
        call()
    timings = interleave(calls, repeats)
    truth = steps["full"](many)[:, 1]
    return {
        name: {
            "formulation": name,
            "rows": SCENES[scene][name].rows,
            "velocity_difference": float((step(many)[:, 1] - truth).abs().max()),
            "step_us": timings[name].wall / batch * 1e6,
            "step_low_us": timings[name].low / batch * 1e6,
            "step_high_us": timings[name].high / batch * 1e6,
            "full_over_this": timings["full"].over(timings[name])[0],
        }
        for name, step in steps.items()
    }


def motion_rows(scene: str, dt: float, repeats: int) -> dict[str, Row]:
    """Follow one block for a second by each formulation, in turns, and compare with the exact motion.

    Returns:
        By formulation: seconds of one trajectory (CPU time, median); position_error, the largest at an instant [m];
        end_error [m] (where a slide stops; how high the first bounce goes; where a fall rests); energy_error, the
        largest over the energy at the start (free fall: lost before impact); penetration, the deepest [m].
    """
    count = round(DURATION / dt)
    calls = {name: partial(roll, formulation.build(dt), start(scene), count)
             for name, formulation in SCENES[scene].items()}  # fmt: skip
    paths = {name: call() for name, call in calls.items()}
    timings = interleave(calls, repeats)
    return {
        name: {
            "formulation": name,
            "rows": SCENES[scene][name].rows,
            "steps": count,
            "seconds": timings[name].cpu,
            **motion_errors(scene, path, dt),
        }
        for name, path in paths.items()
    }


@torch.no_grad()
def roll(step: Step, state: Tensor, count: int) -> Tensor:
    """States [count + 1, 2] of one block."""
    states = [state]
    for _ in range(count):
        states.append(step(states[-1]))
    return torch.cat(states)


def motion_errors(scene: str, path: Tensor, dt: float) -> dict[str, float]:
    """Errors of one trajectory against the exact one; see `motion_rows`."""
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
    _say_bodies(study)
    for scene in SCENES:
        of_scene = [row for row in motions if row["scene"] == scene]
        study.say(
            f"Which step size and formulation for a {scene}?",
            END_ERROR[scene],
            table=_by_step_size(of_scene),
            figure=error_time(scene, of_scene),
        )
    study.finish()


def _say_bodies(study: Study) -> None:
    """Bodies with several contacts, and the exact cone."""
    bodies = [row for row in study.rows if row["part"] == "body"]
    columns = ("scene", "formulation", "batch", "full_rows", "rows", "velocity_difference", "step_us", "solved")
    heads = ("scene", "friction", "batch", "rows of all corners", "rows needed", "from the exact cone [m/s]",
             "step [us]", "solved")  # fmt: skip
    study.say(
        "What does the exact friction cone cost, and what do polygons miss?",
        "Random states that touch the ground, one step: rows of all corners and those that a step needs (mean), "
        f"rms distance of the velocity from that of the exact cone (mu g dt is {MU * 9.81 * DT:.3g} m/s), CPU time.",
        table=Table(heads, [tuple(row[column] for column in columns) for row in bodies]),
        figure=cone_lines(bodies, MU * 9.81 * DT),
    )
    fused = [row for row in study.rows if row["part"] == "fused"]
    study.say(
        "What is a compiled contact step worth?",
        "A box with eight corners, its contact step alone, its whole step, and 20 steps: CPU time of a step of one "
        "box, compiled and assembled in torch, and the largest relative difference of velocities, or of gradients.",
        table=Table(
            ("what", "batch", "", "compiled [us]", "torch [us]", "torch / compiled", "difference"),
            [(r["scene"], r["batch"], r["formulation"], r["step_us"], r["torch_us"], r["full_over_this"],
              r["velocity_difference"]) for r in fused],
        ),
    )  # fmt: skip
    compiled = [row for row in study.rows if row["part"] == "compiled"]
    if compiled:
        study.say(
            "What does torch.compile gain in a step?",
            "A step of one body: CPU time, eager and compiled, the largest difference of states or gradients, and how "
            "long compilation took. The contacts of a box are a break between two graphs.",
            table=Table(
                ("scene", "", "compiled [us]", "eager [us]", "eager / compiled", "difference", "compilation [s]"),
                [(r["scene"], r["formulation"], r["step_us"], r["torch_us"], r["full_over_this"],
                  r["velocity_difference"], r["seconds"]) for r in compiled],
            ),
        )  # fmt: skip
    curves = [row for row in study.rows if row["part"] == "curve"]
    study.say(
        "Which step size and friction for a slide that curves?",
        "A block starts along the contour of a slope of 20 degrees with mu = 0.6 and curves down to a stop. The exact "
        "disc of friction converges with the step size, a polygon of facets only to its own error.",
        table=Table(
            ("dt [s]", "friction", "position error [m]", "end error [m]", "trajectory [ms]"),
            [(float(r["dt"]), r["formulation"], r["position_error"], r["end_error"], 1e3 * float(r["seconds"]))
             for r in curves],
        ),
        figure=curve_lines(curves),
    )  # fmt: skip


END_ERROR = {
    "sliding block": "A block slides to rest from 2 m/s; the end error is that of its stopping distance.",
    "one-way block": "A block slides to rest from 2 m/s; the end error is that of its stopping distance.",
    "falling block": "A block falls 1 m and stays; the energy error is what is lost before impact.",
    "bouncing block": "A block falls 1 m and bounces with restitution 0.5; the end error is that of its first peak.",
}


def _by_step_size(rows: list[Row]) -> Table:
    """Errors, the same for all formulations, and the time of a trajectory by each."""
    names = list(dict.fromkeys(str(row["formulation"]) for row in rows))
    errors = ("position_error", "end_error", "energy_error", "penetration")
    table = []
    for dt in sorted({float(row["dt"]) for row in rows}, reverse=True):
        own = {row["formulation"]: row for row in rows if row["dt"] == dt}
        seconds = [float(own[name]["seconds"]) for name in names]
        table.append((dt, *(own["direct"][column] for column in errors), *(1e3 * value for value in seconds)))
    heads = ("position error [m]", "end error [m]", "energy error [-]", "penetration [m]")
    return Table(("dt [s]", *heads, *(f"{name} [ms]" for name in names)), table)
