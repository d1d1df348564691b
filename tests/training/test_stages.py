"""Stages of a training."""

from typing import Any

import pytest

from lcplearn.training.optimizer import Optimizer
from lcplearn.training.stages import plan

LAST = {"loss": {"pose": 1.0}, "horizon": 32, "epochs": 10, "lr": 0.03}


def test_a_stage_says_what_differs_and_the_last_gets_the_rest():
    first, second, last = plan(
        [{"epochs": 3, "horizon": 8, "violation": 1.0, "pose": 0.0}, {"epochs": 2, "lr": 0.1}], **LAST
    )
    assert (first.first, first.epochs, first.horizon, first.lr) == (0, 3, 8, 0.03)
    assert first.loss == {"pose": 0.0, "violation": 1.0}
    assert (second.first, second.horizon, second.lr, second.loss) == (3, 32, 0.1, {"pose": 1.0})
    assert (last.first, last.epochs, last.lr) == (5, 5, 0.03)


def test_the_rate_starts_anew_and_decays_within_a_stage():
    stage = plan([{"epochs": 4, "lr": 0.1}], **LAST)[0]
    rates = [stage.learning_rate(epoch, Optimizer()) for epoch in range(4)]
    assert rates[0] == pytest.approx(0.1)
    assert rates == sorted(rates, reverse=True)


def test_a_softened_threshold_falls_to_a_500th_and_is_exact_from_then_on():
    optimizer = Optimizer(anneal_epochs=100, anneal_from=2.0)
    found = [optimizer.temperature(epoch) for epoch in (0, 50, 99, 100, 101)]
    assert found == pytest.approx([2.0, 2.0 * 500**-0.5, 2.0 * 500**-0.99, 0.0, 0.0])
    assert Optimizer().temperature(0) == 0.0


def test_the_rate_of_a_stage_in_which_lbfgs_takes_over_ends_at_zero_there():
    last = plan([{"epochs": 50}], **LAST | {"epochs": 200})[-1]
    rates = [last.learning_rate(epoch, Optimizer(lbfgs_after=150)) for epoch in (50, 100, 150)]
    assert rates == pytest.approx([0.03, 0.015, 0.0])


@pytest.mark.parametrize(
    ("before", "message"),
    [
        ([{"epochs": 10}], "stage 2"),
        ([{"horizon": 8}], "stage 1"),
        ([{"epochs": 1, "horizon": 64}], "from 1 to 32"),
        ([{"epochs": 1}, {"epochs": 1.5}], "at least 1 epoch in stage 2, got 1.5"),
        ([{"epochs": "1"}], "at least 1 epoch in stage 1, got '1'"),
        ([{"epochs": 1, "lr": -1}], "lr of stage 1: expected a positive number, got -1"),
        ([5], r"^stages: expected a list of .* got \[5\]"),
        (5, r"^stages: expected a list of .* got 5"),
    ],
)
def test_stages_that_make_no_sense(before: Any, message: str):
    with pytest.raises(ValueError, match=message):
        plan(before, **LAST)
