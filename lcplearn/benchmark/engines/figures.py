"""Figures of `benchmark engines`."""

import math
import re
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from lcplearn.benchmark.engines.cases import StickScene
from lcplearn.benchmark.harness.figures import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PINK,
    RED,
    SKY,
    YELLOW,
    Style,
    new_figure,
    one_legend,
    whole_decades,
)
from lcplearn.benchmark.harness.study import Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LOOKS = {
    "lcplearn": Style(BLUE, "o"),
    "lcplearn body": Style(SKY, "s", "--"),
    "MuJoCo": Style(RED, "v", ":"),
    "MuJoCo elliptic": Style(ORANGE, "^", "-."),
    "MuJoCo noslip": Style(PINK, "D", "--"),
    "MuJoCo stiff": Style(PINK, "h"),
    "Drake": Style(YELLOW, "P", ":"),
    "Drake tuned": Style(GREEN, "X"),
    "Drake TAMSI": Style(BLACK, "p", "--"),
}


def error_time(scene: StickScene, rows: Sequence[Row]) -> "Figure":
    """Position error against CPU time of a simulated second, alone and in a batch; a point a step size."""
    figure, axes = new_figure(1, 2, width=9.0, height=4.2)
    zero = _below(float(row["position_error"]) for row in rows)
    panels = (("step_us", "one scene alone"), ("many_us", "one scene of a batch of 256"))
    for ax, (column, title) in zip(axes[0], panels, strict=True):
        for name in _names(rows):
            own = [row for row in rows if row["engine"] == name]
            x = [1e-6 * float(row[column]) / float(row["dt"]) for row in own]
            _line(ax, name, x, [float(row["position_error"]) or zero for row in own])
        ax.set(xscale="log", yscale="log", xlabel="CPU time of a simulated second [s]")
        whole_decades(ax, "x")
        ax.set_title(title, fontsize=10)
        _mark_zero(ax, zero)
    axes[0, 0].set_ylabel("largest position error [m]")
    figure.suptitle(scene.name, fontsize=11)
    one_legend(figure, axes, columns=4)
    return figure


def margin_lines(rows: Sequence[Row], held: float) -> "Figure":
    """Creep of a pushed block against what friction could hold over the push."""
    figure, axes = new_figure(width=7.0, height=4.6)
    ax, zero = axes[0, 0], _below(float(row["creep_um_s"]) for row in rows)
    for name in _names(rows):
        own = [row for row in rows if row["engine"] == name]
        margins = [float(re.sub(r".*margin ", "", str(row["scene"]))) for row in own]
        _line(ax, name, margins, [float(row["creep_um_s"]) or zero for row in own])
    ax.set(xscale="log", yscale="log", xlabel="margin: friction limit over push [-]", ylabel="creep [µm/s]")
    ax.set_title("a block that friction holds, dt = 2 ms", fontsize=10)
    _mark_zero(ax, zero)
    one_legend(figure, axes, columns=4)
    return figure


def _names(rows: Sequence[Row]) -> list[str]:
    found = {row["engine"] for row in rows}
    return [name for name in LOOKS if name in found]


def _line(ax: "Axes", name: str, x: Sequence[float], y: Sequence[float]) -> None:
    look = LOOKS[name]
    order = np.argsort(x)
    ax.plot(np.array(x)[order], np.array(y)[order], color=look.color, marker=look.marker, linestyle=look.linestyle,
            markersize=5, label=name)  # fmt: skip


def _below(values: Iterable[float]) -> float:
    """Where 0 is drawn on a logarithmic axis: a decade below the smallest other value and more."""
    smallest = min((value for value in values if value > 0.0), default=1e-3)
    return float(10.0 ** (math.floor(math.log10(smallest)) - 1))


def _mark_zero(ax: "Axes", zero: float) -> None:
    """The line of exactly 0, if something is, set off from the decades above it."""
    if not any(np.any(np.asarray(line.get_ydata()) == zero) for line in ax.get_lines()):
        return
    ax.axhline(zero, color="0.6", linewidth=0.8, zorder=1)
    first, last = round(math.log10(zero)) + 1, math.ceil(math.log10(max(ax.get_ylim()[1], 1e2 * zero)))
    decades = range(first, last + 1, 1 + (last - first) // 7)
    ax.set_yticks([zero, *(10.0**k for k in decades)], ["0", *(f"$10^{{{k}}}$" for k in decades)])
    ax.yaxis.minorticks_off()
    ax.set_ylim(zero / 2, 10.0**last)
