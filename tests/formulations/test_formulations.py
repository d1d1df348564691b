"""Formulations: right at the true parameters, and sticking where the structure promises it."""

import copy
import math

import pytest
import torch
from torch import Tensor

from lcplearn.datasets import simulate_sliding_block
from lcplearn.formulations import (
    FORMULATIONS,
    PSD,
    Direct,
    Formulation,
    Physical,
    PSDSkew,
    ReLU,
    Slack,
    Structured,
    Traditional,
)
from lcplearn.scenes import Drive, Mode

DT, MU, MASS, GRAVITY = 0.05, 0.4, 1.5, 9.81
LIMIT = MU * GRAVITY * DT
BIAS = torch.full((2,), -LIMIT, dtype=torch.float64)
TRUE_F = torch.tensor([[1.0, 1.0 / MASS], [-1.0, -1.0 / MASS]], dtype=torch.float64)


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def steps(friction: str | None = None) -> tuple[Tensor, Tensor, Tensor | None, Tensor]:
    """Velocity, force, friction labels and true next velocity of 2000 simulated steps; 40 % stick."""
    data = simulate_sliding_block(seed=3, friction=friction, dt=DT, mu=MU, mass=MASS).train
    labels = None if data.drive.friction is None else data.drive.friction.reshape(-1, 2)
    velocity = data.states[..., 1]
    return velocity[:, :-1].reshape(-1), data.drive.force.reshape(-1), labels, velocity[:, 1:].reshape(-1)


def after_a_step(model: Formulation, velocity: Tensor, force: Tensor, friction: Tensor | None = None) -> Tensor:
    state = torch.stack((torch.zeros_like(velocity), velocity), dim=-1)
    return model.advance(state, Drive(force[..., None], friction)).state[..., 1]


def with_values(model: Formulation, **values: Tensor | float) -> Formulation:
    with torch.no_grad():
        for name, value in values.items():
            model.get_parameter(name).copy_(torch.as_tensor(value, dtype=torch.float64))
    return model


def true_direct() -> Formulation:
    exchange = -torch.eye(2, dtype=torch.float64).flip(0) / MASS
    return with_values(Direct(dt=DT), f_weight=TRUE_F, G=exchange)


def true_slack() -> Formulation:
    return with_values(Slack(dt=DT), f_weight=TRUE_F, f_bias=BIAS, G=torch.eye(2, dtype=torch.float64) / MASS)


def true_relu() -> Formulation:
    return with_values(ReLU(dt=DT), **{"net.0.weight": TRUE_F, "net.0.bias": BIAS})


def true_structured() -> Formulation:
    return Structured(dt=DT, initial_mu=MU, initial_mass=MASS)


def true_physical() -> Formulation:
    return Physical(dt=DT, initial_mu=MU, initial_mass=MASS)


def true_traditional() -> Formulation:
    model = Traditional(dt=DT, initial_mu=MU, initial_noise=0.0)
    rows = torch.cat((TRUE_F, torch.zeros(1, 2, dtype=torch.float64)))
    return with_values(model, f_weight=rows, b_weight=TRUE_F[0])


@pytest.mark.parametrize(
    "model", [true_slack, true_relu, true_structured, true_physical, true_traditional], ids=lambda build: build.__name__
)
def test_at_the_true_parameters_a_step_is_the_closed_form(model) -> None:
    velocity, force, _, after = steps()
    error = after_a_step(model(), velocity, force) - after
    assert error.abs().max() <= 1e-13


@pytest.mark.parametrize("model", [true_slack, true_relu, true_structured, true_physical])
def test_a_model_with_structure_sticks_exactly_where_the_truth_does(model) -> None:
    velocity, force, _, after = steps()
    predicted = after_a_step(model(), velocity, force)
    assert bool((after == 0).any())
    assert torch.equal(predicted == 0, after == 0)


def test_direct_is_exact_with_lcp_friction_but_not_with_physical_friction() -> None:
    """Physical friction is complementary to the velocity, but the affine law misses the truth."""
    velocity, force, labels, after = steps("lcp")
    model = true_direct()
    parts = torch.stack((after.clamp(min=0), (-after).clamp(min=0)), dim=-1)
    assert (model.velocity_parts(velocity, force, labels) - parts).abs().max() <= 1e-13
    physical = steps("physical")[2]
    assert (physical * parts).abs().max() <= 1e-12
    assert (labels * parts).abs().max() > 1.0
    assert (model.velocity_parts(velocity, force, physical) - parts).abs().max() > 0.1
    # Rectified, the affine law is exact for both.
    for friction in (labels, physical):
        rectified = model.velocity_parts(velocity, force, friction).clamp(min=0)
        assert (rectified - parts).abs().max() <= 1e-13


def test_slack_friction_fits_the_affine_law_and_is_what_the_deployed_lcp_finds() -> None:
    velocity, force, labels, after = steps("slack")
    model = true_slack()
    parts = torch.stack((after.clamp(min=0), (-after).clamp(min=0)), dim=-1)
    assert (model.velocity_parts(velocity, force, labels) - parts).abs().max() <= 1e-13
    assert (labels * parts).abs().max() <= 1e-12
    solution = model.predict(velocity, force)[1]
    assert (solution.z / DT - labels).abs().max() <= 1e-10


def sticking_samples(count: int = 2000) -> tuple[Tensor, Tensor]:
    """Blocks at rest under forces of 0.1 to 0.9 of the friction limit, to both sides."""
    share = 0.1 + 0.8 * torch.rand(count, dtype=torch.float64)
    side = torch.where(torch.rand(count) < 0.5, -1.0, 1.0)
    return torch.zeros(count, dtype=torch.float64), side * share * MU * MASS * GRAVITY


def disturbed(model: Formulation, scale: float) -> Formulation:
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += scale * parameter.abs().mean() * torch.randn_like(parameter)
    return model


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e-2])
@pytest.mark.parametrize("model", [true_slack, true_relu, true_structured, true_physical])
def test_sticking_survives_noise_on_the_parameters_of_a_structured_model(model, scale: float) -> None:
    """NOTES 6: noise on (a, b, c) leaves exact zeros, up to the few samples that it moves over the limit."""
    shares = []
    for _ in range(10):
        predicted = after_a_step(disturbed(model(), scale), *sticking_samples(200))
        shares.append((predicted.abs() < 1e-12).double().mean())
    assert torch.stack(shares).mean() >= 0.99


@pytest.mark.parametrize("scale", [1e-6, 1e-3])
@pytest.mark.parametrize("model", [true_traditional], ids=["traditional"])
def test_sticking_does_not_survive_noise_on_free_matrices(model, scale: float) -> None:
    predicted = disturbed(model(), scale).next_velocity(*sticking_samples())
    assert (predicted.abs() < 1e-12).double().mean() <= 0.01


def test_mirrored_rows_make_the_first_prediction_an_odd_function() -> None:
    velocity, force, _, _ = steps()
    for depth in (0, 1):
        output = ReLU(dt=DT, depth=depth).net[-1]
        assert torch.equal(output.weight[0], -output.weight[1])
        assert bool((output.bias < 0).all())
    model = ReLU(dt=DT)
    assert torch.equal(model.next_velocity(-velocity, -force), -model.next_velocity(velocity, force))


def test_the_threshold_at_small_temperature_tends_to_the_lcp() -> None:
    velocity, force, _, _ = steps()
    model = true_structured()
    exact = model.next_velocity(velocity, force)
    errors = []
    for temperature in (1e-2, 1e-3, 1e-4):
        with model.softened(temperature):
            error = (model.next_velocity(velocity, force) - exact).abs().max().item()
        assert error <= temperature * math.log(2)
        errors.append(error)
    assert errors == sorted(errors, reverse=True)


def test_temperature_gives_friction_a_gradient_on_the_plateau() -> None:
    """With mu far too high every sample is predicted to stick: the LCP has no gradient, the softened one has."""
    velocity, force = sticking_samples()
    model = Physical(dt=DT, initial_mu=10.0)
    for temperature, moves in ((0.0, False), (1.0, True)):
        model.zero_grad()
        with model.softened(temperature):
            (after_a_step(model, velocity, force) - 1.0).square().sum().backward()
        assert (abs(model.free["mu"].grad.item()) > 1e-6) == moves
    assert model.temperature == 0.0


def moved(model: Structured) -> Structured:
    """The model with twice its mass."""
    with torch.no_grad():
        model.b_weight[1] /= 2.0
    return model


def test_physical_parameters_read_out_what_went_in() -> None:
    physical, structured = (cls(dt=DT, initial_mu=0.3, initial_mass=2.5) for cls in (Physical, Structured))
    assert physical.physical_parameters() == pytest.approx({"mu": 0.3, "mass": 2.5}, rel=1e-12)
    assert structured.physical_parameters() == pytest.approx({"mu": 0.3}, rel=1e-12)  # no force has told the mass
    assert moved(structured).physical_parameters() == pytest.approx({"mu": 0.3, "mass": 5.0}, rel=1e-12)
    assert set(moved(Structured(dt=DT, c_network=True)).physical_parameters()) == {"mass"}
    assert set(moved(Structured(dt=DT, b_network=True)).physical_parameters()) == {"mu"}
    assert set(Structured(dt=DT, learn_b=False).physical_parameters()) == {"mu"}
    assert set(Physical(dt=DT, learn_mass=False).physical_parameters()) == {"mu"}
    assert ReLU(dt=DT).physical_parameters() == {}


def test_positive_quantities_stay_positive_whatever_the_parameters_are() -> None:
    velocity = torch.linspace(-2, 2, 9, dtype=torch.float64)
    physical = Physical(dt=DT)
    for model in (Structured(dt=DT), Structured(dt=DT, c_network=True)):
        for _ in range(20):
            disturbed(model, 1.0)
            assert bool((model.velocity_limit(velocity) > 0).all())
            assert model.inverse_mass() > 0
            assert all(value > 0 for value in disturbed(physical, 1.0).physical_parameters().values())


@pytest.mark.parametrize("model", [PSD, PSDSkew])
def test_positive_semidefinite_matrices_make_every_lcp_solvable(model) -> None:
    velocity, force, _, _ = steps()
    for _ in range(10):
        free = disturbed(model(dt=DT, initial_noise=0.5), 0.5)
        symmetric = (free.matrix() + free.matrix().mT) / 2
        assert torch.linalg.eigvalsh(symmetric).min() >= 0.9 * free.shift
        assert bool(free.predict(velocity[:100], force[:100])[1].solved.all())


def test_psd_skew_can_express_the_friction_matrix_and_psd_cannot() -> None:
    """The friction matrix is positive semidefinite but not symmetric."""
    friction = torch.tensor([[1.0, -1.0, 1.0], [-1.0, 1.0, 1.0], [-1.0, -1.0, 0.0]], dtype=torch.float64)
    exact = PSDSkew(dt=DT, initial_noise=0.0, shift=1e-12)
    assert (exact.matrix() - friction).abs().max() <= 1e-11
    symmetric = PSD(dt=DT).matrix()
    assert (symmetric - symmetric.mT).abs().max() <= 1e-15
    assert (symmetric - friction).abs().max() >= 1.0 - 1e-3


@pytest.mark.parametrize("name", FORMULATIONS)
def test_a_batch_is_its_elements_one_by_one_and_a_rollout_its_steps(name: str) -> None:
    model = FORMULATIONS[name](dt=DT)
    state = torch.randn(2, 3, 2, dtype=torch.float64)
    forces = 5 * torch.randn(2, 3, 4, 1, dtype=torch.float64)
    friction = torch.rand(2, 3, 4, 2, dtype=torch.float64) if model.needs_friction else None
    path = model.rollout(state, forces, friction)
    assert path.velocities.shape == (2, 3, 5, 1)
    assert path.mode.shape == (2, 3, 4, 1)
    moved = path.positions[..., :-1, :] + DT * path.velocities[..., 1:, :]
    torch.testing.assert_close(path.positions[..., 1:, :], moved, rtol=1e-12, atol=1e-12)
    one, measured = state[1, 2], None
    for k in range(4):
        measured = None if friction is None else friction[1, 2, k]
        one = model.step(one, forces[1, 2, k], measured)
        assert torch.allclose(path.velocities[1, 2, k + 1], one[1:], rtol=1e-12, atol=1e-12)
        assert torch.allclose(path.positions[1, 2, k + 1], one[:1], rtol=1e-12, atol=1e-12)


def test_the_mode_of_a_step_is_stick_exactly_where_the_velocity_is_zero() -> None:
    data = simulate_sliding_block(seed=1).train
    path = true_physical().rollout(data.states[:, 0], data.drive.force)
    assert torch.equal(path.mode[..., 0] == Mode.STICK, path.velocities[:, 1:, 0] == 0)
    assert bool((path.mode == Mode.STICK).any())
    assert bool((path.mode == Mode.SLIP).any())


@pytest.mark.parametrize("name", FORMULATIONS)
def test_every_parameter_is_float64_and_seeded_by_the_global_generator(name: str) -> None:
    first, second = [], []
    for parameters in (first, second):
        torch.manual_seed(7)
        parameters += FORMULATIONS[name](dt=DT).parameters()
    assert all(p.dtype == torch.float64 for p in first)
    assert all(torch.equal(p, other) for p, other in zip(first, second, strict=True))


@pytest.mark.parametrize("name", FORMULATIONS)
def test_a_model_is_rebuilt_from_its_arguments_and_parameters(name: str) -> None:
    velocity, force, _, _ = steps()
    given = {} if name in ("affine", "mlp") else {"gravity": 9.8}
    model = copy.deepcopy(FORMULATIONS[name](dt=DT, **given))
    torch.manual_seed(1)
    again = type(model)(**model.arguments)
    again.load_state_dict(model.state_dict())
    friction = torch.ones(2000, 2, dtype=torch.float64) if model.needs_friction else None
    ours, theirs = (after_a_step(m, velocity, force, friction) for m in (model, again))
    assert torch.equal(ours, theirs)


def test_the_registry_names_every_model_of_the_comparison() -> None:
    names = "affine mlp force_mlp direct slack relu traditional psd psd_skew structured physical"
    assert list(FORMULATIONS) == names.split()


@pytest.mark.parametrize("name", FORMULATIONS)
def test_a_rollout_of_float32_data_is_that_of_the_same_numbers_in_float64(name: str) -> None:
    model = FORMULATIONS[name](dt=DT)
    state, forces = torch.tensor([0.0, 0.5]), torch.tensor([[0.0], [10.0], [-3.0]])
    friction = torch.ones(3, 2) if model.needs_friction else None
    path = model.rollout(state, forces, friction)
    assert path.velocities.dtype == torch.float64
    exact = model.rollout(state.double(), forces.double(), None if friction is None else friction.double())
    assert torch.equal(path.velocities, exact.velocities)


def test_wrong_arguments_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match="dt"):
        Physical(dt=0.0)
    with pytest.raises(ValueError, match="initial_mu"):
        Structured(dt=DT, initial_mu=-1.0)
    with pytest.raises(ValueError, match="shift"):
        PSD(dt=DT, shift=0.0)
    with pytest.raises(ValueError, match="activation"):
        FORMULATIONS["mlp"](dt=DT, activation="gelu")
    with pytest.raises(ValueError, match="friction"):
        Direct(dt=DT).next_velocity(torch.zeros(1), torch.zeros(1))


def test_the_lcp_of_a_structured_model_has_only_the_two_rows_that_it_needs() -> None:
    velocity, force, _, _ = steps()
    model = true_structured()
    solution = model.predict(velocity, force)[1]
    assert solution.z.shape == (2000, 2)
    assert bool(solution.solved.all())
