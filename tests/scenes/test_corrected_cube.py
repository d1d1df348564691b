"""A cube with a small network: nothing changes at 0, gradients, symmetry, rest, and what is refused."""

from typing import Any

import pytest
import torch
from torch import Tensor

from lcplearn.scenes.corrected_cube import REACH, SHAPES, CorrectedCube
from lcplearn.scenes.scene import Drive, rollout
from lcplearn.scenes.space import POSE, quaternion_product, rotation_matrix
from lcplearn.scenes.spatial_body import box_corners
from lcplearn.scenes.tossed_cube import IMPACT_SPEED, TossedCube

H, M, DT, STEPS = 0.05, 0.4, 1 / 148, 40
NUMBERS: dict[str, Any] = {
    **{"half_width": H, "mass": M, "inertia": 0.8 * M * H**2, "mu": 0.2, "mu_impact": 0.15, "restitution": 0.3},
    **{"radius": 0.1 * H, "dt": DT},
}
KINDS = tuple(SHAPES)


def start(count: int = 6) -> Tensor:
    state = torch.randn(count, 13, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    state[:, 2] = 2.0 * H
    state[:, 3:7] /= state[:, 3:7].norm(dim=-1, keepdim=True)
    state[:, 10:] *= 5.0
    return state


def forces(count: int = 6, steps: int = STEPS) -> Drive:
    return Drive(torch.zeros(count, steps, 6, dtype=torch.float64))


def weights(kind: str, units: int = 4) -> dict[str, Tensor]:
    inputs, outputs = SHAPES[kind]
    random = torch.Generator().manual_seed(1)
    hidden = torch.randn(units, inputs + 1, generator=random, dtype=torch.float64)
    return {"hidden": hidden, "outer": 0.3 * torch.randn(outputs, units, generator=random, dtype=torch.float64)}


def cube(kind: str, **more: Any) -> CorrectedCube:
    return CorrectedCube(**{**NUMBERS, **weights(kind), "corrects": kind, **more})


@pytest.mark.parametrize("kind", KINDS)
def test_a_network_of_zeros_leaves_the_cube_as_it_is_to_the_last_bit(kind: str):
    plain = rollout(TossedCube(**NUMBERS), start(), forces())
    none = torch.zeros_like(weights(kind)["outer"])
    assert torch.equal(rollout(cube(kind, outer=none), start(), forces()).states, plain.states)
    steps = plain.states[:, :-1], forces()  # from all rows at once
    two = TossedCube(**NUMBERS, substeps=2).advance(*steps).state
    assert torch.equal(cube(kind, outer=none, substeps=2).advance(*steps).state, two)
    found = cube(kind, substeps=2).advance(*steps)
    assert found.solved is not None
    assert bool(found.solved.all())
    assert float((found.state - two).abs().max()) > 1e-3


@pytest.mark.parametrize("law", ["continuous", "newton"])
@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_finite_differences_and_a_batch_of_networks_is_its_elements(kind: str, law: str):
    given = weights(kind)
    leaves = {name: x.expand(6, *x.shape).clone().requires_grad_() for name, x in given.items()}

    def ends(network: dict[str, Tensor]) -> Tensor:
        path = rollout(cube(kind, restitution_law=law, **network), start(), forces())
        return path.positions[..., -1, :].sum(-1)

    value = ends(leaves)
    torch.testing.assert_close(value, ends(given), rtol=0, atol=1e-12)
    gradients = torch.autograd.grad(value.sum(), [*leaves.values()])
    for (name, x), gradient in zip(given.items(), gradients, strict=True):
        steps = 1e-6 * torch.eye(x.numel(), dtype=torch.float64).reshape(-1, 1, *x.shape)  # one for each number
        up, down = (ends({**given, name: x + sign * steps}) for sign in (1.0, -1.0))
        smooth = (up + down - 2.0 * value.detach()).abs() < 1e-9  # nothing happens between
        assert smooth.double().mean() > 0.7
        torch.testing.assert_close(
            gradient.reshape(6, -1).T[smooth], ((up - down) / 2e-6)[smooth], rtol=1e-4, atol=1e-5
        )


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_turned_about_the_vertical_moves_turned(kind: str):
    half = torch.tensor(0.4, dtype=torch.float64)
    turn = torch.stack((half.cos(), torch.zeros(()), torch.zeros(()), half.sin())).double()
    c, s = (2 * half).cos(), (2 * half).sin()
    plane = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)

    def turned(state: Tensor) -> Tensor:
        state = state.clone()
        for first in (0, 7):
            state[..., first : first + 2] = state[..., first : first + 2] @ plane.mT
        state[..., 3:7] = quaternion_product(turn.expand_as(state[..., 3:7]), state[..., 3:7])
        return state

    scene = cube(kind)
    path = rollout(scene, start(), forces()).states
    torch.testing.assert_close(rollout(scene, turned(start()), forces()).states, turned(path), rtol=0, atol=1e-9)


def test_a_cube_with_other_faces_up_moves_alike():
    """By the quarter turn of the body about one of its own axes, which only renames its corners."""
    quarter = torch.tensor([0.5, 0.5, 0.5, 0.5], dtype=torch.float64)  # x to y to z to x
    renamed = start()
    renamed[:, 3:7] = quaternion_product(renamed[:, 3:7], quarter.expand(6, 4))
    renamed[:, 10:] = renamed[:, 10:].roll(-1, dims=-1)
    scene = cube("force")
    path, other = (rollout(scene, x, forces()) for x in (start(), renamed))
    torch.testing.assert_close(other.positions[..., :3], path.positions[..., :3], rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", ["friction", "restitution"])
def test_with_any_law_a_cube_comes_to_rest_to_the_last_bit(kind: str):
    path = rollout(cube(kind), start(), forces(steps=400))
    assert bool(path.solved.all())
    assert torch.equal(path.velocities[:, -1], torch.zeros(6, 6, dtype=torch.float64))


def test_at_rest_on_the_ground_no_force_is_felt():
    still = POSE.origin()
    still[2] = H
    path = rollout(cube("force"), still.expand(1, 13), forces(1, 50))
    assert torch.equal(path.states[:, 1:, 7:], torch.zeros(1, 50, 6, dtype=torch.float64))


def test_a_corner_near_the_ground_is_held_up_against_its_velocity():
    """Above it nothing touches: the step is that of Newton and Euler under one force at one corner."""
    scene = cube("force", radius=0.0)
    state = start(1)[0]
    turn = rotation_matrix(state[3:7])
    levers = box_corners(torch.full((3,), H, dtype=torch.float64)) @ turn.mT
    lever = levers[levers[:, 2].argmin()]
    state[7:10] = torch.tensor([0.3, -0.2, -0.1])
    state[10:] = turn.mT @ torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)
    state[2] = 0.06 * H + 0.1 * DT - lever[2]  # where it would end: 0.06 half widths
    moves = state[7:10] + torch.linalg.cross(turn @ state[10:], lever)
    slip, speed = moves[:2], IMPACT_SPEED * H
    x = torch.tensor([0.06 / REACH, -0.1 / speed, slip.norm() / speed], dtype=torch.float64)
    hidden, bias = scene.hidden[:, :-1], scene.hidden[:, -1]
    normal, tangential = scene.outer @ (torch.tanh(hidden @ x + bias) - torch.tanh(bias))
    along = -tangential * slip / (speed**2 + slip @ slip).sqrt()
    up = normal * 0.1 / (speed**2 + 0.01) ** 0.5
    force = (1.0 - 0.06 / REACH) * M * 9.81 * torch.cat((along, up[None]))
    after = scene.advance(state, Drive(torch.zeros(6, dtype=torch.float64))).state
    gravity = torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64)
    torch.testing.assert_close(after[7:10] - state[7:10], DT * (force / M + gravity))
    spun = turn.mT @ torch.linalg.cross(lever, force) / (0.8 * M * H**2)
    torch.testing.assert_close(after[10:] - state[10:], DT * spun)


def test_a_law_scales_friction_and_shifts_the_logit_of_restitution():
    closing = torch.tensor([0.0, 0.3, 2.0], dtype=torch.float64)
    hidden, outer = weights("friction").values()
    shares = (closing / (IMPACT_SPEED * H)).unsqueeze(-1)
    net = ((torch.tanh(shares * hidden[:, 0] + hidden[:, 1]) - torch.tanh(hidden[:, 1])) @ outer.mT)[:, 0]
    assert net[0] == 0.0
    expected = {"mu": 0.2 * net.exp(), "mu_impact": 0.15 * net.exp()}
    assert cube("friction").law(closing).keys() == expected.keys()
    for name, value in cube("friction").law(closing).items():
        torch.testing.assert_close(value, expected[name])
    assert list(cube("friction", mu_impact=None).law(closing)) == ["mu"]
    found = cube("restitution").law(closing)["restitution"]
    torch.testing.assert_close(found.logit(), net + torch.tensor(0.3, dtype=torch.float64).logit())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"corrects": "mass"}, "^corrects: expected one of friction, restitution, force, got 'mass'"),
        ({"hidden": torch.ones(4, 3)}, r"^hidden: expected shape \[\*batch, 4, 2\], got \[4, 3\]"),
        ({"outer": torch.ones(2, 4)}, r"^outer: expected shape \[\*batch, 1, 4\], got \[2, 4\]"),
        ({"substeps": 0}, "^substeps: "),
    ],
)
def test_a_wrong_argument_is_named(change: dict[str, Any], message: str):
    with pytest.raises(ValueError, match=message):
        cube("friction", **change)


def test_a_force_has_no_law_of_a_closing_speed():
    with pytest.raises(ValueError, match=r"^corrects: expected friction or restitution"):
        cube("force").law(torch.ones(3, dtype=torch.float64))
