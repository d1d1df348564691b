"""The figures of `benchmark solvers`, drawn from its rows."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lcplearn.benchmark.harness.figures import new_figure, one_legend, style, whole_decades
from lcplearn.benchmark.harness.study import Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHOWN = ("F1", "F3 polygon n=8", "F4 cube", "F4 stacked cubes n=48 ratio 1e3", "F7 nonsymmetric P n=50", "row and")
FLOOR = 1e-17  # an exact result has no place on a logarithmic axis


def draw_work_precision(rows: Sequence[Row]) -> "Figure":
    """Worst residual against time of a problem, a panel a family."""
    figure, axes = _panels(rows)
    for ax, family in axes:
        for row in (row for row in rows if row["family"] == family):
            time, residual = float(row["forward_cpu_us"]), max(float(row["worst_residual"]), FLOOR)
            look = style(str(row["method"]))
            spread = [[time - float(row["forward_cpu_low_us"])], [float(row["forward_cpu_high_us"]) - time]]
            ax.errorbar(residual, time, yerr=spread, **{**look, "linestyle": ""}, label=_base(row),
                        fillstyle="full" if float(row["solved"]) >= 0.99 else "none", capsize=2)  # fmt: skip
        ax.axvline(1e-10, color="0.6", linewidth=0.8, linestyle=":")
        _finish(ax, family)
    _labels(figure, "worst residual [-]", "CPU time of a problem [µs]")
    return figure


def draw_gradients(rows: Sequence[Row]) -> "Figure":
    """Median gradient error against the time of the backward pass, a panel a family."""
    figure, axes = _panels(rows)
    for ax, family in axes:
        for row in (row for row in rows if row["family"] == family):
            error = max(float(row["gradient_error"]), FLOOR)
            look = {**style(str(row["method"])), "linestyle": ""}
            ax.plot(error, float(row["backward_cpu_us"]), **look, label=_base(row))
        _finish(ax, family)
    _labels(figure, "median relative error of a slope [-]", "backward, CPU time of a problem [µs]")
    return figure


def draw_growth(rows: Sequence[Row], batch: int) -> "Figure":
    """Time of a problem against batch (a small and a large contact problem) and against n."""
    figure, axes = new_figure(1, 3, width=10.5, height=4.2)
    double = [row for row in rows if row["precision"] == "float64"]
    for ax, family in zip(axes[0], ("F3 polygon n=8", "F4 cube n=24"), strict=False):
        _lines(ax, [row for row in double if row["family"] == family], "batch")
        ax.set(xscale="log", yscale="log", xlabel="batch size [-]", title=family)
    grown = [row for row in double if str(row["family"]).startswith("F5") and row["batch"] == batch]
    _lines(axes[0, 2], grown, "n")
    axes[0, 2].set(xscale="log", yscale="log", xlabel="n [-]", title=f"F5 positive definite, batch {batch}")
    axes[0, 0].set_ylabel("CPU time of a problem [µs]")
    one_legend(figure, axes, columns=3)
    return figure


def _lines(ax: "Axes", rows: Sequence[Row], x: str) -> None:
    for name in dict.fromkeys(str(row["method"]) for row in rows):
        if name in ("smoothed 1e-4", "smoothed 1e-10"):
            continue  # as smoothed 1e-7
        points = sorted((float(row[x]), float(row["forward_cpu_us"])) for row in rows if row["method"] == name)
        ax.plot(*zip(*points, strict=True), **style(name), label=name.split(" ")[0], markersize=4)


def _panels(rows: Sequence[Row]) -> "tuple[Figure, list[tuple[Axes, str]]]":
    families = list(dict.fromkeys(str(row["family"]) for row in rows))
    chosen = [next((f for f in families if f.startswith(prefix)), "") for prefix in SHOWN]
    chosen = [family for family in chosen if family] or families[:1]
    columns = min(len(chosen), 3)
    lines = -(-len(chosen) // columns)
    figure, axes = new_figure(lines, columns, width=3.5 * columns, height=3.0 * lines + 0.6)
    for ax in axes.flat[len(chosen) :]:
        ax.set_visible(False)
    return figure, list(zip(axes.flat, chosen, strict=False))


def _labels(figure: "Figure", x: str, y: str) -> None:
    shown = [ax for ax in figure.axes if ax.get_visible()]
    for ax in shown:
        grid = ax.get_subplotspec()
        if grid is not None and (grid.is_last_row() or len(shown) < 4):
            ax.set_xlabel(x)
        if grid is not None and grid.is_first_col():
            ax.set_ylabel(y)
    one_legend(figure, np.array(figure.axes), columns=5)


def _finish(ax: "Axes", family: str) -> None:
    ax.set(xscale="log", yscale="log")
    whole_decades(ax, "x")
    whole_decades(ax, "y")
    ax.set_title(family, fontsize=10)
    ax.tick_params(labelsize=8)


def _base(row: Row) -> str:
    return str(row["method"]).split(" ")[0]
