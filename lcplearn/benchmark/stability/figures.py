"""Figures of `benchmark stability`."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lcplearn.benchmark.harness.figures import heat_map, new_figure, one_legend, style
from lcplearn.benchmark.harness.study import Row
from lcplearn.benchmark.stability import noise as noise_study
from lcplearn.benchmark.stability.sweeps import LABELS, SWEEPS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# of the worst case in a family: blue is right, towards red it gets worse; told apart by brightness too
VERDICT_COLORS = ("#0072B2", "#9FD0EE", "#F5D76E", "#B33C00")
FLOOR = 1e-18  # drawn in place of an error of exactly 0


def verdict_map(cases: Sequence[Row], methods: Sequence[str], verdicts: Sequence[str]) -> "Figure":
    """Families against methods: how many cases are right, coloured by the worst verdict."""
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.patches import Patch

    families = list(dict.fromkeys(str(row["family"]) for row in cases))
    values = np.full((len(families), len(methods)), np.nan)
    words = np.full(values.shape, "", dtype=object)
    for i, family in enumerate(families):
        for j, method in enumerate(methods):
            found = [row["verdict"] for row in cases if (row["family"], row["method"]) == (family, method)]
            if found:
                values[i, j] = max(verdicts.index(str(verdict)) for verdict in found)
                words[i, j] = f"{found.count('right')}/{len(found)}"
    figure, axes = new_figure(width=7.0, height=1.8 + 0.27 * len(families))
    colors = ListedColormap(list(VERDICT_COLORS))
    norm = BoundaryNorm(np.arange(-0.5, len(verdicts)), colors.N)
    names = [method.replace("interior_point", "interior point") for method in methods]
    heat_map(axes[0, 0], values, families, names, words, cmap=colors, norm=norm)
    axes[0, 0].set_facecolor("#EEEEEE")
    patches = [Patch(color=color, label=name) for color, name in zip(VERDICT_COLORS, verdicts, strict=True)]
    patches.append(Patch(color="#EEEEEE", label="does not apply"))
    figure.legend(handles=patches, loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    axes[0, 0].set_title("cases handled rightly; colour: the worst of them", fontsize=10)
    return figure


def sweep_lines(rows: Sequence[Row]) -> "Figure":
    """Error against each difficulty, one panel each."""
    figure, axes = new_figure(2, 3, width=8.0, height=5.5)
    for ax, name in zip(axes.flat, SWEEPS, strict=False):
        own = [row for row in rows if row["family"] == name and row["status"] != "does not apply"]
        for method in dict.fromkeys(str(row["method"]) for row in own):
            points = sorted((float(r["x"]), max(float(r["error"]), FLOOR), float(r["solved"])) for r in own
                            if r["method"] == method)  # fmt: skip
            x, error, solved = np.array(points).T
            look: dict[str, Any] = style(method)
            if "float32" in method:
                look |= {"linestyle": ":", "markerfacecolor": "white"}
            ax.loglog(x, error, label=method.replace("_", " "), markersize=4, linewidth=1.2, **look)
            failed = solved < 1
            ax.loglog(x[failed], error[failed], "x", color="black", markersize=8, label="not all solved")
        ax.set_xlabel(LABELS[name], fontsize=9)
        ax.set_ylim(FLOOR / 3, 1e2)
        ax.tick_params(labelsize=8)
    for ax in axes[:, 0]:
        ax.set_ylabel("largest relative error")
    axes[1, 2].set_visible(False)
    one_legend(figure, axes, columns=3)
    return figure


def noise_maps(rows: Sequence[Row]) -> "Figure":
    """Share of blocks that still stick: forms against sigma for u = 0 and u != 0, and entry by entry."""
    forms = list(noise_study.FORMS)
    sigmas = sorted({float(row["x"]) for row in rows})
    found = {(row["method"], row["family"], row["case"], row["x"]): float(row["sticks"]) for row in rows}
    figure, axes = new_figure(2, 2, width=7.5, height=5.8)
    for ax, push in zip(axes[0], noise_study.PUSHES, strict=True):
        values = np.array([[found[form, push, "all", sigma] for sigma in sigmas] for form in forms])
        labels = [str(round(np.log10(sigma))) for sigma in sigmas]
        image = heat_map(ax, values, forms, labels, _words(values), cmap="cividis", vmin=0, vmax=1)
        ax.set_title(f"noise on all entries, {_push(push)}", fontsize=10)
        ax.set_xlabel(r"noise, $\log_{10} \sigma$", fontsize=9)
        ax.tick_params(axis="x", rotation=0)
    axes[0, 1].set_yticklabels([])
    for ax, push in zip(axes[1], noise_study.PUSHES, strict=True):
        single = {row["case"]: float(row["sticks"]) for row in rows if row["family"] == push}
        grid = np.array([[single[float(3 * i + j)] if j < 3 else single[float(9 + i)] for j in range(4)]
                         for i in range(3)])  # fmt: skip
        columns = [r"$\lambda_+$", r"$\lambda_-$", r"$\gamma$", "q"]
        heat_map(ax, grid, ["row 1", "row 2", "row 3"], columns, _words(grid), cmap="cividis", vmin=0, vmax=1)
        ax.set_title(f"traditional, one entry, {_push(push)}", fontsize=10)
        ax.tick_params(axis="x", rotation=0)
    axes[1, 1].set_yticklabels([])
    figure.colorbar(image, ax=axes, label="share that still sticks, |v| < 1e-12 m/s", shrink=0.8)
    return figure


def _push(push: str) -> str:
    return push.replace("!=", "≠")


def _words(values: np.ndarray) -> np.ndarray:
    return np.array(
        [
            [f"{value:.2f}".removeprefix("0") if 0.005 < value < 0.995 else f"{value:.0f}" for value in row]
            for row in values
        ]
    )
