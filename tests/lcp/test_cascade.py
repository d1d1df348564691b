"""Which way the kernel takes: the fastest that solves such a problem, seen by the pivots or rounds that it counts."""

import numpy as np
import pytest
import torch

from lcplearn import solve_lcp
from lcplearn.benchmark.problems import families


@pytest.mark.parametrize("n", [2, 3, 5, 6, 10, 15])
def test_a_small_diagonal_problem_takes_one_round(n):
    """Lemke's method takes a pivot for each negative entry, and one more."""
    rng = np.random.default_rng(n)
    d, q = torch.from_numpy(rng.uniform(0.1, 10.0, (50, n))), torch.from_numpy(rng.standard_normal((50, n)))
    q[:, 0] = -1.0
    solution = solve_lcp(torch.diag_embed(d), q)
    torch.testing.assert_close(solution.z, (-q / d).clamp_min(0.0), rtol=1e-14, atol=0.0)
    assert (solution.iterations == 1).all()


@pytest.mark.parametrize("d", [[1.0] * 7 + [0.0], [1.0] * 16])
def test_a_zero_on_the_diagonal_and_more_rows_take_the_way_of_lemke(d):
    """A pivot for each negative entry, and one more; pivots on the diagonal would end after one round here, too."""
    diagonal = torch.tensor(d, dtype=torch.float64)
    q = torch.where(diagonal > 0.0, -1.0, 1.0).to(torch.float64)
    solution = solve_lcp(torch.diag(diagonal), q)
    assert solution.z.tolist() == d
    assert solution.iterations == sum(d) + 1


@pytest.mark.parametrize("n", [20, 40])
def test_rows_and_columns_scaled_apart_cost_no_second_try(n):
    """By factors of 1e-6 to 1e6; as many pivots as the same problem with largest entries of 1 takes."""
    M, q, _ = families.row_column_scaled(np.random.default_rng(n), 200, n)
    r = 1.0 / np.abs(M).max(2)
    even = M * r[:, :, None]
    even /= np.abs(even).max(1)[:, None, :]
    scaled, well = (solve_lcp(*map(torch.from_numpy, problem)) for problem in ((M, q), (even, r * q)))
    assert scaled.solved.all()
    assert scaled.iterations.double().mean() < 1.1 * well.iterations.double().mean()
