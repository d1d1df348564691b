"""Hand-made data are compared with their space, and what is wrong is named."""

import pytest
import torch

from lcplearn.datasets import Recordings, Task
from lcplearn.scenes import LINE, Drive
from lcplearn.scenes.space import POSE


def part(steps: int = 3, forces: int = 3, columns: int = 2, lengths: tuple[int, ...] = (3, 2)) -> Recordings:
    states = torch.zeros(2, steps + 1, columns, dtype=torch.float64)
    return Recordings(states, Drive(torch.zeros(2, forces, 1, dtype=torch.float64)), torch.tensor(lengths))


def test_padding_may_hold_anything() -> None:
    good = part()
    good.states[1, 3] = float("nan")
    assert Task("mine", LINE, 0.1, good, good, good).test.steps.tolist() == [3, 2]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"forces": 1}, r"^validation\.states: expected shape \[2, 2, 2\], got \[2, 4, 2\]"),
        ({"columns": 4}, r"^validation\.states: expected shape \[2, 4, 2\], got \[2, 4, 4\]"),
        ({"lengths": (3, 4)}, r"^validation\.steps: expected numbers from 1 to 3, got \[3, 4\]"),
        ({"lengths": (3, 0)}, r"^validation\.steps: expected numbers from 1 to 3"),
    ],
)
def test_what_does_not_fit_is_named(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Task("mine", LINE, 0.1, part(), part(**changes), part())


def test_states_that_are_not_finite_and_a_wrong_time_step_are_refused() -> None:
    bad = part()
    bad.states[0, 0, 1] = float("nan")
    with pytest.raises(ValueError, match=r"^test\.states: expected finite numbers"):
        Task("mine", LINE, 0.1, part(), part(), bad)
    with pytest.raises(ValueError, match=r"^dt: expected a positive number, got 0\.0"):
        Task("mine", LINE, 0.0, part(), part(), part())


def test_lengths_are_whole_numbers() -> None:
    half = part()._replace(steps=torch.tensor([2.5, 2.0]))
    # the check of types is first where the tests check types
    with pytest.raises((ValueError, TypeError), match="steps"):
        Task("mine", LINE, 0.1, half, part(), part())


def test_a_quaternion_that_is_no_rotation_is_refused() -> None:
    states = POSE.origin().repeat(1, 3, 1)
    still = Recordings(states, Drive(torch.zeros(1, 2, 6, dtype=torch.float64)), torch.tensor([2]))
    Task("mine", POSE, 0.1, still, still, still)
    states[0, 1, 3:7] = 0.0
    with pytest.raises(ValueError, match=r"^train\.states: expected a quaternion of norm 1, got one of norm 0"):
        Task("mine", POSE, 0.1, still, still, still)
