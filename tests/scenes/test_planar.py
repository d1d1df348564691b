"""A block on a table, a polygon in its plane, a stack of two: against closed forms and blocks in one dimension."""

import math

import pytest
import torch
from torch import Tensor

from lcplearn.scenes import SlidingBlock
from lcplearn.scenes.planar_block import PlanarBlock, slide_in_plane
from lcplearn.scenes.planar_body import STACK, PlanarBody, PlanarStack, rectangle, turned
from lcplearn.scenes.scene import Drive, Mode, rollout

pytestmark = pytest.mark.usefixtures("double_precision")

DT = 0.01
HALF = (0.06, 0.04)


def body(**other) -> PlanarBody:
    given = {"corners": rectangle(*HALF), "inertia": 0.4 * (0.06**2 + 0.04**2) / 3, "mu": 0.4, "dt": DT, "mass": 0.4}
    return PlanarBody(**(given | other))


def tossed(count: int) -> Tensor:
    draw = torch.Generator().manual_seed(0)
    angle = 6.0 * torch.rand(count, generator=draw)
    low = turned(rectangle(*HALF), angle)[..., 1].amin(-1)
    velocity = torch.randn(count, 3, generator=draw) * torch.tensor([1.0, 1.0, 8.0])
    position = torch.stack((torch.zeros(count), 0.02 * torch.rand(count, generator=draw) - low, angle), dim=-1)
    return torch.cat((position, velocity), dim=-1)


def test_a_tossed_rectangle_loses_energy_never_penetrates_and_comes_to_exact_rest():
    scene = body()
    with torch.no_grad():
        path = rollout(scene, tossed(30), Drive(torch.zeros(30, 200, 3)))
    assert path.solved.all()
    mass = torch.tensor([0.4, 0.4, scene.inertia])
    energy = (mass * path.velocities.square()).sum(-1) / 2 + 0.4 * 9.81 * path.positions[..., 1]
    assert (energy[:, 1:] <= energy[:, :-1] + 1e-12).all()
    lowest = (path.positions[..., 1:2] + turned(rectangle(*HALF), path.positions[..., 2])[..., 1]).amin(-1)
    # a corner turns by dt w on an arc while its row is linear
    sagitta = (DT * path.velocities[..., 2]).square() * math.hypot(*HALF) / 2
    assert (lowest[:, 1:] >= -sagitta.cummax(-1).values[:, 1:] - 1e-12).all()
    assert (path.velocities[:, -1] == 0.0).all()


@pytest.mark.parametrize("slope", [0.0, 0.2])
def test_a_rectangle_is_exactly_at_rest_for_10000_steps(slope):
    scene = body(gravity=9.81 * torch.tensor([math.sin(slope), -math.cos(slope)]), mu=0.3)
    state = start = torch.tensor([0.0, 0.04, 0.0, 0.0, 0.0, 0.0])
    with torch.no_grad():
        for _ in range(20):
            state = scene.advance(state, Drive(torch.zeros(3))).state
            assert (state == start).all()  # a fixed point: what 20 steps leave as it is, 10,000 do


def test_a_rectangle_on_a_slope_sticks_above_the_friction_angle_and_slides_below():
    slope = 0.3
    gravity = 9.81 * torch.tensor([math.sin(slope), -math.cos(slope)])
    state = torch.tensor([0.0, 0.04, 0.0, 0.0, 0.0, 0.0])
    for factor, sticks in ((1 + 1e-9, True), (1 - 1e-9, False)):
        step = body(gravity=gravity, mu=factor * math.tan(slope)).advance(state, Drive(torch.zeros(3)))
        if sticks:
            assert (step.state == state).all()
        else:
            expected = DT * 9.81 * math.sin(slope) * 1e-9
            assert float(step.state[3]) == pytest.approx(expected, rel=1e-4)
            assert Mode.SLIP in step.mode


def test_a_flat_rectangle_slides_as_the_block_in_one_dimension():
    draw = torch.Generator().manual_seed(1)
    force = 3.0 * torch.randn(20, 60, generator=draw)
    still = torch.zeros(20, 60)
    block = SlidingBlock(mass=0.4, mu=0.4, dt=DT).rollout(torch.zeros(20, 2), force.unsqueeze(-1))
    # low enough not to tip: a push at the centre of mass
    flat = body(corners=rectangle(0.06, 0.001))
    start = torch.tensor([0.0, 0.001, 0.0, 0.0, 0.0, 0.0])
    with torch.no_grad():
        path = rollout(flat, start, Drive(torch.stack((force, still, still), dim=-1)))
    torch.testing.assert_close(path.velocities[..., 0], block.velocities[..., 0], rtol=0, atol=1e-12)
    assert ((path.velocities[..., 0] == 0.0) == (block.velocities[..., 0] == 0.0)).all()
    assert (path.velocities[..., 1:].abs() < 1e-13).all()


def test_halving_dt_halves_the_error_of_a_slide():
    errors = []
    for dt in (0.04, 0.02, 0.01):
        state = torch.tensor([0.0, 0.04, 0.0, 0.8, 0.0, 0.0])
        with torch.no_grad():
            path = rollout(body(dt=dt, corners=rectangle(0.3, 0.04)), state, Drive(torch.zeros(round(0.4 / dt), 3)))
        errors.append(abs(float(path.positions[-1, 0]) - 0.8**2 / (2 * 0.4 * 9.81)))
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize("restitution", [0.0, 0.5])
def test_a_level_drop_bounces_by_restitution(restitution):
    scene = body(restitution=restitution, dt=2e-3, mu=0.0)
    with torch.no_grad():
        path = rollout(scene, torch.tensor([0.0, 0.09, 0.0, 0.0, 0.0, 0.0]), Drive(torch.zeros(150, 3)))
    height = path.positions[:, 1] - 0.04
    assert float(height[55:].amax()) == pytest.approx(
        0.05 * restitution**2, abs=2e-3
    )  # it turns up to dt v above the ground
    assert float(height.amin()) > -1e-12


def stack(**other) -> PlanarStack:
    given = {"lower": (0.1, 0.05), "upper": (0.06, 0.04), "masses": (1.0, 0.5), "mu": (0.5, 0.4), "dt": DT}
    return PlanarStack(**(given | other))


STACKED = torch.tensor([0.0, 0.05, 0.01, 0.14] + [0.0] * 8, dtype=torch.float64)


@pytest.mark.parametrize("slope", [0.0, 0.2])
def test_a_stack_is_exactly_at_rest(slope):
    scene = stack(gravity=9.81 * torch.tensor([math.sin(slope), -math.cos(slope)]))
    state = STACKED
    with torch.no_grad():
        for _ in range(20):
            state = scene.advance(state, Drive(torch.zeros(6))).state
            assert (state == STACKED).all()


def test_the_upper_block_slides_at_its_own_friction_and_drags_the_lower_one():
    """Pulled by a force between the two limits the upper slides, and the lower one stays or goes with its drag."""
    force = torch.zeros(6)
    force[2] = 4.0  # above mu m g = 1.96 N at the face; the drag stays below 0.5 * 1.5 * g
    with torch.no_grad():
        step = stack(upper=(0.06, 0.001)).advance(STACKED - torch.eye(12)[3] * 0.039, Drive(force))
    position, velocity = STACK.split(step.state)
    assert float(velocity[2]) == pytest.approx(DT * (4.0 - 0.4 * 0.5 * 9.81) / 0.5, rel=1e-12)
    assert (velocity[:2].abs() < 1e-13).all()
    assert float(position[3]) == pytest.approx(0.101, abs=1e-12)


def test_contacts_between_the_two_keep_momentum_in_flight():
    random = torch.randn(40, 6, generator=torch.Generator().manual_seed(2)) * torch.tensor([1, 1, 1, 1, 6, 6])
    state = torch.cat((STACKED[:6] + torch.tensor([0.0, 3.0, 0.0, 3.0, 0.0, 0.0]), torch.zeros(6))).expand(40, 12)
    state = torch.cat((state[:, :6], random), dim=-1)
    with torch.no_grad():
        step = stack().advance(state, Drive(torch.zeros(6)))
    before, after = state[:, 6:], step.state[:, 6:]
    mass = torch.tensor([1.0, 1.0, 0.5, 0.5])
    change = (mass * (after - before)[:, :4]).reshape(40, 2, 2).sum(1)
    torch.testing.assert_close(change, torch.tensor([0.0, -1.5 * 9.81 * DT]).expand(40, 2), rtol=0, atol=1e-12)
    assert ((after - before)[:, 4].abs() > 1e-3).double().mean() > 0.3


def free_speeds(count: int) -> Tensor:
    return torch.randn(count, 2, generator=torch.Generator().manual_seed(3)) * 0.5


def test_a_block_on_a_table_in_three_forms():
    p, limit = free_speeds(300), 0.4 * 9.81 * 0.05
    state = torch.cat((torch.zeros_like(p), p), dim=-1)
    exact = slide_in_plane(p, limit)
    assert ((exact == 0.0).all(-1) == (p.norm(dim=-1) <= limit)).all()
    for m, error in ((8, 0.25), (32, 0.06)):
        steps = [
            PlanarBlock(mass=1.5, mu=0.4, dt=0.05, form=form, m=m).advance(state, Drive(torch.zeros(2)))
            for form in ("facets", "traditional")
        ]
        torch.testing.assert_close(steps[0].state, steps[1].state, rtol=0, atol=1e-12)
        assert (steps[0].state[:, 2:] - exact).square().sum(-1).mean().sqrt() < error * limit
        assert steps[0].solved.all()


@pytest.mark.parametrize("form", ["exact", "facets", "traditional"])
def test_what_is_not_a_number_does_not_rest(form):
    scene = PlanarBlock(mass=1.5, mu=0.4, dt=0.05, form=form)
    state = torch.tensor([[0.0, 0.0, math.nan, 0.0], [0.0, 0.0, 0.1, 0.0]])
    step = scene.advance(state, Drive(torch.zeros(2)))
    assert step.state[0, 2].isnan()
    assert step.mode.tolist() == [[Mode.SLIP], [Mode.STICK]]


@pytest.mark.parametrize("form", ["exact", "facets", "traditional"])
def test_each_block_of_a_batch_may_have_its_own_friction(form):
    mu, state = torch.tensor([0.1, 0.4]), torch.tensor([0.0, 0.0, 2.0, -1.0])
    both = PlanarBlock(mass=1.5, mu=mu, dt=0.05, form=form).step(state, torch.zeros(2))
    one = [PlanarBlock(mass=1.5, mu=float(x), dt=0.05, form=form).step(state, torch.zeros(2)) for x in mu]
    torch.testing.assert_close(both, torch.stack(one), rtol=0, atol=1e-14)


def test_a_block_has_one_mass_or_two():
    # a TypeError first where the tests check types
    with pytest.raises((ValueError, TypeError), match="mass"):
        PlanarBlock(mass=(1.0, 2.0, 3.0), mu=0.4, dt=0.05)


def test_the_cone_of_a_contact_is_the_closed_form_and_the_fixed_point_for_two_masses():
    p, mu, dt = free_speeds(300), 0.4, 0.05
    state = torch.cat((torch.zeros_like(p), p), dim=-1)
    same = PlanarBlock(mass=(1.5, 1.5), mu=mu, dt=dt).advance(state, Drive(torch.zeros(2)))
    assert same.solved.all()
    torch.testing.assert_close(same.state[:, 2:], slide_in_plane(p, mu * 9.81 * dt), rtol=0, atol=1e-9)
    mass = torch.tensor([1.0, 4.0])
    step = PlanarBlock(mass=(1.0, 4.0), mu=mu, dt=dt).advance(state, Drive(torch.zeros(2)))
    assert step.solved.all()
    impulse, limit = mass * (step.state[:, 2:] - p), mu * 2.5 * 9.81 * dt
    speed = step.state[:, 2:].norm(dim=-1, keepdim=True)
    sticks = speed[:, 0] == 0.0
    assert sticks.any()
    assert (impulse[sticks].norm(dim=-1) <= limit + 1e-12).all()
    torch.testing.assert_close(
        (impulse + limit * step.state[:, 2:] / speed)[~sticks], torch.zeros(int((~sticks).sum()), 2), rtol=0, atol=1e-8
    )
