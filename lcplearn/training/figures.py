"""Pictures of a trained model: the one-step map, rollouts against the truth, and the error over the horizon."""

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from lcplearn.formulations import Formulation
from lcplearn.scenes.scene import STICK_SPEED, Drive
from lcplearn.training import toss_figures
from lcplearn.training.metrics import Predictions

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TRUE: dict[str, Any] = {"color": "black", "linewidth": 5.0, "alpha": 0.25}
ROUNDING = 2.2e-16  # of a velocity of 1 m/s
LEARNED: dict[str, Any] = {"color": "tab:red", "linewidth": 1.4}


def draw(found: Predictions) -> dict[str, "Figure"]:
    """Draw what applies to a task and a model, from predictions that judges have asked for already.

    Returns:
        Figures by name: rollouts, error_over_horizon; of tosses those of `toss_figures`; stops on slides; else on a
        line, for models that need no measured friction, one_step_map.
    """
    pictures = {"rollouts": rollouts(found), "error_over_horizon": error_over_horizon(found)}
    if "tosses" in found.task.judged_by:
        pictures |= toss_figures.draw(found)
    if "stops" in found.task.judged_by:
        pictures["stops"] = stops(found)
    elif found.model.space.nv == 1 and not found.model.needs_friction:  # no force acts on slides
        pictures["one_step_map"] = one_step_map(found)
    return pictures


@torch.no_grad()
def one_step_map(found: Predictions, speeds: tuple[float, ...] = (-0.3, 0.0, 0.3)) -> "Figure":
    """Velocity after a step from position 0 against the force, for a few velocities before it, and the true one."""
    figure, axes = new_figure(1, 1, (7.0, 4.5))
    ax, task = axes[0][0], found.task
    reach = 2.0 * float(task.test.drive.force.abs().max()) or 1.0
    force = torch.linspace(-reach, reach, 801, dtype=torch.float64).unsqueeze(-1)
    drive = Drive(force)
    for index, speed in enumerate(speeds):
        state = torch.tensor([0.0, speed], dtype=torch.float64).expand(len(force), 2)
        colour, after = f"C{index}", found.model.advance(state, drive).state[:, 1]
        if task.scene is not None:
            exact = task.scene.advance(state, drive).state[:, 1]
            ax.plot(force, exact, color=colour, linewidth=5, alpha=0.25)
            sticks = force[exact.abs() < STICK_SPEED]
            if speed == 0.0 and len(sticks):
                band = (float(sticks.min()), float(sticks.max()))
                ax.axvspan(*band, color="0.9", zorder=0, label="sticks from rest")
        ax.plot(force, after, color=colour, linewidth=1.4, label=f"from {speed:+.1f} m/s" if speed else "from rest")
    ax.axhline(0.0, color="0.6", linewidth=0.8, zorder=0)
    ax.set(xlabel="force [N]", ylabel="velocity after the step [m/s]")
    wide = " (thin) and truth (wide)" if task.scene is not None else ""
    ax.set_title(f"One-step map: learned{wide}")
    ax.legend(fontsize=9)
    return figure


def rollouts(found: Predictions, count: int = 3) -> "Figure":
    """Velocity (or speed) of a few test recordings, predicted from their start; strips show when the body rests."""
    figure, axes = new_figure(count, 1, (8.0, 2.1 * count + 0.6))
    task, model = found.task, found.model
    chosen = torch.linspace(0, len(task.test.steps) - 1, count).long()  # those from rest come first
    test = task.test.map(lambda values: values[chosen])
    simulated = test.true_states is not None
    velocity, true = (_velocity(model, v) for v in (found.test.velocities[chosen], model.space.split(test.truth)[1]))
    name, what = "true" if simulated else "recorded", "velocity" if model.space.nv == 1 else "speed"
    for row, ax in enumerate(ax for line in axes for ax in line):
        steps = int(test.steps[row])
        time = torch.arange(steps + 1) * task.dt
        ax.plot(time, true[row, : steps + 1], label=name, **TRUE)
        predicted = velocity[row, : steps + 1]
        low, high = _limits(predicted, true[row, : steps + 1])
        far = 10.0 * max(-low, high)  # outside of the axes, where matplotlib can still draw it
        ax.plot(time, predicted.clamp(-far, far), label="rolled out from the start", **LEARNED)
        ax.set(ylim=(low - 0.22 * (high - low), high), ylabel=f"{what} [m/s]")
        if simulated:  # a measured velocity is never exactly zero
            strip(ax, time, true[row, : steps + 1], 0.01, "black", "true at rest", alpha=0.35)
        strip(ax, time, velocity[row, : steps + 1], 0.08, "tab:red", "predicted at rest")
    axes[-1][0].set_xlabel("time [s]")
    axes[0][0].legend(fontsize=8, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    return figure


def stops(found: Predictions) -> "Figure":
    """How far each slide goes: predicted from its start against recorded."""
    figure, axes = new_figure(1, 1, (5.2, 4.8))
    test = found.task.test
    rows, positions = torch.arange(len(test.steps)), (found.test.positions[..., 0], test.states[..., 0])
    predicted, recorded = (1e3 * (x[rows, test.steps] - x[:, 0]) for x in positions)
    diverged = int((~predicted.isfinite()).sum())
    ax, reach = axes[0][0], float(recorded.max())
    ax.plot([0.0, reach], [0.0, reach], color="0.6", linewidth=1.0)
    ax.plot(recorded, predicted, ".", color=LEARNED["color"], alpha=0.6)
    error = (predicted - recorded).abs().quantile(0.5)
    ax.set(xlabel="recorded distance [mm]", ylabel="predicted distance [mm]", aspect="equal")
    if not bool((predicted.abs() < 3.0 * reach).all()):
        ax.set(ylim=(-0.05 * reach, 3.0 * reach))
    ax.set_title(
        f"{len(rows)} slides to rest: median error {error:.1f} mm" + (f", {diverged} diverged" if diverged else ""),
        fontsize=11,
    )
    ax.grid(alpha=0.3)
    return figure


def strip(
    ax: "Axes", time: Tensor, velocity: Tensor, bottom: float, colour: str, label: str, alpha: float = 1.0
) -> None:
    """Mark the steps that begin at rest, at a height given in parts of the axes."""
    still, dt = velocity[:-1].abs() < STICK_SPEED, float(time[1] - time[0])
    spans = [(float(start), dt) for start in time[:-1][still]] or [(0.0, 0.0)]
    ax.broken_barh(
        spans, (bottom, 0.05), facecolors=colour, alpha=alpha, linewidth=0,
        transform=ax.get_xaxis_transform(), label=label,
    )  # fmt: skip


def error_over_horizon(found: Predictions) -> "Figure":
    """Root mean square and largest error of the velocity against the steps since the start of the rollout."""
    figure, axes = new_figure(1, 1, (7.0, 4.0))
    recordings, path = found.long_recordings, found.long
    error = found.model.velocity_error(path.states[:, 1:], recordings.truth[:, 1:]).sqrt()
    known = recordings.valid
    error = torch.where(known, error, 0.0)
    error = error.nan_to_num(nan=1e12).clamp(max=1e12)  # more is not drawn: it has diverged
    rms = (error.square().sum(0) / known.sum(0).clamp(min=1)).sqrt()
    steps = torch.arange(1, len(rms) + 1)
    ax = axes[0][0]
    floor = 1e-17  # exact zeros, which a logarithmic axis can't show
    if float(rms.min()) < 1e3 * ROUNDING:  # else it would only stretch the axis
        ax.axhline(ROUNDING, color="0.5", linewidth=0.8, linestyle=":", label="rounding")
    ax.plot(steps, error.amax(0).clamp(min=floor), color="0.6", linewidth=1.0, label="largest")
    ax.plot(steps, rms.clamp(min=floor), label="root mean square", **LEARNED)
    ax.set(xscale="log", yscale="log", xlabel="steps since the start", ylabel="velocity error [m/s]")
    ax.set_title(f"Error of {len(error)} rollouts")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=9)
    return figure


def _velocity(model: Formulation, velocities: Tensor) -> Tensor:
    return velocities[..., 0] if model.space.nv == 1 else model.space.speed(velocities, model.radius)


def _limits(predicted: Tensor, true: Tensor) -> tuple[float, float]:
    """Of the axis: what leaves them by far is cut off, so that a diverged rollout doesn't flatten the truth."""
    reach = 3.0 * float(true.abs().max().clamp(min=1e-3))
    shown = torch.cat((predicted[predicted.isfinite()].clamp(-reach, reach), true))
    low, high = float(shown.min()), float(shown.max())
    margin = 0.05 * max(high - low, 1e-3)
    return low - margin, high + margin


def new_figure(rows: int, columns: int, size: tuple[float, float]) -> tuple["Figure", list[list["Axes"]]]:
    """A figure without pyplot, so that it needs no display and is freed by itself."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, sharex=False).tolist()
