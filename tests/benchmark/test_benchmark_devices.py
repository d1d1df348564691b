"""`benchmark devices`: what it says of the CPU, on which it can be checked anywhere."""

import pytest

from lcplearn.benchmark.devices.run import FAMILIES, batches, measure


@pytest.mark.parametrize("family", FAMILIES)
def test_the_cpu_solves_all_and_none_wrongly(family):
    row = measure(family, 300, "cpu", seed=0, repeats=1)
    assert (row["left"], row["unsolved"], row["wrong"]) == (0.0, 0.0, 0.0)
    assert row["forward"] > row["both"] > 0.0


def test_batches_end_where_the_matrices_no_longer_fit():
    assert batches("cubes n=24", quick=False) == [10, 100, 1000, 10_000, 100_000]
    assert batches("cubes n=24", quick=True) == [10, 100, 1000]
