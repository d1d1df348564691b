"""Prediction from a checkpoint, as a command and from Python."""

import csv
import json
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from training.helpers import short_fit, tiny_data

import lcplearn
from lcplearn import predict
from lcplearn.datasets import Task
from lcplearn.datasets.cube_slides import COLUMNS
from lcplearn.datasets.inputs import read_inputs
from lcplearn.formulations import Direct, Identified, Physical, Structured
from lcplearn.scenes.planar_body import PlanarBody, rectangle
from lcplearn.training.checkpoint import describe
from lcplearn.training.metrics import evaluate

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


def recorded(data: Task) -> dict[str, np.ndarray]:
    """The test recordings as a file has them."""
    test = data.test
    positions, velocities = data.space.split(test.states)
    arrays = {"positions": positions, "velocities": velocities, "forces": test.drive.force, "steps": test.steps}
    arrays["true_velocities"] = data.space.split(test.truth)[1]
    return {name: value.numpy() for name, value in arrays.items()}


def forces_csv(folder: Path, header: str = "time,force", rows: list[str] | None = None) -> Path:
    path = folder / "forces.csv"
    path.write_text("\n".join([header, *(rows or [f"{k * 0.05},{u}" for k, u in enumerate(FORCES)])]) + "\n")
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
    assert [row["solved"] for row in rows] == ["", *["1"] * len(FORCES)]
    assert picture.stat().st_size > 5000


def test_an_npz_batch_predicts_all_its_trajectories(checkpoint: Path, tmp_path: Path) -> None:
    forces, state = np.array([FORCES, FORCES[::-1]]), np.array([[0.0, 0.0], [1.0, 0.5]])
    np.savez(tmp_path / "in.npz", forces=forces, state=state)
    predict.main([str(checkpoint), "--input", str(tmp_path / "in.npz"), "--output", str(tmp_path / "out.npz")])
    expected = lcplearn.load(checkpoint).rollout(torch.tensor(state), torch.tensor(forces)[..., None])
    with np.load(tmp_path / "out.npz") as found:
        assert np.array_equal(found["velocities"], expected.velocities[..., 0].detach().numpy())
        assert np.array_equal(found["mode"], expected.mode[..., 0].numpy())
        assert found["solved"].all()
    with pytest.raises(SystemExit, match=r"one trajectory, not 2; write \.npz instead"):
        predict.main([str(checkpoint), "--input", str(tmp_path / "in.npz"), "--output", str(tmp_path / "out.csv")])


def test_a_body_is_at_rest_where_it_does_not_move_not_where_one_of_its_contacts_sticks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A rectangle stands on two of its four corners: the others are separate."""
    body = rectangle(0.06, 0.04)
    given = {"mass": 0.4, "inertia": 7e-4, "corners": body.tolist()}
    model = Identified(scene=PlanarBody, dt=0.01, learn={"mu": 0.5}, given=given)
    state = {f"model.{name}": value for name, value in model.state_dict().items()}
    torch.save({"formulation": describe(model), "state_dict": state}, tmp_path / "body.ckpt")
    np.savez(tmp_path / "in.npz", forces=np.zeros((4, 3)), state=[0.0, 0.04, 0.0, 0.0, 0.0, 0.0])
    predict.main([str(tmp_path / "body.ckpt"), "--input", str(tmp_path / "in.npz")])
    assert "at rest after 100% of them" in capsys.readouterr().out


def test_what_is_read_is_not_overwritten(checkpoint: Path, tmp_path: Path) -> None:
    path = forces_csv(tmp_path)
    before = path.read_bytes()
    with pytest.raises(SystemExit, match=r"forces\.csv is what is read: choose another name"):
        predict.main([str(checkpoint), "--input", str(path), "--output", str(tmp_path / "x" / ".." / "forces.csv")])
    with pytest.raises(SystemExit, match=r"best\.ckpt is what is read"):
        predict.main([str(checkpoint), "--score", "any.npz", "--output", str(checkpoint)])
    assert path.read_bytes() == before


def test_a_model_of_measured_friction_asks_for_its_columns(needs_friction: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="needs measured friction: the columns friction_plus and friction_minus"):
        predict.main([str(needs_friction), "--input", str(forces_csv(tmp_path))])
    path = forces_csv(tmp_path, "force,friction_plus,friction_minus", ["1.0,0.0,1.0", "2.0,0.0,2.0"])
    found = predict.predict(lcplearn.load(needs_friction), read_inputs(path))
    assert found.velocities.shape == (3, 1)


def test_scoring_the_test_recordings_gives_the_figures_of_the_run(checkpoint: Path, tmp_path: Path) -> None:
    data = tiny_data()
    arrays = recorded(data)
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
        ("forces", ["1"], "has no column 'force'; it has forces"),
        ("force", ["1.0", "x"], "line 3: force: expected a number, got 'x'"),
        ("force", ["1.0", "nan"], "forces: expected finite numbers"),
        ("force", [""], "forces: expected at least one step"),
        ("force,friction_plus,friction_minus", ["1.0,2.0"], "line 2 has 2 cells, but the header 3"),
        ("force", ["1,5"], "line 2 has 2 cells, but the header 1; decimals have a point, not a comma"),
        ("force;x", ["1;2"], "has no column 'force'; it has force;x"),
        ("time,force", ["0.0,1", '0.05,"1,5"'], "line 3: force: expected a number, got '1,5'; decimals have a point"),
        ("force", ["1", "", "2"], "line 3 is empty, but each line is one time step"),
        ("force,force", ["1,2"], "line 1: there are several columns 'force'"),
        ("force", ["1_000"], "line 2: force: expected a number, got '1_000'"),
        ("time_s,force", ["0,1", "0.01,1"], "has time steps of 0.01 s, but the model was trained for 0.05 s"),
        ("time,force", ["0,1", "0.05,1", "0.2,1"], "time: expected instants at equal steps"),
    ],
)
def test_a_wrong_input_file_gets_one_sentence(
    header: str, rows: list[str] | None, message: str, checkpoint: Path, tmp_path: Path
) -> None:
    with pytest.raises(SystemExit) as error:
        predict.main([str(checkpoint), "--input", str(forces_csv(tmp_path, header, rows))])
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_csv_file_as_spreadsheets_write_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "forces.csv"
    path.write_bytes("\ufeffforce\r\n1.5\r\n".encode())
    assert read_inputs(path).forces.tolist() == [[1.5]]
    path.write_bytes(b"PK\x03\x04\xff\xfe")
    with pytest.raises(ValueError, match="is not a CSV file"):
        read_inputs(path)


@pytest.mark.parametrize(("shape", "steps"), [((3,), (3,)), ((3, 1), (3,)), ((2, 3), (2, 3)), ((2, 3, 1), (2, 3))])
def test_forces_with_a_last_axis_of_one_are_what_rollout_takes(
    shape: tuple[int, ...], steps: tuple[int, ...], tmp_path: Path
) -> None:
    np.savez(tmp_path / "in.npz", forces=np.ones(shape))
    assert read_inputs(tmp_path / "in.npz").forces.shape == (*steps, 1)


def test_an_npz_input_of_another_time_step_is_refused(checkpoint: Path, tmp_path: Path) -> None:
    np.savez(tmp_path / "in.npz", forces=np.ones(3), dt=0.01)
    with pytest.raises(SystemExit, match=r"time steps of 0\.01 s, but the model was trained for 0\.05 s"):
        predict.main([str(checkpoint), "--input", str(tmp_path / "in.npz")])


def test_times_may_be_rounded(tmp_path: Path) -> None:
    model = Physical(dt=1 / 148)
    for digits, fits in ((6, True), (4, False)):
        path = forces_csv(tmp_path, "time,force", [f"{k / 148:.{digits}f},1" for k in range(10)])
        with nullcontext() if fits else pytest.raises(ValueError, match="equal steps"):
            predict.predict(model, read_inputs(path))
    path = forces_csv(tmp_path, "time,force", [f"{k / 150:.6f},1" for k in range(10)])
    with pytest.raises(ValueError, match="but the model was trained for"):
        predict.predict(model, read_inputs(path))


def test_recordings_are_looked_for_where_train_looks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tiny_data()
    np.savez(tmp_path / "mine.npz", dt=data.dt, **recorded(data))
    monkeypatch.setenv("LCPLEARN_DATA", str(tmp_path))
    for name in ("mine.npz", "data/mine.npz"):
        assert len(predict.read_data(name, Structured(dt=data.dt)).test.steps) == len(data.test.steps)
    with pytest.raises(FileNotFoundError, match=r"LCPLEARN_DATA can name its folder"):
        predict.read_data("data/yours.npz", Structured(dt=data.dt))


@pytest.mark.parametrize(
    "changes",
    [
        {"formulation": [1]},
        {"formulation": {}},
        {"formulation": {"class": 7, "arguments": {}}},
        {"state_dict": None},
        {"state_dict": {"model.x": "text"}},
    ],
)
def test_a_checkpoint_of_another_form_gets_one_sentence(
    changes: dict[str, Any], checkpoint: Path, tmp_path: Path
) -> None:
    torch.save(torch.load(checkpoint) | changes, tmp_path / "odd.ckpt")
    with pytest.raises(ValueError, match=r"odd\.ckpt is not a checkpoint of lcplearn\.$"):
        lcplearn.load(tmp_path / "odd.ckpt")


def test_a_truncated_checkpoint_says_so(checkpoint: Path, tmp_path: Path) -> None:
    (tmp_path / "part.ckpt").write_bytes(checkpoint.read_bytes()[:1000])
    with pytest.raises(ValueError, match="it is truncated, another kind of file"):
        lcplearn.load(tmp_path / "part.ckpt")


def test_parameters_that_are_not_finite_are_refused(checkpoint: Path, tmp_path: Path) -> None:
    content = torch.load(checkpoint)
    next(iter(content["state_dict"].values())).fill_(float("nan"))
    torch.save(content, tmp_path / "nan.ckpt")
    with pytest.raises(ValueError, match="is not finite; the training that wrote it had diverged"):
        lcplearn.load(tmp_path / "nan.ckpt")


def test_a_checkpoint_imports_no_module_that_is_not_trusted(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "evil_module.py").write_text("from lcplearn.formulations import Structured\nprint('ran')\n")
    content = torch.load(checkpoint)
    content["formulation"]["class"] = "evil_module.Structured"
    torch.save(content, tmp_path / "evil.ckpt")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match="importing evil_module runs its code"):
        lcplearn.load(tmp_path / "evil.ckpt")
    assert "evil_module" not in sys.modules
    assert isinstance(lcplearn.load(tmp_path / "evil.ckpt", trust=True), Structured)
    assert isinstance(lcplearn.load(tmp_path / "evil.ckpt"), Structured)  # it is loaded already
    del sys.modules["evil_module"]


def test_steps_without_a_solution_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With G = -I and f(v, u) < 0 the LCP 0 <= s, f + G s >= 0 has no solution."""
    saved = {"class": "lcplearn.formulations.line.slack.Slack", "arguments": {"dt": 0.1}}
    state = {"f_weight": torch.zeros(2, 2), "f_bias": -torch.ones(2), "G": -torch.eye(2)}
    state = {f"model.{name}": value.double() for name, value in state.items()}
    torch.save({"formulation": saved, "state_dict": state}, tmp_path / "unsolvable.ckpt")
    (tmp_path / "forces.csv").write_text("force\n1\n2\n")
    out = tmp_path / "motion.csv"
    predict.main([str(tmp_path / "unsolvable.ckpt"), "--input", str(tmp_path / "forces.csv"), "--output", str(out)])
    assert "2 of all steps without a verified solution" in capsys.readouterr().out
    assert [row["solved"] for row in csv.DictReader(out.read_text().splitlines())] == ["", "0", "0"]


def test_a_checkpoint_imports_no_scene_that_is_not_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "evil_scene.py").write_text("from lcplearn.scenes import SlidingBlock\n")
    monkeypatch.syspath_prepend(tmp_path)
    arguments = {"scene": "evil_scene.SlidingBlock", "dt": 0.1, "given": {"mass": 1.0}, "learn": {"mu": 0.5}}
    saved = {"class": "lcplearn.formulations.identified.Identified", "arguments": arguments}
    torch.save({"formulation": saved, "state_dict": {"model.free.mu": torch.zeros(())}}, tmp_path / "evil.ckpt")
    with pytest.raises(ValueError, match="importing evil_scene runs its code"):
        lcplearn.load(tmp_path / "evil.ckpt")
    assert "evil_scene" not in sys.modules
    assert lcplearn.load(tmp_path / "evil.ckpt", trust=True).physical_parameters() == {"mu": 1.0}
    del sys.modules["evil_scene"]


@pytest.mark.parametrize(
    ("name", "state", "velocity"),
    [
        ("baselines.Affine", {"weight": torch.tensor([1.0, 0.5]), "bias": torch.tensor(0.25)}, 1.0 + 0.5 * 0.2 + 0.25),
        ("structured.Physical", {"log_mu": torch.tensor(0.5).log(), "log_mass": torch.tensor(2.0).log()}, 0.61),
    ],
)
def test_checkpoints_of_version_0_1_predict_as_they_did(
    name: str, state: dict[str, torch.Tensor], velocity: float, tmp_path: Path
) -> None:
    """From 1 m/s, under 2 N for 0.1 s; classes stood elsewhere, parameters had other shapes or names."""
    saved = {"class": f"lcplearn.formulations.{name}", "arguments": {"dt": 0.1, "gravity": 9.8}}
    state = {f"model.{key}": value.double() for key, value in state.items()}
    torch.save({"formulation": saved, "state_dict": state}, tmp_path / "old.ckpt")
    start, force = torch.tensor([0.0, 1.0]), torch.tensor([2.0])
    assert lcplearn.load(tmp_path / "old.ckpt").step(start, force)[1].item() == pytest.approx(velocity)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"forces": np.zeros((2, 0))}, "forces: expected at least one step"),
        ({"forces": np.array(["a"])}, "forces: expected numbers, got text"),
        ({"forces": np.array([{}])}, "pickles"),
        ({"state": np.zeros((5, 2))}, r"state: expected shape \[3, 2\] or \[2\], got \[5, 2\]"),
        ({"friction": np.zeros((3, 4))}, r"friction: expected shape \[3, 4, 2\]"),
    ],
)
def test_a_wrong_npz_input_gets_one_sentence(changes: dict[str, np.ndarray], message: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "in.npz", **({"forces": np.zeros((3, 4))} | changes))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=message) as error:
        read_inputs(tmp_path / "in.npz")
    assert "\n" not in str(error.value)


def test_scoring_slides_scores_every_one_of_them(tmp_path: Path) -> None:
    """Two slides of one and two steps that lose no velocity: the model stops mu g dt^2 and 3 mu g dt^2 too early."""
    rows = np.zeros((5, len(COLUMNS)))
    rows[:, COLUMNS.index("s_m")] = [0.0, 0.1, 0.0, 0.1, 0.2]
    rows[:, COLUMNS.index("v_m_s")] = 2.0
    np.savez(tmp_path / "slides.npz", data=rows, offsets=np.array([0, 2, 5]), columns=np.array(COLUMNS), dt=0.05,
             g=9.81, mass_kg=0.37)  # fmt: skip
    model = Physical(dt=0.05, initial_mu=0.1)
    data = predict.read_data(tmp_path / "slides.npz", model)
    assert data.test.steps.tolist() == [1, 2]
    median = (1 + 3) / 2 * 0.1 * 9.81 * 0.05**2 * 1e3
    assert evaluate(model, data)["stop_error_median_mm"] == pytest.approx(median)


def test_files_that_are_no_checkpoint_or_no_data_get_one_sentence(checkpoint: Path, tmp_path: Path) -> None:
    text = forces_csv(tmp_path)
    np.savez(tmp_path / "other.npz", forces=np.zeros((2, 3)), positions=np.zeros((2, 4)), velocities=np.zeros((2, 4)),
             dt=0.1)  # fmt: skip
    np.savez(tmp_path / "short.npz", forces=np.zeros((2, 3)))
    cases = [
        (["nope.ckpt", "--input", str(text)], "There is no checkpoint nope.ckpt"),
        ([str(text), "--input", str(text)], "is not a checkpoint that can be loaded safely"),
        ([str(checkpoint), "--input", "nope.csv"], "There is no input file nope.csv"),
        ([str(checkpoint), "--input", str(checkpoint)], "expected a name that ends in .csv or .npz"),
        ([str(checkpoint), "--score", str(tmp_path / "other.npz")], "has time steps of 0.1 s"),
        ([str(checkpoint), "--score", str(tmp_path / "short.npz")], "positions, velocities, dt missing; got forces"),
        ([str(checkpoint), "--score", str(text)], "expected an NPZ file"),
        ([str(checkpoint), "--score", "nope.npz"], "nope.npz: no such file"),
        (
            [str(checkpoint), "--input", str(text), "--state", "0", "nan"],
            "state: expected finite positions and velocities",
        ),
        ([str(checkpoint), "--input", str(text), "--output", "/proc/none/a.csv"], "^/proc/none: No such file"),
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


@pytest.mark.parametrize(
    ("changed", "reason"),
    [({"arguments": {"dt": 0.05, "mass": 1.0}}, "unexpected keyword argument 'mass'"),
     ({"class": "lcplearn.formulations.relu.ReLU"}, "Missing key"),
     ({"class": "lcplearn.formulations.baselines.MLP", "arguments": {"space": {"positions": ["x"]}}}, "velocities")],
)  # fmt: skip
def test_a_checkpoint_of_a_class_that_has_changed_says_so(
    changed: dict[str, Any], reason: str, checkpoint: Path, tmp_path: Path
) -> None:
    content = torch.load(checkpoint)
    content["formulation"] |= changed
    torch.save(content, tmp_path / "old.ckpt")
    with pytest.raises(ValueError, match=f"was made with another version of .*{reason}") as error:
        lcplearn.load(tmp_path / "old.ckpt")
    assert "\n" not in str(error.value)
