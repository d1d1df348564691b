"""What the compiled kernel needs around it: memory that is large enough, and a disk that need not be there."""

import errno
from itertools import pairwise

import numpy as np
import pytest
from numba.core import caching

from lcplearn.lcp.kernel.jit import cached
from lcplearn.lcp.kernel.memory import scratch_size, workspace


def _successor():
    def successor(x):
        return x + 1

    return successor


def test_a_full_disk_costs_no_solve(monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(caching.IndexDataCacheFile, "save", full)
    assert cached(_successor())(1) == 2


def test_a_cache_folder_that_cannot_be_written_to_costs_no_solve(monkeypatch):
    monkeypatch.setattr(caching.CompileResultCacheImpl, "_locator_classes", [])
    assert cached(_successor())(1) == 2


@pytest.mark.parametrize("offset", [0, 8, 40, 56])
def test_arrays_of_an_element_lie_apart_within_its_memory_whatever_its_alignment(offset):
    for n in (0, 1, 2, 3, 5, 8, 13, 24, 101, 128, 141):
        memory = np.empty(scratch_size.py_func(n) + 8)
        start = memory.ctypes.data - memory.ctypes.data % 64 + offset
        arrays = [x for group in workspace(start, n) for x in group]
        spans = sorted((x.ctypes.data, x.ctypes.data + x.nbytes) for x in arrays)
        assert all(first % 64 == 0 for first, _ in spans)
        assert all(end <= following for (_, end), (following, _) in pairwise(spans))
        assert spans[0][0] >= start
        assert spans[-1][1] <= start + 8 * scratch_size.py_func(n)
