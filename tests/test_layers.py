"""The layers of the package: each imports only from itself and from those before it."""

import ast
from pathlib import Path

import pytest

import lcplearn

LAYERS = ("lcp", "scenes", "datasets", "formulations", "training")
ROOT = Path(lcplearn.__file__).parent


def imported(path: Path) -> set[str]:
    """Layers of lcplearn, and other top-level packages, that a file imports anywhere in it."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    parts = [name.split(".") for name in names]
    return {part[1] if part[0] == "lcplearn" and len(part) > 1 else part[0] for part in parts}


@pytest.mark.parametrize("layer", LAYERS)
def test_a_layer_imports_only_from_those_before_it(layer):
    """Architecture: lcp < scenes < datasets < formulations < training < commands."""
    below = {"predict", "compare", "benchmark", *LAYERS[LAYERS.index(layer) + 1 :]}
    wrong = {path.name: imported(path) & below for path in (ROOT / layer).rglob("*.py")}
    assert wrong
    assert not {name: names for name, names in wrong.items() if names}


@pytest.mark.parametrize("layer", LAYERS)
def test_only_training_knows_lightning_and_only_commands_know_hydra(layer):
    unwanted = {"hydra", "omegaconf"} | (set() if layer == "training" else {"lightning", "pytorch_lightning"})
    found = {path.name: imported(path) & unwanted for path in (ROOT / layer).rglob("*.py")}
    assert not {name: names for name, names in found.items() if names}
