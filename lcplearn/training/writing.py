"""Files that are whole or not there: what kill -9 leaves can be read."""

import json
import math
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO

from lcplearn.datasets.files import replace


def copy(source: str | Path, path: str | Path) -> None:
    """Copy a file, whole or not at all."""
    with Path(source).open("rb") as original:
        replace(path, lambda file: shutil.copyfileobj(original, file))


def write_figures(path: str | Path, figures: Mapping[str, Any]) -> None:
    """Write figures as JSON; what is not finite, for which JSON has no number, is the word "diverged"."""
    values = {
        key: "diverged" if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in figures.items()
    }
    replace(path, lambda file: file.write((json.dumps(values, indent=2) + "\n").encode()))


class AtomicCheckpointIO(TorchCheckpointIO):
    """Lightning's own writes to the temporary folder first, which is often another file system."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        replace(path, lambda file: torch.save(checkpoint, file))
