"""Recordings of one's own: read whole, or refused in one sentence."""

from pathlib import Path

import numpy as np
import pytest
import torch

from lcplearn.datasets import Task, read_recordings


def read(path: Path, **changes: np.ndarray | float) -> Task:
    arrays = {"dt": 0.1, "positions": np.zeros((2, 4)), "velocities": np.ones((2, 4)), "forces": np.zeros((2, 3))}
    np.savez(path / "mine.npz", **(arrays | changes))  # type: ignore[arg-type]
    return read_recordings(path / "mine.npz", given={"gravity": 1.62})


def test_what_is_not_in_the_file_is_unknown_and_no_step_is_padding(tmp_path: Path) -> None:
    data = read(tmp_path)
    assert (data.dt, data.given, data.truth) == (0.1, {"gravity": 1.62}, {})
    assert data.test.steps.tolist() == [3, 3]
    assert data.test.drive.friction is None
    assert data.test.true_states is None


def test_whole_numbers_are_read_as_float64(tmp_path: Path) -> None:
    data = read(tmp_path, forces=np.zeros((2, 3), dtype=int), steps=np.array([1, 3]), mu=1)
    assert data.test.drive.force[..., 0].dtype == torch.float64
    assert data.test.steps.tolist() == [1, 3]
    assert data.truth == {"mu": 1.0}


def test_a_true_number_may_be_0(tmp_path: Path) -> None:
    assert read(tmp_path, mu=0.0).truth == {"mu": 0.0}


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"forces": np.zeros(3)}, r"forces: expected shape \[N, T\], got \[3\]"),
        ({"forces": np.zeros((2, 0))}, r"forces: expected shape \[N, T\], got \[2, 0\]"),
        ({"positions": np.zeros((2, 3))}, r"positions: expected numbers of shape \[2, 4\], got float64 \[2, 3\]"),
        ({"velocities": np.full((2, 4), np.nan)}, "velocities: 8 values are NaN or infinite"),
        ({"velocities": np.full((2, 4), "v")}, r"velocities: expected numbers of shape \[2, 4\], got <U1 \[2, 4\]"),
        ({"velocities": np.array([[0.0], [0.0, 1.0]], dtype=object)}, "pickles"),
        ({"friction": np.zeros((2, 3))}, r"friction: expected numbers of shape \[2, 3, 2\]"),
        ({"steps": np.array([1.0, 2.0])}, r"steps: expected integers of shape \[2\], got float64"),
        ({"steps": np.array([0, 4])}, "steps: expected numbers from 1 to 3"),
        ({"dt": 0.0}, "dt: expected a positive number, got 0.0"),
        ({"true_positions": np.zeros((2, 4))}, "true_velocities: expected beside true_positions, got none"),
        ({"mu": np.ones(2)}, "mu: expected a finite number"),
    ],
)
def test_a_bad_file_is_explained_in_one_sentence(tmp_path: Path, changes: dict[str, np.ndarray], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence) as caught:
        read(tmp_path, **changes)
    assert "\n" not in str(caught.value)
