"""Small files of pushes, drawn by hand: for tests that need no real data."""

from pathlib import Path
from typing import Any

import numpy as np

from lcplearn.datasets.pushes import PushData


def push_arrays(count: int = 12, seed: int = 0) -> dict[str, np.ndarray]:
    """Arrays in the format of planar_pushes.npz: pushes against the left edge, with outcomes that mean nothing."""
    rng = np.random.default_rng(seed)
    rows = rng.integers(20, 40, count)
    pose = np.column_stack([rng.uniform(0.3, 0.6, (count, 2)), rng.uniform(-3.0, 3.0, count)])
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    turn = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], 1)
    height = rng.uniform(0.02, 0.1, count)
    paths, forces = [], []
    for k in range(count):
        along = np.linspace(-0.003, 0.012, rows[k])
        body = np.column_stack([along, np.full(rows[k], height[k])])
        time = np.linspace(0.0, 6.0, rows[k])
        paths.append(np.column_stack([time, pose[k, :2] + body @ turn[k].T]))
        forces.append(np.column_stack([time, 3.0 * turn[k, 0, 0] + 0 * time, 3.0 * turn[k, 1, 0] + 0 * time]))
    offsets = np.concatenate([[0], np.cumsum(rows)]).astype(np.int64)
    points = np.array([[[0.01, 0.13], [0.01, 0.01], [0.13, 0.01]], np.full((3, 2), np.nan)])
    post = pose + np.column_stack([0.01 * c, 0.01 * s, rng.uniform(-0.1, 0.1, count)])
    return {
        "config": rng.permuted(np.arange(count) % 2).astype(np.int16),
        "source_push": np.arange(count),
        "pre_pose": pose,
        "post_pose": post,
        "pusher": np.concatenate(paths).astype(np.float32),
        "pusher_offsets": offsets,
        "force": np.concatenate(forces).astype(np.float32),
        "force_offsets": offsets,
        "config_name": np.array(["feet/a.txt", "face/b.txt"]),
        "config_surface": np.array(["board", "wood"]),
        "config_support_points": points,
        "object_vertices": np.array([[0.0, 0.0], [0.15, 0.0], [0.0, 0.15]]),
        "object_com": np.array([0.05, 0.05]),
        "object_mass": np.float64(1.5),
    }


def push_file(folder: Path, count: int) -> Path:
    """A file of so many pushes."""
    path = folder / "pushes.npz"
    np.savez(path, **push_arrays(count))
    return path


def thing(data: PushData) -> dict[str, Any]:
    """The object that was pushed: what every model of pushes is built from."""
    return {"vertices": data.vertices.tolist(), "com": data.com.tolist(), "mass": data.mass}
