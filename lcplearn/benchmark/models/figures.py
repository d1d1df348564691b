"""Figures of `benchmark models`."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lcplearn.benchmark.harness.figures import BLUE, ORANGE, new_figure, one_legend, style
from lcplearn.benchmark.harness.study import Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SMALLEST, LARGEST = 1e-16, 1e3  # [m/s] range drawn; diverged rollouts stand at its upper end
SMALLEST_WITH_NOISE = 1e-4
QUANTITIES = {"rollout_rmse_100": "100-step rollout error [m/s]", "stick_accuracy": "sticks predicted exactly"}


def look(name: str) -> dict[str, Any]:
    """Style of a model; variants of one have hollow markers."""
    found = style(name.split(",")[0])
    return found | {"markerfacecolor": "white"} if "," in name else found


def median(rows: Sequence[Row], column: str) -> float:
    """Median over seeds of what applies; NaN if nothing does."""
    values = [float(row[column]) for row in rows if row[column] == row[column]]
    return float(np.median(values)) if values else float("nan")


def summary(rows: Sequence[Row], column: str) -> tuple[float, float, float]:
    """Median, smallest and largest over seeds, cut to what is drawn; NaN counts as diverged."""
    values = np.array([float(row[column]) for row in rows])
    if column == "rollout_rmse_100":
        values = np.clip(np.nan_to_num(values, nan=LARGEST, posinf=LARGEST), SMALLEST, LARGEST)
    values = values[np.isfinite(values)]
    if not len(values):
        return float("nan"), float("nan"), float("nan")
    return float(np.median(values)), float(values.min()), float(values.max())


def against_time(rows: Sequence[Row], names: Sequence[str]) -> "Figure":
    """Rollout error and stick accuracy against training and prediction time, without noise and with 0.01 m/s."""
    noises = [noise for noise in (0.0, 0.01) if any(row["noise"] == noise for row in rows)]
    figure, axes = new_figure(2, 2 * len(noises), width=4.4 * len(noises), height=5.6)
    for j, noise in enumerate(noises):
        for i, (quantity, label) in enumerate(QUANTITIES.items()):
            for k, (cost, cost_label) in enumerate(
                (("train_seconds", "training time [s]"), ("predict_us", "one step [µs]"))
            ):
                ax = axes[i, 2 * j + k]
                for name in names:
                    own = [row for row in rows if (row["model"], row["noise"]) == (name, noise)]
                    if own:
                        _dot(ax, name, summary(own, cost), summary(own, quantity))
                _decades(ax, [float(row[cost]) for row in rows])
                _quantity_axis(ax, quantity, noise)
                if i == 0:
                    ax.set_title(f"noise {noise:g} m/s", fontsize=10)
                    ax.tick_params(labelbottom=False)
                else:
                    ax.set_xlabel(cost_label, fontsize=9)
                if 2 * j + k == 0:
                    ax.set_ylabel(label, fontsize=9)
                ax.tick_params(labelleft=k == 0)
    one_legend(figure, axes, columns=4)
    return figure


def _dot(ax: "Axes", name: str, x: tuple[float, float, float], y: tuple[float, float, float]) -> None:
    ax.errorbar(
        [x[0]], [y[0]], xerr=[[x[0] - x[1]], [x[2] - x[0]]], yerr=[[y[0] - y[1]], [y[2] - y[0]]], label=name,
        markersize=6, elinewidth=0.8, **(look(name) | {"linestyle": "none"}),
    )  # fmt: skip


def _decades(ax: "Axes", values: Sequence[float]) -> None:
    """Logarithmic x axis over whole decades, labelled at these only."""
    from matplotlib.ticker import NullFormatter

    finite = np.log10([value for value in values if np.isfinite(value) and value > 0])
    ax.set_xscale("log")
    ax.xaxis.set_minor_formatter(NullFormatter())
    if len(finite):
        ax.set_xlim(10 ** np.floor(finite.min()), min(10 ** (np.floor(finite.max()) + 1), 1e6))


def _quantity_axis(ax: "Axes", quantity: str, noise: float) -> None:
    if quantity == "stick_accuracy":
        ax.set_ylim(-0.05, 1.05)
    else:
        ax.set_yscale("log")
        ax.set_ylim((SMALLEST_WITH_NOISE if noise else SMALLEST) / 5, LARGEST * 3)


def against_samples(rows: Sequence[Row], names: Sequence[str]) -> "Figure":
    """Rollout error and stick accuracy against the number of training steps, a column a noise level."""
    noises = sorted({float(row["noise"]) for row in rows})
    figure, axes = new_figure(2, len(noises), width=2.9 * len(noises) + 0.6, height=5.6)
    for j, noise in enumerate(noises):
        for i, (quantity, label) in enumerate(QUANTITIES.items()):
            ax = axes[i, j]
            for at, name in enumerate(names):
                own = [row for row in rows if (row["model"], row["noise"]) == (name, noise)]
                sizes = sorted({float(row["size"]) for row in own})
                if not sizes:
                    continue
                points = [summary([row for row in own if row["size"] == size], quantity) for size in sizes]
                middle, low, high = np.array(points).T
                beside = np.array(sizes) * 1.04 ** (at - len(names) / 2)  # so that bars do not hide one another
                ax.errorbar(
                    beside, middle, yerr=(middle - low, high - middle), label=name,
                    markersize=4, linewidth=1.0, elinewidth=0.6, **look(name),
                )  # fmt: skip
            ax.set_xscale("log")
            _quantity_axis(ax, quantity, noise)
            if i == 0:
                ax.set_title(f"noise {noise:g} m/s", fontsize=10)
            else:
                ax.set_xlabel("training steps", fontsize=9)
            if j == 0:
                ax.set_ylabel(label, fontsize=9)
    one_legend(figure, axes, columns=4)
    return figure


def real_beside_simulated(slides: Sequence[Row], simulated: Sequence[Row]) -> "Figure":
    """Left: where real slides stop. Right: 100-step error of the same models on the simulated block."""
    learned_from = [row for row in slides if row["size"] == 40]
    noisy = [row for row in simulated if row["noise"] == 0.01]
    names = list(dict.fromkeys(str(row["model"]) for row in learned_from))
    figure, axes = new_figure(1, 2, width=7.5, height=1.2 + 0.45 * len(names))
    left, right = axes[0]
    for ax, rows, column in ((left, learned_from, "stop_error_median_mm"), (right, noisy, "rollout_rmse_100")):
        for at, name in enumerate(names):
            own = [row for row in rows if row["model"] == name]
            if own:
                middle, low, high = summary(own, column)
                dots = look(name) | {"linestyle": "none"}
                ax.errorbar([middle], [at], xerr=[[middle - low], [high - middle]], markersize=7, **dots)
        ax.set_ylim(len(names) - 0.5, -0.5)
        if ax is right:
            _decades(ax, [float(row[column]) for row in rows if row["model"] in names])
    at_rest = [median([row for row in learned_from if row["model"] == name], "rest_share") for name in names]
    labels = [f"{name}\n{share:.0%} at rest" for name, share in zip(names, at_rest, strict=True)]
    left.set_yticks(range(len(names)), labels, fontsize=9)
    right.set_yticks(range(len(names)), [])
    left.set_xlabel("median error of where a slide stops [mm]", fontsize=9)
    right.set_xlabel(QUANTITIES["rollout_rmse_100"], fontsize=9)
    left.set_title("real slides of a cube", fontsize=10)
    right.set_title("simulated block, noise 0.01 m/s", fontsize=10)
    return figure


def mode_bars(entries: Sequence[Sequence[Any]]) -> "Figure":
    """Share of modes foretold, on all steps and where the mode changes: (modes, model, exact twice, nearly twice)."""
    parts = list(dict.fromkeys(entry[0] for entry in entries))
    counts = [sum(entry[0] == part for entry in entries) for part in parts]
    figure, axes = new_figure(1, len(parts), width=8.5, height=1.3 + 0.3 * max(counts))
    for ax, part in zip(axes[0], parts, strict=True):
        own = [entry for entry in entries if entry[0] == part]
        at = np.arange(len(own))
        ax.barh(at - 0.2, [entry[2] for entry in own], 0.38, color=BLUE, label="all steps")
        ax.barh(at + 0.2, [entry[3] for entry in own], 0.38, color=ORANGE, label="steps where the mode changes")
        for shift, column in ((-0.2, 4), (0.2, 5)):
            ax.plot([entry[column] for entry in own], at + shift, "D", color="black", markersize=4,
                    markerfacecolor="white", label="if |v| < 0.01 m/s counts as stick")  # fmt: skip
        ax.set_yticks(at, [entry[1].replace("markov_chain", "Markov chain") for entry in own], fontsize=8)
        ax.set_ylim(max(counts) - 0.4, -0.6)
        ax.set_xlim(0, 1.03)
        ax.set_xlabel("share foretold", fontsize=9)
        ax.set_title(part, fontsize=10)
    one_legend(figure, axes, columns=3)
    return figure
