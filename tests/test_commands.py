"""The installed command, without the repository around it."""

import shutil
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest

from lcplearn.__main__ import COMMANDS

ROOT = Path(__file__).parents[1]


def lcplearn(folder: Path, *arguments: str, package: Path = ROOT) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "lcplearn", *arguments]
    environment = {"PYTHONPATH": str(package), "PATH": ""}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)


def test_each_command_is_there_and_help_names_it(tmp_path):
    shown = lcplearn(tmp_path).stdout
    for name, (module, _) in COMMANDS.items():
        assert find_spec(module) is not None
        assert f"lcplearn {name} " in shown


def test_an_unknown_command_ends_in_one_sentence(tmp_path):
    done = lcplearn(tmp_path, "trian")
    assert done.returncode == 1
    assert done.stderr.startswith("lcplearn: expected a command (train, ")
    assert done.stderr.count("\n") == 1


@pytest.mark.slow
def test_the_package_as_a_wheel_lays_it_out_finds_its_configuration(tmp_path):
    """What pyproject puts into the wheel, unpacked far from the repository."""
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    for package in wheel["packages"]:
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / package, tmp_path / "site" / package, ignore=ignored)
    for source, target in wheel["force-include"].items():
        shutil.copytree(ROOT / source, tmp_path / "site" / target)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    shown = lcplearn(elsewhere, "train", "model=relu", "--cfg", "job", package=tmp_path / "site")
    assert ".ReLU\n" in shown.stdout, shown.stderr
    wrong = lcplearn(elsewhere, "train", "modle=relu", package=tmp_path / "site")
    assert wrong.stderr.strip() == "Unknown setting 'modle'; did you mean 'model'?"
    assert not list(elsewhere.iterdir())
