"""The converter of the published tosses, against the shared files made from the same tosses."""

import pickle

import numpy as np
import pytest
import torch
from real_data import real_data

from lcplearn.datasets.contactnets import convert, final_slide, read_toss


def record(file: dict[str, np.ndarray], rows: str, number: int) -> np.ndarray:
    k = int(np.flatnonzero(file["source_id"] == number)[0])
    return file[rows][file["offsets"][k] : file["offsets"][k + 1]]


def test_the_five_raw_files_give_the_shared_rows():
    """To 1e-12."""
    tosses, slides = convert(real_data("contactnets_raw"))
    with np.load(real_data("cube_tosses.npz")) as file:
        expected_tosses = dict(file)
    with np.load(real_data("cube_slides.npz")) as file:
        expected_slides = dict(file)
    assert tosses["source_id"].tolist() == slides["source_id"].tolist() == [0, 1, 10, 100, 101]
    for number in tosses["source_id"]:
        np.testing.assert_array_equal(record(tosses, "state", number), record(expected_tosses, "state", number))
        ours, theirs = record(slides, "data", number), record(expected_slides, "data", number)
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12)
        k, j = (int(np.flatnonzero(file["source_id"] == number)[0]) for file in (slides, expected_slides))
        assert slides["source_start_row"][k] == expected_slides["source_start_row"][j]
    for made, expected in ((tosses, expected_tosses), (slides, expected_slides)):
        assert set(expected) - set(made) <= {"source_commit"}
        for name in ("columns", "dt", "g", "g_scaled", "mass_kg", "half_width_m", "corners_scaled", "inertia_kg_m2"):
            if name in expected:
                np.testing.assert_array_equal(made[name], expected[name])


def test_all_456_shared_tosses_give_the_443_shared_slides():
    with np.load(real_data("cube_tosses.npz")) as file:
        tosses = dict(file)
    with np.load(real_data("cube_slides.npz")) as file:
        slides = dict(file)
    found = {}
    for number in tosses["source_id"].tolist():
        slide = final_slide(record(tosses, "state", number))
        if slide is not None:
            found[number] = slide
    assert sorted(found) == sorted(slides["source_id"].tolist())
    for k, number in enumerate(slides["source_id"].tolist()):
        assert found[number].start_row == slides["source_start_row"][k]
        np.testing.assert_allclose(found[number].rows, record(slides, "data", number), rtol=0, atol=1e-12)


def toss(rows: int = 30, speed: float = 0.5, height: float = 1.0) -> torch.Tensor:
    """A cube that slides flat along (3, 4)/5, lengths in half widths of 0.0524 m."""
    state = torch.zeros(1, rows, 19, dtype=torch.float64)
    state[..., 3] = 1.0
    state[..., 2] = height
    state[..., 7:9] = torch.tensor([0.6, 0.8]) * speed / 0.0524
    state[..., :2] = state[..., 7:9] * torch.arange(rows)[:, None] / 148
    return state


def test_a_slide_is_measured_along_and_across_the_line_from_start_to_stop():
    """lateral = d_x y - d_y x."""
    state = toss()
    state[0, 10, :2] += torch.tensor([-0.8, 0.6])  # one half width to the left of the direction of motion
    rows = final_slide(state[0, :, :13].numpy()).rows
    np.testing.assert_allclose(rows[:, 1], 0.5 * np.arange(30) / 148, atol=1e-12)
    np.testing.assert_allclose(rows[:, 2], 0.5, atol=1e-12)
    np.testing.assert_allclose(rows[:, 3], np.where(np.arange(30) == 10, 0.0524, 0.0), atol=1e-12)
    np.testing.assert_allclose(rows[:, 4], 0.0524, atol=1e-12)


def test_a_toss_without_a_flat_fast_long_end_has_no_slide():
    assert final_slide(toss(rows=15)[0, :, :13].numpy()) is None
    assert final_slide(toss(speed=0.09)[0, :, :13].numpy()) is None
    assert final_slide(toss(height=1.2)[0, :, :13].numpy()) is None
    spinning = toss()[0, :, :13].numpy()
    spinning[:, 12] = 1.5
    assert final_slide(spinning) is None
    bump = toss()[0, :, :13].numpy()
    bump[12, 9] = 2.0
    assert final_slide(bump).start_row == 13


class Payload:
    """Runs code when unpickled without care."""

    def __reduce__(self):
        return (exec, ("raise SystemExit('a pickle ran')",))


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (torch.zeros(1, 5, 13), r"expected a tensor of shape \[1, T, 19\], got \[1, 5, 13\]"),
        ({"state": torch.zeros(1, 5, 19)}, r"expected a tensor of shape \[1, T, 19\], got dict"),
        (torch.zeros(1, 0, 19), "expected at least one row, got none"),
        (torch.full((1, 5, 19), torch.nan), "95 values are NaN or infinite"),
        (torch.ones(1, 5, 19), r"expected the last 6 columns \(controls\) to be zero"),
        (Payload(), "can't be read without risk"),
    ],
)
def test_a_bad_toss_is_explained_in_one_sentence(tmp_path, content, sentence):
    torch.save(content, tmp_path / "0.pt")
    with pytest.raises(ValueError, match=sentence) as caught:
        convert(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"no tensor", pickle.dumps(Payload())])
def test_a_file_that_is_no_tensor_is_explained_and_not_run(tmp_path, content):
    (tmp_path / "0.pt").write_bytes(content)
    with pytest.raises(ValueError, match=r"0\.pt: expected one saved tensor"):
        read_toss(tmp_path / "0.pt")


def test_tosses_that_are_missing_or_have_no_slide_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"expected toss files 0\.pt, 1\.pt"):
        convert(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"7\.pt: no such file"):
        read_toss(tmp_path / "7.pt")
    torch.save(toss(height=2.0), tmp_path / "0.pt")
    with pytest.raises(ValueError, match="none of the 1 tosses ends in a flat slide"):
        convert(tmp_path)
