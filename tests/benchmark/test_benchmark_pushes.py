"""`benchmark pushes`: pushes that are planned, by random shooting and by gradient, and gradients that are judged."""

import math

import pytest
import torch
from pushes import push_file

from lcplearn.benchmark.pushes.planning import CLEARANCE, FEW, plan, push_of, random_actions, wanted_poses
from lcplearn.benchmark.pushes.run import right_gradients, thing
from lcplearn.datasets.pushes import read_all_pushes
from lcplearn.formulations.pushing import Supports


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return read_all_pushes(push_file(tmp_path_factory.mktemp("pushes"), 8))


@pytest.fixture(scope="module")
def model(data):
    found = Supports(**thing(data), steps=5, surfaces=["board", "wood"])
    with torch.no_grad():
        found.numbers.copy_(torch.tensor((math.log(0.5), 1.0, 0.5)))
    return found


def seeded() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_a_planned_push_starts_outside_an_edge_and_goes_its_way_beyond_it(data, model):
    edge, action = torch.arange(8) % 3, random_actions(8, seeded())
    push = push_of(model, data.pushes.push.pose, action, edge)
    touch = model.object.first_touch(push)
    way = (push.end - push.start).norm(dim=-1)
    torch.testing.assert_close(touch * way, torch.full_like(way, CLEARANCE))
    torch.testing.assert_close((1.0 - touch) * way, action[:, 2])
    normal, _ = model.edge(data.pushes._replace(push=push))
    cosine = (normal * (push.end - push.start)).sum(-1) / way
    torch.testing.assert_close(cosine, action[:, 1].cos())


def test_the_gradient_only_improves_what_random_shooting_found_and_mostly_reaches_it(data, model):
    """The plant is the model, so that what was planned is what happens."""
    wanted = wanted_poses(model, data.pushes, seeded())
    random, gradient = (
        plan(model, model, data.pushes, wanted, guesses=8, gradient_steps=steps, generator=seeded()) for steps in (0, 5)
    )
    assert (gradient.deviation <= random.deviation + 1e-12).all()
    assert gradient.deviation.median() < 0.3 * random.deviation.median()
    assert (random.rollouts, gradient.rollouts) == (8, 8 + 5 * 2 * FEW)


@pytest.mark.parametrize("name", ["height", "pressure x", "pressure y"])
def test_gradients_of_pushes_agree_with_differences_and_wrong_ones_do_not(data, model, name, monkeypatch):
    assert right_gradients(model, data, name) >= 7 / 8
    monkeypatch.setattr(torch.autograd, "grad", lambda output, shift: (torch.zeros_like(shift),))
    assert right_gradients(model, data, name) <= 1 / 8
