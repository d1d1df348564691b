"""Learning friction in the plane: the truth is a fixed point, sticks survive errors, and recordings follow the law."""

import pytest
import torch

from lcplearn.datasets.simulate_planar import simulate_planar_block, simulate_planar_body
from lcplearn.formulations.formulation import build
from lcplearn.formulations.identified import Identified
from lcplearn.formulations.plane import PlanarDirect, PlanarFriction, PlanarTraditional
from lcplearn.scenes.scene import Drive
from lcplearn.scenes.space import PLANE


def test_the_true_numbers_and_the_structured_model_reproduce_the_recordings():
    task = simulate_planar_block(trajectories=4, test_trajectories=4, long_trajectories=1, long_length=5)
    structured = build(PlanarFriction, task, initial_limit=0.4 * 9.81)
    with torch.no_grad():
        structured.weight[:, 2:] /= 1.5
    exact = build(Identified, task, scene="lcplearn.scenes.planar_block.PlanarBlock", learn=dict(task.truth))
    for model in (structured, exact):
        before, after = task.test.states[:, :-1], task.test.states[:, 1:]
        predicted = model.advance(before, Drive(task.test.drive.force)).state
        torch.testing.assert_close(predicted, after, rtol=0, atol=1e-13)
        assert ((predicted[..., 2:] == 0) == (after[..., 2:] == 0)).all()


def test_sticks_survive_errors_of_what_is_learned():
    task = simulate_planar_block(trajectories=1, test_trajectories=20, long_trajectories=1, long_length=5)
    model = build(PlanarFriction, task, initial_limit=0.4 * 9.81)
    with torch.no_grad():
        model.weight[:, 2:] /= 1.5
        model.weight += 1e-3 * torch.randn(2, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        predicted = model.advance(task.test.states[:, :-1], Drive(task.test.drive.force)).state[..., 2:]
    sticks = (task.test.states[:, 1:, 2:] == 0).all(-1)
    assert sticks.any()
    assert (predicted[sticks] == 0).all(-1).double().mean() > 0.99


def test_direct_and_traditional_hold_the_truth_where_friction_or_the_matrices_are_known():
    task = simulate_planar_block(
        trajectories=4, test_trajectories=4, long_trajectories=1, long_length=5, friction="physical"
    )
    torch.testing.assert_close(
        task.test.drive.friction.norm(dim=-1).amax(), torch.tensor(0.4 * 1.5 * 9.81, dtype=torch.float64)
    )
    direct = build(PlanarDirect, task)
    with torch.no_grad():
        direct.weight[:, 2:] /= 1.5
        direct.G.copy_(torch.eye(2, dtype=torch.float64) / 1.5)
    before, after = task.test.states[:, :-1], task.test.states[:, 1:]
    torch.testing.assert_close(direct.advance(before, task.test.drive).state, after, rtol=0, atol=1e-13)
    with pytest.raises(ValueError, match="friction: expected measured friction"):
        direct.advance(before, Drive(task.test.drive.force))
    unit = simulate_planar_block(mass=1.0, test_trajectories=8, long_trajectories=1, long_length=5)
    errors = []
    for m in (8, 32):
        traditional = build(PlanarTraditional, unit, m=m, initial_mu=0.4, initial_noise=0.0)
        step = traditional.advance(unit.test.states[:, :-1], unit.test.drive)
        assert step.solved.all()
        errors.append(float((step.state.detach() - unit.test.states[:, 1:]).square().mean().sqrt()))
    assert errors[1] < 0.5 * errors[0]


def test_facets_approach_the_disc_and_tell_their_friction_coefficient():
    task = simulate_planar_block(mass=1.0, test_trajectories=8, long_trajectories=1, long_length=5)
    errors = []
    for facets in (8, 32):
        model = build(PlanarFriction, task, initial_limit=0.4 * 9.81, facets=facets)
        step = model.advance(task.test.states[:, :-1], Drive(task.test.drive.force))
        assert step.solved.all()
        errors.append(float((step.state.detach() - task.test.states[:, 1:]).square().mean().sqrt()))
        assert model.physical_parameters() == pytest.approx({"mu": 0.4})  # no force has told the mass
        with torch.no_grad():
            model.weight[:, 2:] /= 1.5
        assert model.physical_parameters() == pytest.approx({"mu": 0.4, "mass": 1.5})
    assert errors[1] < 0.5 * errors[0]


def test_a_tossed_rectangle_is_reproduced_by_its_true_numbers_and_gives_them_gradients():
    task = simulate_planar_body(trajectories=3, length=40)
    model = build(Identified, task, scene="lcplearn.scenes.planar_body.PlanarBody", learn=dict(task.truth))
    after = model.advance(task.test.states[:, :-1], Drive(task.test.drive.force)).state
    torch.testing.assert_close(after, task.test.states[:, 1:], rtol=0, atol=1e-10)
    gradients = torch.autograd.grad(after.square().sum(), list(model.parameters()))
    assert all(gradient.abs() > 0 for gradient in gradients)


def test_the_planar_model_refuses_another_space():
    with pytest.raises(ValueError, match="space: expected TABLE"):
        PlanarFriction(dt=0.05, space=PLANE)


@pytest.mark.parametrize(
    ("call", "name", "value"),
    [
        (PlanarTraditional, "initial_noise", -0.1),
        (PlanarTraditional, "m", 2),
        (simulate_planar_block, "switch_probability", 2.0),
        (simulate_planar_body, "half_width", 0.0),
        (simulate_planar_body, "half_height", -0.1),
    ],
)
def test_a_wrong_argument_is_named(call, name, value):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        call(**{"dt": 0.05, name: value})
