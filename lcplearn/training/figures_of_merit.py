"""What models are judged by: the name, meaning and heading of each figure of metrics.json, without torch."""

import re
from collections.abc import Iterable
from typing import NamedTuple


class Figure(NamedTuple):
    """A figure of merit.

    Attributes:
        name: Its key in metrics.json.
        meaning: Unit and meaning.
        heading: Of its column in a comparison.
        more_is_better: Whether a larger one is better; of all others a smaller one is, or neither.
    """

    name: str
    meaning: str
    heading: str
    more_is_better: bool = False


FIGURES = (
    Figure("velocity_rmse", "m/s, one step", "one-step [m/s]"),
    Figure("stick_accuracy", "share of true sticks with |v| < 1e-12 m/s", "stick", more_is_better=True),
    Figure("false_stick", "share of true slips with |v| < 1e-12 m/s", "false stick"),
    Figure("rollout_rmse_100", "m/s, over 100 steps", "100 steps"),
    Figure("rollout_rmse_1000", "m/s, over 1000 steps", "1000 steps"),
    Figure("mu_error", "|learned - true|", "mu error"),
    Figure("mass_error", "kg, |learned - true|", "mass error"),
    Figure("stop_error_median_mm", "mm, where the slide ends", "stop [mm]"),
    Figure("stop_error_p90_mm", "mm, 90th percentile", "stop p90"),
    Figure("rest_share", "share of slides at rest at their end", "at rest", more_is_better=True),
    Figure("deviation_mm", "mm, end pose: sqrt(centre of mass^2 + (50 mm * rotation)^2)", "deviation [mm]"),
    Figure("position_mm", "mm, centre of mass at the end", "position [mm]"),
    Figure("rotation_deg", "deg, at the end", "rotation [deg]"),
    Figure("twist_angle_deg", "deg, median between predicted and true motion, rotation * 50 mm", "twist [deg]"),
    Figure("force_direction_deg", "deg, of the finger's force", "force [deg]"),
    Figure("force_size_n", "N, size of the finger's force", "force [N]"),
    Figure("position_integral", "% of width, mean over a toss, mean of tosses", "position [%]"),
    Figure("position_integral_median", "% of width, median of tosses", "median"),
    Figure("rotation_integral", "deg, mean over a toss, mean of tosses", "rotation [deg]"),
    Figure("rotation_integral_median", "deg, median of tosses", "median"),
    Figure("penetration_beyond", "% of width, mean over a toss, beyond the recorded", "penetration [%]"),
    Figure("same_face", "share of tosses that end on the recorded face", "same face", more_is_better=True),
    Figure("at_rest", "share of tosses at rest at their end", "at rest", more_is_better=True),
    Figure("unsolved_share", "share of LCPs without a verified solution", "unsolved"),
    Figure("mu", "learned friction coefficient", "mu"),
    Figure("parameters", "learned numbers", "parameters"),
    Figure("train_seconds", "s", "train [s]"),
    Figure("predict_us", "us, one step of one body", "step [us]"),
)
KEYS = tuple(figure.name for figure in FIGURES)
_BY_NAME = {figure.name: figure for figure in FIGURES}
# Of learned numbers; of several under one name, NAME_1, too.
UNITS = {
    **dict.fromkeys(("corners", "ground", "half_width", "radius"), "m"),
    **{"mass": "kg", "inertia": "kg m^2", "gravity": "m/s^2", "stiffness": "N/m"},
}


def figure(name: str) -> Figure:
    """A figure by its name; of learned numbers any name will do, and NAME_error."""
    if name in _BY_NAME:
        return _BY_NAME[name]
    number = name.removesuffix("_error")
    unit = UNITS.get(re.sub(r"_\d+$", "", number))
    meaning = "learned" if name == number else "|learned - true|"
    heading = name.replace("_", " ")
    return Figure(name, f"{unit}, {meaning}" if unit else meaning, f"{heading} [{unit}]" if unit else heading)


def in_order(names: Iterable[str]) -> list[str]:
    """Names of figures in the order of the table; those of learned numbers follow as they come."""
    there = dict.fromkeys(names)
    return [name for name in KEYS if name in there] + [name for name in there if name not in _BY_NAME]
