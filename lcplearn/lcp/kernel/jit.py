"""How functions are compiled and cached, and the constants that they share."""

import hashlib
import os
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba

RUIZ_SWEEPS = 4  # as in residuals.py
EPS = 2.220446049250313e-16
SOLVED, INFEASIBLE, UNSOLVED, MAX_ITERATIONS, NONFINITE_INPUT = 0, 1, 2, 3, 4  # solution.Status, as plain constants
APART = 5  # the status of what `islands` has still to solve
DONE, STUCK, CAPPED = 0, 1, 2  # how a stage ended
EXPONENT = 0x7FF0000000000000  # bits of a double that remain when it is rounded down to a power of two
LARGEST = 1.7976931348623157e308  # of all doubles
TINY = 2.2250738585072014e-308  # the smallest double of full precision
_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    # no nnan and no ninf: tests for convergence rely on comparisons with NaN
    "fastmath": {"contract", "reassoc", "nsz", "arcp"},
}


def jit(function: Callable[..., Any], **options: Any) -> Any:
    """Compile a function that an entry calls; it is cached within the entry."""
    return numba.njit(**_OPTIONS, **options)(function)


def jit_inline(function: Callable[..., Any]) -> Any:
    """As `jit`, for what is called once an element: to pass 30 arrays takes as long as a problem of two unknowns."""
    return jit(function, forceinline=True)


def jit_merged(function: Callable[..., Any]) -> Any:
    """Compile a function as part of its only caller.

    numba optimises a function of `jit_inline` once by itself and once more within every function above it.
    """
    return jit(function, inline="always")


def jit_call(function: Any) -> Any:
    """A function of `jit_inline` as one that is called: what runs rarely need not be compiled once for each caller."""
    return jit(function.py_func)


def entry(make: Callable[[str], Callable[..., Any]]) -> Any:
    """Compile the function that `make` returns, with a cache on disk that forgets it when any file here changes.

    Args:
        make: Gets a digest of the kernel's files; the function it returns must hold that in its closure.
    """
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return cached(make(digest.hexdigest()))


def cached(function: Callable[..., Any]) -> Any:
    """Compile a function with a cache on disk; without one where its folder cannot be found or written to."""
    try:
        compiled = numba.njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # "cannot cache function: no locator available"
        return numba.njit(**_OPTIONS)(function)
    cache = compiled._cache  # numba has no public way to survive a full disk
    cache.save_overload = _without_disk_errors(cache.save_overload)
    return compiled


def _without_disk_errors(save: Callable[..., None]) -> Callable[..., None]:
    """The same, but what cannot be saved is compiled again by the next process."""

    def save_or_not(*arguments: Any) -> None:
        try:
            save(*arguments)
        except OSError:
            return

    return save_or_not


@cache
def announce(compiled: Any, words: str) -> None:
    """Say once, on a terminal, that this compiles, unless it lies in numba's cache."""
    if not sys.stderr.isatty():
        return
    folder = getattr(compiled.stats, "cache_path", None)
    start = Path(compiled.py_func.__code__.co_filename).stem + "."
    if folder is None or not os.path.isdir(folder) or not any(f.startswith(start) for f in os.listdir(folder)):
        sys.stderr.write(f"lcplearn: {words}\n")
