"""What a trained model is judged by: the figures of metrics.json."""

import math
import statistics
import time
from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lcplearn.datasets import BlockData, Recordings
from lcplearn.formulations import Formulation
from lcplearn.formulations.formulation import STICK_SPEED

KEYS = (
    "velocity_rmse",
    "stick_accuracy",
    "false_stick",
    "rollout_rmse_100",
    "rollout_rmse_1000",
    "mu_error",
    "mass_error",
    "unsolved_share",
    "train_seconds",
    "predict_us",
    "parameters",
    "stop_error_median_mm",
    "stop_error_p90_mm",
    "rest_share",
    "mu",
)
UNITS = {
    "velocity_rmse": "m/s, one step",
    "stick_accuracy": "share of true sticks with |v| < 1e-12 m/s",
    "false_stick": "share of true slips with |v| < 1e-12 m/s",
    "rollout_rmse_100": "m/s, over 100 steps",
    "rollout_rmse_1000": "m/s, over 1000 steps",
    "mu_error": "|learned - true|",
    "mass_error": "kg, |learned - true|",
    "unsolved_share": "share of LCPs without a verified solution",
    "train_seconds": "s",
    "predict_us": "us, one step of one block",
    "parameters": "learned numbers",
    "stop_error_median_mm": "mm, where the slide ends",
    "stop_error_p90_mm": "mm, 90th percentile",
    "rest_share": "share of slides at rest at their end",
    "mu": "learned friction coefficient",
}


def truth(recordings: Recordings) -> Float[Tensor, "N T+1"]:
    """Noise-free velocities where they are known, else the measured ones [m/s]."""
    return recordings.velocities if recordings.true_velocities is None else recordings.true_velocities


def valid_steps(recordings: Recordings) -> Bool[Tensor, "N T"]:
    """False after the end of a shorter recording."""
    steps = recordings.steps
    return torch.arange(recordings.forces.shape[1], device=steps.device) < steps[:, None]


@torch.no_grad()
def one_step(model: Formulation, recordings: Recordings) -> dict[str, float | None]:
    """Judge one step from every true state of the recordings.

    Stick figures need exact zeros in the truth, so real recordings have none.

    Returns:
        velocity_rmse [m/s], stick_accuracy, false_stick, unsolved_share, lcp_residual (None: does not apply).
    """
    known, velocity = valid_steps(recordings), truth(recordings)
    before, after, force = velocity[:, :-1][known], velocity[:, 1:][known], recordings.forces[known]
    friction = None if recordings.friction is None else recordings.friction[known]
    model.last_solution = None
    predicted = model.next_velocity(before, force, friction)
    sticks, still = after.abs() < STICK_SPEED, predicted.abs() < STICK_SPEED
    simulated, solution = recordings.true_velocities is not None, model.last_solution
    return {
        "velocity_rmse": _rms(predicted - after),
        "stick_accuracy": _share(still[sticks]) if simulated else None,
        "false_stick": _share(still[~sticks]) if simulated else None,
        "unsolved_share": None if solution is None else 1.0 - float(solution.solved.double().mean()),
        "lcp_residual": None if solution is None else float(solution.residual.max()),
    }


@torch.no_grad()
def rollout(model: Formulation, recordings: Recordings, steps: int | None = None) -> tuple[Tensor, Tensor]:
    """Predict recordings from their first true state and their forces.

    Returns:
        Positions [m] and velocities [m/s], both [N, T + 1].
    """
    steps = steps or recordings.forces.shape[1]
    state = torch.stack((recordings.positions[:, 0], truth(recordings)[:, 0]), dim=-1)
    friction = None if recordings.friction is None else recordings.friction[:, :steps]
    path = model.rollout(state, recordings.forces[:, :steps, None], friction)
    return path.positions[..., 0], path.velocities[..., 0]


def evaluate(model: Formulation, data: BlockData, *, train_seconds: float | None = None) -> dict[str, float | None]:
    """Evaluate a model on the test part of a data set.

    Args:
        model: The model, on the CPU.
        data: `BlockData`.
        train_seconds: Reported as it comes.

    Returns:
        All `KEYS`; None where a figure does not apply, infinite where it is not finite. `UNITS` says what each is.
    """
    values: dict[str, float | None] = dict.fromkeys(KEYS)
    values |= {key: value for key, value in one_step(model, data.test).items() if key in KEYS}
    learned = model.physical_parameters()
    values["mu"] = learned.get("mu")
    for name, true in (("mu", data.mu), ("mass", data.mass)):
        if name in learned and true is not None and data.kind != "cube_slides":
            values[f"{name}_error"] = abs(learned[name] - true)
    if data.kind == "cube_slides":
        values |= _stops(model, data.test)
    else:
        values["rollout_rmse_100"] = _rollout_rmse(model, data.test, 100)
        values["rollout_rmse_1000"] = _rollout_rmse(model, data.test_long, 1000)
    values["train_seconds"] = train_seconds
    values["predict_us"] = _predict_us(model, data.test)
    values["parameters"] = sum(p.numel() for p in model.parameters() if p.requires_grad)
    return {key: math.inf if value is not None and math.isnan(value) else value for key, value in values.items()}


def table(metrics: Mapping[str, float | None]) -> list[tuple[str, str, str]]:
    """Rows (name, value, meaning) of the figures that apply."""
    return [(key, number(metrics[key]), UNITS[key]) for key in KEYS if metrics[key] is not None]


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


def describe_model(model: Formulation, data: BlockData) -> str:
    """One line: what learns, how large it is, and from what."""
    parameters = sum(p.numel() for p in model.parameters() if p.requires_grad)
    dtype = str(next(model.parameters()).dtype).removeprefix("torch.")
    steps = int(data.train.steps.sum())
    counted = f"{parameters} parameter{'s' * (parameters != 1)}"
    return f"{type(model).__name__}: {counted} ({dtype}); {data.kind}: {steps} training steps"


def _stops(model: Formulation, slides: Recordings) -> dict[str, float | None]:
    position, velocity = rollout(model, slides)
    rows, last = torch.arange(len(slides.steps)), slides.steps
    error = (position[rows, last] - slides.positions[rows, last]).abs() * 1e3
    return {
        "stop_error_median_mm": float(error.quantile(0.5)),
        "stop_error_p90_mm": float(error.quantile(0.9)),
        "rest_share": _share(velocity[rows, last].abs() < STICK_SPEED),
    }


def _rollout_rmse(model: Formulation, recordings: Recordings | None, steps: int) -> float | None:
    if recordings is None or recordings.forces.shape[1] < steps:
        return None
    whole = recordings.steps >= steps
    if not bool(whole.all()):
        return None
    _, velocity = rollout(model, recordings, steps)
    return _rms(velocity[:, 1:] - truth(recordings)[:, 1 : steps + 1])


@torch.no_grad()
def _predict_us(model: Formulation, recordings: Recordings, repeats: int = 200) -> float:
    velocity, force = truth(recordings)[:1, 0], recordings.forces[:1, 0]
    friction = None if recordings.friction is None else recordings.friction[:1, 0]
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        model.next_velocity(velocity, force, friction)
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds) * 1e6


def _rms(error: Tensor) -> float:
    return float(error.square().mean().sqrt())


def _share(flags: Bool[Tensor, " n"]) -> float | None:
    return float(flags.double().mean()) if len(flags) else None
