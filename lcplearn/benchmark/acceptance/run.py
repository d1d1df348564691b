"""`benchmark acceptance`: every figure that the LCP layer must show, measured, with its floor and its goal."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lcplearn.benchmark.acceptance import accuracy as accuracy_checks
from lcplearn.benchmark.acceptance import speed as speed_checks
from lcplearn.benchmark.acceptance.check import Check
from lcplearn.benchmark.harness.figures import STYLES, new_figure
from lcplearn.benchmark.harness.study import Options, Row, Study, Table, Value, show
from lcplearn.benchmark.solvers.peers import missing_peers

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CHECKS: tuple[Check, ...] = (*accuracy_checks.CHECKS, *speed_checks.CHECKS)


def run(options: Options) -> None:
    """Measure all cases of all checks; print a line for each check, then all cases."""
    checks = {check.name: check for check in CHECKS}
    study = Study("acceptance", options, ("check", "case"), ("figure", "must_met", "goal_met", "words"))
    keys = [(check.name, case) for check in CHECKS for case in check.cases(options.quick)]

    def seconds(name: str, case: str) -> float:
        return 1.0 if options.quick else checks[name].seconds

    for key in study.remaining(keys, seconds=seconds):
        finding = checks[str(key[0])].measure(str(key[1]), options)
        study.add(key, finding._asdict())
    _say(study, options)
    study.finish()


def _say(study: Study, options: Options) -> None:
    lines = []
    for check in CHECKS:
        rows = [row for row in study.rows if row["check"] == check.name and row["figure"] == row["figure"]]
        skipped = sum(row["check"] == check.name for row in study.rows) - len(rows)
        if rows:
            lines.append(_line(check, rows, skipped))
        else:
            lines.append([check.name, 0, "", check.must, "skipped", check.goal, "skipped"])
    missed = [line[0] for line in lines if line[4] is False]
    text = "Every floor is met." if not missed else f"Below its floor: {'; '.join(map(str, missed))}."
    if options.quick:
        text += " These are small sizes (--quick): too few repeats for a claim about time."
    if missing_peers():
        text += f" {missing_peers()}"
    columns = ("what", "cases", "worst", "must", "met", "goal", "reached")
    study.say("Does the layer do what it must?", text, table=Table(columns, lines), figure=draw_ratios(study.rows))
    for check in CHECKS:
        rows = [row for row in study.rows if row["check"] == check.name]
        cells = [
            [row["case"], row["figure"], bool(row["must_met"]), bool(row["goal_met"]), row["words"]] for row in rows
        ]
        heading = f"Must: {check.must}. Goal: {check.goal or 'the same'}."
        study.say(check.name, heading, table=Table(("case", check.unit, "must", "goal", "seen"), cells))


def _line(check: Check, rows: Sequence[Row], skipped: int) -> list[Value]:
    figures = [float(row["figure"]) for row in rows]
    worst = min(figures) if check.larger_is_better else max(figures)
    met = all(row["must_met"] for row in rows)
    reached = sum(bool(row["goal_met"]) for row in rows)
    cases = f"{len(rows)}" + (f" ({skipped} skipped)" if skipped else "")
    goal = "" if not check.goal else "yes" if reached == len(rows) else f"{reached} of {len(rows)}"
    return [check.name, cases, f"{show(worst)} {check.unit}", check.must, met, check.goal, goal]


def draw_ratios(rows: Sequence[Row]) -> "Figure | None":
    """How many times faster pivoting is than quantecon and our interior point, a bar a family; None if not measured."""
    panels = (
        (speed_checks.AGAINST_QUANTECON, "quantecon", 1.0, "as fast"),
        (speed_checks.AGAINST_INTERIOR_POINT, "interior_point", 10.0, "must"),
    )
    measured = [
        (own, *panel)
        for panel in panels
        if (own := [row for row in rows if row["check"] == panel[0] and row["figure"] == row["figure"]])
    ]
    if not measured:
        return None
    figure, axes = new_figure(1, len(measured), width=5.0 * len(measured), height=5.5)
    for ax, (own, _, method, line, meaning) in zip(axes[0], measured, strict=True):
        places = np.arange(len(own))[::-1]
        ax.barh(places, [float(row["figure"]) for row in own], color=STYLES[method].color)
        ax.set_yticks(places, [str(row["case"]) for row in own], fontsize=8)
        ax.axvline(line, color="black", linewidth=1.0, linestyle=":")
        ax.set_xlabel(f"times faster than {method} [-]")
        ax.set_title(f"dotted: {meaning}", fontsize=10)
        if method == "interior_point":
            ax.set_xscale("log")
    return figure
