"""The claims of NOTES 5.3 to 5.6 on sliding blocks."""

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lcplearn import solve_lcp
from lcplearn.scenes import Mode, OneWayBlock, SlidingBlock, Trajectory, slide

DT, MU, MASS, GRAVITY = 0.05, 0.4, 1.5, 9.81
LIMIT = MU * MASS * GRAVITY
FORMS = ("direct", "physical", "traditional")

positive = st.floats(1e-3, 1e3)
signed = st.floats(-1e3, 1e3)


def block(form: str = "direct", **changes: float) -> SlidingBlock:
    return SlidingBlock(**{"mass": MASS, "mu": MU, "dt": DT, "form": form, **changes})


@pytest.fixture(scope="module")
def random_pushes() -> tuple[torch.Tensor, torch.Tensor]:
    """Starts and forces of 300 trajectories of 100 random steps, with about as much stick as slip."""
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(300, 2, generator=generator, dtype=torch.float64)
    return start, 1.2 * LIMIT * torch.randn(300, 100, 1, generator=generator, dtype=torch.float64)


@pytest.fixture(scope="module")
def paths(random_pushes) -> dict[str, Trajectory]:
    return {form: block(form).rollout(*random_pushes) for form in FORMS}


@pytest.mark.parametrize("form", FORMS)
def test_all_forms_give_the_closed_form_velocity_on_30000_random_steps(form, random_pushes, paths):
    """NOTES 5.6. The mode has to agree too: sticking is exactly zero velocity."""
    start, forces = random_pushes
    path, velocity = paths[form], start[:, 1]
    for k in range(forces.shape[1]):
        velocity = slide(velocity + forces[:, k, 0] * DT / MASS, MU * GRAVITY * DT)
        assert (path.velocities[:, k + 1, 0] - velocity).abs().max() <= 1e-12
        assert torch.equal(path.mode[:, k, 0] == Mode.STICK, velocity == 0)
    assert 0.2 < (path.mode == Mode.STICK).double().mean() < 0.8


def test_direct_equals_traditional_on_30000_random_steps(paths):
    """NOTES 5.6 against 5.4."""
    assert (paths["direct"].velocities - paths["traditional"].velocities).abs().max() <= 1e-12


def test_the_two_velocities_are_complementary_on_30000_random_steps(random_pushes, paths):
    """NOTES 5.4: complementarity of v+ and v-."""
    before = paths["direct"].velocities[:, :-1, 0]
    z = solve_lcp(*block().lcp(before, random_pushes[1][..., 0]), method="diagonal").z
    assert (z >= 0).all()
    assert (z[..., 0] * z[..., 1] == 0).all()


@settings(deadline=None)
@given(plus=positive, minus=positive, force=signed, dt=st.floats(1e-4, 5), mu=st.floats(0, 2))
def test_the_velocities_become_complementary_even_after_ones_that_were_not(plus, minus, force, dt, mu):
    """No induction hypothesis is needed: only v+ - v- enters the LCP."""
    start = torch.tensor(plus, dtype=torch.float64) - torch.tensor(minus, dtype=torch.float64)
    z = solve_lcp(*block(dt=dt, mu=mu).lcp(start, torch.tensor(force, dtype=torch.float64)), method="diagonal").z
    assert z[0] * z[1] == 0


def test_velocities_are_not_complementary_for_a_negative_friction_coefficient():
    """With |p| < -c both velocities are positive."""
    zero = torch.zeros((), dtype=torch.float64)
    z = solve_lcp(*block(mu=torch.tensor(-0.4, dtype=torch.float64)).lcp(zero, zero), method="diagonal").z
    assert (z > 0).all()


@settings(deadline=None)
@given(velocity=st.floats(0, 1e3), force=st.floats(0, 1e3), mu=st.floats(0, 2), mass=positive, dt=st.floats(1e-3, 1))
def test_one_way_friction_never_pushes_a_block_that_is_not_pulled_back(velocity, force, mu, mass, dt):
    """NOTES 5.3: lambda = mu m g - w >= 0 for v_k >= 0 and u >= 0."""
    one_way = OneWayBlock(mass, mu, dt)
    v, u = torch.tensor(velocity, dtype=torch.float64), torch.tensor(force, dtype=torch.float64)
    solution = solve_lcp(*one_way.lcp(v, u), method="diagonal")
    limit = mu * mass * GRAVITY
    assert limit - solution.w.item() >= -1e-12 * (limit + velocity * mass / dt + force)
    assert one_way.next_velocity(v, u).item() >= 0


def test_one_way_friction_holds_the_block_against_any_backward_force():
    """NOTES 5.3: pulled back, lambda is negative and the velocity still 0."""
    one_way = OneWayBlock(MASS, MU, DT)
    v, u = torch.tensor(0.0, dtype=torch.float64), torch.tensor(-100.0, dtype=torch.float64)
    solution = solve_lcp(*one_way.lcp(v, u), method="diagonal")
    assert LIMIT - solution.w.item() == pytest.approx(-100.0)
    assert one_way.next_velocity(v, u) == 0


@settings(deadline=None)
@given(velocity=st.floats(0, 1e3), force=signed)
def test_one_way_block_has_its_closed_form(velocity, force):
    """NOTES 5.3."""
    one_way = OneWayBlock(MASS, MU, DT)
    v, u = torch.tensor(velocity, dtype=torch.float64), torch.tensor(force, dtype=torch.float64)
    torch.testing.assert_close(one_way.next_velocity(v, u), one_way.closed_form(v, u), rtol=1e-13, atol=1e-12)


def test_a_one_way_block_slows_down_under_friction_and_stops():
    """NOTES 5.3: mu g dt of velocity a step, then none."""
    path = OneWayBlock(MASS, MU, DT).rollout(
        torch.tensor([0.0, 0.5], dtype=torch.float64), torch.zeros(5, 1, dtype=torch.float64)
    )
    lost = MU * GRAVITY * DT
    expected = [0.5, 0.5 - lost, 0.5 - 2 * lost, 0.0, 0.0, 0.0]
    torch.testing.assert_close(path.velocities[:, 0], torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-15)
    assert path.mode[:, 0].tolist() == [Mode.SLIP, Mode.SLIP, Mode.STICK, Mode.STICK, Mode.STICK]


@settings(deadline=None)
@given(velocity=signed, force=signed, mu=st.floats(0, 2), mass=positive, dt=st.floats(1e-3, 1))
def test_direct_friction_forces_add_up_to_minus_the_speed(velocity, force, mu, mass, dt):
    """NOTES 5.4: lambda+ + lambda- = -|v_{k+1}| m/dt, so that one of the two is fictitious in motion."""
    v, u = torch.tensor(velocity, dtype=torch.float64), torch.tensor(force, dtype=torch.float64)
    solution = solve_lcp(*block(mu=mu, mass=mass, dt=dt).lcp(v, u), method="diagonal")
    limit = mu * mass * GRAVITY
    scale = limit + (abs(velocity) * mass / dt + abs(force))
    assert (
        2 * limit - solution.w.sum() + solution.z.sum() * mass / dt
    ).abs() <= 1e-13 * scale + 1e-300  # below: underflow


def test_the_slack_of_the_physical_form_is_that_of_the_physical_friction(random_pushes, paths):
    """NOTES 5.5: w = (mu m g + F, mu m g - F) with F from the equation of motion, |F| <= mu m g."""
    force = random_pushes[1][..., 0]
    before, after = paths["physical"].velocities[:, :-1, 0], paths["physical"].velocities[:, 1:, 0]
    friction = (after - before) * MASS / DT - force
    w = solve_lcp(*block("physical").lcp(before, force)).w
    torch.testing.assert_close(w, torch.stack((LIMIT + friction, LIMIT - friction), dim=-1), rtol=0, atol=1e-11)
    assert (friction.abs() <= LIMIT + 1e-11).all()


@settings(deadline=None, max_examples=50)
@given(velocity=st.floats(-10, 10), force=st.floats(-50, 50), form=st.sampled_from(FORMS))
def test_a_mirrored_push_gives_the_mirrored_velocity(velocity, force, form):
    """Left and right are the same to a block on a level table (2.2)."""
    v, u = torch.tensor([velocity, -velocity], dtype=torch.float64), torch.tensor([force, -force], dtype=torch.float64)
    after = block(form).next_velocity(v, u)
    assert (after[0] + after[1]).abs() <= 1e-13


@pytest.mark.parametrize("form", FORMS)
def test_without_friction_momentum_grows_by_the_impulse(form, random_pushes):
    """m v_{k+1} = m v_k + u dt for mu = 0, where gamma of the traditional form is not unique (NOTES 5.6)."""
    start, forces = random_pushes
    path = block(form, mu=0.0).rollout(start[:20], forces[:20])
    momentum = MASS * start[:20, 1:2] + DT * forces[:20, :, 0].cumsum(dim=1)
    torch.testing.assert_close(MASS * path.velocities[:, 1:, 0], momentum, rtol=0, atol=1e-12)


def minors(M: torch.Tensor) -> list[float]:
    indices = [list(rows) for n in (1, 2, 3) for rows in itertools.combinations(range(3), n)]
    return [torch.linalg.det(M[rows][:, rows]).item() for rows in indices]


@pytest.mark.parametrize(("mass", "dt"), [(1.0, 1.0), (1.5, 0.05), (0.01, 2.0)])
def test_the_traditional_matrix_is_semidefinite_but_not_a_p_matrix(mass, dt):
    """NOTES 5.6: minors 1 1 0, 0 1 1, 4 (for a = 1); symmetric part with eigenvalues 0, 0, 2a."""
    a = dt / mass
    zero = torch.zeros((), dtype=torch.float64)
    M, q = block("traditional", mass=mass, dt=dt).lcp(zero, zero)
    assert minors(M) == pytest.approx([a, a, 0, 0, 1, 1, 4 * a])
    eigenvalues = torch.linalg.eigvalsh((M + M.T) / 2)
    torch.testing.assert_close(eigenvalues, torch.tensor([0, 0, 2 * a], dtype=torch.float64), rtol=1e-12, atol=1e-12)
    assert q.tolist() == pytest.approx([0, 0, MU * mass * GRAVITY])


def test_sticking_friction_is_not_unique_in_the_traditional_form_but_velocity_is():
    """NOTES 5.6: all (lambda+, lambda-) with the right difference and a sum up to the limit solve the LCP."""
    v, u = torch.tensor(0.0, dtype=torch.float64), torch.tensor(0.5 * LIMIT, dtype=torch.float64)
    M, q = block("traditional").lcp(v, u)
    for extra in (0.0, 0.1 * LIMIT, 0.25 * LIMIT):  # 0.25 = (mu m g - |p|/a) / 2, the end of the interval
        z = torch.tensor([extra, 0.5 * LIMIT + extra, 0.0], dtype=torch.float64)
        w = M @ z + q
        assert (w >= -1e-12).all()
        assert (z @ w).abs() <= 1e-12
        assert (v + DT / MASS * (u + z[0] - z[1])).abs() <= 1e-15
    assert torch.linalg.matrix_rank(M[:2, :2]) == 1


@pytest.mark.parametrize("form", FORMS)
def test_rows_are_only_those_that_the_form_needs(form):
    """Issue: 1, 1, 2, 2, 3 rows."""
    zero = torch.zeros(4, dtype=torch.float64)
    M, q = block(form).lcp(zero, zero)
    rows = 3 if form == "traditional" else 2
    assert M.shape == (rows, rows)
    assert q.shape == (4, rows)


@pytest.mark.parametrize("form", FORMS)
def test_mass_and_mu_may_differ_in_the_batch_and_take_gradients(form):
    """A batch of blocks is each block alone, and dv/dmu = -g dt sign(v) in slip, 0 in stick."""
    mass = torch.tensor([0.5, 1.5, 4.0, 1.0], dtype=torch.float64, requires_grad=True)
    mu = torch.tensor([0.1, 0.4, 0.2, 0.9], dtype=torch.float64, requires_grad=True)
    state = torch.tensor([[0.0, 2.0], [0.0, 0.0], [1.0, -3.0], [0.0, 0.1]], dtype=torch.float64)
    force = torch.tensor([[1.0], [1.0], [-1.0], [0.0]], dtype=torch.float64)
    after = SlidingBlock(mass, mu, DT, form=form).step(state, force)
    for k in range(4):
        alone = SlidingBlock(mass[k].item(), mu[k].item(), DT, form=form).step(state[k], force[k])
        torch.testing.assert_close(after[k], alone, rtol=0, atol=1e-14)
    after[:, 1].sum().backward()
    expected = torch.tensor([-GRAVITY * DT, 0.0, GRAVITY * DT, 0.0], dtype=torch.float64)
    torch.testing.assert_close(mu.grad, expected, rtol=0, atol=1e-12)
    expected = torch.tensor([-1.0 * DT / 0.25, 0.0, 1.0 * DT / 16, 0.0], dtype=torch.float64)  # -u dt / m^2
    torch.testing.assert_close(mass.grad, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("form", FORMS)
def test_a_batch_of_blocks_may_start_from_one_state(form, random_pushes):
    """Batch dimensions of parameters, states and forces broadcast."""
    mu = torch.tensor([0.1, 0.4, 0.9], dtype=torch.float64)
    start, forces = random_pushes
    paths = SlidingBlock(MASS, mu, DT, form=form).rollout(start[0], forces[0, :20])
    assert paths.positions.shape == paths.velocities.shape == (3, 21, 1)
    alone = block(form, mu=0.9).rollout(start[0], forces[0, :20])
    torch.testing.assert_close(paths.positions[2], alone.positions, rtol=0, atol=1e-13)


def test_the_gradient_of_the_closed_form_is_that_of_sticking_at_the_kink():
    """A stated element at |p| = c: 0."""
    p = torch.tensor([0.5, -0.5, 0.7, -0.7, 0.1], dtype=torch.float64, requires_grad=True)
    slide(p, 0.5).sum().backward()
    assert p.grad.tolist() == [0, 0, 1, 1, 0]


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("dt", {"dt": 0.0}),
        ("mass", {"mass": -1.0}),
        ("mass", {"mass": math.nan}),
        ("gravity", {"gravity": -9.81}),
        ("temperature", {"temperature": -1.0}),
        ("form", {"form": "corrected"}),
    ],
)
def test_a_wrong_argument_is_named(name, arguments):
    # a wrong literal is a TypeError first where the tests check types
    with pytest.raises((ValueError, TypeError), match=name):
        block(**arguments)


def test_a_softened_threshold_has_all_digits_of_its_numbers():
    velocity, force = torch.tensor([2.0, -2.0], dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    soft, hard = (block(temperature=t).next_velocity(velocity, force) for t in (1e-6, 0.0))
    torch.testing.assert_close(soft, hard, rtol=0, atol=1e-14)


@pytest.mark.parametrize("form", FORMS)
def test_a_block_at_rest_that_nothing_pushes_has_no_gradient(form):
    """Friction could hold more: the velocity is 0 all around."""
    inputs = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (0.0, 0.0, MU, MASS)]
    velocity, force, mu, mass = inputs
    after = SlidingBlock(mass, mu, DT, form=form).next_velocity(velocity, force)
    gradients = torch.autograd.grad(after, inputs, allow_unused=True)
    assert [0.0 if slope is None else float(slope) for slope in gradients] == [0.0] * 4
