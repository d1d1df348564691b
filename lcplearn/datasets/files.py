"""Find, open and write data files; what is wrong with one is said in one sentence."""

import os
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lcplearn.domains import POSITIVE, REAL, Domain

PUBLISHED = {"cube_slides.npz": "slides", "cube_tosses.npz": "tosses", "planar_pushes.npz": "pushes"}


def find(name: str) -> Path:
    """Path of a data file, in the folder named by LCPLEARN_DATA or else in data/.

    Raises:
        FileNotFoundError: It is not there.
    """
    path = Path(os.environ.get("LCPLEARN_DATA") or "data") / name
    if not path.is_file():
        what = PUBLISHED.get(name, "|".join(PUBLISHED.values()))
        raise FileNotFoundError(
            f"{path}: no such file; `python -m lcplearn.datasets.get {what}` "
            "brings published recordings (see data/README.md), and LCPLEARN_DATA can name its folder"
        )
    return path


def read_npz(
    path: Path | str, keys: tuple[str, ...], optional: tuple[str, ...] = (), *, finite: bool = True
) -> dict[str, NDArray]:
    """Arrays of an NPZ file, without ever running a pickle.

    Args:
        path: The file.
        keys: Names of the arrays that it must hold.
        optional: Names of arrays that it may hold.
        finite: Whether NaN and infinity are refused.

    Returns:
        These arrays by name, as far as they are there.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is not an NPZ file, is pickled, lacks an array, or (where that is asked) numbers in it are
            not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path}: expected an NPZ file (a zip of arrays), got something else; pickles are not read")
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            missing = [key for key in keys if key not in file]
            if missing:
                raise ValueError(
                    f"expected the arrays {', '.join(keys)}; {', '.join(missing)} missing; got {', '.join(file)}"
                )
            there = [*keys, *(key for key in optional if key in file)]
            arrays = {key: np.asarray(file[key]) for key in there}  # a member that is no array comes as bytes
    except (ValueError, zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, MemoryError) as error:
        reason = "arrays of Python objects (pickles) are not read" if "allow_pickle" in str(error) else error
        raise ValueError(f"{path}: {reason}") from None
    for key, array in arrays.items():
        if array.dtype.kind not in "fiuU":
            raise ValueError(f"{path}: {key}: expected numbers or text, got {array.dtype}")
        if finite and array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{path}: {key}: {int((~np.isfinite(array)).sum())} values are NaN or infinite")
    return arrays


def replace(path: Path | str, write: Callable[[BinaryIO], Any]) -> None:
    """Write a file beside `path`, bring it to the disk, and put it in its place in one step.

    Beside it, because a move from another file system is a copy, of which a kill leaves a part.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.part")
    try:
        with beside.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def positive_number(path: Path | str, name: str, value: NDArray) -> float:
    """The positive number in an array of one; see `number`."""
    return number(path, name, value, POSITIVE)


def number(path: Path | str, name: str, value: NDArray, domain: Domain = REAL) -> float:
    """The number in an array of one.

    Raises:
        ValueError: It is not one number of the domain.
    """
    if value.size != 1 or value.dtype.kind not in "fiu" or value.item() not in domain:
        raise ValueError(f"{path}: {name}: expected {domain.words}, got {value}")
    return float(value.item())


def check_offsets(path: Path | str, offsets: NDArray, rows: int) -> None:
    """Require that record k is rows offsets[k]:offsets[k + 1], that each has two rows or more and that all are used.

    Raises:
        ValueError: They are not so.
    """
    if offsets.ndim != 1 or len(offsets) < 2 or offsets.dtype.kind not in "iu":
        raise ValueError(f"{path}: offsets: expected at least two integers, got {offsets.dtype} {list(offsets.shape)}")
    if offsets[0] != 0 or offsets[-1] != rows:
        raise ValueError(f"{path}: offsets: expected 0 to {rows}, the rows of data, got {offsets[0]} to {offsets[-1]}")
    lengths = np.diff(offsets.astype(np.int64))
    if (lengths < 2).any():
        k = int(np.argmax(lengths < 2))
        raise ValueError(f"{path}: offsets: record {k} has {lengths[k]} rows, expected at least 2")
