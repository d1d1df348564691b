"""`benchmark tosses`: the simulator that learned bodies are compared with, and what is said of each system."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from lcplearn.benchmark.tosses.mujoco_cube import MujocoCube
from lcplearn.benchmark.tosses.run import _roll, figures
from lcplearn.benchmark.tosses.starts import denoised
from lcplearn.datasets.cube_tosses import Tosses
from lcplearn.scenes.scene import rollout
from lcplearn.scenes.tossed_cube import TossedCube

H, M, DT = 0.05, 0.4, 1 / 148
INERTIA = 0.797 * M * H**2
SCENE = TossedCube(half_width=H, mass=M, inertia=INERTIA, mu=0.2, dt=DT)


def tosses(height: float, steps: int) -> Tosses:
    random = torch.Generator().manual_seed(0)
    start = torch.randn(3, 13, generator=random, dtype=torch.float64)
    start[:, 2] = height * H
    start[:, 3:7] /= start[:, 3:7].norm(dim=-1, keepdim=True)
    states, _ = _roll(partial(rollout, SCENE), start, steps)
    return Tosses(states, torch.tensor([steps, steps - 2, steps]), (0, 1, 2), DT, H, 9.81, M, INERTIA, 0.2, 0.0)


@pytest.mark.parametrize("radius", [None, 0.2])
def test_flight_in_mujoco_is_ours(radius: float | None):
    """Four substeps each, and velocities that are means over a step: both must end on the recorded convention."""
    pytest.importorskip("mujoco")
    ours = tosses(40.0, 30)
    found = MujocoCube(radius=radius).rollout(ours, ours.states[:, 0], 30)
    torch.testing.assert_close(found[..., :3], ours.states[..., :3], rtol=0, atol=1e-6)
    torch.testing.assert_close(found[..., 7:], ours.states[..., 7:], rtol=0, atol=1e-6)
    along = (found[..., 3:7] * ours.states[..., 3:7]).sum(-1).abs()
    assert float((1.0 - along).max()) < 1e-6


def test_a_cube_of_mujoco_comes_to_lie_on_the_board():
    pytest.importorskip("mujoco")
    ours = tosses(3.0, 300)
    end = MujocoCube(radius=0.2, ground=0.0).rollout(ours, ours.states[:, 0], 300)[:, -1]
    np.testing.assert_allclose(end[:, 2], H, atol=1e-3)
    assert float(end[:, 7:10].norm(dim=-1).max()) < 0.01


def test_denoised_starts_are_the_starts_of_a_flight_without_noise_and_nearer_to_them_with_it():
    true = tosses(40.0, 30)
    torch.testing.assert_close(denoised(true).states, true.states, rtol=0, atol=1e-9)
    noisy = true.states.clone()
    noisy[..., 7:] += 0.1 * torch.randn(noisy[..., 7:].shape, generator=torch.Generator().manual_seed(1))
    found = denoised(replace(true, states=noisy)).states
    assert torch.equal(found[:, 1:], noisy[:, 1:])
    left, before = ((x - true.states)[:, 0, 7:].norm() for x in (found, noisy))
    assert float(left) < 0.4 * float(before)  # of 29 and 31 rows: 0.18


def test_who_predicts_right_has_no_error_and_who_does_not_is_said_to_have_more():
    ours = tosses(3.0, 60)
    row, right = figures(ours, [0, 1, 2], partial(_roll, partial(rollout, SCENE)), None)
    assert row["position"] == row["unsolved"] == 0.0
    assert float(row["rotation"]) < 1e-12
    slippery = TossedCube(half_width=H, mass=M, inertia=INERTIA, mu=0.05, dt=DT)
    row, _ = figures(ours, [0, 1, 2], partial(_roll, partial(rollout, slippery)), right)
    assert row["more_position"] == row["position"]
    assert float(row["position"]) > 0.1
    assert row["more_position_low"] <= row["more_position"] <= row["more_position_high"]
