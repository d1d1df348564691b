"""Figures of `benchmark scenes`."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lcplearn.benchmark.harness.figures import BLACK, BLUE, GREEN, RED, SKY, Style, new_figure, one_legend
from lcplearn.benchmark.harness.study import Row

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LOOKS = {
    "closed form": Style(GREEN, "^"),
    "direct": Style(BLUE, "o"),
    "physical slack": Style(SKY, "v", "--"),
    "traditional": Style(RED, "s"),
    "full": Style(BLACK, "D", ":"),
}
ERRORS = {
    "position_error": ("largest position error [m]", Style(BLUE, "o")),
    "end_error": ("end error [m]", Style(GREEN, "s", "--")),
    "energy_error": ("energy error / energy", Style(RED, "^", "-.")),
    "penetration": ("penetration [m]", Style(BLACK, "v", ":")),
}
FLOOR = 1e-12  # smaller errors are rounding


def time_bars(rows: Sequence[Row]) -> "Figure":
    """Time of a step for each scene and formulation, one panel a batch size."""
    batches = sorted({float(row["batch"]) for row in rows})
    scenes = list(dict.fromkeys(str(row["scene"]) for row in rows))
    figure, axes = new_figure(1, len(batches), width=8.0, height=3.6)
    for ax, batch in zip(axes[0], batches, strict=True):
        for name, look in LOOKS.items():
            own = [row for row in rows if (row["formulation"], row["batch"]) == (name, batch)]
            at = [
                scenes.index(str(row["scene"])) + 0.16 * (list(LOOKS).index(name) - (len(LOOKS) - 1) / 2) for row in own
            ]
            middle, low, high = (
                np.array([float(row[column]) for row in own]) for column in ("step_us", "step_low_us", "step_high_us")
            )
            ax.bar(at, middle, 0.15, color=look.color, label=name, yerr=(middle - low, high - middle), ecolor="#777777")
        ax.set_xticks(range(len(scenes)), [scene.replace(" ", "\n") for scene in scenes], fontsize=9)
        ax.set_title(f"batch {batch:g}", fontsize=10)
    axes[0, 0].set_ylabel("time of a step of one block [µs]")
    one_legend(figure, axes, columns=6)
    return figure


def error_time(scene: str, rows: Sequence[Row]) -> "Figure":
    """Left: errors against step size; right: position error against time, a line a formulation."""
    figure, axes = new_figure(1, 2, width=8.0, height=3.9)
    left, right = axes[0]
    direct = sorted((row for row in rows if row["formulation"] == "direct"), key=lambda row: float(row["dt"]))
    dt = np.array([float(row["dt"]) for row in direct])
    for column, (label, look) in ERRORS.items():
        error = np.array([float(row[column]) for row in direct])
        if (error > FLOOR).any():
            left.loglog(dt[error > FLOOR], error[error > FLOOR], label=label, color=look.color, marker=look.marker,
                        linestyle=look.linestyle, markersize=4)  # fmt: skip
    left.loglog(dt, direct[0]["position_error"] * dt / dt[0], color="#999999", linewidth=0.8, label="first order")
    left.set_xlabel("step size dt [s]")
    left.set_ylabel("error [m], or relative to the energy")
    left.legend(fontsize=8, frameon=False)
    left.set_title(f"{scene}: errors, the same for all formulations", fontsize=10)
    for name, look in LOOKS.items():
        own = sorted((row for row in rows if row["formulation"] == name), key=lambda row: float(row["dt"]))
        if not own:
            continue
        x, y = ([float(row[column]) for row in own] for column in ("seconds", "position_error"))
        right.loglog(x, y, label=f"{name} ({own[0]['rows']:g})" if own[0]["rows"] else name, color=look.color,
                     marker=look.marker, linestyle=look.linestyle, markersize=5)  # fmt: skip
        if name == "closed form":
            for row, a, b in zip(own[1::3], x[1::3], y[1::3], strict=True):
                label = f"dt {float(row['dt']):.2g}"
                right.annotate(label, (a, b), (-5, -3), textcoords="offset points", fontsize=7, ha="right", va="top")
    right.set_xlabel("CPU time of a trajectory of 1 s [s]")
    right.set_ylabel("largest position error [m]")
    right.legend(fontsize=8, frameon=False, loc="lower left")
    right.set_title("error against time (rows of the LCP)", fontsize=10)
    return figure


CONE_LOOKS = (Style(GREEN, "^"), Style(BLUE, "o"), Style(SKY, "v", "--"), Style(RED, "s", ":"))


def cone_lines(rows: Sequence[Row], limit: float) -> "Figure":
    """Distance from the exact cone against time of a step, a point a batch; in units of the friction limit."""
    figure, axes = new_figure(width=6.5, height=4.2)
    box = [row for row in rows if row["scene"] == "box in space"]
    for name, look in zip(dict.fromkeys(str(row["formulation"]) for row in box), CONE_LOOKS, strict=False):
        own = [row for row in box if row["formulation"] == name]
        x = [float(row["step_us"]) for row in own]
        y = [float(row["velocity_difference"]) / limit for row in own]
        axes[0, 0].plot(x, y, color=look.color, marker=look.marker, linestyle=look.linestyle, label=name)
        for row, a, b in zip(own, x, y, strict=True):
            axes[0, 0].annotate(f"{row['batch']:g}", (a, b), (3, 4), textcoords="offset points", fontsize=7)
    axes[0, 0].set(xscale="log", xlabel="time of a step of one body [µs] (numbers: batch)")
    axes[0, 0].set_ylabel("rms distance from the exact cone [mu g dt]")
    axes[0, 0].set_title("box in space, on a face, an edge or a corner", fontsize=10)
    axes[0, 0].legend(fontsize=8, frameon=False)
    return figure


def curve_lines(rows: Sequence[Row]) -> "Figure":
    """Error of a curved slide against step size and against time."""
    figure, axes = new_figure(1, 2, width=8.0, height=3.9)
    for ax, column, label in zip(axes[0], ("dt", "seconds"), ("step size dt [s]", "CPU time of a trajectory [s]"),
                                 strict=True):  # fmt: skip
        for name, look in zip(dict.fromkeys(str(row["formulation"]) for row in rows), CONE_LOOKS, strict=False):
            own = [row for row in rows if row["formulation"] == name]
            ax.loglog([float(r[column]) for r in own], [float(r["position_error"]) for r in own], label=name,
                      color=look.color, marker=look.marker, linestyle=look.linestyle, markersize=4)  # fmt: skip
        ax.set_xlabel(label)
    axes[0, 0].set_ylabel("largest position error [m]")
    one_legend(figure, axes)
    return figure
