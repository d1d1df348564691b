"""Each script in examples/ runs and shows what it says, in quick form; so does the notebook."""

import importlib.util
import json
import runpy
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest
from hydra.errors import HydraException
from real_data import real_data

from lcplearn.command_line import own_folders, prepare
from lcplearn.lcp import methods, solve
from lcplearn.train import CONF
from lcplearn.training.settings import SettingsError
from lcplearn.training.vocabulary import explain

EXAMPLES = Path(__file__).parents[2] / "examples"


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def extending(monkeypatch):
    """examples/ as the folder where somebody works."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.chdir(EXAMPLES)


def test_each_example_has_a_test_here():
    tests = {name.removeprefix("test_") for name in globals() if name.startswith("test_")}
    assert {path.stem for path in EXAMPLES.glob("*.py")} <= tests


def test_layer_in_a_network():
    assert example("layer_in_a_network").main(steps=60) > 0.9


def test_sliding_block():
    structured, network = example("sliding_block").main(epochs=4)
    assert structured == 0
    assert network > 0


def test_own_recording():
    learned = example("own_recording").main(epochs=60)
    assert learned["mu"] == pytest.approx(0.4, abs=2e-3)
    assert learned["mass"] == pytest.approx(1.5, abs=1e-2)


@pytest.mark.parametrize(
    ("name", "arguments", "said"),
    [
        ("own_recording", ["."], "expected at least 4 CSV files, one a recording, got 0"),
        ("tosses", [], "no such file"),
        ("pushes", [], "no such file"),
    ],
)
def test_what_is_missing_is_said_in_a_sentence(name, arguments, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LCPLEARN_DATA", str(tmp_path))
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    with pytest.raises(SystemExit, match=said):
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")


def test_stick_slip_controller():
    before, after = example("stick_slip_controller").main(iterations=12)
    assert after < 0.7 * before


def test_tossed_box(tmp_path):
    module = example("tossed_box")
    assert 0.5 < module.main() < 1.5
    module.draw(*module.toss(10), tmp_path / "box.gif", hold=1)
    assert (tmp_path / "box.gif").read_bytes().startswith(b"GIF89a")


def test_tosses():
    real_data("cube_tosses.npz")
    assert example("tosses").main(count=10) < 0.4


def test_pushes():
    real_data("planar_pushes.npz")
    assert example("pushes").main(count=5) < 2e-3


def test_notebook(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    notebook = json.loads((EXAMPLES / "first_steps.ipynb").read_text())
    scope: dict[str, object] = {"__name__": "notebook"}
    for number, cell in enumerate(notebook["cells"]):
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"first_steps.ipynb, cell {number}", "exec"), scope)


@pytest.mark.usefixtures("extending")
def test_a_scene_of_ones_own():
    assert import_module("extending.scene").main() == 0


@pytest.mark.usefixtures("extending")
def test_a_data_set_of_ones_own():
    assert import_module("extending.data_set").main() == 10


@pytest.mark.usefixtures("extending")
def test_a_formulation_of_ones_own():
    assert import_module("extending.formulation").main(epochs=30) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.usefixtures("extending")
def test_a_loss_of_ones_own():
    off = import_module("extending.loss").main(epochs=30)
    assert off["huber"] < 0.5 * off["prediction"]


@pytest.mark.usefixtures("extending")
def test_a_solver_method_of_ones_own(monkeypatch):
    monkeypatch.setattr(methods, "TORCH_METHODS", dict(methods.TORCH_METHODS))
    monkeypatch.setattr(solve, "TORCH_METHODS", methods.TORCH_METHODS)
    symmetric, others = import_module("extending.solver_method").main()
    assert symmetric == 1
    assert others < 1


@pytest.mark.usefixtures("extending")
def test_own_configuration_is_found_and_checked(tmp_path):
    own = ["--config-dir", "extending/conf", "data=ramp", "model=clipped", "loss=huber", f"hydra.run.dir={tmp_path}"]
    arguments = prepare(own, CONF).arguments
    assert arguments[-1] == f"hydra.searchpath=['file://{EXAMPLES}/extending/conf']"
    with pytest.raises(SettingsError, match=r"Unknown setting 'data.outlier'; did you mean 'data.outliers'"):
        prepare([*own, "+data.outlier=1"], CONF)
    with pytest.raises(SettingsError, match=r"--config-dir nowhere is not a folder"):
        prepare(["--config-dir=nowhere"], CONF)
    with pytest.raises(HydraException) as error:
        prepare(["--config-dir=extending/conf", "model=clipd"], CONF)
    assert explain(str(error.value), CONF) == "There is no model=clipd; did you mean 'clipped'?"
    with pytest.raises(HydraException) as error:
        prepare(["--config-dir=extending/conf", "data=ramp", "data.outlierz=1"], CONF)
    meant = explain(str(error.value), CONF, own_folders(["--config-dir=extending/conf"]))
    assert meant == "Unknown setting 'data.outlierz'; did you mean 'data.outliers'?"
