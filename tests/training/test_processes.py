"""Several runs at a time (joblib) and several processes in a run (torchrun), as a user starts them."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from training.helpers import ROOT, SMALL, environment, short_fit, train

import lcplearn
from lcplearn.datasets import Task, simulate_sliding_block
from lcplearn.formulations import Physical
from lcplearn.training import Optimizer

pytestmark = pytest.mark.slow

SHORT = ["trainer.max_epochs=3", "optimizer.lbfgs_after=2", *SMALL]
TWO = ["trainer.strategy=ddp", "trainer.devices=2"]


@pytest.fixture(scope="module")
def data() -> Task:
    return simulate_sliding_block(trajectories=4, length=30, long_length=20)


@pytest.fixture(scope="module")
def error(data: Task, tmp_path_factory: pytest.TempPathFactory) -> float | None:
    """Of one process that trains alone."""
    folder = tmp_path_factory.mktemp("alone") / "run"
    result = short_fit(Physical(dt=data.dt), data, folder, epochs=3, optimizer=Optimizer(lbfgs_after=2))
    assert result.metrics is not None
    return result.metrics["velocity_rmse"]


def noise(text: str) -> list[str]:
    return [line for line in text.splitlines() if line and "epoch" not in line]


def test_runs_side_by_side_train_as_one_by_one_end_with_the_comparison_and_resume(
    tmp_path: Path, data: Task, error: float | None
) -> None:
    done = train(tmp_path, "-m", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "model=affine,physical", *SHORT)
    assert done.returncode == 0, done.stderr
    assert not noise(done.stderr)
    (folder,) = (tmp_path / "runs").glob("*_sweep")
    runs = ["0_model=affine", "1_model=physical"]
    assert {path.name for path in folder.iterdir()} == {*runs, "compare.md", "compare.png", "multirun.yaml"}
    table = (folder / "compare.md").read_text()
    assert table in done.stdout
    assert table.count("Affine") == table.count("Physical") == 1
    figures = json.loads((folder / runs[1] / "metrics.json").read_text())
    assert figures["velocity_rmse"] == pytest.approx(error, rel=1e-6)
    last = folder / runs[1] / "last.ckpt"
    more = {"epochs": 5, "optimizer": Optimizer(lbfgs_after=2), "ckpt_path": last}
    resumed = short_fit(lcplearn.load(last).train(), data, tmp_path / "resumed", **more)
    assert resumed.metrics is not None
    assert (resumed.metrics["velocity_rmse"] or 0.0) < figures["velocity_rmse"]


def test_ctrl_c_ends_runs_side_by_side_without_a_traceback(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "train.py"), "-m", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2",
               "seed=0,1", "trainer.max_epochs=50000", "optimizer=adam", "patience=null", *SMALL]  # fmt: skip
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in a background job and its children
    process = subprocess.Popen(
        command, cwd=tmp_path, env=environment(PYTHONUNBUFFERED="1"), text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    signal.signal(signal.SIGINT, before)
    assert process.stdout is not None
    while "#1 : seed=1" not in (line := process.stdout.readline()):
        assert line, "ended before it launched its runs"
    process.send_signal(signal.SIGINT)
    errors = process.communicate(timeout=300)[1]
    assert process.returncode == 1
    assert "Stopped." in errors.splitlines()
    assert "Traceback" not in errors


def test_processes_of_torchrun_train_as_one_would_and_write_one_run(tmp_path: Path, error: float | None) -> None:
    launcher = ("-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2")
    done = train(tmp_path, "hydra.run.dir=runs/pair", "model=physical", *TWO, *SHORT, launcher=launcher)
    assert done.returncode == 0, done.stderr
    assert not noise(done.stderr)
    assert done.stdout.count("run folder: runs/pair") == done.stdout.count("velocity_rmse") == 1
    (folder,) = (tmp_path / "runs").iterdir()
    names = {path.name for path in folder.iterdir() if path.suffix != ".png"}
    assert names == {".hydra", "config.yaml", "best.ckpt", "last.ckpt", "metrics.json", "tensorboard"}
    figures = json.loads((folder / "metrics.json").read_text())
    assert figures["velocity_rmse"] == pytest.approx(error, rel=1e-6)
