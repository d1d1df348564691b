"""The claims of NOTES 5.1 and 5.2 on a falling block, its impact and restitution."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lcplearn import solve_lcp
from lcplearn.scenes import BouncingBlock, FallingBlock, Mode

GRAVITY = 9.81


def drop(block, height: float, steps: int, velocity: float = 0.0, dtype: torch.dtype = torch.float64):
    path = block.rollout(torch.tensor([height, velocity], dtype=dtype), torch.zeros(steps, 1, dtype=dtype))
    return path.positions[..., 0], path.velocities[..., 0], path.mode[..., 0]


@settings(deadline=None, max_examples=50)
@given(
    height=st.floats(0, 10),
    velocity=st.floats(-10, 10),
    force=st.floats(-20, 20),
    mass=st.floats(0.1, 10),
    dt=st.floats(1e-3, 0.2),
)
def test_a_step_satisfies_the_equations_of_motion_and_the_contact_conditions(height, velocity, force, mass, dt):
    """NOTES 5.1, the first two equations with general mass, and 0 <= x ⟂ lambda >= 0."""
    block = FallingBlock(mass, dt)
    x, v, u = (torch.tensor(value, dtype=torch.float64) for value in (height, velocity, force))
    contact = solve_lcp(*block.lcp(x, v, u), method="diagonal").w[0]
    after = block.step(torch.stack((x, v)), u[None])
    torch.testing.assert_close(after[0], block.closed_form(x, v, u), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(after[0], x + dt * after[1], rtol=1e-12, atol=1e-12)
    scale = (height / dt + abs(velocity) + dt * (GRAVITY + abs(force) / mass)) + 1
    expected = v + dt * (u / mass - GRAVITY + contact / mass)
    assert (after[1] - expected).abs() <= 1e-12 * scale
    assert after[0] >= 0
    assert contact >= 0
    assert after[0] * contact == 0


@pytest.mark.parametrize("dt", [0.1, 0.01])
def test_energy_changes_by_the_contact_work_less_half_the_squared_velocity_change(dt):
    """NOTES 5.1: dE = lambda dt v' - (v' - v)^2 / 2 for unit mass, and contact never adds energy."""
    block = FallingBlock(1.0, dt)
    x, v, _ = drop(block, 1.0, 100)
    contact = solve_lcp(*block.lcp(x[:-1], v[:-1], torch.zeros_like(x[:-1])), method="diagonal").w[:, 0]
    energy = v**2 / 2 + GRAVITY * x
    work = contact * dt * v[1:]
    torch.testing.assert_close(energy.diff(), work - v.diff() ** 2 / 2, rtol=0, atol=1e-12)
    assert (work <= 1e-12).all()
    assert (energy.diff() <= 1e-12).all()


@pytest.mark.parametrize(("dt", "mass"), [(0.1, 1.0), (0.01, 3.0)])
def test_each_step_of_free_flight_loses_the_same_energy(dt, mass):
    """NOTES 5.1: m g^2 dt^2 / 2 a step, from implicit Euler."""
    x, v, mode = drop(FallingBlock(mass, dt), 1.0, 20)
    energy = mass * (v**2 / 2 + GRAVITY * x)
    flight = mode == Mode.SEPARATION
    lost = -energy.diff()[flight]
    torch.testing.assert_close(lost, torch.full_like(lost, mass * GRAVITY**2 * dt**2 / 2), rtol=0, atol=1e-12)


def test_energy_lost_before_impact_shrinks_with_the_step_size():
    """NOTES 5.1: 19.6, 6.2, 2.2, 0.22 % of a fall from 1 m for dt = 0.1, 0.03, 0.01, 0.001."""
    for dt, expected in ((0.1, 0.196), (0.03, 0.062), (0.01, 0.022), (0.001, 0.0022)):
        x, v, mode = drop(FallingBlock(1.0, dt), 1.0, int(0.5 / dt) + 2)
        last = int((mode == Mode.SEPARATION).sum())
        lost = 1 - (v[last] ** 2 / 2 + GRAVITY * x[last]) / GRAVITY
        assert lost.item() == pytest.approx(expected, abs=0.06 * expected)


def test_impact_takes_two_steps_and_then_the_ground_carries_the_weight():
    """NOTES 5.1: gap exactly 0 with v = -x_k/dt, then v exactly 0; impulse |v_in| + 2 g dt (unit mass)."""
    dt = 0.01
    block = FallingBlock(1.0, dt)
    x, v, mode = drop(block, 1.0, 100)
    landing = int((mode == Mode.SEPARATION).sum())  # the step at which the gap closes
    assert x[landing] > 0
    assert (x[landing + 1 :] == 0).all()
    assert v[landing + 1] == -x[landing] / dt
    assert v[landing] <= v[landing + 1] <= 0
    assert (v[landing + 2 :] == 0).all()
    contact = solve_lcp(*block.lcp(x[:-1], v[:-1], torch.zeros_like(x[:-1])), method="diagonal").w[:, 0]
    impulse = dt * contact[landing : landing + 2].sum()
    assert impulse.item() == pytest.approx(-v[landing].item() + 2 * GRAVITY * dt, abs=1e-12)
    torch.testing.assert_close(contact[landing + 2 :], torch.full_like(contact[landing + 2 :], GRAVITY))
    assert mode.tolist() == [Mode.SEPARATION] * landing + [Mode.STICK] * (100 - landing)


def test_a_block_pulled_up_harder_than_its_weight_leaves_the_ground():
    """NOTES 5.1: only a gap ends the contact force."""
    block = FallingBlock(2.0, 0.1)
    rest = torch.zeros(2, dtype=torch.float64)
    for force, leaves in ((2.0 * GRAVITY - 0.1, False), (2.0 * GRAVITY + 0.1, True)):
        after = block.step(rest, torch.tensor([force], dtype=torch.float64))
        assert (after > 0).all() if leaves else (after == 0).all()


def test_a_bouncing_block_peaks_at_the_restitution_squared():
    """NOTES 5.2: peaks of a fall from 1 m near e^2, e^4, e^6, and no penetration beyond g dt^2."""
    dt = 1e-3
    restitution = torch.tensor([0.5, 0.8, 1.0], dtype=torch.float64)
    gaps, _, _ = drop(BouncingBlock(1.0, restitution, dt), 1.0, 2100)
    for x, expected in zip(gaps, [[0.2506, 0.0630, 0.0164], [0.640, 0.411, 0.263], [1.000, 1.000]], strict=True):
        inner = x[1:-1]
        peaks = inner[(inner > x[:-2]) & (inner >= x[2:]) & (inner > 1e-3)]
        assert peaks[: len(expected)].tolist() == pytest.approx(expected, abs=6e-4)
        assert x.min() >= -GRAVITY * dt**2


def test_a_block_without_restitution_does_not_rebound_in_either_law():
    """NOTES 5.2: the LCP on gaps has none, Moreau's law with e = 0 neither."""
    for block in (FallingBlock(1.0, 0.01), BouncingBlock(1.0, 0.0, 0.01)):
        _, v, _ = drop(block, 1.0, 100)
        assert (v <= 0).all()
        assert (v[-10:] == 0).all()


def test_rebound_speed_is_restitution_times_impact_speed():
    """Moreau's law, in a single step in contact."""
    e = torch.tensor([0.0, 0.3, 1.0], dtype=torch.float64)
    after = BouncingBlock(2.0, e, 0.01).step(torch.tensor([0.0, -2.0], dtype=torch.float64), torch.zeros(1).double())
    assert after[:, 1].tolist() == pytest.approx([0.0, 0.6, 2.0], abs=1e-15)


def test_gravity_can_be_learned_from_free_flight_and_not_from_rest():
    """The gradient of the next gap is -dt^2 in flight and 0 on the ground."""
    gravity = torch.tensor(5.0, dtype=torch.float64, requires_grad=True)
    state = torch.tensor([[1.0, 0.0], [0.0, 0.0]], dtype=torch.float64)
    gaps = FallingBlock(1.0, 0.1, gravity).step(state, torch.zeros(2, 1, dtype=torch.float64))[:, 0]
    gradients = [torch.autograd.grad(gap, gravity, retain_graph=True)[0].item() for gap in gaps]
    assert gradients == pytest.approx([-0.01, 0.0], abs=1e-15)


def test_each_scene_has_one_row():
    """A gap, or a velocity in excess of the rebound: no more unknowns than the scene needs."""
    zero = torch.zeros(4, dtype=torch.float64)
    for M, q in (FallingBlock(1.0, 0.1).lcp(zero, zero, zero), BouncingBlock(1.0, 0.5, 0.1).lcp(zero, zero)):
        assert M.shape[-2:] == (1, 1)
        assert q.shape == (4, 1)


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("dt", lambda: FallingBlock(1.0, 0.0)),
        ("mass", lambda: FallingBlock(-1.0, 0.1)),
        ("dt", lambda: BouncingBlock(1.0, 0.5, -0.1)),
        ("restitution", lambda: BouncingBlock(1.0, 1.5, 0.1)),
    ],
)
def test_a_wrong_argument_is_named(name, make):
    with pytest.raises(ValueError, match=f"^{name}: expected a .*number.*, got"):
        make()
