"""Pictures of a tossed cube: a filmstrip, an animation, learned corners, contact modes along a toss."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.formulations.cube_corners import FACES, CubeCorners
from lcplearn.formulations.cube_network import CubeNetwork
from lcplearn.scenes.scene import Mode
from lcplearn.scenes.space import rotation_matrix
from lcplearn.scenes.spatial_body import box_corners
from lcplearn.training.metrics import Predictions
from lcplearn.training.toss_metrics import score_tosses

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RECORDED, PREDICTED = "0.35", "tab:red"
# Corners are numbered as the bits of their signs; an edge joins those that differ in one.
EDGES = tuple((a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4))
COLOURS = {Mode.STICK: "tab:blue", Mode.SLIP: "tab:orange", Mode.SEPARATION: "0.92"}


class Toss(NamedTuple):
    """A recorded toss and its prediction: states [rows, 13], what each contact does [T, C], the time between rows."""

    recorded: Tensor
    predicted: Tensor
    mode: Tensor
    half_width: float
    dt: float
    corners: Tensor | None


def median_toss(found: Predictions) -> Toss:
    """The toss whose error, position integral [% width] plus rotation integral [deg], is the median of all."""
    test, path, half_width = found.task.test, found.test, found.task.given["half_width"]
    predicted = path.states
    scores = score_tosses(test.states, predicted, test.steps, half_width)
    error = scores["position integral [% width]"] + scores["rotation integral [deg]"]
    chosen = int(error.argsort()[len(error) // 2])
    rows = int(test.steps[chosen]) + 1
    corners = found.model.numbers()["corners"].detach() if isinstance(found.model, CubeCorners) else None
    return Toss(
        test.states[chosen, :rows],
        predicted[chosen, :rows],
        path.mode[chosen, : rows - 1],
        half_width,
        found.task.dt,
        corners,
    )


def draw(found: Predictions) -> dict[str, "Figure"]:
    """The toss of median error as a filmstrip and by its contacts; learned corners or laws, where they are."""
    toss, model = median_toss(found), found.model
    pictures = {"filmstrip": filmstrip(toss)}
    if model.contacts == 8:
        pictures["contact_modes"] = contact_modes(toss)
    if isinstance(model, CubeCorners) and toss.corners is not None:
        start = CubeCorners(**dict(model.arguments)).numbers()["corners"].detach()
        pictures["corners"] = corner_views(toss.corners, start, toss.half_width)
    if isinstance(model, CubeNetwork) and model.corrects != "force":
        pictures["law"] = law_view(model)
    return pictures


def filmstrip(toss: Toss, *, frames: int = 6) -> "Figure":
    """A recorded toss and its prediction at a few instants."""
    figure, axes = _scenes(frames, (2.0 * frames, 2.1))
    chosen = torch.linspace(0, len(toss.recorded) - 1, frames).round().long().tolist()
    limits = _limits(toss)
    for ax, row in zip(axes, chosen, strict=True):
        _frame(ax, toss, row, limits)
        ax.set_title(f"{row * toss.dt:.2f} s", fontsize=9, y=1.0)
    figure.supxlabel("a real toss (grey), and predicted from its first row alone (red)", fontsize=10)
    return figure


def animation(toss: Toss, *, every: int = 3) -> bytes:
    """The same as a GIF, every third row at a quarter of the speed."""
    from matplotlib.animation import FuncAnimation, PillowWriter

    figure, (ax,) = _scenes(1, (5.0, 3.4))
    limits = _limits(toss)

    def show(row: int) -> list[Any]:
        ax.clear()
        _frame(ax, toss, row, limits)
        ax.set_title(f"{row * toss.dt:.2f} s   recorded (grey), predicted (red)", fontsize=9)
        return []

    rows = [*range(0, len(toss.recorded), every), *[len(toss.recorded) - 1] * 8]
    moving = FuncAnimation(figure, show, frames=rows)
    with TemporaryDirectory() as folder:  # PillowWriter writes to a path only
        path = Path(folder) / "toss.gif"
        moving.save(path, writer=PillowWriter(fps=round(1.0 / (4.0 * every * toss.dt))), dpi=84)
        return path.read_bytes()


def log_animation(writer: Any, moving: bytes, step: int) -> None:
    """Show a GIF among TensorBoard's images, which its own call for videos does only with another package."""
    from tensorboard.compat.proto.summary_pb2 import Summary

    image = Summary.Image(encoded_image_string=moving, colorspace=3)
    writer.file_writer.add_summary(Summary(value=[Summary.Value(tag="test/toss", image=image)]), step)
    writer.flush()


def corner_views(learned: Float[Tensor, "8 3"], start: Float[Tensor, "8 3"], half_width: float) -> "Figure":
    """Learned corners from three sides, with where they started and the published cube."""
    figure, axes = _figure(1, 3, (10.5, 3.8))
    true = box_corners(torch.full((3,), half_width, dtype=learned.dtype))
    reach = 1.1e3 * float(torch.stack((learned, start, true)).abs().max())
    styles: tuple[tuple[str, Tensor, dict[str, Any]], ...] = (
        ("published cube", true, {"color": "0.7", "linewidth": 4.0, "alpha": 0.6}),
        ("start", start, {"color": "tab:blue", "linewidth": 0.9, "linestyle": ":"}),
        ("learned", learned, {"color": PREDICTED, "linewidth": 1.4, "marker": "."}),
    )
    for ax, (a, b), view in zip(axes[0], ((0, 1), (0, 2), (1, 2)), ("top", "front", "side"), strict=True):
        for name, shape, style in styles:
            for number, (i, j) in enumerate(EDGES):
                ends = 1e3 * shape[[i, j]]
                ax.plot(ends[:, a], ends[:, b], label=None if number else name, **style)
        ax.set(aspect="equal", title=view, xlabel=f"{'xyz'[a]} [mm]", ylabel=f"{'xyz'[b]} [mm]")
        ax.set(xlim=(-reach, reach), ylim=(-reach, reach))
    axes[0][0].legend(fontsize=8, loc="center")
    return figure


def law_view(model: CubeNetwork) -> "Figure":
    """Learned friction or restitution against the closing speed."""
    figure, axes = _figure(1, 1, (5.0, 3.2))
    ax, speed = axes[0][0], torch.linspace(0.0, 2.0, 201, dtype=torch.float64)
    ax.plot(speed, model.law(speed), color=PREDICTED)
    ax.set(xlabel="closing speed [m/s]", ylabel=model.corrects, xlim=(0.0, float(speed[-1])), ylim=(0.0, None))
    ax.grid(alpha=0.3)
    return figure


def contact_modes(toss: Toss) -> "Figure":
    """What each corner does along a predicted toss, under the speeds."""
    figure, axes = _figure(2, 1, (8.0, 5.0))
    dt, mode = toss.dt, toss.mode
    time = torch.arange(len(toss.predicted)) * dt
    for states, colour, name in ((toss.recorded, RECORDED, "recorded"), (toss.predicted, PREDICTED, "predicted")):
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


def _frame(ax: Any, toss: Toss, row: int, limits: Sequence[tuple[float, float]]) -> None:
    """Two bodies over the board."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    cube = box_corners(torch.full((3,), toss.half_width, dtype=torch.float64))
    (x0, x1), (y0, y1), (z0, z1) = limits
    board = [(x0, y0, 0.0), (x1, y0, 0.0), (x1, y1, 0.0), (x0, y1, 0.0)]
    ax.computed_zorder = False  # matplotlib would guess which of two bodies is in front
    ax.add_collection3d(Poly3DCollection([board], facecolor="0.95", edgecolor="0.75", zorder=1, clip_on=False))
    learned = cube if toss.corners is None else toss.corners
    bodies = (
        (toss.recorded[row], cube, {"facecolor": (0.2, 0.2, 0.2, 0.12), "edgecolor": "0.45", "linewidth": 1.6}),
        (toss.predicted[row], learned, {"facecolor": (0.0, 0.0, 0.0, 0.0), "edgecolor": PREDICTED, "linewidth": 1.2}),
    )
    for zorder, (state, shape, style) in enumerate(bodies, 2):
        points = state[:3] + shape @ rotation_matrix(state[3:7] / state[3:7].norm()).mT
        faces = [points[[a, b, d, c]].tolist() for a, b, c, d in FACES]
        ax.add_collection3d(Poly3DCollection(faces, zorder=zorder, clip_on=False, **style))
    ax.set(xlim=(x0, x1), ylim=(y0, y1), zlim=(z0, z1))
    ax.set_box_aspect((x1 - x0, y1 - y0, z1 - z0), zoom=1.2)
    ax.set_axis_off()


def _limits(toss: Toss) -> list[tuple[float, float]]:
    places, margin = torch.cat((toss.recorded[:, :3], toss.predicted[:, :3])), 1.8 * toss.half_width
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
    from lcplearn.training.figures import new_figure

    return new_figure(rows, columns, size)
