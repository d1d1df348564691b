"""Models of pushes: what they learn from a known object, what they see, and what is left in their checkpoints."""

import copy
import math
from pathlib import Path

import pytest
import torch
from pushes import push_file, thing
from real_data import real_data

from lcplearn.datasets.pushes import read_all_pushes
from lcplearn.formulations.pushing import PushMLP, Residual, Ridge, Supports
from lcplearn.formulations.pushing.baselines import _kernel
from lcplearn.formulations.pushing.features import features
from lcplearn.formulations.pushing.gauss_newton import least_deviation
from lcplearn.formulations.pushing.process import LATENTS, Process
from lcplearn.formulations.pushing.residual import BESIDE, INSIDE
from lcplearn.scenes.pushed_object import PushedObject
from lcplearn.training.checkpoint import load

F = torch.float64
CHECKPOINTS = Path(__file__).parents[2] / "data" / "checkpoints"
COARSE = {"steps": 5}  # the pushes of `known` are made by the same steps


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return read_all_pushes(push_file(tmp_path_factory.mktemp("pushes"), 24))


@pytest.fixture(scope="module")
def known(data):
    """Pushes of an object whose numbers are known, predicted by the mechanics themselves."""
    model = Supports(**thing(data), **COARSE, surfaces=["board", "wood"])
    with torch.no_grad():
        model.numbers.copy_(torch.tensor((math.log(0.5), 1.2, 0.8)))
        model.mu.copy_(torch.tensor(((0.25, 0.25), (0.4, 0.4))))  # board is seen under feet, wood under the face
        end = model.predict(data.pushes)
    return model, data.outcome._replace(pose=end.pose, force=end.force)


def run(model, pushes, outcome):
    for _ in model.fit(pushes, outcome):
        pass
    return model


@pytest.fixture(scope="module")
def fitted(data, known):
    """One model of each kind, fitted to the known pushes."""
    _, outcome = known
    coarse = {Supports: COARSE, Residual: COARSE | {"learning_steps": 10}, Ridge: {}, PushMLP: {"rounds": 40}}
    return {kind: run(kind(**thing(data), **own), data.pushes, outcome) for kind, own in coarse.items()}


def test_supports_find_the_numbers_that_made_the_pushes(data, known):
    """mu_c, height and rim from end poses; mu of each surface from forces."""
    true, outcome = known
    often = torch.arange(24).repeat(20)  # the prior counts as much as a push of 1 mm noise does
    model = Supports(**thing(data), **COARSE)
    found = run(model, data.pushes.take(often), outcome.take(often)).physical_parameters()
    for name, value in true.physical_parameters().items():
        assert found[name] == pytest.approx(value, rel=0.02), name


def test_mu_comes_from_the_force_alone(data, known):
    _, outcome = known
    doubled = outcome._replace(force=2.0 * outcome.force)
    one, two = (
        run(Supports(**thing(data), **COARSE, height=False), data.pushes, o).physical_parameters()
        for o in (outcome, doubled)
    )
    assert two["mu_board"] == pytest.approx(2.0 * one["mu_board"])
    assert two["mu_c"] == pytest.approx(one["mu_c"])


def test_the_residual_learns_what_the_mechanics_miss(data, known):
    """A motion that depends on the configuration, which no number of the supports can make."""
    true, outcome = known
    moved = true.motion(data.pushes, outcome.pose)
    moved[:, 2] += torch.where(data.pushes.whole_face, 0.0015, -0.001)
    outcome = outcome._replace(pose=true.pose(data.pushes, moved))
    model = run(Residual(**thing(data), **COARSE), data.pushes, outcome)
    with torch.no_grad():
        after = (model.motion(data.pushes, model.predict(data.pushes).pose) - moved).norm(dim=-1).mean()
        before = (model.motion(data.pushes, model.base.predict(data.pushes).pose) - moved).norm(dim=-1).mean()
    assert after < 0.5 * before


def test_the_residual_is_the_mean_of_what_is_learned_inside_and_beside_the_rollout(data, fitted):
    def motion(*silent):
        model = copy.deepcopy(fitted[Residual])
        for name in silent:
            getattr(model, name).weights.zero_()
        with torch.no_grad():
            return model.motion(data.pushes, model.predict(data.pushes).pose)

    both, inside, beside, neither = motion(), motion("beside"), motion("inside"), motion("inside", "beside")
    torch.testing.assert_close(both - neither, (inside - neither) + (beside - neither), rtol=0, atol=1e-12)
    assert min(float((part - neither).abs().max()) for part in (inside, beside)) > 1e-6


@pytest.mark.parametrize("kind", [Supports, Residual, Ridge, PushMLP])
def test_a_model_from_its_state_predicts_the_same(data, fitted, kind):
    model = fitted[kind]
    again = kind(**model.arguments)
    again.load_state_dict(copy.deepcopy(model.state_dict()))
    with torch.no_grad():
        assert torch.equal(again.predict(data.pushes).pose, model.predict(data.pushes).pose)


@pytest.mark.parametrize("kind", [Residual, Ridge])
def test_a_prediction_does_not_depend_on_the_other_pushes(data, fitted, kind):
    model = fitted[kind]
    with torch.no_grad():
        together, alone = model.predict(data.pushes).pose, model.predict(data.pushes.take([7])).pose
    torch.testing.assert_close(alone[0], together[7], atol=1e-10, rtol=0)


@pytest.mark.parametrize("name", ["pushes_supports", "pushes_residual"])
def test_shipped_checkpoints_predict(data, name):
    """A checkpoint knows its surfaces and numbers by name: it must load after any change of the models."""
    model = load(CHECKPOINTS / f"{name}.ckpt")
    pushes = data.pushes.take(torch.arange(2))._replace(surface=("hardboard", "wood"))
    with torch.no_grad():
        prediction = model.predict(pushes)
    assert prediction.solved.all()
    moved = model.motion(pushes, prediction.pose).norm(dim=-1)
    assert ((moved > 0.002) & (moved < 0.03)).all()  # the finger goes 12 mm from the first touch on


@pytest.mark.parametrize("kind", [Supports, Residual])
def test_an_unknown_surface_is_refused_by_name(data, fitted, kind):
    with pytest.raises(ValueError, match="surface: expected board or wood, as learned, got ice"):
        fitted[kind].predict(data.pushes._replace(surface=("ice",) * 24))


@pytest.mark.parametrize("kind", [Supports, Residual, Ridge, PushMLP])
def test_no_push_gives_no_prediction(data, fitted, kind):
    found = fitted[kind].predict(data.pushes.take(torch.zeros(0, dtype=torch.long)))
    assert found.pose.shape == (0, 3)
    assert found.solved.shape == (0,)


def test_a_law_without_gradient_is_refused(data):
    # a TypeError first where the tests check types
    with pytest.raises((ValueError, TypeError), match="law"):
        Supports(**thing(data), law="polygon")


def test_a_network_is_not_learned_from_one_push(data):
    with pytest.raises(ValueError, match="pushes: expected at least 2 to learn from, got 1"):
        run(PushMLP(**thing(data)), data.pushes.take([0]), data.outcome.take([0]))


def test_motion_and_pose_are_inverse(data, known):
    model, outcome = known
    there = model.pose(data.pushes, model.motion(data.pushes, outcome.pose))
    torch.testing.assert_close(there[:, :2], outcome.pose[:, :2])
    torch.testing.assert_close(there[:, 2].sin(), outcome.pose[:, 2].sin())


def test_three_numbers_tell_where_real_pushes_end():
    data = read_all_pushes(real_data("planar_pushes.npz"))
    model = run(Supports(**thing(data)), data.pushes, data.outcome)
    with torch.no_grad():
        end = model.predict(data.pushes)
    assert end.solved.all()
    error = (model.motion(data.pushes, end.pose) - model.motion(data.pushes, data.outcome.pose)).norm(dim=-1)
    assert 1e3 * error.mean() < 1.5
    found = model.physical_parameters()
    assert found["mu_hardboard"] == pytest.approx(0.300, abs=0.02)
    assert found["mu_wood"] == pytest.approx(0.346, abs=0.02)


def test_ridge_chooses_by_the_error_of_each_push_without_itself(data, known):
    """Leaving one out by its formula is leaving one out."""
    (_, outcome), model = known, Ridge(**thing(data))
    told = next(model.fit(data.pushes, outcome))["deviation_mm"]
    motion, seen = 1e3 * model.motion(data.pushes, outcome.pose), features(data.pushes, model.object)
    centred = motion - motion.mean(0)
    chosen = torch.tensor((Ridge.WIDTHS[0], Ridge.DIRECTIONS[0], Ridge.SHARES[0]), dtype=F)
    kernel, errors = _kernel(seen, seen, chosen), []
    torch.testing.assert_close(kernel.diagonal(), torch.full((24,), 1.0 + Ridge.SHARES[0], dtype=F))
    other = seen._replace(geometry=seen.geometry + 1.0)  # one never seen: the common function is left
    torch.testing.assert_close(_kernel(other, seen, chosen).diagonal(), torch.ones(24, dtype=F))
    for penalty in Ridge.PENALTIES:
        left = []
        for k in range(24):
            rest = torch.arange(24) != k
            weights = torch.linalg.solve(kernel[rest][:, rest] + penalty * torch.eye(23, dtype=F), centred[rest])
            left.append((kernel[k, rest] @ weights - centred[k]).norm())
        errors.append(float(torch.stack(left).mean()))
    assert told == pytest.approx(min(errors), rel=1e-9)


@pytest.mark.parametrize("count", [1, 30])
def test_the_least_deviation_is_that_of_errors_and_prior_together(count):
    """One number, errors along a line: against all numbers of a fine grid."""
    generator = torch.Generator().manual_seed(0)
    slope, offset = torch.randn(2, count, 3, generator=generator, dtype=F)
    expected, spread, noise, floor = torch.tensor([0.5], dtype=F), torch.tensor([0.2], dtype=F), 0.8, 0.1
    found = least_deviation(
        lambda x: (slope * x - offset, slope[..., None]), torch.zeros(1, dtype=F), floor=floor, expected=expected,
        spread=spread, noise=noise, iterations=60,
    )  # fmt: skip
    *_, (best, loss) = found

    def objective(x):
        size = ((slope * x - offset).square().sum(-1) + floor**2).sqrt().mean()
        return float(size + noise / (2 * count) * ((x - expected) / spread).square().sum())

    grid = torch.linspace(-2.0, 2.0, 4001, dtype=F)
    assert loss == pytest.approx(objective(best))
    assert objective(best) == pytest.approx(min(map(objective, grid)), rel=2e-4)


@pytest.mark.parametrize("terms", [INSIDE, BESIDE], ids=["inside", "beside"])
def test_a_process_has_the_posterior_of_its_gaussian_and_learns_uphill(data, terms):
    """Against the dense covariance of latents and end poses, assembled entry by entry."""
    thing_ = PushedObject(data.vertices, data.com, data.mass)
    seen, other = (features(data.pushes.take(torch.arange(*rows)), thing_) for rows in ((0, 10), (10, 14)))
    generator = torch.Generator().manual_seed(0)
    through, left = (
        torch.randn(10, 3, 11, generator=generator, dtype=F),
        torch.randn(10, 3, generator=generator, dtype=F),
    )
    through[..., 8:] = torch.eye(3, dtype=F)
    process = Process(terms, 10, 15)
    likelihood = [figures["log_likelihood"] for figures in process.fit(seen, through, left)]
    assert likelihood[-1] > likelihood[0] + 0.1
    between, across = (process.functions(each, seen, process.log_scales) for each in (seen, other))
    covariance = (2.0 * process.log_scales[-1]).exp() * torch.eye(30, dtype=F)
    crossed = torch.zeros(4, 11, 30, dtype=F)
    for name in terms:
        for latent in range(11)[LATENTS[name][0]]:
            rows = through[:, :, latent]
            covariance += torch.einsum("ia,ij,jb->iajb", rows, between[name], rows).reshape(30, 30)
            crossed[:, latent] += torch.einsum("ij,jb->ijb", across[name], rows).reshape(4, 30)
    posterior = crossed @ torch.linalg.solve(covariance, left.reshape(-1))
    torch.testing.assert_close(process.mean(other, seen), posterior, rtol=0, atol=1e-6)  # weights are float32
