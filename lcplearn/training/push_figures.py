"""Pictures of pushes: where they ended and where a model says, and its error by configuration."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from lcplearn.datasets.pushes import PushData
from lcplearn.formulations.pushing import PushModel, PushPrediction, Supports
from lcplearn.scenes.pushed_object import rotate
from lcplearn.training.figures import new_figure
from lcplearn.training.push_metrics import by_configuration, errors, intervals

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CM = 100.0
NEWTON_CM = 1.5  # length of an arrow of one newton


def draw(model: PushModel, data: PushData, prediction: PushPrediction) -> dict[str, "Figure"]:
    """The pictures that a run leaves, by file name."""
    return {
        "pushes": draw_pushes(model, data, prediction),
        "configurations": draw_configurations(model, data, prediction),
    }


def draw_pushes(model: PushModel, data: PushData, prediction: PushPrediction, count: int = 6) -> "Figure":
    """A push of each of several configurations, the one of median error: start, recorded end, predicted end, forces."""
    deviation = errors(model, data, prediction).values["deviation_mm"]
    rows = []
    for k in data.configuration.unique()[:count]:
        own = (data.configuration == k).nonzero()[:, 0]
        rows.append(int(own[deviation[own].argsort()[len(own) // 2]]))
    lines = (len(rows) + 2) // 3
    figure, grid = new_figure(lines, 3, (4.2 * 3, 4.4 * lines + 0.6))
    axes = [ax for line in grid for ax in line]
    for ax, row in zip(axes, rows, strict=False):
        _draw_push(ax, data, prediction, row)
        name = data.names[int(data.configuration[row])]
        ax.set_title(f"{name}\ndeviation {float(deviation[row]):.2f} mm", fontsize=9)
    for ax in axes[len(rows) :]:
        ax.remove()
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=9)
    return figure


def draw_configurations(model: PushModel, data: PushData, prediction: PushPrediction) -> "Figure":
    """Mean deviation of each configuration."""
    found = errors(model, data, prediction)
    table = by_configuration(found, data)
    figure, ((ax,),) = new_figure(1, 1, (8.0, 0.42 * len(table) + 1.6))
    values = [row["deviation_mm"] for row in table.values()]
    lengths = [value if math.isfinite(value) else 0.0 for value in values]
    ax.barh(range(len(table)), lengths, color="C0", height=0.6)
    for k, (value, length) in enumerate(zip(values, lengths, strict=True)):
        ax.text(length + 0.02, k, f"{value:.2f}" if math.isfinite(value) else "diverged", va="center", fontsize=9)
    mean = found.figures()["deviation_mm"]
    if math.isfinite(mean):
        low, high = intervals(found, data)["deviation_mm"]
        ax.axvspan(low, high, color="0.85", zorder=0)
        ax.axvline(mean, color="0.4", lw=1, label=f"all: {mean:.2f} mm (95 %: {low:.2f} to {high:.2f})")
        ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), fontsize=9)
    ax.set_yticks(range(len(table)), list(table), fontsize=9)
    ax.invert_yaxis()
    ax.set_xlabel("mean deviation of the end pose [mm]")
    ax.margins(x=0.12)
    return figure


def animate_push(model: Supports, data: PushData, row: int, path: str | Path) -> None:
    """Write an animation of one push as the model sees it, with the recorded end, as GIF."""
    from matplotlib.animation import FuncAnimation, PillowWriter

    one = data.take(torch.tensor([row]))
    with torch.no_grad():
        pushed = model.path(one.pushes)
    figure, ((ax,),) = new_figure(1, 1, (5.0, 5.2))
    everything = _corners(data, torch.cat((pushed.poses[0], one.outcome.pose))).reshape(-1, 2) * CM
    low, high = everything.amin(0) - 2.0, everything.amax(0) + 2.0

    def frame(k: int) -> list[Any]:
        ax.clear()
        _outline(ax, data, one.pushes.push.pose[0], color="0.8")
        _outline(ax, data, one.outcome.pose[0], color="C2", ls="--", label="recorded end")
        _outline(ax, data, pushed.poses[0, k], color="C0", lw=2, label="model")
        _supports(ax, one, pushed.poses[0, k])
        finger = pushed.finger[0, k] * CM
        ax.plot(*finger, "o", color="k", ms=6)
        if k > 0:
            _arrow(ax, finger, pushed.forces[0, k - 1], "C3")
            ax.set_title(f"force {float(pushed.forces[0, k - 1].norm()):.1f} N", fontsize=10)
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x [cm]", ylabel="y [cm]")
        ax.legend(loc="upper right", fontsize=9)
        return []

    frames = [*range(pushed.poses.shape[1]), *[pushed.poses.shape[1] - 1] * 8]
    FuncAnimation(figure, frame, frames=frames).save(path, PillowWriter(fps=8), dpi=80)


def _draw_push(ax: "Axes", data: PushData, prediction: PushPrediction, row: int) -> None:
    one = data.take(torch.tensor([row]))
    start, end = (point[0] * CM for point in (one.pushes.push.start, one.pushes.push.end))
    _outline(ax, data, one.pushes.push.pose[0], color="0.75", label="start")
    _outline(ax, data, one.outcome.pose[0], color="C2", ls="--", lw=1.8, label="recorded end")
    _outline(ax, data, prediction.pose[row], color="C0", lw=1.8, label="predicted end")
    _supports(ax, one, one.pushes.push.pose[0])
    ax.plot(*torch.stack((start, end), 1), color="k", lw=1.2, label="finger")
    ax.plot(*end, "o", color="k", ms=4)
    forces = [(one.outcome.force[0], "C2")] + ([] if prediction.force is None else [(prediction.force[row], "C0")])
    for force, color in forces:
        _arrow(ax, end, force, color)
    ax.set(aspect="equal", xlabel="x [cm]", ylabel="y [cm]")


def _arrow(ax: "Axes", foot: Tensor, force: Tensor, color: str) -> None:
    (x, y), (tip_x, tip_y) = foot.tolist(), (foot + force * NEWTON_CM).tolist()
    ax.annotate("", (tip_x, tip_y), (x, y), arrowprops={"arrowstyle": "->", "color": color, "lw": 1.8})
    ax.update_datalim([(tip_x, tip_y)])


def _outline(ax: "Axes", data: PushData, pose: Tensor, **style: Any) -> None:
    corners = _corners(data, pose[None])[0] * CM
    ax.plot(*torch.cat((corners, corners[:1])).T, **style)


def _supports(ax: "Axes", one: PushData, pose: Tensor) -> None:
    points = one.pushes.points[0]
    if not bool(points.isnan().any()):
        there = (rotate(pose[2].expand(3), points) + pose[:2]) * CM
        ax.plot(*there.T, "^", color="0.5", ms=5, ls="none", label="supports")


def _corners(data: PushData, poses: Tensor) -> Tensor:
    return rotate(poses[:, 2, None], data.vertices.expand(len(poses), -1, 2)) + poses[:, None, :2]
