"""The judge in torch and the judge inside the CPU kernel are one judge."""

import numpy as np
import pytest
import torch

from lcplearn import solve_lcp
from lcplearn.benchmark.problems import families as problems
from lcplearn.lcp.kernel import judging
from lcplearn.lcp.kernel.memory import padded
from lcplearn.lcp.residuals import equilibrate, judge


def judged_by_kernel(M: np.ndarray, q: np.ndarray, z: np.ndarray, tol: float = 1e-10) -> tuple[float, float]:
    """Residual and tolerance by the kernel's own steps, for one problem."""
    n = len(q)
    width = padded.py_func(n)
    d, rows, largest, r, c, p, w, omega = (x[:n] for x in np.ones((8, width)))
    S, rest = np.empty((width, width))[:n], np.empty(4)
    judging.equilibrate(M, rows, largest, rest, d)
    r[:], c[:] = d, d
    s = judging.scale(M, q, r, c, rest, S, p)
    scaled = z / s / c
    judging.evaluate(S, p, scaled, w, omega)
    return judging.judge(q, S, p, d, r, c, s, scaled, w, omega, tol)


def judged_by_torch(M: np.ndarray, q: np.ndarray, z: np.ndarray, tol: float = 1e-10) -> tuple[float, float]:
    verdict = judge(torch.from_numpy(M), torch.from_numpy(q), torch.from_numpy(z), tol=tol)
    return verdict.residual.item(), verdict.tolerance.item()


def assert_same_verdict(M: np.ndarray, q: np.ndarray, z: np.ndarray) -> None:
    (one, one_tol), (other, other_tol) = judged_by_kernel(M, q, z), judged_by_torch(M, q, z)
    size = (np.abs(q) + np.abs(M) @ z).max() / np.abs(q).max()
    assert one == pytest.approx(other, rel=1e-9, abs=1e-14 * max(1.0, size))
    assert one_tol == pytest.approx(other_tol, rel=1e-9)
    assert (one <= one_tol) == (other <= other_tol)


@pytest.mark.parametrize("name", [name for name in problems.RANDOM_FAMILIES if "100" not in name])
@pytest.mark.parametrize("error", [0.0, 1e-12, 1e-6, 1.0])
def test_both_judges_agree_on_right_and_wrong_solutions_of_every_family(name, error):
    rng = np.random.default_rng(1)
    M, q, _ = problems.RANDOM_FAMILIES[name](rng, 10)
    z = solve_lcp(torch.from_numpy(M), torch.from_numpy(q)).z.numpy()
    for b in range(10):
        assert_same_verdict(M[b], q[b], z[b] * np.exp(error * rng.standard_normal(q.shape[1])))


@pytest.mark.parametrize("size", [1e-280, 1e-100, 1.0, 1e100, 1e280])
def test_both_judges_agree_on_data_of_any_size(size):
    rng = np.random.default_rng(2)
    M, q, z = problems.nonsymmetric(rng, 10, 6)
    assert z is not None
    for b in range(10):
        assert_same_verdict(M[b], size * q[b], size * z[b])
        assert_same_verdict(M[b], size * q[b], 1.01 * size * z[b])


@pytest.mark.parametrize("t", [0.0, 1.0, 1e6, 1e12, 1e18, 1e100])
def test_huge_z_whose_w_is_rounding_noise_is_refused_by_both_judges(t):
    q, z = np.array([-2.0, -2.0]), np.array([t, t])
    for M in ([[2.0, -2.0], [1.0, -1.0]], [[1.0, -1.0], [-1.0, 1.0]]):
        for residual, tolerance in (judged_by_kernel(np.array(M), q, z), judged_by_torch(np.array(M), q, z)):
            assert residual > tolerance


def test_exact_solutions_have_residual_zero_in_both_judges():
    M, q, z = np.array([[2.0, 1.0], [0.0, 4.0]]), np.array([-3.0, -4.0]), np.array([1.0, 1.0])
    assert judged_by_kernel(M, q, z)[0] == judged_by_torch(M, q, z)[0] == 0.0


@pytest.mark.parametrize("q", [-5e-324, -1e-310, -2.5e-308])
@pytest.mark.parametrize("m", [1e-300, 0.5, 3.0])
def test_data_below_the_range_of_full_precision_get_a_finite_answer_that_both_judges_accept(q, m):
    M, q = np.array([[m]]), np.array([q])
    result = solve_lcp(torch.from_numpy(M), torch.from_numpy(q))
    assert result.solved
    assert result.z.isfinite().all()
    for z in (result.z.numpy(), -q / m):
        residual, tolerance = judged_by_torch(M, q, z)
        assert residual <= tolerance


def test_equilibration_of_an_element_does_not_depend_on_its_neighbours():
    rng = np.random.default_rng(3)
    even, uneven = np.eye(4), 10.0 ** rng.uniform(-6, 6, (4, 4))
    together = equilibrate(torch.from_numpy(np.stack([even, uneven])))
    for M, d in zip((even, uneven), together, strict=True):
        torch.testing.assert_close(equilibrate(torch.from_numpy(M)), d, rtol=0, atol=0)


def test_equilibrated_matrix_has_rows_of_size_one_within_a_factor_of_three():
    M = torch.from_numpy(problems.badly_scaled(np.random.default_rng(4), 20, 10).M)
    d = equilibrate(M)
    largest = (d.unsqueeze(-1) * M * d.unsqueeze(-2)).abs().amax(-1)
    assert ((largest > 1 / 3) & (largest < 3)).all()


def test_without_a_central_path_smoothing_is_never_solved():
    """M = 0, q = 0: z w = tau and w = 0 contradict each other."""
    for dtype in (torch.float32, torch.float64):
        M, q = torch.zeros(2, 2, dtype=dtype).requires_grad_(), torch.zeros(2, dtype=dtype).requires_grad_()
        solution = solve_lcp(M, q, smoothing=1e-3)
        assert not solution.solved
        solution.z.sum().backward()
        assert not M.grad.any()


def test_one_row_in_large_units_does_not_loosen_the_tolerance_of_the_others():
    M, q, z = np.diag([1e30, 1.0]), np.array([-1e-15, -1.0]), np.array([1e-22, 1.0])
    for residual, tolerance in (judged_by_kernel(M, q, z), judged_by_torch(M, q, z)):
        assert residual > tolerance == pytest.approx(1e-10)


def test_a_sum_that_comes_out_as_zero_by_rounding_verifies_nothing():
    """q = -M z in doubles, where M z is what rounding leaves of terms of 1e17: w is 0, and says nothing."""
    rng, tried = np.random.default_rng(0), 0
    while tried < 20:
        row = rng.uniform(0.5, 1.0, 2) * [1, -1]
        M, z = np.stack((row, 0.7 * row)), 1e17 * np.abs(row[::-1])
        q = -(M * z).sum(-1)
        if q.any():
            tried += 1
            for residual, tolerance in (judged_by_kernel(M, q, z), judged_by_torch(M, q, z)):
                assert residual > tolerance


def test_rounding_raises_the_tolerance_to_a_millionth_at_most():
    M, q = np.array([[1.0, -1.0], [-1.0, 1.0]]), np.array([1.0, -1.0])
    for size, expected in ((1e5, 2e-10), (1e12, 1e-6)):
        z = np.array([size, size + 1.0])
        for _, tolerance in (judged_by_kernel(M, q, z), judged_by_torch(M, q, z)):
            assert tolerance == pytest.approx(max(1e-10, min(1e-6, 20 * 2.2e-16 * size)), rel=0.2)
            assert tolerance <= max(1e-6, expected)


def test_a_small_entry_of_z_counts_by_what_its_column_weighs():
    """z_2 = 1e-12 beside z_1 = 1 in the caller's units; the second column is 1e12 times as large: not negligible."""
    M, q = np.array([[1.0, 0.0], [0.0, 1e12]]), np.array([-1.0, 1.0])
    wrong = np.array([1.0, 1e-12])
    for residual, tolerance in (judged_by_kernel(M, q, wrong), judged_by_torch(M, q, wrong)):
        assert residual > 0.1 > tolerance
