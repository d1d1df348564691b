"""How figures look: one style for each method in all of them, sizes that stay readable at half a page."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class Style(NamedTuple):
    """Colour, marker and dashes of a method."""

    color: str
    marker: str = "o"
    linestyle: str = "-"


# Okabe and Ito's palette, told apart by colour-blind readers too. Markers and dashes repeat what colours say.
BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, RED, PINK = (
    "#000000", "#E69F00", "#56B4E9", "#009E73", "#D6C700", "#0072B2", "#D55E00", "#CC79A7"
)  # fmt: skip

STYLES: dict[str, Style] = {
    # solvers
    "pivoting": Style(BLUE, "o"),
    "interior_point": Style(ORANGE, "s"),
    "smoothed": Style(PINK, "D", "-."),
    "diagonal": Style(GREEN, "^"),
    "quantecon": Style(RED, "v", "--"),
    # formulations
    "affine": Style("#888888", "P", ":"),
    "mlp": Style(BLACK, "X", ":"),
    "force_mlp": Style(BLACK, "x", "-."),
    "direct": Style(BLUE, "o"),
    "slack": Style(SKY, "v", "--"),
    "relu": Style(PINK, "D"),
    "traditional": Style(RED, "s"),
    "psd": Style(ORANGE, "h", "--"),
    "psd_skew": Style(YELLOW, "p", "-."),
    "structured": Style(GREEN, "^"),
    "physical": Style(GREEN, "*", "--"),
}


def style(name: str) -> dict[str, Any]:
    """Keywords of `Axes.plot` for a method; "interior_point 1e-6" and the like have the style of their first word."""
    found = STYLES.get(name) or STYLES.get(name.split(" ")[0]) or Style("#555555", ".", ":")
    return {"color": found.color, "marker": found.marker, "linestyle": found.linestyle}


def new_figure(
    rows: int = 1, columns: int = 1, *, width: float = 7.0, height: float = 4.5
) -> "tuple[Figure, np.ndarray]":
    """An empty figure [inches] and its axes [rows, columns]; belongs to no window and needs no closing."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False)
    for ax in axes.flat:
        ax.grid(alpha=0.3, linewidth=0.6)
        ax.set_axisbelow(True)
    return figure, axes


def whole_decades(ax: "Axes", axis: str) -> None:
    """A logarithmic axis from one power of ten to another, so that it has at least two labels."""
    low, high = ax.get_xlim() if axis == "x" else ax.get_ylim()
    limits = 10.0 ** np.floor(np.log10(low)), 10.0 ** np.ceil(np.log10(high))
    ax.set(**{f"{axis}scale": "log", f"{axis}lim": limits})


def one_legend(figure: "Figure", axes: np.ndarray, columns: int = 4) -> None:
    """One legend below all axes, each label once."""
    entries: dict[str, Any] = {}
    for ax in axes.flat:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    figure.legend(
        list(entries.values()), list(entries), loc="outside lower center", ncols=columns, frameon=False, fontsize=9
    )


def heat_map(
    ax: "Axes", values: np.ndarray, rows: list[str], columns: list[str], words: np.ndarray, **options: Any
) -> Any:
    """Cells coloured by value with a word in each, dark ones in white; returns the image, for a colour bar."""
    image = ax.imshow(values, aspect="auto", **{"cmap": "viridis", **options})
    ax.set_xticks(range(len(columns)), columns, rotation=45, ha="right")
    ax.set_yticks(range(len(rows)), rows)
    ax.grid(False)
    for i in range(len(rows)):
        for j in range(len(columns)):
            red, green, blue, _ = image.cmap(image.norm(values[i, j]))
            dark = 0.3 * red + 0.6 * green + 0.1 * blue < 0.5
            ax.text(j, i, str(words[i, j]), ha="center", va="center", fontsize=8, color="white" if dark else "black")
    return image
