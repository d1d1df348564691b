"""Figures of merit on recordings whose errors are known by construction, none of them perfect."""

from typing import Any

import pytest
import torch
from torch import Tensor

from lcplearn.datasets import Recordings, Task
from lcplearn.formulations import LineFormulation, Physical
from lcplearn.lcp.solution import LCPSolution
from lcplearn.lcp.solve import solve_lcp
from lcplearn.scenes import LINE, Drive
from lcplearn.training.figures_of_merit import figure
from lcplearn.training.metrics import evaluate, one_step

DT = 0.1


class Echo(LineFormulation):
    """The velocity after a step is the force: what a test wants predicted stands in its recordings."""

    def __init__(self, *, dt: float = DT, gravity: float = 9.81) -> None:
        super().__init__(dt=dt, gravity=gravity)
        self.unused = torch.nn.Parameter(torch.zeros((), dtype=torch.float64))

    def predict(
        self, velocity: Tensor, force: Tensor, friction: Tensor | None = None
    ) -> tuple[Tensor, LCPSolution | None]:
        return force + 0.0 * velocity, None


def recordings(predicted: Tensor, true: Tensor, steps: list[int] | None = None, *, real: bool = False) -> Recordings:
    """True velocities after each step, from rest at 0, and what `Echo` is to predict."""
    velocities = torch.nn.functional.pad(true, (1, 0))
    positions = torch.nn.functional.pad(DT * true.cumsum(1), (1, 0))
    length = torch.full((len(true),), true.shape[1]) if steps is None else torch.tensor(steps)
    states = torch.stack((positions, velocities), dim=-1)
    return Recordings(states, Drive(predicted.unsqueeze(-1)), length, None if real else states)


def data(test: Recordings, test_long: Recordings | None = None, **more: Any) -> Task:
    return Task("echo", LINE, DT, test, test, test, test_long, **more)


def tensor(*rows: list[float]) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def test_only_a_speed_below_1e_minus_12_is_a_stick_and_shares_are_of_true_sticks_and_true_slips() -> None:
    true = tensor([0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    predicted = tensor([0.0, 1e-13, 1e-11, 1e-7, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    found = one_step(Echo(), recordings(predicted, true))
    assert found["stick_accuracy"] == pytest.approx(2 / 4)
    assert found["false_stick"] == pytest.approx(1 / 6)  # of six slips, not of ten steps
    assert found["velocity_rmse"] == pytest.approx((1 / 10) ** 0.5, rel=1e-6)


def test_steps_behind_the_end_of_a_recording_do_not_count() -> None:
    true = tensor([1.0, 1.0, 1.0], [1.0, 1.0, 1.0])
    predicted = tensor([1.5, 1.5, 1.5], [1.5, 99.0, 99.0])
    found = one_step(Echo(), recordings(predicted, true, [3, 1]))
    assert found["velocity_rmse"] == pytest.approx(0.5)


def test_rollout_errors_are_over_as_many_steps_as_they_say() -> None:
    """Wrong by 1 m/s in the last half of 1000 steps, of which the first 100 know nothing."""
    true = torch.ones(2, 1000, dtype=torch.float64)
    predicted = true.clone()
    predicted[:, 500:] += 1.0
    predicted[:, 50:100] += 2.0
    found = evaluate(Echo(), data(recordings(predicted[:, :100], true[:, :100]), test_long=recordings(predicted, true)))
    assert found["rollout_rmse_100"] == pytest.approx((50 * 4 / 100) ** 0.5)
    assert found["rollout_rmse_1000"] == pytest.approx(((50 * 4 + 500) / 1000) ** 0.5)


def test_stops_are_judged_by_median_90th_percentile_and_rest_at_each_slides_own_end() -> None:
    """Ten slides of two steps, the last step behind the end; slide k stops k mm too far, eight are at rest."""
    true = torch.zeros(11, 3, dtype=torch.float64)
    true[:, 0] = 1.0
    predicted = true.clone()
    predicted[:, 0] += torch.arange(11) * 1e-3 / DT
    predicted[8:, 1] = 1e-9
    predicted[:, 2] = 7.0
    found = evaluate(Echo(), data(recordings(predicted, true, [2] * 11, real=True), judged_by=("one_step", "stops")))
    assert found["stop_error_median_mm"] == pytest.approx(5.0, abs=1e-4)
    assert found["stop_error_p90_mm"] == pytest.approx(9.0, abs=1e-4)
    assert found["rest_share"] == pytest.approx(8 / 11)
    assert found["stick_accuracy"] is None


class Unsolvable(Echo):
    """Its LCP has a solution where the force is positive only."""

    def predict(
        self, velocity: Tensor, force: Tensor, friction: Tensor | None = None
    ) -> tuple[Tensor, LCPSolution | None]:
        return force, solve_lcp(torch.zeros(1, 1, dtype=torch.float64), force.unsqueeze(-1))


def test_the_share_of_unsolved_lcps_is_counted() -> None:
    predicted = tensor([1.0, -1.0, 1.0, 1.0])
    assert one_step(Unsolvable(), recordings(predicted, predicted.clone()))["unsolved_share"] == pytest.approx(0.25)


def test_parameter_errors_are_distances_from_the_truth() -> None:
    test = recordings(tensor([0.0]), tensor([0.0]))
    known = data(test, truth={"mass": 1.0, "mu": 0.5})
    found = evaluate(Physical(dt=DT, initial_mu=0.25, initial_mass=3.0), known)
    assert found["mu_error"] == pytest.approx(0.25)
    assert found["mass_error"] == pytest.approx(2.0)


def test_learned_numbers_are_told_with_their_unit() -> None:
    assert figure("stiffness_error").meaning == "N/m, |learned - true|"
    assert figure("corners_12").meaning == "m, learned"
    assert figure("restitution_error").meaning == "|learned - true|"  # it has none
    assert figure("stiffness_error").heading == "stiffness error [N/m]"
