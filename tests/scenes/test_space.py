"""Spaces: positions advance by the exponential, differences invert it, gradients exist at rest."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lcplearn.scenes.space import LINE, PLANE, POSE, Space, quaternion_exponential, quaternion_product, rotation_matrix

SPACES = {"line": LINE, "plane": PLANE, "pose": POSE}


def positions(space: Space, count: int, seed: int) -> torch.Tensor:
    x = torch.randn(count, space.nq, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    if space.nq > space.nv:
        x[:, -4:] /= x[:, -4:].norm(dim=-1, keepdim=True)
    return x


@pytest.mark.parametrize("name", SPACES)
@given(seed=st.integers(0, 1000), size=st.sampled_from([0.0, 1e-12, 1e-6, 1e-4, 1e-3, 1.0]))
def test_the_difference_of_an_advance_is_its_velocity(name, seed, size):
    space = SPACES[name]
    velocity = torch.randn(5, space.nv, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    velocity = size * velocity / velocity.norm(dim=-1, keepdim=True)  # rotations below pi
    start = positions(space, 5, seed + 1)
    torch.testing.assert_close(
        space.difference(space.advance(start, velocity, 1.0), start), velocity, rtol=1e-12, atol=4e-15
    )


@given(seed=st.integers(0, 1000))
def test_a_quaternion_turns_like_the_matrix_exponential(seed):
    turn = torch.randn(4, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    zero = torch.zeros(4, dtype=torch.float64)
    x, y, z = turn.unbind(-1)
    skew = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).reshape(4, 3, 3)
    torch.testing.assert_close(rotation_matrix(quaternion_exponential(turn)), torch.linalg.matrix_exp(skew))


def test_the_product_of_quaternions_is_the_product_of_their_matrices():
    a, b = positions(POSE, 8, 0)[:, -4:], positions(POSE, 8, 1)[:, -4:]
    torch.testing.assert_close(rotation_matrix(quaternion_product(a, b)), rotation_matrix(a) @ rotation_matrix(b))


def test_a_quaternion_and_its_negative_are_as_far_away():
    a, b = positions(POSE, 8, 2), positions(POSE, 8, 3)
    torch.testing.assert_close(POSE.difference(a * torch.tensor([1, 1, 1, -1, -1, -1, -1]), b), POSE.difference(a, b))


@pytest.mark.parametrize("size", [0.0, 3e-5, 1e-3])
def test_gradients_of_advance_and_difference_hold_near_rest(size):
    start = positions(POSE, 1, 4)
    velocity = (size * torch.tensor([[1.0, 2.0, 3.0, 1.0, -1.0, 0.5]], dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda v: POSE.difference(POSE.advance(start, v, 1.0), start), velocity)


def test_speed_weighs_rotations_by_the_radius():
    assert PLANE.speed(torch.tensor([3.0, 0.0, 2.0]), radius=2.0) == 5.0
    assert POSE.speed(torch.tensor([0.0, 0.0, 3.0, 8.0, 0.0, 0.0]), radius=0.5) == 5.0


def test_what_is_no_state_of_the_space_is_refused_by_name():
    with pytest.raises(ValueError, match=r"state: expected shape \[\*batch, 13\]"):
        POSE.split(torch.zeros(3, 12))
    with pytest.raises(ValueError, match="positions: expected as many as velocities"):
        Space(("x",), ("v", "w"))


def test_a_quaternion_of_rounded_digits_is_normalised_and_a_wrong_one_refused():
    state = POSE.origin()
    state[3:7] = torch.tensor([0.7071, 0.0, 0.7071, 0.0])
    turned = POSE.normalised(state)
    assert turned[3:7].norm().item() == pytest.approx(1.0, abs=1e-15)
    assert torch.equal(POSE.normalised(POSE.origin()), POSE.origin())
    with pytest.raises(ValueError, match=r"^state: expected a quaternion of norm 1, got one of norm 2$"):
        POSE.normalised(torch.cat((state[:3], 2.0 * turned[3:7], state[7:])))
    line = torch.tensor([3.0, 4.0], dtype=torch.float64)
    assert LINE.normalised(line) is line
