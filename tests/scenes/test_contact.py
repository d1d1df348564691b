"""Contacts: every solution is held against Coulomb's law over all contacts, against enumeration and differences."""

import itertools

import numpy as np
import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from hypothesis import example, given, settings
from hypothesis import strategies as st
from real_data import real_data
from scenes.contact_scenes import DT, boxes, polygons, resting_boxes, violation
from torch import Tensor

from lcplearn.scenes.contact import (
    Contacts,
    ContactStep,
    _flatten,
    check_law,
    closing_speed,
    compiled_contacts,
    contact_step,
    rebound,
)
from lcplearn.scenes.contact_solve import _iterate, find
from lcplearn.scenes.planar_body import PlanarBody, rectangle
from lcplearn.scenes.spatial_body import SpatialBody, box_corners
from lcplearn.scenes.tossed_cube import TossedCube

pytestmark = pytest.mark.usefixtures("double_precision")


@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 2**31))
@example(seed=28794637)  # a load on redundant corners that only compliance decides
def test_what_the_needed_rows_give_solves_the_law_of_all_contacts(seed):
    torch.set_default_dtype(torch.float64)
    for scene in (polygons(30, seed), boxes(30, seed), boxes(30, seed, compliance=1e-3)):
        step = contact_step(*scene, DT, rest=False)  # which writes 0 for a velocity that compliance leaves
        right, wrong = step.solved & step.settled, violation(*scene, step)
        assert (right & (wrong < 1e-12)).sum() >= 29  # of a million boxes one does not settle, nine to 6e-10 only
        assert wrong[right].amax() < 1e-9


@pytest.mark.parametrize("seed", [5121, 5132])
def test_what_counts_as_settled_obeys_the_law(seed):
    """Among 3000 boxes is one whose corner opens, closes again and then slips along an axis that it had not before."""
    scene = boxes(3000, seed)
    step = contact_step(*scene, DT, rest=False)
    assert (step.solved & step.settled).all()
    assert violation(*scene, step).amax() < 1e-9


def test_a_box_on_corners_that_contradict_each_other_rests_as_by_the_lcps(monkeypatch):
    """What violates the law by less than a slip that counts as none is only taken where it is at rest."""
    pytest.importorskip("numba")
    scene = resting_boxes(1000, 4)
    step = contact_step(*scene, DT)
    monkeypatch.setattr("lcplearn.scenes.contact.compiled_contacts", lambda device: None)
    expected = contact_step(*scene, DT)
    right = step.solved & step.settled & expected.solved & expected.settled
    assert right.sum() >= 999
    assert (step.at_rest != expected.at_rest).sum() <= 1  # corners creep at what just counts as none
    both = right & (step.at_rest == expected.at_rest)
    assert step.at_rest.sum() > 50
    assert (step.velocity - expected.velocity)[both & (scene[0].compliance[:, 0] > 0.0)].abs().amax() < 1e-9


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("speed", [1e-9, 1e-12])
def test_a_block_on_ice_is_not_at_rest_however_slowly_it_slides(compiled, speed, monkeypatch):
    if not compiled:
        monkeypatch.setattr("lcplearn.scenes.contact.compiled_contacts", lambda device: None)
    mass = torch.tensor([[0.3] * 3 + [5e-4] * 3])
    corners = box_corners(torch.tensor([0.05, 0.05, 0.05]))
    linear = torch.eye(3).expand(8, 3, 3)
    rows = torch.cat((linear, torch.linalg.cross(corners.unsqueeze(-2).expand(8, 3, 3), linear)), dim=-1)
    contacts = Contacts(
        gap=corners[:, 2] + 0.05,
        normal=rows[:, 2],
        tangents=rows[:, :2],
        mu=torch.zeros(8),
        bounce=torch.zeros(8),
        compliance=torch.full((8,), 1e-3),
    )
    free = torch.tensor([speed, 0.0, -9.81 * DT, 0.0, 0.0, 0.0])
    step = contact_step(contacts, free, mass[0], DT)
    assert step.solved
    assert not step.at_rest
    assert abs(float(step.velocity[0]) - speed) < 1e-3 * speed


@pytest.mark.parametrize("seed", range(3))
def test_boxes_that_come_to_rest_settle(seed):
    """Here corners contradict each other; without `FINE_CREEP` 5 % break the law by up to 1e-7 and 1 % don't settle."""
    scene = resting_boxes(1000, seed)
    step = contact_step(*scene, DT, rest=False)
    right, wrong = step.solved & step.settled, violation(*scene, step)
    assert right.sum() >= 999
    assert (wrong < 1e-12).double().mean() > 0.99
    assert wrong[right].amax() < 1e-8


def test_a_corner_in_the_ground_settles_without_any_free_velocity():
    """What the gap demands is then the only scale of speeds."""
    scene = resting_boxes(500, 3, still=True)
    step = contact_step(*scene, DT, rest=False)
    assert (step.solved & step.settled).all()
    wrong = violation(*scene, step)
    assert (wrong < 1e-12).double().mean() > 0.98
    assert wrong.amax() < 1e-9
    assert (step.velocity != 0.0).any(-1).all()


def test_rows_of_all_contacts_give_the_same_velocity():
    problem, _ = _flatten(*boxes(200, 8, compliance=1e-3), DT)  # which makes it unique
    needed, _ = find(problem, None, rest=False)
    everything = _iterate(problem)
    assert (everything.settled & everything.solved).all()
    assert (needed.velocity - everything.velocity).abs().amax() < 1e-11


def test_a_body_that_slides_and_spins_on_four_corners_settles_without_compliance():
    """Any three corners can carry it; the iteration must not jump from three to three."""
    contacts, free, mass = boxes(1500, 9)
    level = (contacts.gap < 1e-12).sum(-1) == 4
    spin = torch.tensor([1.0, 0.3, 0.0, 0.0, 0.0, 3.0])
    step = contact_step(Contacts(*(x[level] for x in contacts)), free[level] + spin, mass[level], DT)
    assert level.sum() > 200
    assert (step.solved & step.settled).all()


def enumerated(contacts: Contacts, free: Tensor, mass: Tensor) -> Tensor:
    """Velocities [B, nv] of contacts in a plane by trying every combination of modes; NaN where none is consistent."""
    count = contacts.gap.shape[-1]
    rows = torch.cat((contacts.normal, contacts.tangents[..., 0, :]), dim=-2)
    A = rows / mass.unsqueeze(-2) @ rows.mT
    speed = (rows @ free.unsqueeze(-1)).squeeze(-1)
    target = torch.cat((-contacts.gap / DT, torch.zeros_like(contacts.gap)), dim=-1)
    result = torch.full_like(free, torch.nan)
    for modes in itertools.product(("open", "stick", "right", "left"), repeat=count):
        K, rhs = torch.zeros_like(A), torch.zeros_like(speed)
        for i, mode in enumerate(modes):
            n, t = i, count + i
            for row, moves in ((n, mode == "open"), (t, mode != "stick")):
                if not moves:  # its speed is the target
                    K[:, row], rhs[:, row] = A[:, row], target[:, row] - speed[:, row]
            if mode == "open":
                K[:, n, n], K[:, t, t] = 1.0, 1.0
            elif mode != "stick":
                K[:, t, t] = 1.0
                K[:, t, n] = contacts.mu[:, i] * (1.0 if mode == "right" else -1.0)
        f = (torch.linalg.pinv(K, rtol=1e-10) @ rhs.unsqueeze(-1)).squeeze(-1)
        after = speed + (A @ f.unsqueeze(-1)).squeeze(-1)
        load, friction, slip = f[:, :count], f[:, count:], after[:, count:]
        scale = 1e-9
        right = ((K @ f.unsqueeze(-1)).squeeze(-1) - rhs).abs().amax(-1) < scale
        right &= (after[:, :count] - target[:, :count] > -scale).all(-1) & (load > -scale).all(-1)
        right &= (friction.abs() <= contacts.mu * load + scale).all(-1)
        for i, mode in enumerate(modes):
            if mode in ("right", "left"):
                right &= slip[:, i] * (1.0 if mode == "right" else -1.0) > -scale
        velocity = free + ((rows.mT @ f.unsqueeze(-1)).squeeze(-1)) / mass
        result = torch.where((right & result.isnan().any(-1)).unsqueeze(-1), velocity, result)
    return result


def test_a_block_on_two_contacts_is_right_against_all_combinations_of_modes():
    count = 1500
    draw = torch.Generator().manual_seed(0)
    contacts, free, mass = polygons(count, 5, corners=4)
    half = 0.5
    flat = torch.rand(count, 1, generator=draw) < 0.8
    lever = torch.tensor([[-half, -0.3], [half, -0.3]]).expand(count, 2, 2)
    one, zero = torch.ones(count, 2), torch.zeros(count, 2)
    gap = torch.where(flat, 0.0, 0.02 * torch.rand(count, 2, generator=draw))
    still = torch.rand(count, 1, generator=draw) < 0.3
    # at rest on the table and pushed by up to twice what friction holds, or moving and turning
    push = torch.randn(count, 3, generator=draw) * torch.tensor([1.0, 0.3, 1.0]) * 0.098
    free = torch.where(still, push - torch.tensor([0.0, 0.0981, 0.0]), free)
    mu = torch.tensor([0.0, 0.3, 0.6, 1.5])[torch.randint(4, (count, 1), generator=draw)].expand(count, 2)
    contacts = Contacts(
        gap=gap,
        normal=torch.stack((zero, one, lever[..., 0]), dim=-1),
        tangents=torch.stack((one, zero, -lever[..., 1]), dim=-1).unsqueeze(-2),
        mu=mu,
        bounce=zero,
        compliance=zero,
    )
    step = contact_step(contacts, free, mass, DT)
    assert step.solved.all()
    truth = enumerated(contacts, free, mass)
    assert not truth.isnan().any()
    assert (step.velocity - truth).abs().amax() < 1e-11
    assert violation(contacts, free, mass, step).amax() < 1e-12


def test_what_was_not_needed_and_what_was_added_changes_nothing():
    """The first rows are those that close alone; a tilted box needs more: the far corner comes down."""
    lever = torch.tensor([[-0.5, -0.3], [0.5, -0.3], [0.5, 0.3], [-0.5, 0.3]])
    one, zero = torch.ones(4), torch.zeros(4)
    contacts = Contacts(
        gap=torch.tensor([0.0, 0.001, 0.6, 0.6]),
        normal=torch.stack((zero, one, lever[:, 0]), dim=-1),
        tangents=torch.stack((one, zero, -lever[:, 1]), dim=-1).unsqueeze(-2),
        mu=0.5 * one,
        bounce=zero,
        compliance=zero,
    )
    free, mass = torch.tensor([0.0, -0.0981, 0.0]), torch.tensor([1.0, 1.0, 0.02])
    step = contact_step(contacts, free, mass, DT)
    assert (step.normal_impulse > 0.0).tolist() == [True, True, False, False]
    assert violation(contacts, free, mass, step) < 1e-14


@pytest.mark.parametrize("scene", [polygons, boxes])
def test_a_batch_is_its_elements_and_corners_can_be_renumbered(scene):
    contacts, free, mass = scene(60, 3)
    # a body that slides and spins on coplanar corners has several velocities without compliance
    contacts = contacts._replace(compliance=torch.full_like(contacts.gap, 1e-3))
    order = torch.randperm(contacts.gap.shape[-1], generator=torch.Generator().manual_seed(0))
    together = contact_step(contacts, free, mass, DT)
    other = contact_step(Contacts(*(x[:, order] for x in contacts)), free, mass, DT)
    right = together.solved & together.settled & other.solved & other.settled
    assert right.double().mean() >= 0.9
    for i in range(20):
        alone = contact_step(Contacts(*(x[i] for x in contacts)), free[i], mass[i], DT)
        torch.testing.assert_close(alone.velocity, together.velocity[i], rtol=0, atol=1e-13)
    assert (other.velocity - together.velocity)[right].abs().amax() < 1e-8


@pytest.mark.parametrize("name", ["mu", "gap", "normal", "tangents", "bounce", "compliance", "free", "mass"])
def test_gradients_with_needed_rows_are_those_of_differences(name):
    contacts, free, mass = boxes(40, 1, compliance=1e-3)
    given = {**contacts._asdict(), "free": free, "mass": mass}
    draw = torch.Generator().manual_seed(2)
    weights, direction = torch.randn(40, 6, generator=draw), torch.randn(given[name].shape, generator=draw)
    if name in ("mu", "compliance", "mass"):  # numbers that must not become negative
        direction = direction * given[name]

    def outcome(value: Tensor) -> Tensor:
        new = given | {name: value}
        found = contact_step(Contacts(*(new[field] for field in Contacts._fields)), new["free"], new["mass"], DT)
        return (weights * found.velocity).sum(-1)

    start = given[name].clone().requires_grad_()
    gradient = (torch.autograd.grad(outcome(start).sum(), start)[0] * direction).flatten(1).sum(-1)
    with torch.no_grad():
        rough, fine = (
            (outcome(start + h * direction) - outcome(start - h * direction)) / (2 * h) for h in (1e-5, 1e-6)
        )
    scale = fine.abs().clamp_min(1e-2)
    smooth = (rough - fine).abs() <= 1e-4 * scale
    assert smooth.double().mean() >= 0.9
    assert (fine.abs() > 1e-6).double().mean() > (0.0 if name == "bounce" else 0.3)
    assert ((gradient - fine).abs() <= 1e-4 * scale)[smooth].double().mean() >= 0.98


@pytest.mark.parametrize("polygon", [None, 4])
@pytest.mark.parametrize("compiled", [True, False])
def test_nothing_goes_back_through_a_step_that_is_not_solved(compiled, polygon, monkeypatch):
    """Here one whose highest corner has no number for its gap; the others bear loads."""
    if not compiled:
        monkeypatch.setattr("lcplearn.scenes.contact.compiled_contacts", lambda device: None)
    contacts, free, mass = boxes(6, 1, compliance=1e-3)
    free, broken = free - torch.tensor([0.0, 0.0, 10.0, 0.0, 0.0, 0.0]), contacts.gap.clone()
    broken[5, broken[5].argmax()] = torch.nan

    def slopes(count: int, gap: Tensor) -> tuple[Tensor, ...]:
        mu, start = torch.tensor(0.3, requires_grad=True), free[:count].clone().requires_grad_()
        given = (x[:count] for x in contacts._replace(gap=gap, mu=mu.expand(6, 8)))
        step = contact_step(Contacts(*given), start, mass[:count], DT, polygon=polygon)
        assert step.solved.tolist() == (torch.arange(count) < 5).tolist()
        assert (step.normal_impulse > 0.0).any(-1).all()
        return torch.autograd.grad(step.velocity.sum(), (mu, start))

    (mu, start), (expected_mu, expected_start) = slopes(6, broken), slopes(5, contacts.gap)
    assert mu == expected_mu != 0.0
    assert torch.equal(start[:5], expected_start)
    assert (start[5] == 0.0).all()


@pytest.mark.parametrize("compiled", [True, False])
def test_what_no_velocity_can_obey_is_not_solved(compiled, monkeypatch):
    """A particle between walls that close, level or or tilted, with friction that holds it; the last is free."""
    if not compiled:
        monkeypatch.setattr("lcplearn.scenes.contact.compiled_contacts", lambda device: None)
    tilt = torch.tensor([0.0, 0.0, 0.1, 0.1, 1.5])
    c, s, o = tilt.cos(), tilt.sin(), torch.zeros(5)
    floor = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]).expand(5, 3, 3)
    roof = torch.stack((torch.stack((s, o, -c), -1), torch.stack((c, o, s), -1), floor[:, 2]), dim=1)
    rows = torch.stack((floor, roof), dim=1)
    contacts = Contacts(
        gap=torch.full((5, 2), -1e-3),
        normal=rows[:, :, 0],
        tangents=rows[:, :, 1:],
        mu=torch.tensor([[0.0], [2.0], [0.5], [2.0], [0.5]]),
        bounce=torch.zeros(5, 1),
        compliance=torch.zeros(5, 1),
    )
    step = contact_step(contacts, torch.tensor([0.3, 0.2, -0.1]), torch.ones(3), DT)
    assert step.solved.tolist() == [False] * 4 + [True]


def test_rows_at_random_are_solved_within_the_law_or_told_to_be_unsolved():
    """More rows than a body has velocities: for 3 of 10 no velocity obeys the law, but loads of 1e15 hide it."""
    draw, count = torch.Generator().manual_seed(3), 20000
    contacts = Contacts(
        gap=0.01 * torch.randn(count, 4, generator=draw) * (torch.rand(count, 4, generator=draw) < 0.5),
        normal=torch.randn(count, 4, 3, generator=draw),
        tangents=torch.randn(count, 4, 2, 3, generator=draw),
        mu=torch.rand(count, 4, generator=draw),
        bounce=torch.zeros(count, 1),
        compliance=torch.zeros(count, 1),
    )
    free = torch.randn(count, 3, generator=draw)
    step = contact_step(contacts, free, torch.ones(3), DT, rest=False)
    opening = torch.einsum("bcv,bv->bc", contacts.normal, step.velocity) + contacts.gap / DT
    wrong = torch.where(step.normal_impulse > 0.0, opening.abs(), -opening).amax(-1)
    right = step.solved & step.settled
    assert right.sum() > 0.7 * count
    assert wrong[right].amax() < 1e-6


def test_speeds_whose_squares_overflow_are_not_solved():
    contacts, free, mass = boxes(20, 1)
    step = contact_step(contacts, 1e160 * free, mass, DT)
    flies = (step.normal_impulse == 0.0).all(-1)
    assert not step.solved[~flies].any()


def test_a_batch_of_gradients_is_refused():
    contacts, free, mass = boxes(2, 1)
    velocity = contact_step(contacts, free.requires_grad_(), mass, DT).velocity
    with pytest.raises(RuntimeError, match="can't be batched"):
        torch.autograd.grad(velocity, free, torch.ones(3, 2, 6), is_grads_batched=True)


def test_a_polygon_of_many_directions_comes_close_to_the_cone():
    contacts, free, mass = boxes(100, 7, compliance=1e-3)
    cone = contact_step(contacts, free, mass, DT)
    right = cone.solved & cone.settled
    errors = []
    for k in (2, 4, 8):
        polygon = contact_step(contacts, free, mass, DT, polygon=k)
        assert polygon.solved.double().mean() >= 0.99
        errors.append(float((polygon.velocity - cone.velocity)[right & polygon.solved].square().mean().sqrt()))
    assert errors[0] > 1.4 * errors[1] > 1.4**2 * errors[2]


def test_restitution_newton_and_continuous():
    gap, before, free = torch.tensor([0.0, 0.005, 0.02]), torch.tensor([-1.0, -1.0, -1.0]), torch.tensor([-1.1] * 3)
    for law, speeds, bounces in (
        ("continuous", [1.0, 0.5, 0.0], [0.5, 0.25, 0.0]),
        ("newton", [1.0, 1.0, 0.0], [0.5, 1.0, 0.0]),
    ):
        closing = closing_speed(gap, before, free, DT, law)
        assert closing.tolist() == speeds
        assert rebound(gap, closing, torch.tensor(0.5).expand(3), DT, law).tolist() == bounces


def test_by_newton_a_contact_that_closes_no_faster_than_its_forces_make_it_in_a_step_does_not_bounce():
    before, gained = torch.tensor([-0.09, -0.1, -0.05, -0.05]), torch.tensor([0.0981, 0.0981, 0.0, -0.2])
    closing = closing_speed(torch.zeros(4), before, before - gained, DT, "newton")
    assert closing.tolist() == [0.0, 0.1, 0.05, 0.0]  # the last is lifted and does not close


def test_a_law_of_restitution_that_there_is_not_is_refused_by_name():
    """Else the compiled code would take another one."""
    for law in ("newton", "continuous"):
        check_law(law)
    with pytest.raises(ValueError, match=r"^restitution_law: expected 'newton' or 'continuous', got 'bounce'"):
        check_law("bounce")
    bodies = (
        (SpatialBody, {"corners": box_corners(torch.ones(3)), "inertia": 1.0}),
        (PlanarBody, {"corners": rectangle(1.0, 1.0), "inertia": 1.0}),
        (TossedCube, {"half_width": 1.0, "inertia": 1.0}),
    )
    for scene, numbers in bodies:
        # a wrong literal is a TypeError first where the tests check types
        with pytest.raises((ValueError, TypeError), match="restitution_law"):
            scene(**numbers, mu=0.5, dt=0.01, restitution_law="bounce")


def published(name: str, data: dict) -> tuple[Contacts, Tensor, Tensor]:
    """A friction problem given by its Delassus matrix W, free speeds and mu, as contacts of a made-up body."""
    W, speed, mu = (torch.tensor(np.asarray(data[f"{key}/{name}"])) for key in ("W", "wq", "mu"))
    count = len(mu)
    values, vectors = torch.linalg.eigh((W + W.mT) / 2.0)
    mass = 1.0 / values.clamp_min(1e-13 * values[-1])
    rows = vectors.reshape(count, -1, len(values))
    nothing = torch.zeros(count)
    free = (vectors.mT @ speed.unsqueeze(-1)).squeeze(-1)
    return Contacts(nothing, rows[:, 0], rows[:, 1:], mu, nothing, nothing), free, mass


def test_all_published_friction_problems_obey_the_law_of_the_cone():
    data = np.load(real_data("lcp_cases.npz"))
    names = [key.removeprefix("mu/") for key in data.files if key.startswith("mu/")]
    assert len(names) == 21
    for name in names:
        contacts, free, mass = published(name, data)
        step = contact_step(contacts, free, mass, DT)
        assert step.solved, name
        assert step.settled, name
        scale = max(float(free.abs().amax()), float(step.normal_impulse.amax()), 1.0)
        assert violation(contacts, free, mass, step) < 1e-10 * scale, name


def test_forward_mode_gives_what_reverse_mode_gives():
    contacts, free, mass = boxes(40, 1, compliance=1e-3)
    draw = torch.Generator().manual_seed(3)
    direction, weights = (torch.randn(free.shape, generator=draw) for _ in range(2))
    start = free.clone().requires_grad_()
    step = contact_step(contacts, start, mass, DT)
    backward = (torch.autograd.grad((weights * step.velocity).sum(), start)[0] * direction).sum(-1)
    with forward_ad.dual_level():
        velocity = contact_step(contacts, forward_ad.make_dual(free, direction), mass, DT).velocity
        forward = (weights * forward_ad.unpack_dual(velocity).tangent).sum(-1)
    right = step.solved & step.settled
    torch.testing.assert_close(forward[right], backward[right], rtol=1e-6, atol=1e-6)


def test_a_step_changed_in_place_has_no_gradient():
    """It would be a wrong one: impulses are what the gradient is computed from."""
    contacts, free, mass = boxes(5, 1)
    step = contact_step(contacts, free.requires_grad_(), mass, DT)
    with torch.no_grad():
        step.normal_impulse.div_(DT)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        step.velocity.sum().backward()


def test_three_friction_directions_are_refused():
    contacts, free, mass = boxes(2, 1)
    wrong = contacts._replace(tangents=contacts.tangents[..., [0, 1, 1], :])
    with pytest.raises(ValueError, match="tangents: expected"):
        contact_step(wrong, free, mass, DT)


@pytest.mark.parametrize("compliance", [0.0, 1e-3])
@pytest.mark.parametrize("scene", [polygons, boxes])
def test_the_compiled_step_and_its_gradient_are_those_of_torch(scene, compliance, monkeypatch):
    pytest.importorskip("numba")
    contacts, free, mass = scene(60, 11)
    contacts = contacts._replace(compliance=torch.full_like(contacts.gap, compliance))
    draw = torch.Generator().manual_seed(1)
    weights = torch.randn(free.shape, generator=draw), torch.randn(contacts.tangents.shape[:-1], generator=draw)

    def both(kernel: object) -> tuple[ContactStep, list[Tensor]]:
        monkeypatch.setattr("lcplearn.scenes.contact.compiled_contacts", lambda device: kernel)
        inputs = [x.clone().requires_grad_() for x in (*contacts, free, mass)]
        step = contact_step(Contacts(*inputs[:6]), inputs[6], inputs[7], DT)
        loss = (weights[0] * step.velocity).sum()
        if compliance:  # else loads are not unique, nor what friction of each contact
            loss = loss + (weights[1] * step.friction_impulse).sum() + step.normal_impulse.square().sum()
        return step, list(torch.autograd.grad(loss, inputs))

    compiled, gradients = both(compiled_contacts(torch.device("cpu")))
    found, expected = both(None)
    assert (compiled.solved & compiled.settled & found.solved & found.settled).all()
    assert (compiled.at_rest == found.at_rest).all()
    torch.testing.assert_close(compiled.velocity, found.velocity, rtol=0, atol=1e-12)
    if compliance:
        torch.testing.assert_close(compiled.normal_impulse, found.normal_impulse, rtol=0, atol=1e-11)
        assert (compiled.mode == found.mode).all()
    close = 1e-9 if compliance else 1e-11  # a small compliance makes loads unique, and sensitive
    for mine, wanted in zip(gradients, expected, strict=True):
        torch.testing.assert_close(mine, wanted, rtol=0, atol=close * float(1.0 + wanted.abs().amax()))


def test_views_of_an_elements_memory_lie_apart_and_within_it():
    pytest.importorskip("numba")
    from lcplearn.scenes.contact_kernel.memory import cone_memory, contact_scratch, element_memory, modes_memory

    for C, nv in ((1, 3), (2, 6), (8, 6), (8, 12), (30, 2)):
        memory = np.empty(contact_scratch(C, nv))
        start = memory.ctypes.data
        whole, part, after = element_memory(start, C, nv)
        for more in (modes_memory(after, C, nv), cone_memory(after, C, nv)):
            spans = sorted((x.ctypes.data, x.ctypes.data + x.nbytes) for x in (*whole, *part, *more))
            assert spans[0][0] == start
            assert all(end <= following for (_, end), (following, _) in itertools.pairwise(spans))
            assert spans[-1][1] <= start + memory.nbytes


def test_compiled_code_is_found_by_the_types_it_is_for():
    pytest.importorskip("numba")
    from lcplearn.lcp.kernel.calling import address_of
    from lcplearn.scenes.contact_kernel.compiling import compiled

    def half(x):
        return x / 2

    fast = compiled(half)
    fast(1), fast(1.0)
    whole, real = address_of(fast, 1), address_of(fast, 1.0)
    assert whole != real
    assert address_of(fast, 3) == whole
