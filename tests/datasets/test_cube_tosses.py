"""Tosses of the cube: units, the frozen split, and what a file must be."""

from pathlib import Path

import numpy as np
import pytest
import torch
from real_data import real_data

from lcplearn.datasets.contactnets import convert
from lcplearn.datasets.cube_tosses import CHOOSE, LEARN, in_file_units, read_tosses, split


@pytest.fixture
def file(tmp_path: Path) -> Path:
    generator = np.random.default_rng(0)
    state = generator.standard_normal((9, 13))
    state[:, 3:7] /= np.linalg.norm(state[:, 3:7], axis=1, keepdims=True)
    path = tmp_path / "tosses.npz"
    np.savez(path, state=state, offsets=np.array([0, 4, 9]), half_width_m=np.array(0.1), g_scaled=np.array(98.1))
    return path


def test_states_come_in_si_units_and_go_back_as_they_were(file: Path):
    tosses, raw = read_tosses(file), np.load(file)["state"]
    assert tosses.states.shape == (2, 5, 13)
    assert tosses.steps.tolist() == [3, 4]
    np.testing.assert_allclose(tosses.states[1, 2, :3], 0.1 * raw[6, :3], rtol=1e-15)
    np.testing.assert_array_equal(tosses.states[1, 2, 3:7], raw[6, 3:7])
    np.testing.assert_allclose(tosses.states[1, 2, 7:10], 0.1 * raw[6, 7:10], rtol=1e-15)
    np.testing.assert_array_equal(tosses.states[0, 4], tosses.states[0, 3])  # padding repeats the last row
    assert tosses.gravity == pytest.approx(9.81)
    np.testing.assert_allclose(in_file_units(tosses.states, tosses.steps, tosses.half_width), raw, rtol=1e-14)


def test_only_starts_reads_what_may_be_anything_afterwards(file: Path):
    arrays = dict(np.load(file))
    arrays["state"][1], arrays["state"][6] = np.nan, 7.0
    np.savez(file, **arrays)
    with pytest.raises(ValueError, match="NaN"):
        read_tosses(file)
    assert read_tosses(file, only_starts=True).states.shape == (2, 5, 13)
    arrays["state"][4] = 7.0
    np.savez(file, **arrays)
    with pytest.raises(ValueError, match="row 0 of each toss"):
        read_tosses(file, only_starts=True)


def test_a_resting_cube_lies_on_its_board_and_velocities_are_backward_differences():
    tosses = read_tosses(real_data("cube_tosses.npz"))
    end = tosses.states[torch.arange(len(tosses.steps)), tosses.steps]
    assert float(end[:, 2].median()) == pytest.approx(0.978 * 0.0524, abs=2e-4)
    moved = (tosses.states[:, 1:80, :3] - tosses.states[:, :79, :3]) / tosses.dt
    assert float((moved - tosses.states[:, 1:80, 7:10]).abs().median()) < 0.01


def test_the_frozen_split_and_another_seed():
    numbers = read_tosses(real_data("cube_tosses.npz")).numbers
    learn, choose, judge = split(numbers)
    assert (len(learn), len(choose), len(judge)) == (64, 48, 344)
    assert sorted([*learn, *choose, *judge]) == list(range(456))
    assert [numbers[k] for k in learn] == list(LEARN)
    assert [numbers[k] for k in choose] == list(CHOOSE)
    other = split(numbers, seed=1)
    assert [numbers[k] for k in other[0][:3]] == [509, 208, 418]
    assert set(other[0]) != set(learn)
    # A hash places each number by itself: without a few others the order stays.
    fewer = tuple(number for number in numbers if number not in (509, 418))
    assert fewer[split(fewer, seed=1)[0][0]] == 208


def test_too_few_tosses_for_a_split():
    with pytest.raises(ValueError, match="112 tosses of the split of seed 0"):
        split((1, 2, 3))
    with pytest.raises(ValueError, match="more than 112"):
        split((1, 2, 3), seed=1)


def test_what_the_converter_makes_of_published_files_can_be_read(tmp_path: Path):
    arrays, _ = convert(real_data("contactnets_raw"))
    np.savez(tmp_path / "tosses.npz", **arrays)
    ours, shared = read_tosses(tmp_path / "tosses.npz"), read_tosses(real_data("cube_tosses.npz"))
    for k, number in enumerate(ours.numbers):
        j, rows = shared.numbers.index(number), int(ours.steps[k]) + 1
        torch.testing.assert_close(ours.states[k, :rows], shared.states[j, :rows], rtol=0, atol=0)
    assert ours.gravity == pytest.approx(9.81)
