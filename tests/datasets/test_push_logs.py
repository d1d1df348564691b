"""Raw logs of pushes: written by hand, converted and read again."""

import numpy as np
import pytest

from lcplearn.datasets.push_logs import FOLDER, LOGS, convert, force_on_object, parse, plane_pose, yaw
from lcplearn.datasets.pushes import read_all_pushes


def quaternion(angle: float) -> list[float]:
    return [np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)]


def log(count: int = 2, tool: float = 0.0) -> str:
    """Pushes along x by 15 mm in 6 s; from 1 s on the object feels (3, 1) N in the tool's frame."""
    lines = [str(count)]
    for k in range(count):
        lines += [
            " ".join(map(str, [400 + k, 100, 5, *quaternion(0.3 * k)])),
            " ".join(map(str, [410, 101, 5, *quaternion(0.4)])),
        ]
        times = np.arange(100.0, 106.0, 0.1)
        sensor = -np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2.0) @ np.array([3.0, 1.0])
        lines.append(str(len(times)))
        lines += [" ".join(map(str, [t, *(np.array([0.7, -0.4]) + (sensor if t >= 101.0 else 0.0))])) for t in times]
        lines.append(str(len(times)))
        lines += [" ".join(map(str, [t, 395 + 2.5 * (t - 100), 110, 200, *quaternion(tool)])) for t in times]
    return "\n".join(lines) + "\n"


@pytest.fixture
def clone(tmp_path):
    for names in LOGS.values():
        for name in names:
            path = tmp_path / "clone" / FOLDER / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(log())
    return tmp_path / "clone"


def test_the_converted_file_is_one_that_can_be_read(clone, tmp_path):
    np.savez(tmp_path / "planar_pushes.npz", **convert(clone))
    data = read_all_pushes(tmp_path / "planar_pushes.npz")
    assert len(data.configuration) == 20
    assert int(data.pushes.whole_face.sum()) == 4
    way = data.pushes.push.end - data.pushes.push.start
    np.testing.assert_allclose(way.norm(dim=-1), 2.5e-3 * 5.9, rtol=1e-4)
    np.testing.assert_allclose(data.pushes.push.pose[1], [0.401, 0.1, 0.3], rtol=1e-6)
    np.testing.assert_allclose(data.outcome.force, np.tile([3.0, 1.0], (20, 1)), atol=1e-5)


def test_the_force_turns_with_the_tool():
    push = parse(log(1, tool=0.5))[0]
    c, s = np.cos(0.5), np.sin(0.5)
    np.testing.assert_allclose(force_on_object(push)[-1, 1:], [3.0 * c - s, 3.0 * s + c], atol=1e-12)
    np.testing.assert_allclose(force_on_object(push)[:3, 1:], 0.0, atol=1e-12)


def test_the_angle_is_the_yaw_of_the_quaternion():
    assert yaw(np.array(quaternion(-2.2))) == pytest.approx(-2.2)
    np.testing.assert_allclose(plane_pose(np.array([100, 200, 3, *quaternion(1.0)])), [0.1, 0.2, 1.0])


def test_a_log_that_ends_early_is_refused():
    with pytest.raises(ValueError, match="ends in the middle"):
        parse("\n".join(log(2).splitlines()[:-5]))


def test_a_folder_that_is_no_clone_is_named(tmp_path):
    with pytest.raises(ValueError, match=f"{tmp_path} is no clone"):
        convert(tmp_path)
