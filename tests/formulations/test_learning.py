"""What formulations learn from simulated data in a second each: the figures of docs/formulations.md, on one seed."""

from collections.abc import Mapping

import pytest
import torch
from torch import Tensor

from lcplearn.datasets import Windows, simulate_sliding_block, windows
from lcplearn.formulations import FORMULATIONS, Formulation, loss_terms
from lcplearn.scenes import Drive

DT = 0.05


def learn(model: Formulation, data: Windows, weights: Mapping[str, float]) -> None:
    """Full batch: 100 steps of Adam with cosine decay, then 60 of LBFGS."""
    parameters = [p for p in model.parameters() if p.requires_grad]
    adam = torch.optim.Adam(parameters, lr=5e-2)
    decay = torch.optim.lr_scheduler.CosineAnnealingLR(adam, 100)
    lbfgs = torch.optim.LBFGS(
        parameters,
        max_iter=60,
        history_size=20,
        tolerance_grad=0.0,
        tolerance_change=0.0,
        line_search_fn="strong_wolfe",
    )

    def closure() -> Tensor:
        adam.zero_grad()
        loss = torch.stack(list(loss_terms(model, data, weights).values())).sum()
        loss.backward()
        return loss

    for _ in range(100):
        adam.step(closure)
        decay.step()
    lbfgs.step(closure)


def learned(name: str, noise: float, seed: int = 0, **options: float) -> tuple[Formulation, Tensor, Tensor]:
    """The model, its one-step predictions on noise-free test data, and the truth."""
    data = simulate_sliding_block(seed=seed, noise=noise, dt=DT, friction="slack" if name == "slack" else None)
    torch.manual_seed(seed)
    model = FORMULATIONS[name](dt=DT, **options)
    learn(model, windows(data.train, 1), {"prediction": 1.0})
    with torch.no_grad():
        predicted = model.advance(data.test.states[:, :-1], Drive(data.test.drive.force)).state[..., 1]
    return model, predicted, data.test.states[:, 1:, 1]


def rmse(predicted: Tensor, truth: Tensor) -> float:
    return (predicted - truth).square().mean().sqrt().item()


@pytest.mark.parametrize("name", ["structured", "physical", "relu", "slack"])
def test_without_noise_the_block_is_found_to_machine_precision_and_sticks(name: str) -> None:
    model, predicted, truth = learned(name, noise=0.0)
    assert rmse(predicted, truth) <= 1e-8
    assert torch.equal(predicted == 0, truth == 0)
    if name in ("structured", "physical"):
        assert model.physical_parameters() == pytest.approx({"mu": 0.4, "mass": 1.5}, abs=1e-7)


@pytest.mark.parametrize("name", ["structured", "physical", "relu"])
def test_with_noisy_velocities_the_block_still_sticks_exactly(name: str) -> None:
    model, predicted, truth = learned(name, noise=0.01)
    assert rmse(predicted, truth) <= 6e-4
    assert (predicted[truth == 0].abs() < 1e-12).double().mean() >= 0.999
    assert (predicted[truth != 0] == 0).double().mean() <= 2e-3
    if name != "relu":
        assert model.physical_parameters()["mu"] == pytest.approx(0.4, abs=2e-3)


@pytest.mark.parametrize("seed", range(5))
def test_rectified_outputs_that_start_mirrored_do_not_die(seed: int) -> None:
    """At mu = 0.2 one random sign pattern in a few used to leave an output without gradient (RMSE 0.8)."""
    data = simulate_sliding_block(seed=seed, mu=0.2, dt=DT)
    torch.manual_seed(seed)
    model = FORMULATIONS["relu"](dt=DT)
    learn(model, windows(data.train, 1), {"prediction": 1.0})
    predicted = model.advance(data.test.states[:, :-1], data.test.drive).state
    assert rmse(predicted[..., 1], data.test.states[:, 1:, 1]) <= 1e-4


def test_an_affine_model_never_sticks() -> None:
    _, predicted, truth = learned("affine", noise=0.0)
    assert not bool((predicted[truth == 0].abs() < 1e-12).any())
