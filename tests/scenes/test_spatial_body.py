"""Bodies in space against flight, symmetries, rest, energy and differences."""

import math

import pytest
import torch
from torch import Tensor

from lcplearn.scenes import SlidingBlock
from lcplearn.scenes.scene import Drive, Mode, Trajectory, rollout
from lcplearn.scenes.space import POSE, quaternion_product, rotation_matrix
from lcplearn.scenes.spatial_body import SpatialBody, box_corners

HALF = torch.tensor([0.05, 0.06, 0.07], dtype=torch.float64)
CORNERS = box_corners(HALF)
REST = torch.tensor([0.0, 0.0, 0.07, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
NOTHING = Drive(torch.zeros(6, dtype=torch.float64))


@pytest.fixture(autouse=True)
def _double_precision():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def body(**other) -> SpatialBody:
    given = {"corners": CORNERS, "inertia": (0.0011, 0.001, 0.0008), "mu": 0.4, "dt": 0.01, "mass": 0.4}
    return SpatialBody(**(given | other))


def tossed(count: int, seed: int = 0) -> Tensor:
    """States just above the ground, tumbling."""
    random = torch.Generator().manual_seed(seed)
    turn = torch.randn(count, 4, generator=random)
    turn = turn / turn.norm(dim=-1, keepdim=True)
    low = (CORNERS @ rotation_matrix(turn).mT)[..., 2].amin(-1, keepdim=True)
    height = 0.01 * torch.rand(count, 1, generator=random) - low
    velocity = torch.randn(count, 6, generator=random) * torch.tensor([1.0, 1.0, 1.0, 5.0, 5.0, 5.0])
    return torch.cat((torch.zeros(count, 2), height, turn, velocity), dim=-1)


def test_a_tossed_box_loses_energy_never_penetrates_and_comes_to_exact_rest():
    scene = body()
    with torch.no_grad():
        path = rollout(scene, tossed(8), Drive(torch.zeros(8, 120, 6)))
    inertia = torch.tensor([0.4] * 3 + [0.0011, 0.001, 0.0008])
    energy = (inertia * path.velocities.square()).sum(-1) / 2 + 0.4 * 9.81 * path.positions[..., 2]
    assert (energy[:, 1:] <= energy[:, :-1] + 1e-12).all()
    corners = (CORNERS @ rotation_matrix(path.positions[..., 3:]).mT)[..., 2] + path.positions[..., 2:3]
    # a corner turns by dt w on an arc while its row is linear: dt^2 w^2 r / 2
    turned = (0.01 * path.velocities[..., 3:].norm(dim=-1)).square() * HALF.norm() / 2
    assert (corners[:, 1:].amin(-1) >= -turned.cummax(-1).values[:, 1:] - 1e-12).all()
    assert (path.velocities[:, -1] == 0.0).all()
    assert (path.mode[:, -1] == Mode.STICK).sum(-1).ge(2).all()
    assert path.solved.all()


def test_gradients_of_a_step_are_those_of_differences():
    names = ("mu", "mass", "radius", "restitution", "ground", "mu_impact")
    value = torch.tensor([0.3, 0.4, 0.004, 0.2, 0.002, 0.2])
    state = tossed(40, seed=1)
    weights = torch.randn(40, 13, generator=torch.Generator().manual_seed(3))

    def outcome(parameters: Tensor) -> Tensor:
        scene = body(**dict(zip(names, parameters.unbind(-1), strict=True)), compliance=1e-3)
        return (weights * scene.advance(state, NOTHING).state).sum(-1)

    parameters = value.expand(40, 6).clone().requires_grad_()
    gradient = torch.autograd.grad(outcome(parameters).sum(), parameters)[0]
    with torch.no_grad():
        steps = [(h, h * torch.eye(6)) for h in (1e-5, 1e-6)]
        both = [[(outcome(value + d) - outcome(value - d)) / (2 * h) for d in step] for h, step in steps]
    rough, fine = (torch.stack(x, dim=-1) for x in both)
    scale = fine.abs().clamp_min(1e-3)
    smooth = (rough - fine).abs() <= 1e-4 * scale
    assert smooth.double().mean() > 0.9
    assert ((gradient - fine).abs() <= 1e-4 * scale)[smooth].double().mean() >= 0.99


@pytest.mark.parametrize("name", ["start", "corners", "inertia", "gravity", "force"])
def test_gradients_of_a_rollout_are_those_of_differences(name):
    draw = torch.Generator().manual_seed(8)
    given = {"start": tossed(40, seed=4), "corners": CORNERS.expand(40, 8, 3), "force": torch.zeros(40, 4, 6)}
    given |= {"inertia": torch.tensor([0.0011, 0.001, 0.0008]).expand(40, 3)}
    given |= {"gravity": torch.tensor([0.4, 0.0, -9.81]).expand(40, 3)}
    weights, direction = torch.randn(40, 13, generator=draw), torch.randn(given[name].shape, generator=draw)
    if name in ("corners", "inertia"):
        direction = 0.1 * direction * given[name].abs()

    def outcome(value: Tensor) -> Tensor:
        new = given | {name: value}
        scene = body(
            corners=new["corners"], inertia=new["inertia"].unbind(-1), gravity=new["gravity"], compliance=1e-3, mu=0.3
        )
        path = scene.rollout(new["start"], Drive(new["force"]))
        return (weights * path.states[:, -1]).sum(-1)

    value = given[name].clone().requires_grad_()
    gradient = (torch.autograd.grad(outcome(value).sum(), value)[0] * direction).flatten(1).sum(-1)
    with torch.no_grad():
        rough, fine = (
            (outcome(value + h * direction) - outcome(value - h * direction)) / (2 * h) for h in (1e-6, 1e-7)
        )
    scale = fine.abs().clamp_min(1e-2)
    smooth = (rough - fine).abs() <= 1e-4 * scale
    assert smooth.double().mean() >= 0.8
    assert (fine.abs() > 1e-4).double().mean() > 0.5
    assert ((gradient - fine).abs() <= 3e-4 * scale)[smooth].double().mean() >= 0.95


@pytest.mark.parametrize("slope", [0.0, 0.2])
def test_a_box_rests_exactly(slope):
    gravity = 9.81 * torch.tensor([math.sin(slope), 0.0, -math.cos(slope)])
    scene = body(gravity=gravity, mu=0.3)
    state = REST
    with torch.no_grad():
        for _ in range(20):
            step = scene.advance(state, NOTHING)
            assert (step.state == REST).all()  # a fixed point: what 20 steps leave as it is, 10,000 do
            state = step.state


@pytest.mark.parametrize("slope", [0.0, 0.2])
def test_a_box_is_exactly_at_rest_for_10000_steps(slope):
    pytest.importorskip("numba")
    gravity = 9.81 * torch.tensor([math.sin(slope), 0.0, -math.cos(slope)])
    path = body(gravity=gravity, mu=0.3).rollout(REST, Drive(torch.zeros(10_000, 6)))
    assert path.solved.all()
    assert (path.positions == REST[:7]).all()
    assert (path.velocities == 0.0).all()


def test_a_box_at_rest_moves_when_it_is_pushed_and_only_then():
    """A rollout does not solve again what rests; its steps one by one are the judge."""
    pytest.importorskip("numba")
    push = torch.zeros(1, 24, 6)
    push[:, 8:12, 0], push[:, 12:14, 0] = 1.0, 3.0
    weights = torch.randn(1, 25, 13, generator=torch.Generator().manual_seed(0))
    gradients, states = [], []
    for steps in (24, 1):
        force, mu = push.clone().requires_grad_(), torch.tensor([0.4], requires_grad=True)
        scene, state, path = body(mu=mu), REST[None].clone(), [REST[None, None]]
        for k in range(0, 24, steps):
            path.append(scene.rollout(state, Drive(force[:, k : k + steps])).states[:, 1:])
            state = path[-1][:, -1]
        states.append(torch.cat(path, dim=1))
        gradients.append(torch.autograd.grad((weights * states[-1]).sum(), (force, mu)))
    assert torch.equal(states[0], states[1])
    still = (states[0][0, :, 7:] == 0.0).all(-1)
    assert still[:13].all()
    assert not still[13]
    assert still[-1]
    for found, wanted in zip(*gradients, strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-12)


def test_a_box_on_a_slope_sticks_just_above_the_friction_angle_and_slides_just_below():
    slope = 0.3
    gravity = 9.81 * torch.tensor([math.sin(slope), 0.0, -math.cos(slope)])
    for factor, sticks in ((1 + 1e-9, True), (1 - 1e-9, False)):
        with torch.no_grad():
            step = body(gravity=gravity, mu=factor * math.tan(slope)).advance(REST, NOTHING)
        assert step.solved
        if sticks:
            assert (step.state == REST).all()
        else:
            expected = 0.01 * 9.81 * math.sin(slope) * 1e-9
            assert float(step.state[7]) == pytest.approx(expected, rel=1e-4)
            assert Mode.SLIP in step.mode


def test_a_flat_box_slides_straight_as_the_block_in_one_dimension():
    force = 2.0 * torch.randn(10, 40, generator=torch.Generator().manual_seed(1))
    block = SlidingBlock(mass=0.4, mu=0.4, dt=0.01).rollout(torch.zeros(10, 2), force.unsqueeze(-1))
    # so low that a push at the centre of mass tips nothing
    flat = body(corners=box_corners(torch.tensor([0.05, 0.06, 0.001])))
    start = torch.cat((REST[:2], torch.tensor([0.001]), REST[3:])).expand(10, 13)
    with torch.no_grad():
        path = flat.rollout(start, Drive(torch.nn.functional.pad(force.unsqueeze(-1), (0, 5))))
    assert path.solved.all()
    torch.testing.assert_close(path.velocities[..., 0], block.velocities[..., 0], rtol=0, atol=1e-9)
    assert ((path.velocities[..., 0] == 0.0) == (block.velocities[..., 0] == 0.0)).all()
    assert (block.velocities[..., 0] == 0.0).any()
    assert (path.velocities[..., 1:].abs() < 1e-9).all()


def test_halving_dt_halves_the_error_of_a_slide_that_curves():
    """Across a slope of 20 degrees, against the block's equations v' = g_x - mu g_z v / |v| in tiny steps."""
    flat, gravity = box_corners(torch.tensor([0.05, 0.06, 1e-6])), 9.81 * torch.tensor([0.342, 0.0, -0.94])
    exact, speed, step = torch.zeros(2), torch.tensor([0.0, 0.8]), 1e-5
    for _ in range(20_000):  # explicit midpoint
        middle = speed + 0.5 * step * (gravity[:2] + 0.6 * gravity[2] * speed / speed.norm())
        exact = exact + step * middle
        speed = speed + step * (gravity[:2] + 0.6 * gravity[2] * middle / middle.norm())
    errors = []
    for dt in (0.02, 0.01, 0.005):
        scene = body(dt=dt, corners=flat, mu=0.6, gravity=gravity, inertia=0.001)
        start = torch.tensor([0.0, 0.0, 1e-6, 1.0, 0.0, 0.0, 0.0, 0.0, 0.8, 0.0, 0.0, 0.0, 0.0])
        path = scene.rollout(start, Drive(torch.zeros(round(0.2 / dt), 6)))
        errors.append(float((path.positions[-1, :2] - exact).norm()))
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(2.0, rel=0.1)


def test_a_rotation_about_the_vertical_rotates_the_motion():
    angle = 0.7
    about = torch.tensor([math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)])
    turn = rotation_matrix(about)

    def rotate(state: Tensor) -> Tensor:
        position, quaternion, velocity, spin = state.split((3, 4, 3, 3), dim=-1)
        return torch.cat((position @ turn.mT, quaternion_product(about, quaternion), velocity @ turn.mT, spin), dim=-1)

    state = tossed(100, seed=2)
    scene = body(compliance=1e-4)
    with torch.no_grad():
        here, there = scene.advance(state, NOTHING), scene.advance(rotate(state), NOTHING)
    right = here.solved & there.solved
    assert right.double().mean() > 0.98
    assert (rotate(here.state) - there.state)[right].abs().amax() < 1e-8


def test_flight_is_exact():
    scene = body(inertia=0.001)
    state = tossed(10) + torch.tensor([0.0, 0.0, 5.0] + [0.0] * 10)
    with torch.no_grad():
        path = rollout(scene, state, Drive(torch.zeros(10, 20, 6)))
    velocity = state[:, 7:] + 0.2 * torch.tensor([0.0, 0.0, -9.81, 0.0, 0.0, 0.0])
    torch.testing.assert_close(path.velocities[:, -1], velocity, rtol=0, atol=1e-13)
    turned = POSE.advance(state[:, :7], state[:, 7:], 0.2)[:, 3:]
    torch.testing.assert_close(path.positions[:, -1, 3:], turned, rtol=0, atol=1e-13)


@pytest.mark.parametrize("compiled", [True, False])
def test_ice_holds_nothing(compiled, monkeypatch):
    """Neither the slip of a contact without friction nor its gradient, also where the slip is 0."""
    if not compiled:
        monkeypatch.setattr("lcplearn.scenes.spatial_body.compiled_contacts", lambda device: None)
        monkeypatch.setattr("lcplearn.scenes.contact.compiled_contacts", lambda device: None)
    ice = body(mu=0.0)
    force = torch.zeros(6, requires_grad=True)
    pushed = ice.advance(REST, Drive(force)).state[7:]
    slopes = torch.stack([torch.autograd.grad(pushed[k], force, retain_graph=True)[0] for k in range(2)])
    torch.testing.assert_close(slopes, 0.01 / 0.4 * torch.eye(2, 6), rtol=0, atol=1e-12)
    # an edge that hits the ground slips to the side, exactly
    tilted = torch.tensor([0.0, 0.0, 0.0, math.cos(0.15), math.sin(0.15), 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
    tilted[2] = -(CORNERS @ rotation_matrix(tilted[3:7]).mT)[:, 2].amin()
    step = ice.advance(tilted, Drive(force))
    assert (step.mode == Mode.SLIP).sum() == 2
    assert not (step.mode == Mode.STICK).any()
    slope = torch.autograd.grad(step.state[8], force)[0]
    torch.testing.assert_close(slope, 0.01 / 0.4 * torch.eye(6)[1], rtol=0, atol=1e-12)


@pytest.mark.parametrize("columns", [1, 3, 5, 7])
def test_a_force_of_other_columns_is_refused(columns):
    """Compiled code would read on in memory."""
    force = torch.zeros(5, columns)
    with pytest.raises(ValueError, match="forces: expected"):
        body().rollout(REST, Drive(force))
    with pytest.raises(ValueError, match="force: expected"):
        body().advance(REST, Drive(force[0]))


def test_a_rollout_changed_in_place_has_no_gradient():
    """It would be a wrong one: the states are what the gradient is computed from."""
    pytest.importorskip("numba")
    mu = torch.tensor(0.1, requires_grad=True)
    path = body(mu=mu).rollout(tossed(2), NOTHING.map(lambda x: x.expand(3, 6)))
    total = path.velocities.sum()
    with torch.no_grad():
        path.positions[..., 2].mul_(3.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        total.backward()


def test_batched_parameters_are_their_elements_one_by_one():
    state, mu = tossed(1)[0], torch.tensor([0.1, 0.3, 0.9])
    radius, inertia = torch.tensor([0.0, 0.01, 0.02]), torch.tensor([[0.001], [0.002]])
    with torch.no_grad():
        together = body(mu=mu, radius=radius, inertia=inertia).advance(state, NOTHING)
        assert together.state.shape == (2, 3, 13)
        assert together.mode.shape == (2, 3, 8)
        for i in range(2):
            for j in range(3):
                alone = body(mu=mu[j], radius=radius[j], inertia=inertia[i, 0]).advance(state, NOTHING)
                torch.testing.assert_close(together.state[i, j], alone.state, rtol=0, atol=1e-14)


def test_float32_states_stay_float32_and_agree():
    state = tossed(20)
    with torch.no_grad():
        single = body(corners=CORNERS.float()).advance(state.float(), Drive(torch.zeros(6, dtype=torch.float32)))
        double = body().advance(state, NOTHING)
    assert single.state.dtype is torch.float32
    assert single.solved.all()
    torch.testing.assert_close(single.state.double(), double.state, rtol=0, atol=1e-4)


def test_a_state_of_nan_is_not_solved_and_harms_no_neighbour():
    state = tossed(3)
    state[1, 3] = torch.nan
    with torch.no_grad():
        step, alone = body().advance(state, NOTHING), body().advance(state[2:], NOTHING)
    assert step.solved.tolist() == [True, False, True]
    assert (step.state[2] == alone.state[0]).all()


def test_a_state_of_nan_harms_no_neighbours_gradient():
    pytest.importorskip("numba")
    given = {"mu": torch.tensor(0.3), "mass": torch.tensor(0.4), "corners": CORNERS.clone()}
    given |= {"gravity": torch.tensor([0.4, 0.0, -9.81])}
    moments = [torch.tensor(x, requires_grad=True) for x in (0.0011, 0.001, 0.0008)]
    given = {name: x.requires_grad_() for name, x in given.items()}

    def slopes(state: Tensor) -> tuple[Tensor, ...]:
        path = body(**given, inertia=tuple(moments), compliance=1e-3).rollout(state, Drive(torch.zeros(6, 6)))
        return torch.autograd.grad(path.states.square().sum(), [*given.values(), *moments])

    for column in (2, 4, 9, 11):  # height, quaternion, velocity, spin
        state = tossed(3)
        state[1, column] = torch.nan
        torch.testing.assert_close(slopes(state), slopes(state[[0, 2]]), rtol=1e-12, atol=1e-12)


def test_a_batch_of_gradients_is_refused():
    pytest.importorskip("numba")
    state = tossed(2).requires_grad_()
    end = body().advance(state, NOTHING).state
    with pytest.raises(RuntimeError, match="can't be batched"):
        torch.autograd.grad(end, state, torch.ones(3, 2, 13), is_grads_batched=True)


@pytest.mark.parametrize("law", ["newton", "continuous"])
@pytest.mark.parametrize("inertia", [0.001, (0.0011, 0.001, 0.0008)], ids=["one_inertia", "three"])
def test_the_compiled_rollout_and_its_gradient_are_those_of_torch(law, inertia, monkeypatch):
    pytest.importorskip("numba")
    random = torch.Generator().manual_seed(6)
    count, steps = 40, 12
    push = 0.1 * torch.randn(count, steps, 6, generator=random)
    weights = torch.randn(count, steps, 13, generator=random)
    numbers = {"mu": 0.4, "mu_impact": 0.2, "restitution": 0.3, "radius": 0.005, "ground": 0.002, "mass": 0.4}
    numbers |= {"compliance": 1e-3, "corners": CORNERS, "gravity": torch.tensor([0.3, 0.0, -9.81])}
    moments = inertia if isinstance(inertia, tuple) else (inertia,)
    numbers |= {f"inertia_{k}": moment for k, moment in enumerate(moments)}

    def outcome() -> tuple[Trajectory, list[Tensor]]:
        values = {name: torch.as_tensor(x).expand(count, *torch.as_tensor(x).shape) for name, x in numbers.items()}
        inputs = [x.clone().requires_grad_() for x in (tossed(count, seed=5), push, *values.values())]
        given = dict(zip(values, inputs[2:], strict=True))
        own = tuple(given.pop(f"inertia_{k}") for k in range(len(moments)))
        scene = body(**given, inertia=own if len(own) > 1 else own[0], restitution_law=law)
        path = scene.rollout(inputs[0], Drive(inputs[1]))
        loss = (weights * torch.cat((path.positions, path.velocities), dim=-1)[:, 1:]).sum()
        return path, list(torch.autograd.grad(loss, inputs))

    path, gradients = outcome()
    with torch.no_grad():
        without = body(**{k: v for k, v in numbers.items() if "inertia" not in k}, inertia=inertia, restitution_law=law)
        assert torch.equal(without.rollout(tossed(count, seed=5), Drive(push)).positions, path.positions)
    monkeypatch.setattr("lcplearn.scenes.spatial_body.compiled_contacts", lambda device: None)
    reference, expected = outcome()
    torch.testing.assert_close(path.positions, reference.positions, rtol=0, atol=1e-12)
    torch.testing.assert_close(path.velocities, reference.velocities, rtol=0, atol=4e-12)
    assert (path.mode == reference.mode).all()
    assert (path.solved == reference.solved).all()
    for found, wanted in zip(gradients, expected, strict=True):
        found, wanted = found.reshape(count, -1), wanted.reshape(count, -1)
        assert (wanted != 0.0).any()
        scale = wanted.abs().amax(-1) + wanted.abs().amax() * 1e-6
        assert ((found - wanted).abs().amax(-1) / scale).amax() < 1e-5
