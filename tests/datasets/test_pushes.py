"""Pushes: what is read, what models see of it, and how they are judged."""

import numpy as np
import pytest
import torch
from pushes import push_arrays
from real_data import real_data

from lcplearn.datasets.pushes import read_all_pushes, read_pushes, straighten
from lcplearn.scenes.pushes import geometries

FEET = push_arrays()["config_support_points"]


@pytest.fixture
def file(tmp_path):
    def write(**changes):
        path = tmp_path / "pushes.npz"
        np.savez(path, **{k: v for k, v in (push_arrays() | changes).items() if v is not None})
        return path

    return write


def test_the_real_file_has_400_pushes_of_five_geometries_on_two_surfaces():
    data = read_pushes(real_data("planar_pushes.npz"))
    assert len(data.configuration) == 400
    assert len(geometries(data.pushes.points).unique()) == 5
    assert set(data.pushes.surface) == {"hardboard", "wood"}
    length = (data.pushes.push.end - data.pushes.push.start).norm(dim=-1)
    assert 0.014 < length.min() < length.max() < 0.018
    assert 3.0 < data.outcome.force.norm(dim=-1).mean() < 4.7


def test_models_see_nothing_but_path_start_pose_and_configuration(file):
    """The recordings' order, end poses and forces would tell the answer: garbage there changes no input."""
    arrays = push_arrays()
    garbage = {
        "post_pose": arrays["post_pose"] + 9.0,
        "force": arrays["force"] * -3.0,
        "source_push": np.arange(12)[::-1],
    }
    clean, dirty = read_all_pushes(file()).pushes, read_all_pushes(file(**garbage)).pushes
    for a, b in zip(clean.push, dirty.push, strict=True):
        assert torch.equal(a, b)
    assert torch.equal(clean.points.nan_to_num(9.0), dirty.points.nan_to_num(9.0))
    assert clean.surface == dirty.surface
    assert clean._fields == ("push", "points", "surface")
    assert clean.push._fields == ("pose", "start", "end")


def test_the_force_is_the_mean_of_the_second_half_of_the_time(file):
    arrays = push_arrays()
    late = arrays["force"][:, 0] >= 3.0
    arrays["force"][:, 1:] = np.where(late[:, None], [2.0, -1.0], [7.0, 7.0])
    force = read_all_pushes(file(force=arrays["force"])).outcome.force
    torch.testing.assert_close(force, torch.tensor((2.0, -1.0), dtype=torch.float64).expand(12, 2))


def test_a_straightened_path_keeps_its_ends_and_loses_its_jitter():
    rng = np.random.default_rng(0)
    line = np.linspace([0.1, 0.2], [0.11, 0.19], 200)
    found = straighten(np.round(line + rng.normal(0.0, 3e-5, line.shape), 4))
    assert np.abs(found - line[[0, -1]]).max() < 1.5e-4
    direction = (found[1] - found[0]) / np.linalg.norm(found[1] - found[0])
    assert abs(direction @ np.array([1.0, 1.0])) < 0.01
    np.testing.assert_allclose(straighten(line[::-1])[0], line[-1])


@pytest.mark.parametrize("options", [{}, {"protocol": "unseen_supports"}, {"protocol": "few", "training_pushes": 5}])
def test_no_push_is_learned_from_and_judged_on(file, options):
    data = read_pushes(file(), folds=3, **options)
    for split in data.splits:
        assert not set(split.train.tolist()) & set(split.test.tolist())
        assert len(split.train) + len(split.test) == 12
    if options.get("protocol") != "few":
        assert sorted(torch.cat([split.test for split in data.splits]).tolist()) == list(range(12))


def test_an_unseen_support_geometry_is_unseen_on_all_surfaces():
    data = read_pushes(real_data("planar_pushes.npz"), protocol="unseen_supports")
    number = geometries(data.pushes.points)
    assert len(data.splits) == 5
    for split in data.splits:
        assert not set(number[split.train].tolist()) & set(number[split.test].tolist())
        assert len({data.pushes.surface[k] for k in split.test.tolist()}) == 2


def test_the_same_seed_draws_the_same_parts(file):
    one, two, other = (read_pushes(file(), folds=3, seed=seed).splits[0].test for seed in (0, 0, 1))
    assert torch.equal(one, two)
    assert not torch.equal(one, other)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"pusher": None}, "pusher"),
        ({"post_pose": np.zeros((12, 2))}, "post_pose"),
        ({"pre_pose": np.zeros((12, 2))}, "pre_pose"),
        ({"config": np.full(12, 7)}, "config"),
        ({"pusher": np.zeros((10, 3))}, "offsets"),
        ({"pre_pose": np.full((12, 3), np.nan)}, "pre_pose"),
        ({"object_mass": np.float64(-1.0)}, "object_mass"),
        ({"config": np.array(1)}, "config: expected integers of shape"),
        ({"config": np.full(12, 0.6)}, "config: expected integers of shape"),
        ({"config_name": np.array("a")}, "config_name"),
        ({"pusher_offsets": np.array(1)}, "pusher"),
        ({"pre_pose": np.full((12, 3), "a")}, "pre_pose: expected numbers of shape"),
        ({"object_vertices": np.zeros(4)}, "object_vertices"),
        ({"config_support_points": np.add(FEET, 0.06)}, "config_support_points: expected three points around"),
        ({"config_support_points": FEET * [1.0, 0.0]}, "config_support_points: expected three points around"),
    ],
)
def test_a_file_that_is_not_as_described_is_refused_by_name(file, changes, named):
    with pytest.raises(ValueError, match=named):
        read_all_pushes(file(**changes))


@pytest.mark.parametrize(("missing", "named"), [("post_pose", "pose"), ("force", "force"), ("force_offsets", "force")])
def test_pushes_without_their_ends_are_not_learned_from(file, missing, named):
    assert read_all_pushes(file(**{missing: None})).outcome._asdict()[named].isnan().all()
    with pytest.raises(ValueError, match=f"{named}: expected how each push ended"):
        read_pushes(file(**{missing: None}), folds=3)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"protocol": "guess"}, "protocol"),
        ({"folds": 1}, "folds"),
        ({"protocol": "few"}, "training_pushes"),
        ({"training_pushes": 4}, "training_pushes"),
        ({"protocol": "few", "training_pushes": 12}, "training_pushes"),
    ],
)
def test_a_setting_that_does_not_fit_is_refused_by_name(file, options, named):
    with pytest.raises(ValueError, match=named):
        read_pushes(file(), **options)
