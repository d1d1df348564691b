"""train.py as a user runs it; each call pays the imports, so there are few."""

import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from training.helpers import ROOT, SMALL, environment, short_fit, train

from lcplearn.datasets import simulate_sliding_block
from lcplearn.formulations import Physical
from lcplearn.training import Optimizer

pytestmark = pytest.mark.slow


def test_a_mistyped_setting_ends_in_one_sentence_without_torch(tmp_path: Path) -> None:
    code = "import runpy, sys; sys.argv = ['train.py', 'modle=relu']\ntry: runpy.run_path(%r, run_name='__main__')\n"
    code += "finally: print('torch' in sys.modules)"
    command = [sys.executable, "-c", code % str(ROOT / "train.py")]
    done = subprocess.run(command, cwd=tmp_path, env=environment(), capture_output=True, text=True, timeout=300)
    assert done.returncode == 1
    assert done.stderr.strip() == "Unknown setting 'modle'; did you mean 'model'?"
    assert done.stdout.strip() == "False"
    assert not (tmp_path / "runs").exists()


def test_a_sweep_over_two_processes_each_trains_as_one_would_and_ends_with_the_comparison(tmp_path: Path) -> None:
    done = train(tmp_path, "-m", "model=affine,physical", "trainer.max_epochs=3", "optimizer.lbfgs_after=2",
                 "trainer.strategy=ddp_fork", "trainer.devices=2", *SMALL)  # fmt: skip
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "runs").glob("*_sweep")
    runs = ["0_model=affine", "1_model=physical"]
    assert {path.name for path in folder.iterdir()} >= {*runs, "compare.md", "compare.png"}
    for run, model in zip(runs, ("Affine", "Physical"), strict=True):
        assert len(list((folder / run).glob("metrics.json"))) == 1
        config = yaml.safe_load((folder / run / "config.yaml").read_text())
        assert config["model"]["_target_"].endswith(model)
        assert model in (folder / "compare.md").read_text()
    data = simulate_sliding_block(trajectories=4, length=30, long_length=20)
    alone = short_fit(Physical(dt=data.dt), data, tmp_path / "alone", epochs=3, optimizer=Optimizer(lbfgs_after=2))
    together = json.loads((folder / runs[1] / "metrics.json").read_text())
    assert alone.metrics is not None
    assert together["velocity_rmse"] == pytest.approx(alone.metrics["velocity_rmse"], rel=1e-6)
    noise = [line for line in done.stderr.splitlines() if line and "epoch" not in line]
    assert not noise, noise  # no adverts and no warnings


@pytest.mark.parametrize("processes", [[], ["trainer.strategy=ddp_fork", "trainer.devices=2"]])
def test_ctrl_c_leaves_a_checkpoint_and_the_command_that_goes_on(processes: list[str], tmp_path: Path) -> None:
    command = [sys.executable, "-u", str(ROOT / "train.py"), "model=physical", "trainer.max_epochs=5000",
               "optimizer=adam", "patience=null", *processes, *SMALL]  # fmt: skip
    process = subprocess.Popen(command, cwd=tmp_path, env=environment(), stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    while "val/rollout_rmse" not in process.stderr.read(80):
        assert process.poll() is None
    process.send_signal(signal.SIGINT)
    errors = process.communicate(timeout=300)[1]
    assert process.returncode == 1
    hint = re.search(r"Stopped; to go on: python train.py (.* ckpt_path=\S+last.ckpt)", errors)
    assert hint is not None, errors
    assert (tmp_path / hint[1].rpartition("ckpt_path=")[2]).is_file()


def test_a_run_says_what_it_does_and_where_it_put_it(tmp_path: Path) -> None:
    done = train(tmp_path, "trainer.max_epochs=3", "optimizer.lbfgs_after=2", *SMALL)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("Structured: 5 parameters (float64); sliding_block: 120 training steps; 1 thread")
    folder = tmp_path / re.findall(r"run folder: (\S+)", done.stdout)[0]
    metrics = json.loads((folder / "metrics.json").read_text())
    assert re.search(r"velocity_rmse\s+" + re.escape(f"{metrics['velocity_rmse']:.4g}"), done.stdout)
    assert (folder / ".hydra" / "overrides.yaml").is_file()
    assert list((folder / "tensorboard").glob("events*"))


def test_a_run_of_a_sweep_that_diverges_leaves_an_empty_row_and_the_sweep_goes_on(tmp_path: Path) -> None:
    done = train(
        tmp_path, "-m", "optimizer=adam", "optimizer.lr=1e200,0.05", "model=mlp", "trainer.max_epochs=3", *SMALL
    )
    assert done.returncode == 0, done.stderr
    assert (
        "Training diverged in epoch 1: the error on the validation data is not finite; lower optimizer.lr"
        in done.stdout
    )
    rows = (tmp_path / "runs" / "latest" / "compare.md").read_text().splitlines()[2:]
    assert [row.split("|")[3].strip() for row in rows] == ["0 of 1", "1 of 1"]
    assert not rows[1].split("|")[4].strip()
