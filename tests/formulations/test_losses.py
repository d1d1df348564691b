"""Loss terms: values worked out by hand, gradients by finite differences, padding without effect."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from lcplearn.datasets import Windows
from lcplearn.formulations import FORMULATIONS, MLP, Direct, Formulation, Physical, loss_terms
from lcplearn.scenes import PLANE, Drive
from lcplearn.scenes.violation import VIOLATION_WIDTH, violation

DT, GRAVITY = 0.1, 10.0
MODELS_OF = {
    "prediction": set(FORMULATIONS),
    "rollout": set(FORMULATIONS),
    "pose": set(FORMULATIONS),
    "complementarity": {"direct", "slack"},
    "nonnegativity": {"direct", "slack"},
    "violation": {"structured", "physical"},
}


LOSS_TERMS = tuple(MODELS_OF)


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def build(name: str) -> Formulation:
    given = {} if name in ("affine", "mlp") else {"gravity": GRAVITY}
    return FORMULATIONS[name](dt=DT, **given)


def line_windows(velocity: Tensor, force: Tensor, friction: Tensor | None = None) -> Windows:
    """From velocities [B, k + 1] and forces [B, k]; positions are 0."""
    states = torch.stack((torch.zeros_like(velocity), velocity), dim=-1)
    return Windows(states, Drive(force[..., None], friction), torch.ones(force.shape, dtype=torch.bool))


def some_windows(count: int = 6, k: int = 3) -> Windows:
    return line_windows(
        velocity=torch.randn(count, k + 1, dtype=torch.float64),
        force=5 * torch.randn(count, k, dtype=torch.float64),
        friction=torch.rand(count, k, 2, dtype=torch.float64),
    )


def tensor(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize("term", LOSS_TERMS)
@pytest.mark.parametrize("name", FORMULATIONS)
def test_a_term_is_a_scalar_where_the_model_has_it_and_one_sentence_elsewhere(name: str, term: str) -> None:
    if name in MODELS_OF[term]:
        values = loss_terms(build(name), some_windows(), {term: 0.5})
        assert list(values) == [term]
        assert values[term].shape == ()
        assert values[term] >= 0
    else:
        with pytest.raises(ValueError, match=term) as error:
            loss_terms(build(name), some_windows(), {term: 0.5})
        assert "\n" not in str(error.value)


def test_wrong_weights_are_refused() -> None:
    for weights, message in (
        ({"prediction": -1.0}, "prediction.*-1"),
        ({"prediction": float("nan")}, "prediction"),
        ({"predict": 1.0}, "predict"),
        ({"prediction": 0.0}, "positive weight"),
    ):
        with pytest.raises(ValueError, match=message):
            loss_terms(build("affine"), some_windows(), weights)
    with pytest.raises(ValueError, match="friction"):
        loss_terms(build("slack"), line_windows(torch.zeros(1, 2), torch.zeros(1, 1)), {"prediction": 1.0})


def test_prediction_and_rollout_equal_values_worked_out_by_hand() -> None:
    """mu g dt = 0.4 m/s and m = 2 kg: from 1 m/s under 4 N, v' = 1 + 0.2 - 0.4 = 0.8; then under -10 N, 0 (stick)."""
    model = Physical(dt=DT, gravity=GRAVITY, initial_mu=0.4, initial_mass=2.0)
    windows = line_windows(tensor(1.0, 1.0, 0.5)[None], tensor(4.0, -10.0)[None])
    terms = loss_terms(model, windows, {"prediction": 1.0, "rollout": 1.0})
    assert terms["prediction"].item() == pytest.approx(0.2**2)
    assert terms["rollout"].item() == pytest.approx((0.2**2 + 0.5**2) / 2)


def test_the_pose_error_is_a_robust_distance_that_weighs_rotations_by_the_radius() -> None:
    """c (sqrt(1 + d^2 / c^2) - 1), c = radius / 10; a body that goes on moves by 0.03 m and turns by 0.2 rad."""
    block = Physical(dt=DT, gravity=GRAVITY, initial_mu=0.4, initial_mass=2.0)
    windows = line_windows(tensor(1.0, 0.8)[None], tensor(4.0)[None])  # recorded at 0, and 0.08 m from there
    found = loss_terms(block, windows, {"pose": 1.0})["pose"]
    assert found.item() == pytest.approx(0.1 * (1.64**0.5 - 1.0))
    body = MLP(dt=DT, space=PLANE)
    body.radius = 0.5
    for parameter in body.parameters():
        parameter.data.fill_(0.0)
    still = torch.zeros(1, 2, 6, dtype=torch.float64)
    still[..., 3:] = tensor(0.3, 0.0, 2.0)
    turned = Windows(still, Drive(torch.zeros(1, 1, 3, dtype=torch.float64)), torch.ones(1, 1, dtype=torch.bool))
    square = (0.03**2 + (0.5 * 0.2) ** 2) / 0.05**2
    assert loss_terms(body, turned, {"pose": 1.0})["pose"].item() == pytest.approx(0.05 * ((1.0 + square) ** 0.5 - 1.0))
    still[:, 1, 5] += 1.0  # recorded faster by 1 rad/s
    assert loss_terms(body, turned, {"rollout": 1.0})["rollout"].item() == pytest.approx(0.5**2)


def test_penalties_equal_values_worked_out_by_hand() -> None:
    """Without G the parts are (p, -p) with p = v + u dt = 0.5: the second is negative by 0.5."""
    model = Direct(dt=DT, gravity=GRAVITY)
    windows = line_windows(tensor(1.0, 0.4)[None], tensor(-5.0)[None], tensor(2.0, 3.0)[None, None])
    weights = {"prediction": 1.0, "complementarity": 1.0, "nonnegativity": 1.0}
    terms = loss_terms(model, windows, weights)
    assert terms["prediction"].item() == pytest.approx((0.5 - 0.4) ** 2 + 0.5**2)
    assert terms["complementarity"].item() == pytest.approx((2 * 0.5) ** 2 + (3 * 0.5) ** 2)
    assert terms["nonnegativity"].item() == pytest.approx(0.5**2)


@pytest.mark.parametrize("name", ["mlp", "slack", "direct", "relu", "psd_skew", "structured", "physical"])
def test_padding_changes_neither_values_nor_gradients(name: str) -> None:
    windows, model = some_windows(4, 3), build(name)
    weights = {term: 1.0 for term in LOSS_TERMS if name in MODELS_OF[term]}
    valid = torch.tensor([[True, True, True], [True, True, False], [True, False, False], [False, False, False]])
    results = []
    for padding in (0.5, -3.0, 1e6):
        after = torch.where(valid[..., None], windows.states[:, 1:], padding)
        padded = Windows(
            states=torch.cat((windows.states[:, :1], after), dim=1),
            drive=windows.drive.map(lambda values, padding=padding: torch.where(valid[..., None], values, padding)),
            valid=valid,
        )
        model.zero_grad()
        terms = loss_terms(model, padded, weights)
        sum(terms.values()).backward()
        results.append([t.detach() for t in terms.values()] + [p.grad.clone() for p in model.parameters()])
    assert all(bool(torch.isfinite(x).all()) for x in results[0])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
    one_step = Windows(windows.states[:3, :2], windows.drive.map(lambda x: x[:3, :1]), windows.valid[:3, :1])
    first = loss_terms(model, one_step, weights)
    beyond_the_first_step = {"rollout", "pose"} | ({"violation"} if name == "physical" else set())
    for term in set(weights) - beyond_the_first_step:
        assert terms[term].item() == pytest.approx(first[term].item(), rel=1e-12)


@pytest.mark.parametrize(
    ("name", "term"), [(name, term) for term in LOSS_TERMS for name in sorted(MODELS_OF[term]) if name != "traditional"]
)
def test_gradients_of_losses_equal_central_differences(name: str, term: str) -> None:
    windows, model = some_windows(5, 2), build(name)
    with torch.no_grad():  # away from symmetric starts, where rectifiers sit on their kinks
        for parameter in model.parameters():
            parameter += 0.05 * torch.randn_like(parameter)
    terms = loss_terms(model, windows, {term: 1.0})
    parameters = list(model.parameters())
    gradients = torch.autograd.grad(terms[term], parameters, allow_unused=True)
    directions = [torch.randn_like(p) for p in parameters]
    expected = sum((g * d).sum().item() for g, d in zip(gradients, directions, strict=True) if g is not None)
    h, values = 1e-6, []
    for step in (h, -2 * h):
        with torch.no_grad():
            for parameter, direction in zip(parameters, directions, strict=True):
                parameter += step * direction
            values.append(loss_terms(model, windows, {term: 1.0})[term].item())
    assert (values[0] - values[1]) / (2 * h) == pytest.approx(expected, rel=1e-5, abs=1e-7)


def objective(after: Tensor, unexplained: Tensor, limit: Tensor, y: Tensor) -> Tensor:
    """What `violation` minimises over y, written out."""
    gate = (after.abs() / VIOLATION_WIDTH).clamp(max=1.0)
    excess = (y.abs() - limit).clamp(min=0)
    return (unexplained - y) ** 2 + gate * (y + torch.sign(after) * limit) ** 2 + excess**2


@settings(deadline=None, max_examples=200)
@given(after=st.floats(-3, 3), unexplained=st.floats(-3, 3), limit=st.floats(1e-3, 2))
def test_the_violation_loss_is_the_minimum_over_a_grid_of_frictions(
    after: float, unexplained: float, limit: float
) -> None:
    v, r, c = tensor(after), tensor(unexplained), tensor(limit)
    found = violation(v, r, c).item()
    grid = torch.linspace(-7, 7, 140001, dtype=torch.float64)
    brute = objective(v, r, c, grid).min().item()
    assert found <= brute + 1e-12
    assert found >= brute - 1e-7  # curvature <= 3, grid step 1e-4: the grid misses the minimum by at most 8e-9


def test_the_violation_loss_vanishes_on_fast_true_steps_and_on_sticks() -> None:
    """A slip faster than the gate with y = -sign(v') l, and a stick explained by less than the limit."""
    assert violation(tensor(2 * VIOLATION_WIDTH), tensor(-0.3), tensor(0.3)).item() == pytest.approx(0.0, abs=1e-30)
    assert violation(tensor(0.0), tensor(0.2), tensor(0.3)).item() == pytest.approx(0.0, abs=1e-30)
    assert violation(tensor(0.0), tensor(0.5), tensor(0.3)).item() == pytest.approx(0.02)  # y = 0.4: 0.01 + 0.01


def test_the_violation_loss_has_a_gradient_where_prediction_has_none() -> None:
    """With mu far too high all samples are predicted to stick, and the prediction loss is flat in mu."""
    windows = line_windows(tensor(0.0, 0.5)[None], tensor(20.0)[None])
    model = Physical(dt=DT, gravity=GRAVITY, initial_mu=5.0)
    gradients = {}
    for term in ("prediction", "violation"):
        (gradient,) = torch.autograd.grad(loss_terms(model, windows, {term: 1.0})[term], model.free["mu"])
        gradients[term] = gradient.item()
    assert gradients["prediction"] == 0.0
    assert gradients["violation"] > 0.0
