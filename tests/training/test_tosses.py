"""Tosses through training, prediction and pictures, on a few that are simulated."""

import signal
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch
from lightning.pytorch import Callback, Trainer
from torch import Tensor
from training.helpers import QUIET

import lcplearn
from lcplearn.datasets import Recordings, Task
from lcplearn.datasets.cube_tosses import read_tosses
from lcplearn.formulations import Identified, build
from lcplearn.formulations.cube_corners import FACES, CubeCorners, flatten
from lcplearn.formulations.cube_network import CubeNetwork
from lcplearn.scenes.scene import Drive, rollout
from lcplearn.scenes.space import POSE
from lcplearn.scenes.spatial_body import box_corners
from lcplearn.scenes.tossed_cube import TossedCube
from lcplearn.training import Optimizer, TrainingInterrupted, figures, fit, toss_scores
from lcplearn.training.metrics import Predictions

H, M, DT, STEPS = 0.05, 0.4, 1 / 148, 24
KNOWN = {"half_width": H, "mass": M, "gravity": 9.81}
TRUE = {"mu": 0.2, "inertia": 0.8 * M * H**2}


def simulated(count: int = 4) -> Task:
    random = torch.Generator().manual_seed(0)
    start = torch.randn(count, 13, generator=random, dtype=torch.float64)
    start[:, 2] = 2.2 * H
    start[:, 3:7] /= start[:, 3:7].norm(dim=-1, keepdim=True)
    start[:, 10:] *= 5.0
    drive = Drive(torch.zeros(count, STEPS, 6, dtype=torch.float64))
    path = rollout(TossedCube(**KNOWN, **TRUE, dt=DT), start, drive)
    states = torch.cat((path.positions, path.velocities), dim=-1)
    tosses = Recordings(states, drive, torch.tensor([STEPS, *[STEPS - 5] * (count - 1)]))
    return Task(
        name="tosses", space=POSE, dt=DT, train=tosses, validation=tosses, test=tosses, given=KNOWN,
        judged_by=("tosses",), chosen_by="pose",
    )  # fmt: skip


class StopInEpoch(Callback):
    """Send the signal of Ctrl-C at the start of an epoch."""

    def __init__(self, epoch: int) -> None:
        self.epoch = epoch

    def on_train_epoch_start(self, trainer: Trainer, *_: object) -> None:
        if trainer.current_epoch == self.epoch:
            signal.raise_signal(signal.SIGINT)


def train(folder: Path, callbacks: Sequence[Callback] = (), ckpt_path: Path | None = None) -> Tensor:
    """Four epochs in three stages; all parameters at the end. Pictures are drawn where a training is resumed."""
    data = simulated()
    start = {"mu": 0.4, "inertia": 0.6 * M * H**2, "restitution": 0.1}
    model = build(CubeCorners, data, learn=start, noise=0.1, clip=10.0)
    stages = [{"epochs": 1, "horizon": 4, "lr": 0.05, "violation": 1.0, "pose": 0.0}, {"epochs": 2, "horizon": 4}]
    drawing = "lcplearn.training.figures.draw", "lcplearn.training.toss_figures.animation"
    with ExitStack() as stack:
        for name, nothing in zip(drawing, ({}, b""), strict=True) if ckpt_path is None else ():
            stack.enter_context(mock.patch(name, return_value=nothing))
        fit(
            model, data, folder=folder, loss={"pose": 1.0, "violation": 0.5}, horizon=8, stages=stages, epochs=4,
            batch_size=16, batches=2, optimizer=Optimizer(lr=0.02), patience=None, ckpt_path=ckpt_path,
            trainer={**QUIET, "check_val_every_n_epoch": 1, "callbacks": [*callbacks]},
        )  # fmt: skip
    state = torch.load(folder / "last.ckpt")["state_dict"]
    return torch.cat([values.reshape(-1) for values in state.values()])


def test_a_training_in_stages_resumes_as_if_nothing_had_been_and_leaves_its_pictures(tmp_path: Path):
    whole = train(tmp_path / "whole")
    with pytest.raises(TrainingInterrupted) as stopped:  # in the middle of the second stage
        train(tmp_path / "first", [StopInEpoch(1)])
    resumed = train(tmp_path / "second", ckpt_path=stopped.value.checkpoint)
    assert torch.equal(resumed, whole)
    left = {path.name for path in (tmp_path / "second").iterdir()}
    assert {"filmstrip.png", "contact_modes.png", "corners.png", "toss.gif"} <= left
    assert (tmp_path / "second" / "toss.gif").read_bytes().startswith(b"GIF89a")


def test_a_network_is_learned_beside_the_numbers_kept_and_drawn(tmp_path: Path):
    data = simulated()
    model = build(CubeNetwork, data, learn={**TRUE, "restitution": 0.3}, corrects="restitution", clip=10.0)
    assert isinstance(model, CubeNetwork)
    closing = torch.linspace(0.0, 2.0, 5, dtype=torch.float64)
    torch.testing.assert_close(model.law(closing), torch.full((5,), 0.3, dtype=torch.float64))
    with mock.patch("lcplearn.training.toss_figures.animation", return_value=b""):
        fit(
            model, data, folder=tmp_path, loss={"pose": 1.0}, horizon=8, epochs=2, batch_size=16, batches=2,
            optimizer=Optimizer(lr=0.02), patience=None, trainer=QUIET,
        )  # fmt: skip
    law = model.law(closing)
    assert float((law - law[0]).abs().max()) > 1e-5
    loaded = lcplearn.load(tmp_path / "best.ckpt")
    assert isinstance(loaded, CubeNetwork)
    assert torch.equal(loaded.law(closing), law)
    assert loaded.physical_parameters().keys() == {"mu", "inertia", "restitution"}
    assert (tmp_path / "law.png").is_file()


def test_how_fast_a_cube_is_is_called_a_speed():
    data = simulated()
    drawn = figures.rollouts(Predictions(build(Identified, data, scene=TossedCube, learn=TRUE), data), count=2)
    assert [ax.get_ylabel() for ax in drawn.axes] == ["speed [m/s]"] * 2


def test_a_law_of_friction_goes_from_sliding_to_impacts():
    learn = {**TRUE, "mu_impact": 0.1}
    model = CubeNetwork(dt=DT, given=KNOWN, learn=learn)
    closing = torch.tensor([0.0, 5.0 * H, 10.0 * H, 20.0 * H], dtype=torch.float64)
    torch.testing.assert_close(model.law(closing), torch.tensor([0.2, 0.15, 0.1, 0.1], dtype=torch.float64))
    one = CubeNetwork(dt=DT, given=KNOWN, learn=TRUE)
    torch.testing.assert_close(one.law(closing), torch.full((4,), 0.2, dtype=torch.float64))
    for wrong, message in (({"units": 0}, "^units: expected"), ({"corrects": "mass"}, "^corrects: expected one of")):
        with pytest.raises(ValueError, match=message):
            CubeNetwork(**{"dt": DT, "given": KNOWN, "learn": TRUE, **wrong})


@pytest.mark.parametrize("flat", [True, False])
def test_corners_start_around_the_cube_and_faces_are_flat(flat: bool):
    data = simulated(1)
    corners = build(CubeCorners, data, learn={**TRUE}, noise=0.1, flat=flat).numbers()["corners"].detach()
    cube = box_corners(torch.full((3,), H, dtype=torch.float64))
    assert 0.05 * H < float((corners - cube).square().mean().sqrt()) < 0.15 * H
    volumes = [torch.linalg.det(corners[face[1:]] - corners[face[0]]).abs() for face in FACES]
    assert (max(map(float, volumes)) < 1e-12 * H**3) == flat


def test_flattening_leaves_a_flat_body_alone_at_any_size():
    box = box_corners(torch.tensor([0.05, 0.03, 0.08], dtype=torch.float64)) + 0.01
    torch.testing.assert_close(flatten(torch.stack((box, 7.0 * box))), torch.stack((box, 7.0 * box)))


def test_a_prediction_sees_row_0_of_each_toss_and_nothing_else(tmp_path: Path):
    random = np.random.default_rng(0)
    state = random.standard_normal((9, 13))
    state[:, 2] += 4.0
    state[:, 3:7] /= np.linalg.norm(state[:, 3:7], axis=1, keepdims=True)
    other = random.standard_normal((9, 13))
    other[[0, 4]] = state[[0, 4]]
    model = Identified(scene=TossedCube, dt=DT, given=KNOWN, learn=TRUE)
    predicted = []
    for name, rows in (("one", state), ("other", other)):
        constants = {"half_width_m": H, "dt": DT, "mass_kg": M, "g_scaled": 9.81 / H}
        np.savez(tmp_path / f"{name}.npz", state=rows, offsets=np.array([0, 4, 9]), **constants)
        tosses = toss_scores.read_for(tmp_path / f"{name}.npz", model)
        toss_scores.write_tosses(tmp_path / f"{name}_out.npz", toss_scores.predict_tosses(model, tosses), tosses)
        predicted.append(np.load(tmp_path / f"{name}_out.npz"))
    assert read_tosses(tmp_path / "one.npz").steps.tolist() == [3, 4]
    for key in ("state", "offsets"):
        np.testing.assert_array_equal(predicted[0][key], predicted[1][key])
    np.testing.assert_allclose(predicted[0]["state"][[0, 4]], state[[0, 4]], rtol=1e-14)
