"""Each script in examples/ runs and shows what it says, in quick form; so does the notebook."""

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import pytest
from real_data import real_data

EXAMPLES = Path(__file__).parents[2] / "examples"


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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
