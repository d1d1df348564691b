"""How a trained model is judged: the figures of metrics.json."""

import math
import statistics
import time
from collections.abc import Callable, Mapping
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lcplearn.datasets import Recordings, Task
from lcplearn.formulations import Formulation
from lcplearn.scenes.scene import STICK_SPEED, Step, Trajectory
from lcplearn.training.figures_of_merit import KEYS, figure, in_order
from lcplearn.training.toss_metrics import score_tosses, summarise

Figures = dict[str, float | None]


class Predictions:
    """What a model predicts of a task's test recordings, each computed once: judges and pictures share them.

    Args:
        model: The model, on the CPU.
        task: What it is judged on.
    """

    def __init__(self, model: Formulation, task: Task) -> None:
        self.model, self.task = model, task

    @property
    def long_recordings(self) -> Recordings:
        """The recordings for long rollouts."""
        return self.task.test if self.task.test_long is None else self.task.test_long

    @cached_property
    def test(self) -> Trajectory:
        """Rollouts of the test recordings."""
        return rollout(self.model, self.task.test)

    @cached_property
    def long(self) -> Trajectory:
        """Rollouts of the long recordings."""
        return self.test if self.task.test_long is None else rollout(self.model, self.task.test_long)


@torch.no_grad()
def rollout(model: Formulation, recordings: Recordings) -> Trajectory:
    """Predict recordings from their first true state and what drives them."""
    return model.rollout(recordings.truth[:, 0], recordings.drive.force, recordings.drive.friction)


@torch.no_grad()
def one_step(model: Formulation, recordings: Recordings) -> Figures:
    """Judge one step from every true state of the recordings.

    Stick figures need exact zeros in the truth, so real recordings have none.

    Returns:
        velocity_rmse [m/s], stick_accuracy, false_stick, unsolved_share, lcp_residual (None: does not apply).
    """
    known, states, space = recordings.valid, recordings.truth, model.space
    after = states[:, 1:][known]
    step: Step = model.advance(states[:, :-1][known], recordings.drive.map(lambda values: values[known]))
    predicted, velocity = (space.split(state)[1] for state in (step.state, after))
    sticks, still = (space.speed(v, model.radius) < STICK_SPEED for v in (velocity, predicted))
    simulated = recordings.true_states is not None
    return {
        "velocity_rmse": _rms(model.velocity_error(step.state, after)),
        "stick_accuracy": _share(still[sticks]) if simulated else None,
        "false_stick": _share(still[~sticks]) if simulated else None,
        "unsolved_share": None if step.solved is None else 1.0 - float(step.solved.double().mean()),
        "lcp_residual": None if step.solution is None else float(step.solution.residual.max()),
    }


def judge_one_step(found: Predictions) -> Figures:
    """Figures of one step; see `one_step`."""
    return {name: value for name, value in one_step(found.model, found.task.test).items() if name in KEYS}


def judge_rollout(found: Predictions) -> Figures:
    """Velocity error over 100 steps of the test recordings and 1000 of the long ones, where they are so long."""
    long = found.long if found.task.test_long is not None else None
    return {
        "rollout_rmse_100": _rollout_rmse(found.model, found.test, found.task.test, 100),
        "rollout_rmse_1000": None if long is None else _rollout_rmse(found.model, long, found.long_recordings, 1000),
    }


def judge_stops(found: Predictions) -> Figures:
    """Where slides on a line end, and whether they end at rest."""
    slides, path = found.task.test, found.test
    rows, last = torch.arange(len(slides.steps)), slides.steps
    error = (path.positions[rows, last, 0] - slides.states[rows, last, 0]).abs() * 1e3
    return {
        "stop_error_median_mm": float(error.quantile(0.5)),
        "stop_error_p90_mm": float(error.quantile(0.9)),
        "rest_share": _share(path.velocities[rows, last, 0].abs() < STICK_SPEED),
    }


def judge_tosses(found: Predictions) -> Figures:
    """How far whole tosses of a cube are from the recorded ones; see `toss_metrics`."""
    test, path = found.task.test, found.test
    scores = score_tosses(test.states, path.states, test.steps, found.task.given["half_width"])
    position, rotation = (
        summarise(scores[name]) for name in ("position integral [% width]", "rotation integral [deg]")
    )
    unsolved = None if path.solved is None else _share(~path.solved[test.valid])
    return {
        "position_integral": position.mean,
        "position_integral_median": position.median,
        "rotation_integral": rotation.mean,
        "rotation_integral_median": rotation.median,
        "penetration_beyond": float(scores["penetration integral beyond the recorded [% width]"].mean()),
        "same_face": float(scores["same face down at the end [share]"].mean()),
        "at_rest": float(scores["at rest at the end [share]"].mean()),
        "unsolved_share": unsolved,
    }


JUDGES: dict[str, Callable[[Predictions], Figures]] = {
    "one_step": judge_one_step,
    "rollout": judge_rollout,
    "stops": judge_stops,
    "tosses": judge_tosses,
}


def evaluate(
    model: Formulation, task: Task, *, train_seconds: float | None = None, predictions: Predictions | None = None
) -> Figures:
    """Evaluate a model on the test part of a data set.

    Args:
        model: The model, on the CPU.
        task: Names its judges.
        train_seconds: Reported as it comes.
        predictions: The model's, if somebody else wants them too.

    Returns:
        All `KEYS`, and learned numbers by name; None where a figure does not apply, infinite where it is not finite.
    """
    found = Predictions(model, task) if predictions is None else predictions
    values: Figures = dict.fromkeys(KEYS)
    for name in task.judged_by:
        values |= JUDGES[name](found)
    for name, learned in model.physical_parameters().items():
        if name in task.truth:
            values[f"{name}_error"] = abs(learned - task.truth[name])
        values[name] = learned
    values["train_seconds"] = train_seconds
    values["predict_us"] = _predict_us(model, task.test)
    values["parameters"] = sum(p.numel() for p in model.parameters() if p.requires_grad)
    return {key: math.inf if value is not None and math.isnan(value) else value for key, value in values.items()}


def table(metrics: Mapping[str, float | None]) -> list[tuple[str, str, str]]:
    """Rows (name, value, meaning) of the figures that apply."""
    there = [name for name in in_order(metrics) if metrics[name] is not None]
    return [(name, number(metrics[name]), figure(name).meaning) for name in there]


def number(value: float | None) -> str:
    """Four significant digits, as short as they go."""
    if value is None:
        return "-"
    if math.isinf(value):
        return "diverged"
    return str(value) if isinstance(value, int) else f"{value:.4g}"


def format_table(metrics: Mapping[str, float | None]) -> str:
    """The result table as text."""
    return "\n".join(f"{name:<22}{value:>12}   {unit}" for name, value, unit in table(metrics))


def describe_model(model: Formulation, task: Task) -> str:
    """One line: what learns, how large it is, from what, and on how many threads."""
    parameters = sum(p.numel() for p in model.parameters() if p.requires_grad)
    dtype = str(next(model.parameters()).dtype).removeprefix("torch.")
    steps = int(task.train.steps.sum())
    counted = f"{parameters} parameter{'s' * (parameters != 1)}"
    count = torch.get_num_threads()
    threads = f"{count} thread{'s' * (count != 1)}"
    return f"{type(model).__name__}: {counted} ({dtype}); {task.name}: {steps} training steps; {threads}"


def _rollout_rmse(model: Formulation, path: Trajectory, recordings: Recordings, steps: int) -> float | None:
    if not bool((recordings.steps >= steps).all()):
        return None
    return _rms(model.velocity_error(path.states[:, 1 : steps + 1], recordings.truth[:, 1 : steps + 1]))


@torch.no_grad()
def _predict_us(model: Formulation, recordings: Recordings, repeats: int = 200) -> float:
    state, drive = recordings.truth[:1, 0], recordings.drive.map(lambda values: values[:1, 0])
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        model.advance(state, drive)
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds) * 1e6


def _rms(squares: Float[Tensor, "*shape"]) -> float:
    return float(squares.mean().sqrt())


def _share(flags: Bool[Tensor, " n"]) -> float | None:
    return float(flags.double().mean()) if len(flags) else None
