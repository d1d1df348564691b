"""One figure that the layer must show: its floor, its goal, the cases it is measured on."""

from collections.abc import Callable
from typing import NamedTuple

from lcplearn.benchmark.harness.study import Options

SKIPPED = float("nan")


class Finding(NamedTuple):
    """What was measured in one case; a figure of NaN was not measured."""

    figure: float
    must_met: bool
    goal_met: bool
    words: str = ""


class Check(NamedTuple):
    """A row of the acceptance table.

    Attributes:
        name: What is measured.
        must: The floor, in words.
        goal: Where it should be, in words; empty where the floor is the goal.
        unit: Of the figure.
        cases: Names of the cases, for the quick run or the full one.
        measure: Measures a case.
        seconds: Expected time of a case in the full run.
        larger_is_better: Which end of the figures is the worst.
    """

    name: str
    must: str
    goal: str
    unit: str
    cases: Callable[[bool], list[str]]
    measure: Callable[[str, Options], Finding]
    seconds: float
    larger_is_better: bool = False


def skipped(reason: str) -> Finding:
    """A case that can't be measured here."""
    return Finding(SKIPPED, True, True, f"skipped: {reason}")
