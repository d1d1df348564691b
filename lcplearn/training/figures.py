"""Pictures of a trained model: the one-step map, rollouts against the truth, and the error over the horizon."""

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from lcplearn.datasets import BlockData, Recordings
from lcplearn.formulations import Formulation
from lcplearn.formulations.formulation import STICK_SPEED
from lcplearn.training.metrics import rollout, truth, valid_steps

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TRUE: dict[str, Any] = {"color": "black", "linewidth": 5.0, "alpha": 0.25}
ROUNDING = 2.2e-16  # of a velocity of 1 m/s
LEARNED: dict[str, Any] = {"color": "tab:red", "linewidth": 1.4}


def draw(model: Formulation, data: BlockData) -> dict[str, "Figure"]:
    """Draw what applies to the data.

    Args:
        model: The trained model, on the CPU.
        data: `BlockData`.

    Returns:
        Figures by name: rollouts, error_over_horizon, and stops on slides, else one_step_map (for models that need no
        measured friction).
    """
    pictures = {"rollouts": rollouts(model, data), "error_over_horizon": error_over_horizon(model, data)}
    if data.kind == "cube_slides":  # no force acts there
        pictures["stops"] = stops(model, data)
    elif not model.needs_friction:
        pictures["one_step_map"] = one_step_map(model, data)
    return pictures


@torch.no_grad()
def one_step_map(model: Formulation, data: BlockData, speeds: tuple[float, ...] = (-0.3, 0.0, 0.3)) -> "Figure":
    """Velocity after a step against the force, for a few velocities before it, with the true stick band."""
    figure, axes = _figure(1, 1, (7.0, 4.5))
    mass, mu = data.mass or 1.0, data.mu if data.mu is not None else model.physical_parameters().get("mu")
    limit = (mu or 0.3) * mass * data.gravity
    reach = 2.5 * limit + max(speeds) * mass / data.dt
    force = torch.linspace(-reach, reach, 801, dtype=torch.float64)
    ax = axes[0][0]
    for index, speed in enumerate(speeds):
        colour = f"C{index}"
        after = model.next_velocity(torch.full_like(force, speed), force)
        if data.mu is not None:
            p, c = speed + force * data.dt / mass, data.mu * data.gravity * data.dt
            exact = p.sign() * (p.abs() - c).clamp(min=0.0)
            ax.plot(force, exact, color=colour, linewidth=5, alpha=0.25)
        ax.plot(force, after, color=colour, linewidth=1.4, label=f"from {speed:+.1f} m/s" if speed else "from rest")
    if data.mu is not None:
        ax.axvspan(-limit, limit, color="0.9", zorder=0, label="sticks from rest")
    ax.axhline(0.0, color="0.6", linewidth=0.8, zorder=0)
    ax.set(xlabel="force [N]", ylabel="velocity after the step [m/s]")
    wide = " (thin) and truth (wide)" if data.mu is not None else ""
    ax.set_title(f"One-step map: learned{wide}")
    ax.legend(fontsize=9)
    return figure


def rollouts(model: Formulation, data: BlockData, count: int = 3) -> "Figure":
    """Velocity of a few test recordings, predicted from their start; strips below show when the block rests."""
    figure, axes = _figure(count, 1, (8.0, 2.1 * count + 0.6))
    chosen = torch.linspace(0, len(data.test.steps) - 1, count).long()  # those from rest come first
    test = Recordings(*(None if field is None else field[chosen] for field in data.test))  # type: ignore[arg-type]
    _, velocity = rollout(model, test)
    true, name = truth(test), "recorded" if data.kind == "cube_slides" else "true"
    for row, ax in enumerate(ax for line in axes for ax in line):
        steps = int(test.steps[row])
        time = torch.arange(steps + 1) * data.dt
        ax.plot(time, true[row, : steps + 1], label=name, **TRUE)
        predicted = velocity[row, : steps + 1]
        low, high = _limits(predicted, true[row, : steps + 1])
        far = 10.0 * max(-low, high)  # outside of the axes, where matplotlib can still draw it
        ax.plot(time, predicted.clamp(-far, far), label="rolled out from the start", **LEARNED)
        ax.set(ylim=(low - 0.22 * (high - low), high), ylabel="velocity [m/s]")
        if data.test.true_velocities is not None:  # a measured velocity is never exactly zero
            strip(ax, time, true[row, : steps + 1], 0.01, "black", "true at rest", alpha=0.35)
        strip(ax, time, velocity[row, : steps + 1], 0.08, "tab:red", "predicted at rest")
    axes[-1][0].set_xlabel("time [s]")
    axes[0][0].legend(fontsize=8, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    return figure


def stops(model: Formulation, data: BlockData) -> "Figure":
    """How far each slide goes: predicted from its start against recorded."""
    figure, axes = _figure(1, 1, (5.2, 4.8))
    test = data.test
    position, _ = rollout(model, test)
    rows = torch.arange(len(test.steps))
    predicted, recorded = (1e3 * (x[rows, test.steps] - x[:, 0]) for x in (position, test.positions))
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


def error_over_horizon(model: Formulation, data: BlockData) -> "Figure":
    """Root mean square and largest error of the velocity against the steps since the start of the rollout."""
    figure, axes = _figure(1, 1, (7.0, 4.0))
    recordings = data.test_long if data.test_long is not None else data.test
    _, velocity = rollout(model, recordings)
    error = (velocity - truth(recordings))[:, 1:].abs()
    known = valid_steps(recordings)
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


def _limits(predicted: Tensor, true: Tensor) -> tuple[float, float]:
    """Of the axis: what leaves them by far is cut off, so that a diverged rollout doesn't flatten the truth."""
    reach = 3.0 * float(true.abs().max().clamp(min=1e-3))
    shown = torch.cat((predicted[predicted.isfinite()].clamp(-reach, reach), true))
    low, high = float(shown.min()), float(shown.max())
    margin = 0.05 * max(high - low, 1e-3)
    return low - margin, high + margin


def _figure(rows: int, columns: int, size: tuple[float, float]) -> tuple["Figure", list[list["Axes"]]]:
    """A figure without pyplot, so that it needs no display and is freed by itself."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, sharex=False).tolist()
