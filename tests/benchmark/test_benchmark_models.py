"""The mode question on chains that can be counted by hand, and trainings of `benchmark models`."""

import math

import pytest
import torch
from real_data import real_data

from lcplearn.benchmark.harness.study import Options
from lcplearn.benchmark.models import run as models
from lcplearn.benchmark.models import training as training_runs
from lcplearn.benchmark.models.modes import chain, entropy, foretell, modes_from_forces, score, simulate_modes
from lcplearn.datasets import simulate_sliding_block
from lcplearn.formulations import Physical

# stick stick slip slip slip stick: pairs 00 01 11 11 10
BY_HAND = torch.tensor([[0, 0, 1, 1, 1, 0]])


def test_a_chain_is_counted_as_by_hand():
    probabilities = chain(BY_HAND, 1)
    assert probabilities[0].tolist() == pytest.approx([1 / 2, 1 / 2, 0])
    assert probabilities[1].tolist() == pytest.approx([1 / 3, 2 / 3, 0])
    assert probabilities[2].tolist() == pytest.approx([1 / 3] * 3)  # separation never occurred
    assert chain(BY_HAND, 0).tolist() == pytest.approx([1 / 2, 1 / 2, 0])
    assert chain(BY_HAND, 2)[0, 1].tolist() == pytest.approx([0, 1, 0])


def test_a_chain_never_joins_the_end_of_one_recording_to_the_start_of_the_next():
    assert chain(torch.tensor([[0, 0], [1, 1]]), 1)[0].tolist() == [1, 0, 0]


def test_a_chain_that_says_stay_is_right_but_where_the_mode_changes():
    stay = torch.tensor([[0.9, 0.1, 0.0], [0.2, 0.8, 0.0], [0.0, 0.0, 1.0]])
    assert foretell(stay, BY_HAND).tolist() == [[0, 0, 1, 1, 1]]
    found = score(foretell(stay, BY_HAND), BY_HAND)
    assert found.everywhere == pytest.approx(3 / 5)
    assert found.at_changes == 0


def test_a_second_order_prediction_uses_the_modes_in_their_order():
    """After (0, 1) comes 1 and after (1, 0) comes 2."""
    observed = torch.tensor([[0, 1, 1, 0, 2, 0, 1]])
    probabilities = torch.zeros(3, 3, 3)
    probabilities[0, 1, 1] = probabilities[1, 0, 2] = 1
    predicted = foretell(probabilities, observed)
    assert predicted[0, 0] == 1
    assert predicted[0, 2] == 2


def test_entropies_are_those_of_the_counts():
    assert entropy(BY_HAND, 0) == pytest.approx(1.0)
    pairs = (2 * 1.0 + 3 * (-(1 / 3) * math.log2(1 / 3) - (2 / 3) * math.log2(2 / 3))) / 5
    assert entropy(BY_HAND, 1) == pytest.approx(pairs)


def test_a_chain_is_never_right_where_the_mode_changes_and_the_lcp_always_is():
    """A chain of order 1 is right on about 95 % of the steps and never where the mode changes; the LCP always is."""
    data = simulate_modes(seed=0, count=100, steps=500)
    shares = [float((data.mode == mode).double().mean()) for mode in range(3)]
    assert shares == pytest.approx([0.45, 0.41, 0.14], abs=0.04)
    found = score(foretell(chain(data.mode, 1), data.mode), data.mode)
    assert found.everywhere == pytest.approx(0.951, abs=0.01)
    assert found.at_changes == 0
    exact = modes_from_forces(data, mass=1.5, mu=0.4, dt=0.05)
    assert torch.equal(exact, data.mode)


def test_a_model_that_is_the_truth_foretells_every_mode():
    data = simulate_sliding_block(test_trajectories=5, long_trajectories=1, long_length=10)
    model = Physical(dt=data.dt, initial_mu=0.4, initial_mass=1.5)
    row = training_runs.foretell_modes(model, data)
    assert row["mode"] == 1
    assert row["mode_at_changes"] == 1


@pytest.mark.parametrize("steps", models.STEPS)
def test_training_sets_have_the_size_they_are_asked_for(steps):
    data = training_runs.simulated(steps, 0.0, 0)
    assert int(data.train.steps.sum()) == steps
    assert int(data.validation.steps.sum()) <= max(steps, 100)


def test_a_training_fills_its_columns(monkeypatch):
    few = training_runs.SIMULATED["physical"]._replace(adam=10, lbfgs=100)
    monkeypatch.setitem(training_runs.SIMULATED, "physical", few)
    row = training_runs.train_simulated("physical", 0.0, 30, 0, simulate_modes(seed=0, count=2, steps=50))
    assert set(row) <= set(models.COLUMNS)
    assert row["train_seconds"] > 0
    assert row["velocity_rmse"] < 1e-8
    assert row["mode"] > 0.999
    assert row["with_support"] > 0.99


def test_real_slides_teach_mu(monkeypatch):
    monkeypatch.setenv("LCPLEARN_DATA", str(real_data("cube_slides.npz").parent))
    few = training_runs.SLIDES["physical"]._replace(adam=10, lbfgs=100)
    monkeypatch.setitem(training_runs.SLIDES, "physical", few)
    row = training_runs.train_slides("physical", 40, 0)
    assert 0.2 < row["mu"] < 0.23
    assert row["rest_share"] > 0.98


def test_all_models_meet_the_same_data_and_seeds(tmp_path):
    keys = [key for key in models.plan(Options(tmp_path), slides=True) if key[0] == "simulated"]
    of_model = {model: [key[2:] for key in keys if key[1] == model] for model in training_runs.SIMULATED}
    assert len({tuple(values) for values in of_model.values()}) == 1
    assert len({key[-1] for key in keys}) >= 3
    labelled, plain = (training_runs.simulated(100, 0.01, 1, friction=kind) for kind in ("slack", None))
    assert torch.equal(labelled.train.states[..., 1], plain.train.states[..., 1])


def test_the_quick_study_runs_from_its_plan_to_its_figures(tmp_path, monkeypatch, capsys):
    """Trainings are replaced by numbers: what is tested is the plan, the tables and the figures."""
    row = dict.fromkeys(models.COLUMNS, 0.5) | {"train_seconds": 1.0}
    monkeypatch.setattr(models, "train_simulated", lambda *_: row)
    monkeypatch.setattr(models, "train_slides", lambda *_: row)
    monkeypatch.setattr(models, "find", lambda name: None)
    models.run(Options(tmp_path, quick=True))
    assert "Which formulation should I learn?" in capsys.readouterr().out
    assert len(list(tmp_path.glob("*.png"))) == 4
    assert (tmp_path / "summary.json").exists()
