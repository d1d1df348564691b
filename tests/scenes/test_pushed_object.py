"""Quasi-static pushing, judged by force balance, closed forms, differences and symmetry."""

import math

import pytest
import torch

from lcplearn.scenes import pushed_object, pushing_node, pushing_rollout, pushing_step
from lcplearn.scenes.pushed_object import Grip, PushedObject, plane_fit, rotate
from lcplearn.scenes.pushes import Push
from lcplearn.scenes.scene import Mode

F = torch.float64
SQUARE = torch.tensor(((0.0, 0.0), (0.1, 0.0), (0.1, 0.1), (0.0, 0.1)), dtype=F)
CENTRE = torch.tensor((0.05, 0.05), dtype=F)
TRIANGLE = torch.tensor(((0.0, 0.0), (0.15, 0.0), (0.0, 0.15)), dtype=F)
FEET = torch.tensor(((0.01, 0.13), (0.01, 0.01), (0.13, 0.01)), dtype=F)


def square(**options) -> PushedObject:
    return PushedObject(SQUARE, CENTRE, mass=2.0, **options)


def triangle(**options) -> PushedObject:
    return PushedObject(TRIANGLE, CENTRE, mass=1.5, **options)


def square_grip(count: int = 1) -> Grip:
    loads = torch.full((count, 4), 0.25, dtype=F)
    one = torch.ones(count, dtype=F)
    return Grip(SQUARE.expand(count, -1, 2), loads, torch.zeros(count, 4, 2, dtype=F), 0.3 * one, 0.5 * one, 0.0 * one)


def triangle_grip(count: int, height: float = 0.015) -> Grip:
    loads, levers = plane_fit(FEET.expand(count, -1, 2), CENTRE, torch.ones(count, 3, dtype=F))
    one = torch.ones(count, dtype=F)
    return Grip(FEET.expand(count, -1, 2), loads, levers, 0.3 * one, 0.45 * one, height * one)


def random_pushes(count: int, seed: int = 0) -> Push:
    """From outside towards the middle of the triangle, off its centre, as a robot pushes."""
    generator = torch.Generator().manual_seed(seed)
    angle = 6.28 * torch.rand(count, generator=generator, dtype=F)
    aim = CENTRE + 0.03 * (torch.rand(count, 2, generator=generator, dtype=F) - 0.5)
    direction = rotate(angle, torch.tensor((1.0, 0.0), dtype=F).expand(count, 2))
    outside = triangle()
    far = Push(torch.zeros(count, 3, dtype=F), aim - 0.2 * direction, aim)
    start = far.start + (outside.first_touch(far) * 0.2 - 0.002)[:, None] * direction
    turn = 6.28 * torch.rand(count, generator=generator, dtype=F)
    place = torch.rand(count, 2, generator=generator, dtype=F)
    start, end = (place + rotate(turn, point) for point in (start, start + 0.017 * direction))
    return Push(torch.cat((place, turn[:, None]), -1), start, end)


def test_a_push_through_the_centre_moves_the_object_with_the_finger_against_mu_m_g():
    push = Push(torch.zeros(1, 3, dtype=F), torch.tensor([[-0.01, 0.05]]).to(F), torch.tensor([[0.02, 0.05]]).to(F))
    path = square().rollout(push, square_grip())
    assert path.solved.all()
    assert path.settled.all()
    torch.testing.assert_close(path.poses[0, -1], torch.tensor((0.02, 0.0, 0.0), dtype=F), atol=1e-7, rtol=0)
    torch.testing.assert_close(path.forces[0, -1], torch.tensor((0.3 * 2.0 * 9.81, 0.0), dtype=F), atol=1e-6, rtol=0)
    assert (path.mode == Mode.STICK).all()


def test_forces_of_coulombs_cone_balance_the_finger():
    """Judge: f_i = -mu N_i v_i / |v_i| at every support that moves, its load with what the finger adds."""
    push, grip, thing = random_pushes(200), triangle_grip(200), triangle(steps=1, creep=1e-4)
    path = thing.rollout(push, grip)
    assert path.solved.all()
    assert path.settled.double().mean() > 0.98
    start, end = push.pose, path.poses[:, -1]
    turn = end[:, 2] - start[:, 2]
    middle = start[:, 2] + turn / 2.0  # a step moves along the object's axes in the middle of the turn
    shift = end[:, :2] + rotate(end[:, 2], CENTRE) - start[:, :2] - rotate(start[:, 2], CENTRE)
    twist = rotate(-middle, shift)
    arms = FEET - CENTRE
    velocity = twist[:, None] + turn[:, None, None] * torch.stack((-arms[:, 1], arms[:, 0]), -1)
    force = rotate(-start[:, 2], path.forces[:, 0])
    weight = 1.5 * 9.81
    load = grip.loads * weight + 0.015 * (grip.levers @ force[..., None])[..., 0]
    friction = -0.3 * load[..., None] * velocity / velocity.norm(dim=-1, keepdim=True)
    moving = (velocity.norm(dim=-1) > 1e-2 * velocity.norm(dim=-1).amax(-1, keepdim=True)).all(-1) & path.settled[:, 0]
    assert moving.double().mean() > 0.6  # the others pivot about a support at rest
    assert (load > 0).all()
    torch.testing.assert_close(friction.sum(1)[moving], -force[moving], atol=2e-3 * 0.3 * weight, rtol=0)


def test_the_finger_keeps_its_own_cone():
    path = triangle().rollout(random_pushes(200), triangle_grip(200))
    edges = TRIANGLE.roll(-1, 0) - TRIANGLE
    inward = torch.stack((-edges[:, 1], edges[:, 0]), -1) / edges.norm(dim=-1, keepdim=True)
    body = rotate(-path.poses[:, :-1, 2], path.forces)
    normal = (body[:, :, None] * inward).sum(-1)
    tangential = (body.norm(dim=-1)[..., None] ** 2 - normal**2).clamp_min(0.0).sqrt()
    excess = (tangential - 0.45 * normal).amin(-1)  # of the edge that fits best
    assert excess.max() < 1e-9
    assert {int(m) for m in path.mode.unique()} >= {int(Mode.STICK), int(Mode.SLIP)}


def test_a_batch_equals_its_elements_one_by_one():
    push, grip, thing = random_pushes(12), triangle_grip(12), triangle()
    together = thing.rollout(push, grip)
    for k in range(12):
        alone = thing.rollout(
            Push(*(p[k : k + 1] for p in push)), Grip(*(g if g is None else g[k : k + 1] for g in grip))
        )
        torch.testing.assert_close(alone.poses[0], together.poses[k], atol=1e-13, rtol=0)


def test_the_compiled_step_is_the_lcp_solvers(monkeypatch):
    """Poses, forces and gradients with respect to all that a push and a grip have."""
    push, grip, thing = random_pushes(60), triangle_grip(60), triangle(steps=4)
    grip = grip._replace(shift=torch.full((60, 2), 1e-4, dtype=F), wrench=torch.full((60, 3), 0.02, dtype=F))
    inputs = [x.clone().requires_grad_() for x in (*push, *grip)]
    weights = torch.tensor((3.0, -8.0, 0.5), dtype=F)

    def found():
        path = thing.rollout(Push(*inputs[:3]), Grip(*inputs[3:]))
        assert (path.solved & path.settled).all()
        total = (path.poses[:, -1] * weights).sum() + 0.01 * path.forces.sum()
        return path, torch.autograd.grad(total, inputs)

    with torch.no_grad():
        rolled = thing.rollout(push, grip)
    stepped, gradients = found()
    for module in (pushing_step, pushed_object):
        monkeypatch.setattr(module, "compiled_pushing", lambda x: None)
    slow, true = found()
    for path in (rolled, stepped):
        for ours, theirs in zip(path, slow, strict=True):
            torch.testing.assert_close(ours, theirs.detach(), atol=1e-10, rtol=1e-10, check_dtype=False)
    for ours, theirs in zip(gradients, true, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-8, atol=1e-8 * float(theirs.abs().max()))


def test_what_the_compiled_code_leaves_is_solved(monkeypatch):
    """Every second push: its numbers are garbage then."""
    push, grip, thing = random_pushes(20), triangle_grip(20), triangle(steps=3)
    with torch.no_grad():
        whole = thing.rollout(push, grip)
    settle, roll = pushing_node._settle, pushing_rollout._roll

    def settle_half(*arguments):
        settle(*arguments)
        out, flags = arguments[-2:]
        flags[1::2, :2] = 0
        for x in out:
            x[1::2] = math.nan

    def roll_half(*arguments):
        roll(*arguments)
        track, forces, flags = arguments[-1]
        track[1::2, 2:], forces[1::2, 1:], flags[1::2, 1:] = math.nan, math.nan, 0

    monkeypatch.setattr(pushing_rollout, "_roll", roll_half)
    monkeypatch.setattr(pushing_node, "_settle", settle_half)
    with torch.no_grad():
        mended = thing.rollout(push, grip)
    for ours, theirs in zip(mended, whole, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-10, rtol=1e-10)


def test_the_world_may_be_turned():
    push, grip = random_pushes(20), triangle_grip(20)
    turn = torch.full((20,), 0.7, dtype=F)
    turned = Push(
        torch.cat((rotate(turn, push.pose[:, :2]), push.pose[:, 2:] + 0.7), -1),
        rotate(turn, push.start),
        rotate(turn, push.end),
    )
    there, here = triangle().rollout(turned, grip), triangle().rollout(push, grip)
    torch.testing.assert_close(there.poses[..., :2], rotate(turn[:, None], here.poses[..., :2]), atol=1e-9, rtol=0)
    torch.testing.assert_close(there.poses[..., 2], here.poses[..., 2] + 0.7, atol=1e-8, rtol=0)


def test_fine_polygons_tend_to_the_cone():
    push, grip = random_pushes(60), triangle_grip(60)
    exact = triangle().rollout(push, grip).poses[:, -1]
    error = [
        (triangle(law="polygon", facets=m).rollout(push, grip).poses[:, -1] - exact)[:, :2].norm(dim=-1).mean()
        for m in (8, 64)
    ]
    assert error[1] < error[0] / 4.0
    assert error[1] < 4e-5


def test_the_gradient_of_the_end_pose_agrees_with_differences():
    """For mu_c, the height and the loads; a polygon's would not."""
    push, thing = random_pushes(100), triangle()

    def end(mu_c, height, loads):
        grip = triangle_grip(100)._replace(finger_mu=mu_c, height=height, loads=loads)
        pose = thing.rollout(push, grip).poses[:, -1]
        return torch.cat((pose[:, :2] / 0.05, pose[:, 2:]), -1)

    grip = triangle_grip(100)
    at = [grip.finger_mu.clone(), grip.height.clone(), grip.loads.clone()]
    weights = torch.tensor((0.3, -0.8, 0.5), dtype=F)
    inputs = [x.requires_grad_() for x in at]
    gradients = torch.autograd.grad((end(*inputs) @ weights).sum(), inputs)
    right = []
    for k, gradient in enumerate(gradients):
        direction = (
            torch.ones_like(at[k]) if at[k].ndim == 1 else torch.tensor((1.0, -0.4, -0.6), dtype=F).expand(100, 3)
        )
        h = 1e-5 * (0.01 if k == 1 else 1.0)
        with torch.no_grad():
            plus, minus = ([x + s * h * direction if i == k else x for i, x in enumerate(at)] for s in (1, -1))
            slope = ((end(*plus) - end(*minus)) @ weights) / (2 * h)
        found = gradient if at[k].ndim == 1 else (gradient * direction).sum(-1)
        right.append((found - slope).abs() <= 1e-4 * slope.abs().clamp_min(slope.abs().median()))
    assert torch.stack(right).double().mean() >= 0.98


def test_a_finger_that_never_touches_moves_nothing():
    push = Push(
        torch.zeros(2, 3, dtype=F),
        torch.tensor([[-0.05, 0.2], [-0.05, 0.05]]).to(F),
        torch.tensor([[0.2, 0.2], [-0.02, 0.05]]).to(F),
    )
    path = square().rollout(push, square_grip(2))
    assert path.solved.all()
    assert (path.poses[:, -1].abs() < 1e-12).all()
    assert (path.forces == 0).all()
    assert (path.mode == Mode.SEPARATION).all()


def test_a_finger_that_passes_the_corner_leaves():
    """It slides along an edge over the corner; the line of the edge beyond it pushes nothing."""
    push = Push(torch.zeros(1, 3, dtype=F), torch.tensor([[-0.0005, 0.08]]).to(F), torch.tensor([[0.0015, 0.14]]).to(F))
    grip = square_grip()._replace(finger_mu=torch.full((1,), 0.01, dtype=F))
    path = square(steps=60).rollout(push, grip)
    assert path.solved.all()
    assert path.mode[0, 5] == Mode.SLIP
    assert path.mode[0, -1] == Mode.SEPARATION
    assert (path.poses[0, -1] == path.poses[0, -5]).all()


@pytest.mark.parametrize("height", [0.04, 0.12])  # at the second the triangle would tip
def test_a_high_finger_lifts_a_support_and_every_step_is_solved(height):
    path = triangle().rollout(random_pushes(100), triangle_grip(100, height=height))
    assert path.solved.all()
    assert path.poses.isfinite().all()


def test_nan_is_reported_and_stays_with_its_push():
    push, grip, thing = random_pushes(3), triangle_grip(3), triangle()
    broken = push._replace(pose=push.pose.clone())
    broken.pose[1, 0] = math.nan
    path, whole = thing.rollout(broken, grip), thing.rollout(push, grip)
    assert not path.solved[1].any()
    assert path.solved[[0, 2]].all()
    assert (path.poses[[0, 2]] == whole.poses[[0, 2]]).all()


def test_plane_fit_balances_the_weight_and_the_moment():
    generator = torch.Generator().manual_seed(0)
    points = 0.15 * torch.rand(5, 7, 2, generator=generator, dtype=F)
    loads, levers = plane_fit(points, CENTRE, torch.rand(5, 7, generator=generator, dtype=F) + 0.1)
    arms = points - CENTRE
    torch.testing.assert_close(loads.sum(-1), torch.ones(5, dtype=F))
    torch.testing.assert_close((loads[..., None] * arms).sum(1), torch.zeros(5, 2, dtype=F), atol=1e-12, rtol=0)
    torch.testing.assert_close(levers.sum(1), torch.zeros(5, 2, dtype=F), atol=1e-9, rtol=0)
    torch.testing.assert_close(arms.mT @ levers, torch.eye(2, dtype=F).expand(5, 2, 2), atol=1e-10, rtol=0)


@pytest.mark.parametrize("name", ["points", "loads", "levers", "mu", "finger_mu", "height"])
def test_a_grip_for_another_number_of_pushes_is_refused(name):
    """Compiled code would read on in memory."""
    grip = triangle_grip(6)
    with pytest.raises(ValueError, match=f"{name}: expected"):
        triangle().rollout(random_pushes(6), grip._replace(**{name: getattr(grip, name)[:1]}))


def test_a_grip_changed_in_place_has_no_gradient():
    grip = triangle_grip(6)
    loads = grip.loads.clone().requires_grad_()
    path = triangle(steps=2).rollout(random_pushes(6), grip._replace(loads=loads))
    with torch.no_grad():
        loads[:, 0] *= 0.5
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        path.poses.sum().backward()


@pytest.mark.parametrize(
    "bad", [{"vertices": SQUARE.flip(0)}, {"steps": 0}, {"creep": 0.0}, {"law": "cones"}, {"facets": 2}]
)
def test_what_makes_no_sense_is_refused_by_name(bad):
    # a wrong literal is a TypeError first where the tests check types
    with pytest.raises((ValueError, TypeError), match=next(iter(bad))):
        PushedObject(**({"vertices": SQUARE, "com": CENTRE, "mass": 1.0} | bad))


def test_the_first_touch_is_the_first_point_of_the_way_that_is_not_outside():
    """Ways in all directions, some past a corner, some too short, some that start inside: against 20,000 points."""
    generator = torch.Generator().manual_seed(0)
    start, end = (0.3 * torch.rand(400, 2, generator=generator, dtype=F) - 0.1 for _ in range(2))
    pose = torch.cat((torch.zeros(400, 2, dtype=F), 6.28 * torch.rand(400, 1, generator=generator, dtype=F)), -1)
    push = Push(pose, rotate(pose[:, 2], start), rotate(pose[:, 2], end))
    ways = torch.linspace(0.0, 1.0, 20_001, dtype=F)
    points = start[:, None] + ways[:, None] * (end - start)[:, None]
    inside = (points[..., 0] >= 0) & (points[..., 1] >= 0) & (points.sum(-1) <= 0.15)
    first = torch.where(inside.any(1), ways[inside.int().argmax(1)], 1.0)
    assert min(inside.any(1).sum(), (~inside.any(1)).sum()) > 100
    off = (triangle().first_touch(push) - first).abs()
    assert off.max() <= 1e-4
