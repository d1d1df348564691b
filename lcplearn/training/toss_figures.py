"""Pictures of a tossed cube: a filmstrip, an animation, learned corners, contact modes along a toss."""

from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lcplearn.scenes.scene import Mode
from lcplearn.scenes.space import rotation_matrix
from lcplearn.scenes.spatial_body import box_corners

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RECORDED, PREDICTED = "0.35", "tab:red"
# Corners are numbered as the bits of their signs; an edge joins those that differ in one.
EDGES = tuple((a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4))
COLOURS = {Mode.STICK: "tab:blue", Mode.SLIP: "tab:orange", Mode.SEPARATION: "0.92"}


def filmstrip(
    recorded: Float[Tensor, "rows 13"],
    predicted: Float[Tensor, "rows 13"],
    half_width: float,
    dt: float,
    *,
    corners: Float[Tensor, "8 3"] | None = None,
    frames: int = 6,
) -> "Figure":
    """A recorded toss beside its prediction, at a few instants.

    Args:
        recorded, predicted: States of one toss.
        half_width: Half of the cube's width [m].
        dt: Time between rows [s].
        corners: Those of the predicted body [m]; the cube's by default.
        frames: How many instants.
    """
    figure, axes = _scenes(frames, (2.6 * frames, 3.0))
    chosen = torch.linspace(0, len(recorded) - 1, frames).round().long().tolist()
    limits = _limits(recorded, predicted, half_width)
    for ax, row in zip(axes, chosen, strict=True):
        _frame(ax, recorded[row], predicted[row], half_width, corners, limits)
        ax.set_title(f"{row * dt:.2f} s", fontsize=9, y=0.92)
    figure.suptitle("recorded (grey) and predicted from the first row alone (red)", fontsize=10)
    return figure


def animation(
    recorded: Float[Tensor, "rows 13"],
    predicted: Float[Tensor, "rows 13"],
    half_width: float,
    dt: float,
    *,
    corners: Float[Tensor, "8 3"] | None = None,
    every: int = 2,
) -> bytes:
    """The same as a GIF, every second row at a quarter of the speed."""
    from matplotlib.animation import FuncAnimation, PillowWriter

    figure, (ax,) = _scenes(1, (4.2, 3.4))
    limits = _limits(recorded, predicted, half_width)

    def draw(row: int) -> list[Any]:
        ax.clear()
        _frame(ax, recorded[row], predicted[row], half_width, corners, limits)
        ax.set_title(f"{row * dt:.2f} s   recorded (grey), predicted (red)", fontsize=9)
        return []

    rows = [*range(0, len(recorded), every), *[len(recorded) - 1] * 8]
    film = FuncAnimation(figure, draw, frames=rows)
    with TemporaryDirectory() as folder:  # PillowWriter writes to a path only
        path = Path(folder) / "toss.gif"
        film.save(path, writer=PillowWriter(fps=round(1.0 / (4.0 * every * dt))), dpi=72)
        return path.read_bytes()


def corner_views(learned: Float[Tensor, "8 3"], start: Float[Tensor, "8 3"], half_width: float) -> "Figure":
    """Learned corners from three sides, with where they started and the published cube."""
    figure, axes = _figure(1, 3, (10.5, 3.8))
    true = box_corners(torch.full((3,), half_width, dtype=learned.dtype))
    for ax, (a, b), name in zip(axes[0], ((0, 1), (0, 2), (1, 2)), ("top", "front", "side"), strict=True):
        styles: list[tuple[Tensor, dict[str, Any]]] = [
            (true, {"color": "0.7", "linewidth": 4.0, "alpha": 0.6}),
            (start, {"color": "tab:blue", "linewidth": 0.7, "linestyle": ":"}),
            (learned, {"color": PREDICTED, "linewidth": 1.4, "marker": "."}),
        ]
        for shape, style in styles:
            for i, j in EDGES:
                ax.plot([shape[i, a], shape[j, a]], [shape[i, b], shape[j, b]], **style)
        ax.set(aspect="equal", title=name, xlabel=f"{'xyz'[a]} [m]", ylabel=f"{'xyz'[b]} [m]")
    for colour, name in (("0.7", "published cube"), ("tab:blue", "start"), (PREDICTED, "learned")):
        axes[0][0].plot([], [], color=colour, label=name)
    axes[0][0].legend(fontsize=8)
    return figure


def contact_modes(
    recorded: Float[Tensor, "rows 13"], predicted: Float[Tensor, "rows 13"], mode: Int[Tensor, "T 8"], dt: float
) -> "Figure":
    """What each corner does along a predicted toss, over the speeds."""
    figure, axes = _figure(2, 1, (8.0, 5.0))
    time = torch.arange(len(predicted)) * dt
    for states, colour, name in ((recorded, RECORDED, "recorded"), (predicted, PREDICTED, "predicted")):
        axes[0][0].plot(time, states[:, 7:10].norm(dim=-1), color=colour, label=name)
    axes[0][0].set(ylabel="speed [m/s]", xlim=(0.0, float(time[-1])))
    axes[0][0].legend(fontsize=8)
    ax = axes[1][0]
    for corner in range(mode.shape[1]):
        for kind, colour in COLOURS.items():
            spans = [(float(k * dt), dt) for k in torch.nonzero(mode[:, corner] == kind)[:, 0]]
            ax.broken_barh(spans, (corner + 0.55, 0.9), facecolors=colour, linewidth=0)
    for kind, colour in COLOURS.items():
        ax.plot([], [], color=colour, linewidth=6, label=kind.name.lower())
    ax.set(xlabel="time [s]", ylabel="corner", xlim=(0.0, float(time[-1])), yticks=range(1, mode.shape[1] + 1))
    ax.legend(fontsize=8, ncols=3, loc="upper left", bbox_to_anchor=(0.0, 1.16), frameon=False)
    return figure


def error_against_tosses(
    learned: Mapping[str, Sequence[tuple[int, float]]], anchors: Mapping[str, float], unit: str
) -> "Figure":
    """Error of learned models against the number of tosses they learned from; anchors are lines.

    Args:
        learned: By name, (tosses, error) of each run.
        anchors: Errors of systems that learned from all, or not at all, by name.
        unit: Label of the error.
    """
    figure, axes = _figure(1, 1, (6.5, 4.2))
    ax = axes[0][0]
    for index, (name, points) in enumerate(learned.items()):
        counts = sorted({count for count, _ in points})
        runs = [sorted(error for count, error in points if count == chosen) for chosen in counts]
        ax.plot(counts, [run[len(run) // 2] for run in runs], marker="o", color=f"C{index}", label=name)
        ax.fill_between(counts, [run[0] for run in runs], [run[-1] for run in runs], color=f"C{index}", alpha=0.2)
    for index, (name, error) in enumerate(anchors.items()):
        ax.axhline(error, color="0.4", linestyle=("-", "--", ":", "-.")[index % 4], linewidth=1.0, label=name)
    ax.set(xscale="log", xlabel="tosses to learn from", ylabel=unit)
    ax.set_xticks([1, 4, 16, 64], ["1", "4", "16", "64"])
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)
    return figure


def as_png(figure: "Figure", dpi: int = 120) -> bytes:
    """A figure as the bytes of a PNG."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def _frame(
    ax: Any,
    recorded: Float[Tensor, " 13"],
    predicted: Float[Tensor, " 13"],
    half_width: float,
    corners: Float[Tensor, "8 3"] | None,
    limits: Sequence[tuple[float, float]],
) -> None:
    """Two bodies over the board."""
    cube = box_corners(torch.full((3,), half_width, dtype=torch.float64))
    (x0, x1), (y0, y1), (z0, z1) = limits
    ax.plot([x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0], [0.0] * 5, color="0.8", linewidth=0.8)
    body = cube if corners is None else corners
    for state, shape, style in (
        (recorded, cube, {"color": RECORDED, "linewidth": 2.4, "alpha": 0.6}),
        (predicted, body, {"color": PREDICTED, "linewidth": 1.2}),
    ):
        points = state[:3] + shape @ rotation_matrix(state[3:7] / state[3:7].norm()).mT
        for i, j in EDGES:
            ax.plot(*zip(points[i].tolist(), points[j].tolist(), strict=True), **style)
    ax.set(xlim=(x0, x1), ylim=(y0, y1), zlim=(z0, z1))
    ax.set_box_aspect((x1 - x0, y1 - y0, z1 - z0), zoom=1.35)
    ax.set_axis_off()


def _limits(recorded: Tensor, predicted: Tensor, half_width: float) -> list[tuple[float, float]]:
    places, margin = torch.cat((recorded[:, :3], predicted[:, :3])), 1.8 * half_width
    low, high = places.amin(0) - margin, places.amax(0) + margin
    low[2] = 0.0
    return list(zip(low.tolist(), high.tolist(), strict=True))


def _scenes(count: int, size: tuple[float, float]) -> tuple["Figure", list[Any]]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    axes = [figure.add_subplot(1, count, k + 1, projection="3d", elev=22, azim=-60) for k in range(count)]
    return figure, axes


def _figure(rows: int, columns: int, size: tuple[float, float]) -> tuple["Figure", list[list["Axes"]]]:
    from lcplearn.training.figures import _figure as figure

    return figure(rows, columns, size)
