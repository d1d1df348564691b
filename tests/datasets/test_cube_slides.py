"""Real slides: the split, and one clear sentence for each kind of bad file."""

import contextlib
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from real_data import real_data

from lcplearn.datasets import Task, find, read_cube_slides
from lcplearn.datasets.cube_slides import COLUMNS


@pytest.fixture
def slides() -> Path:
    return real_data("cube_slides.npz")


def arrays(slides: int = 6, rows: int = 5) -> dict[str, np.ndarray]:
    """A small valid file: slide k has velocity k in all rows."""
    data = np.zeros((slides * rows, len(COLUMNS)))
    data[:, COLUMNS.index("v_m_s")] = np.repeat(np.arange(slides), rows)
    data[:, COLUMNS.index("s_m")] = np.arange(slides * rows)
    return {
        "data": data,
        "offsets": np.arange(slides + 1) * rows,
        "columns": np.array(COLUMNS),
        "dt": np.array(1 / 148),
        "g": np.array(9.81),
        "mass_kg": np.array(0.37),
    }


def read(path: Path, **changes: np.ndarray | None) -> Task:
    content = {name: value for name, value in {**arrays(), **changes}.items() if value is not None}
    np.savez(path, **content)
    return read_cube_slides(path, training_slides=3, validation_slides=1)


def test_real_slides_are_split_into_40_to_learn_from_and_403_to_test_on(slides):
    data = read_cube_slides(slides)
    sizes = [len(part.steps) for part in (data.train, data.validation, data.test)]
    assert sizes == [32, 8, 403]
    assert (data.truth, data.given, data.test_long) == ({}, {"mass": 0.37, "gravity": 9.81}, None)
    assert data.dt == pytest.approx(1 / 148)


def test_real_slides_lose_velocity_at_mu_g(slides):
    """data/README: mu = 0.216, no applied force; velocity is the backward difference of position."""
    data = read_cube_slides(slides)
    part = data.test
    assert (part.drive.force[..., 0] == 0).all()
    assert part.drive.friction is None
    assert part.true_states is None
    moving = part.states[:, 1:, 1] > 0.1
    mu = -part.states[..., 1].diff(dim=1)[moving] / (9.81 * data.dt)
    assert mu.median().item() == pytest.approx(0.215, abs=0.01)
    rate = part.states[..., 0].diff(dim=1)[moving] / data.dt - part.states[:, 1:, 1][moving]
    assert rate.abs().median() < 0.01


def test_slides_are_padded_with_their_last_row_and_appear_once(slides):
    data = read_cube_slides(slides, seed=7)
    stops = []
    for part in (data.train, data.validation, data.test):
        last = part.states[..., 0].gather(1, part.steps[:, None])[:, 0]
        assert torch.equal(part.states[:, -1, 0], last)
        stops += last.tolist()
    with np.load(slides) as file:
        expected = file["data"][file["offsets"][1:] - 1, COLUMNS.index("s_m")]
    assert sorted(stops) == sorted(expected.tolist())


def test_the_split_depends_on_the_seed_only(tmp_path):
    np.savez(tmp_path / "a.npz", **arrays(20))
    parts = [
        read_cube_slides(tmp_path / "a.npz", seed=seed, training_slides=10, validation_slides=2).train.states[..., 1]
        for seed in (0, 0, 1)
    ]
    assert torch.equal(parts[0], parts[1])
    assert not torch.equal(parts[0], parts[2])


def test_a_missing_file_is_named_with_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setenv("LCPLEARN_DATA", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"no such file; `python -m lcplearn.datasets.get slides`"):
        find("cube_slides.npz")
    with pytest.raises(FileNotFoundError, match=r"cube_slides.npz: no such file"):
        read_cube_slides()
    with pytest.raises(FileNotFoundError, match=r"other.npz: no such file"):
        read_cube_slides(tmp_path / "other.npz")


def test_data_are_found_where_the_environment_says_or_in_data(tmp_path, monkeypatch):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "a.npz").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("LCPLEARN_DATA", raising=False)
    assert find("a.npz") == Path("data") / "a.npz"
    monkeypatch.setenv("LCPLEARN_DATA", str(tmp_path / "data"))
    assert find("a.npz") == tmp_path / "data" / "a.npz"


NAN = arrays()["data"] * np.where(np.arange(6) == 2, np.nan, 1.0)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"data": NAN}, "data: 30 values are NaN or infinite"),
        ({"columns": np.array(COLUMNS[::-1])}, "expected the columns t_s, .* got yaw_rate"),
        ({"data": np.zeros((30, 4))}, r"expected the columns .* data of float64 \[30, 4\]"),
        ({"offsets": None}, "expected the arrays .* offsets missing"),
        ({"data": np.zeros((0, 6)), "offsets": np.array([0, 0])}, "expected at least one slide, got no rows"),
        ({"offsets": np.array([0, 10, 20, 25])}, "offsets: expected 0 to 30, the rows of data, got 0 to 25"),
        ({"offsets": np.array([0, 20, 10, 30])}, "offsets: record 1 has -10 rows, expected at least 2"),
        ({"offsets": np.array([0, 10, 11, 30])}, "offsets: record 1 has 1 rows, expected at least 2"),
        ({"offsets": np.array([0.0, 30.0])}, "offsets: expected at least two integers, got float64"),
        ({"offsets": np.array([0, 10, 20, 30])}, "training_slides, validation_slides: expected .* got 3 and 1"),
        ({"dt": np.array(0.0)}, "dt: expected a positive number, got 0.0"),
        ({"g": np.array(["9.81"])}, "g: expected a positive number"),
        ({"data": np.array([{}], dtype=object)}, r"arrays of Python objects \(pickles\) are not read"),
    ],
)
def test_a_bad_file_is_explained_in_one_sentence(tmp_path, changes, sentence):
    with pytest.raises(ValueError, match=sentence) as caught:
        read(tmp_path / "bad.npz", **changes)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", pickle.dumps([1, 2]), b"t_s,s_m\n0,0\n"])
def test_a_file_that_is_no_npz_is_not_opened(tmp_path, content):
    (tmp_path / "bad.npz").write_bytes(content)
    with pytest.raises(ValueError, match=r"expected an NPZ file .* pickles are not read"):
        read_cube_slides(tmp_path / "bad.npz")


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize("damaged", range(0, 1500, 50))
def test_damage_to_a_file_is_a_value_error_wherever_it_is(tmp_path, save, damaged):
    save(tmp_path / "a.npz", **arrays())
    content = bytearray((tmp_path / "a.npz").read_bytes())
    content[damaged : damaged + 50] = bytes([7]) * 50
    (tmp_path / "a.npz").write_bytes(content)
    with contextlib.suppress(ValueError):
        read_cube_slides(tmp_path / "a.npz", training_slides=3, validation_slides=1)


def test_a_zip_of_something_else_is_explained(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        for name in arrays():
            file.writestr(name, b"1, 2, 3")
    with pytest.raises(ValueError, match=r"data: expected numbers or text, got \|S7"):
        read_cube_slides(tmp_path / "a.npz")


def test_an_npz_that_is_whole_is_read(tmp_path):
    data = read(tmp_path / "good.npz")
    assert [len(part.steps) for part in (data.train, data.validation, data.test)] == [2, 1, 3]
