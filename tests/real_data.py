"""Recordings and published problems that the repository does not ship."""

import os
from pathlib import Path

import pytest


def real_data(name: str) -> Path:
    """Path of a file or folder in LCPLEARN_DATA or data/; skips the test without it, or fails it on CI."""
    path = Path(os.environ.get("LCPLEARN_DATA") or "data") / name
    if not path.exists():
        reason = f"needs real data: {path} is missing (set LCPLEARN_DATA to its folder)"
        pytest.fail(reason) if os.environ.get("CI") else pytest.skip(reason)
    return path
