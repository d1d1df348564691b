"""One training of one formulation for `benchmark models`: settings, data of a wanted size, figures."""

import tempfile
import warnings
from typing import Any, NamedTuple

import torch

from lcplearn.benchmark.harness.study import Row
from lcplearn.benchmark.models.modes import ModeData, Score, modes_from_forces, score
from lcplearn.datasets import Task, read_cube_slides, simulate_sliding_block
from lcplearn.formulations import FORMULATIONS, Formulation, build
from lcplearn.lcp.solve import solve_lcp
from lcplearn.scenes import Mode
from lcplearn.training import Optimizer, fit

NEARLY = 0.01  # [m/s] a block slower than this looks at rest
METRICS = (
    "velocity_rmse", "stick_accuracy", "false_stick", "rollout_rmse_100", "rollout_rmse_1000", "mu_error", "mass_error",
    "unsolved_share", "train_seconds", "predict_us", "parameters", "stop_error_median_mm", "stop_error_p90_mm",
    "rest_share", "mu",
)  # fmt: skip
MODE_COLUMNS = ("mode", "mode_at_changes", "nearly_mode", "nearly_at_changes")
WITH_SUPPORT = ("with_support", "with_support_at_changes")


class Settings(NamedTuple):
    """How a formulation is trained.

    Attributes:
        lr, adam, lbfgs: Adam's learning rate and epochs, then LBFGS iterations, 10 an epoch. Every tenth epoch and the
            last are validated, and can become the best.
        friction: Labels it learns from, if any.
        arguments: Of its constructor, beside dt and gravity.
        loss, horizon: Loss term, and steps of a window.
    """

    lr: float = 5e-2
    adam: int = 100
    lbfgs: int = 100
    friction: Any = None
    arguments: dict[str, Any] = {}  # noqa: RUF012 (read only)
    loss: str = "prediction"
    horizon: int = 1


SIMULATED = {
    "affine": Settings(),
    "mlp": Settings(lr=3e-3, adam=1500, lbfgs=0),
    "force_mlp": Settings(lr=3e-3, adam=1500, lbfgs=0),
    "direct": Settings(adam=200, friction="physical"),
    "slack": Settings(friction="slack"),
    "relu": Settings(),
    "traditional": Settings(lr=1e-2, adam=300),
    "psd": Settings(lr=1e-2, adam=300),
    "psd_skew": Settings(lr=1e-2, adam=300),
    "structured": Settings(),
    "physical": Settings(),
    "physical, 10-step loss": Settings(loss="rollout", horizon=10),
}
# No force acts and no friction is measured: direct, slack and force_mlp have nothing to learn from.
SLIDES = {
    "affine": Settings(adam=60, loss="rollout", horizon=10),
    "mlp": Settings(lr=3e-3, adam=300, lbfgs=0, loss="rollout", horizon=10),
    "relu": Settings(adam=60, loss="rollout", horizon=10),
    "traditional": Settings(lr=1e-2, adam=60, loss="rollout", horizon=10),
    "psd_skew": Settings(lr=1e-2, adam=60, loss="rollout", horizon=10),
    "structured": Settings(
        lr=1e-2,
        loss="rollout",
        horizon=10,
        arguments={"c_network": True, "width": 16, "depth": 1, "learn_b": False},
    ),
    "physical": Settings(adam=60, loss="rollout", horizon=10, arguments={"learn_mass": False}),
}


def warm_up() -> None:
    """Solve and differentiate one LCP, so that compiling the kernel is not counted as somebody's training."""
    M = torch.eye(2, dtype=torch.float64, requires_grad=True)
    solve_lcp(M, torch.tensor([-1.0, 1.0], dtype=torch.float64), method="pivoting").z.sum().backward()


def simulated(steps: int, noise: float, seed: int, friction: Any = None) -> Task:
    """A sliding block with a wanted number of training steps; a quarter of that on top to validate."""
    length = min(steps, 100)
    trajectories = max(1, steps // 100)
    return simulate_sliding_block(
        seed=seed,
        trajectories=trajectories,
        length=length,
        validation_trajectories=max(1, trajectories // 4),
        noise=noise,
        friction=friction,
    )


def train_simulated(name: str, noise: float, steps: int, seed: int, modes: ModeData | None) -> Row:
    """Train a formulation on the simulated block and judge it on the same noise-free test data as all others.

    Returns:
        The figures of `lcplearn.training`, the share of modes foretold on the test data, and, for a model that knows
        mu and mass, on a block that is lifted now and then, given the normal force.
    """
    settings = SIMULATED[name]
    data = simulated(steps, noise, seed, settings.friction)
    model, row = _train(name, settings, data, seed)
    row |= foretell_modes(model, data)
    known = model.physical_parameters()
    if modes is not None and {"mu", "mass"} <= set(known) and known["mass"] > 0:
        found = score(modes_from_forces(modes, mass=known["mass"], mu=known["mu"], dt=data.dt), modes.mode)
        row |= dict(zip(WITH_SUPPORT, found, strict=True))
    return row


def train_slides(name: str, slides: int, seed: int) -> Row:
    """Train a formulation on some of the real slides and judge where the others stop."""
    data = read_cube_slides(seed=seed, training_slides=slides, validation_slides=max(1, slides // 5))
    settings = SLIDES[name]
    arguments = dict(settings.arguments)
    if name == "physical":
        arguments["initial_mass"] = data.given["mass"]
    return _train(name, settings._replace(arguments=arguments), data, seed)[1]


def _train(name: str, settings: Settings, data: Task, seed: int) -> tuple[Formulation, Row]:
    torch.manual_seed(seed)
    model = build(FORMULATIONS[name.split(",")[0]], data, **settings.arguments)
    iterations = settings.lbfgs // 10
    optimizer = Optimizer(lr=settings.lr, lbfgs_after=settings.adam if iterations else None)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Lightning's, about what the benchmark chooses on purpose
        result = fit(
            model,
            data,
            loss={settings.loss: 1.0},
            horizon=settings.horizon,
            epochs=settings.adam + iterations,
            optimizer=optimizer,
            patience=None,
            folder=folder,
            seed=seed,
            trainer={"enable_progress_bar": False},
        )
    metrics = result.metrics or {}
    values = {key: metrics.get(key) for key in METRICS}
    return result.model, {key: float("nan") if value is None else float(value) for key, value in values.items()}


@torch.no_grad()
def foretell_modes(model: Formulation, data: Task) -> Row:
    """Share of stick and slip foretold one step ahead on the test data: exactly at rest, and slower than `NEARLY`."""
    truth = data.test.true_states
    if truth is None:
        raise ValueError("data: expected simulated recordings, whose modes are known")
    actual = _two_modes(truth[:, 1:, 1] == 0)
    velocity = model.advance(truth[:, :-1], data.test.drive).state[..., 1]
    exactly: Score = score(_two_modes(velocity.abs() < 1e-12), actual)
    nearly: Score = score(_two_modes(velocity.abs() < NEARLY), actual)
    return dict(zip(MODE_COLUMNS, (*exactly, *nearly), strict=True))


def _two_modes(rests: torch.Tensor) -> torch.Tensor:
    return torch.where(rests, int(Mode.STICK), int(Mode.SLIP))
