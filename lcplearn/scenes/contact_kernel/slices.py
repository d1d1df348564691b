"""A batch of elements on several threads."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lcplearn.lcp.threads import in_slices, slice_size


def by_slices(
    function: Callable[..., Any], arrays: Sequence[np.ndarray], count: int, seconds: float, scratch: int
) -> None:
    """Call function(scratch, *arrays) for slices of a batch of elements that know nothing of each other.

    Args:
        function: Compiled; releases the GIL.
        arrays: Of count elements, or empty.
        seconds: Roughly what an element takes, to decide on threads.
        scratch: Numbers of memory that each call needs for itself.
    """

    def run(start: int, stop: int) -> None:
        part = arrays if stop - start == count else [x[start:stop] for x in arrays]
        function(np.empty(scratch), *part)

    size = slice_size(count, count * seconds)
    if size < count:
        run(0, 0)  # compiles or loads: else threads would wait for that, and seem late
    in_slices(run, count, size)
