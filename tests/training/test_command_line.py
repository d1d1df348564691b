"""What train.py does around Hydra: folders, names and mistakes, without training."""

import subprocess
import sys
from pathlib import Path

import pytest
from hydra.errors import HydraException
from training.helpers import ROOT

from lcplearn.command_line import _new, prepare, settle
from lcplearn.training.settings import SettingsError

CONF = ROOT / "conf"


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("arguments", ["modle=relu", "data.dt=-1", "-m seed=0,1 threads=1,0", "-m model=affine,mpl"])
def test_a_mistake_in_any_run_makes_no_folder(arguments: str) -> None:
    with pytest.raises((SettingsError, HydraException)):
        prepare(arguments.split(), CONF)
    assert not list(Path().iterdir())


@pytest.mark.parametrize("arguments", ["model=relu", "-m model=relu,mlp"])
def test_commands_of_the_same_second_get_folders_of_their_own(arguments: str) -> None:
    first, *others = [prepare([*arguments.split()], CONF) for _ in range(3)]
    folders = {first.folder, *(other.folder for other in others)}
    assert len(folders) == 3
    assert all(folder is not None and folder.is_dir() for folder in folders)
    assert f'="{first.folder}"' in first.arguments[-1]


def test_a_taken_name_is_counted_on() -> None:
    assert [_new(Path("runs/a"), "").name for _ in range(3)] == ["a", "a_2", "a_3"]
    Path("file").touch()
    with pytest.raises((SettingsError, OSError)):
        _new(Path("file/a"), "hydra.run.dir")


def test_runs_of_a_sweep_are_named_by_what_differs() -> None:
    command = prepare(["-m", "model=affine,mlp", "seed=0,1", "data.noise=0.01"], CONF)
    assert "hydra.job.config.override_dirname.exclude_keys=[data.noise]" in command.arguments
    assert "hydra.sweep.subdir='${hydra.job.num}_${hydra.job.override_dirname}'" in command.arguments


def test_what_the_user_names_stays() -> None:
    command = prepare(["hydra.run.dir=here"], CONF)
    assert command == (["hydra.run.dir=here"], None)
    assert prepare(["--cfg", "job"], CONF) == (["--cfg", "job"], None)
    assert not list(Path().iterdir())


def test_a_checkpoint_in_a_folder_of_a_sweep_needs_no_quotes(tmp_path: Path) -> None:
    path = tmp_path / "3_model=relu" / "last.ckpt"
    path.parent.mkdir()
    path.touch()
    assert prepare([f"ckpt_path={path}", "hydra.run.dir=x"], CONF).arguments[0] == f'ckpt_path="{path}"'


def test_a_folder_without_a_run_goes_and_latest_is_the_last_with_one() -> None:
    folders = [prepare([], CONF).folder for _ in range(3)]
    for folder in folders:
        assert folder is not None
        (folder / ".hydra").mkdir()
        (folder / ".hydra" / "config.yaml").touch()
    first, second, third = folders
    for folder in (first, second):
        assert folder is not None
        (folder / "0").mkdir()
        (folder / "0" / "last.ckpt").write_text(folder.name)
        (folder / "0" / "tensorboard").mkdir()
        (folder / "0" / "tensorboard" / "events").touch()
        settle(folder)
    settle(third)
    assert third is not None
    assert not third.exists()
    assert second is not None
    assert Path("runs/latest/0/last.ckpt").read_text() == second.name
    assert [path.name for path in Path("runs/latest").rglob("*") if not path.is_dir()] == ["last.ckpt"]  # no events
    Path("runs/latest/mine").touch()
    settle(first)
    assert Path("runs/latest/mine").is_file()


def test_a_disk_without_links_takes_no_run_down(monkeypatch: pytest.MonkeyPatch) -> None:
    folder = prepare([], CONF).folder
    assert folder is not None
    (folder / "last.ckpt").touch()

    def refuse(*arguments: object) -> None:
        raise OSError("links are not supported")

    monkeypatch.setattr(Path, "symlink_to", refuse)
    settle(folder)
    assert (folder / "last.ckpt").is_file()


def test_nothing_here_imports_torch() -> None:
    code = "import sys, lcplearn.command_line; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0
