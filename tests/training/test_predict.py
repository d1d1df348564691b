"""Prediction from a checkpoint, as a command and from Python."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from training.helpers import short_fit, tiny_data

import lcplearn
from lcplearn import predict
from lcplearn.formulations import Direct, Structured

FORCES = [0.0, 3.0, 12.0, -9.0, -9.0, 0.5, 0.0]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("structured")
    data = tiny_data()
    short_fit(Structured(dt=data.dt), data, folder, epochs=1)
    return folder / "best.ckpt"


@pytest.fixture(scope="module")
def needs_friction(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("direct")
    data = tiny_data(friction="physical")
    short_fit(Direct(dt=data.dt), data, folder, epochs=1)
    return folder / "best.ckpt"


def forces_csv(folder: Path, header: str = "time,force", rows: list[str] | None = None) -> Path:
    path = folder / "forces.csv"
    path.write_text("\n".join([header, *(rows or [f"{k},{u}" for k, u in enumerate(FORCES)])]) + "\n")
    return path


def test_a_csv_prediction_equals_the_rollout(checkpoint: Path, tmp_path: Path) -> None:
    out, picture = tmp_path / "motion.csv", tmp_path / "motion.png"
    predict.main([str(checkpoint), "--input", str(forces_csv(tmp_path)), "--output", str(out), "--plot", str(picture),
                  "--state", "1.0", "-0.2"])  # fmt: skip
    with out.open() as file:
        rows = list(csv.DictReader(file))
    model = lcplearn.load(checkpoint)
    state, forces = torch.tensor([1.0, -0.2], dtype=torch.float64), torch.tensor(FORCES, dtype=torch.float64)[:, None]
    expected = model.rollout(state, forces)
    assert [float(row["velocity_m_s"]) for row in rows] == expected.velocities[:, 0].tolist()
    assert [float(row["position_m"]) for row in rows] == expected.positions[:, 0].tolist()
    assert [float(row["time_s"]) for row in rows] == pytest.approx([k * model.dt for k in range(len(FORCES) + 1)])
    assert rows[0]["mode"] == ""
    assert {row["mode"] for row in rows[1:]} <= {"stick", "slip"}
    assert picture.stat().st_size > 5000


def test_an_npz_batch_predicts_all_its_trajectories(checkpoint: Path, tmp_path: Path) -> None:
    forces, state = np.array([FORCES, FORCES[::-1]]), np.array([[0.0, 0.0], [1.0, 0.5]])
    np.savez(tmp_path / "in.npz", forces=forces, state=state)
    predict.main([str(checkpoint), "--input", str(tmp_path / "in.npz"), "--output", str(tmp_path / "out.npz")])
    expected = lcplearn.load(checkpoint).rollout(torch.tensor(state), torch.tensor(forces)[..., None])
    with np.load(tmp_path / "out.npz") as found:
        assert np.array_equal(found["velocities"], expected.velocities[..., 0].detach().numpy())
        assert np.array_equal(found["mode"], expected.mode[..., 0].numpy())
    with pytest.raises(SystemExit, match=r"one trajectory, not 2; write \.npz instead"):
        predict.main([str(checkpoint), "--input", str(tmp_path / "in.npz"), "--output", str(tmp_path / "out.csv")])


def test_a_model_of_measured_friction_asks_for_its_columns(needs_friction: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="needs measured friction: the columns friction_plus and friction_minus"):
        predict.main([str(needs_friction), "--input", str(forces_csv(tmp_path))])
    path = forces_csv(tmp_path, "force,friction_plus,friction_minus", ["1.0,0.0,1.0", "2.0,0.0,2.0"])
    found = predict.predict(lcplearn.load(needs_friction), predict.read_inputs(path))
    assert found.velocities.shape == (3, 1)


def test_scoring_the_test_recordings_gives_the_figures_of_the_run(checkpoint: Path, tmp_path: Path) -> None:
    data = tiny_data()
    arrays = {name: value for name, value in data.test._asdict().items() if value is not None}
    np.savez(tmp_path / "data.npz", dt=data.dt, mu=0.4, mass=1.5, **arrays)
    predict.main([str(checkpoint), "--score", str(tmp_path / "data.npz"), "--output", str(tmp_path / "score.json")])
    score = json.loads((tmp_path / "score.json").read_text())
    run = json.loads((checkpoint.parent / "metrics.json").read_text())
    for key in ("velocity_rmse", "stick_accuracy", "false_stick", "mu_error", "mass_error", "parameters"):
        assert score[key] == run[key]


@pytest.mark.parametrize(
    ("header", "rows", "message"),
    [
        ("time,Force", None, "has no column 'force'; it has time, Force"),
        ("force", ["1.0", "x"], "line 3: force must be a number, got 'x'"),
        ("force", ["1.0", "nan"], "forces must be finite numbers"),
        ("force", [""], "forces must have at least one step"),
    ],
)
def test_a_wrong_input_file_gets_one_sentence(
    header: str, rows: list[str] | None, message: str, checkpoint: Path, tmp_path: Path
) -> None:
    with pytest.raises(SystemExit) as error:
        predict.main([str(checkpoint), "--input", str(forces_csv(tmp_path, header, rows))])
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_files_that_are_no_checkpoint_or_no_data_get_one_sentence(checkpoint: Path, tmp_path: Path) -> None:
    text = forces_csv(tmp_path)
    np.savez(tmp_path / "other.npz", forces=np.zeros((2, 3)), positions=np.zeros((2, 4)), velocities=np.zeros((2, 4)),
             dt=0.1)  # fmt: skip
    np.savez(tmp_path / "short.npz", forces=np.zeros((2, 3)))
    cases = [
        (["nope.ckpt", "--input", str(text)], "There is no checkpoint nope.ckpt"),
        ([str(text), "--input", str(text)], "is not a checkpoint that can be loaded safely"),
        ([str(checkpoint), "--input", "nope.csv"], "There is no input file nope.csv"),
        ([str(checkpoint), "--input", str(checkpoint)], "must end in .csv or .npz"),
        ([str(checkpoint), "--score", str(tmp_path / "other.npz")], "has time steps of 0.1 s"),
        ([str(checkpoint), "--score", str(tmp_path / "short.npz")], "lacks dt, positions, velocities"),
    ]
    for arguments, message in cases:
        with pytest.raises(SystemExit, match=message):
            predict.main(arguments)


def test_a_checkpoint_that_names_another_class_is_not_built(checkpoint: Path, tmp_path: Path) -> None:
    content = torch.load(checkpoint)
    content["formulation"]["class"] = "pathlib.Path"
    torch.save(content, tmp_path / "odd.ckpt")
    with pytest.raises(ValueError, match="not a Formulation"):
        lcplearn.load(tmp_path / "odd.ckpt")
