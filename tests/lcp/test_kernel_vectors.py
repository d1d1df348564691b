"""Vector operations of the kernel do what their formulas say, at sizes that are no multiples of 4 too."""

import numba
import numpy as np
import pytest

from lcplearn.lcp.kernel import square, vectors
from lcplearn.lcp.kernel.memory import padded

SIZES = (1, 2, 3, 4, 5, 6, 7, 8, 9, 13)


@numba.njit
def _scaling(M, rest, at, n, width):
    square.largest_entries(M, rest, at[0], at[1], at[2], n)
    square.scale_transposed(M, rest, at[0], at[3], at[4], n)
    vectors.divide_by_roots(at[5], at[3], width // 4)


@numba.njit
def _even_out(at, width):
    return vectors.even_out(at[0], at[1], at[2], 1.3, 0.83, 1e-3, width // 4)


@numba.njit
def _sums(S, at, n, width):
    vectors.add_columns(S, at[0], at[1], at[2], at[3], n, width // 4)
    vectors.add_product(S, at[4], at[0], n, width // 4)
    return vectors.smallest_ratio(at[4], at[0], at[5], 1e-9, width // 4)


@numba.njit
def _exchange(T, factors, c, row, columns, width):
    vectors.exchange_columns(T, factors, c, row, columns, width // 4)


@numba.njit
def _first(numbers, bound, width):
    bits = vectors.at_most(numbers, bound, width // 4)
    return bits, vectors.first_bit(bits)


@numba.njit
def _powers(x):
    below = vectors.power_below(x)
    return below, vectors.inverse_of_power(below)


def _vectors(rng, n, width):
    """Six vectors of n numbers with padding of another size, and their addresses."""
    memory = np.full((6, width), 7.0)
    memory[:, :n] = rng.uniform(0.5, 2.0, (6, n))
    return memory, tuple(row.ctypes.data for row in memory)


@pytest.mark.parametrize("n", SIZES)
def test_scaling_takes_the_largest_of_rows_and_of_columns_and_transposes(n):
    rng, width = np.random.default_rng(n), int(padded.py_func(n))
    M, S = rng.standard_normal((n, n)), np.zeros((width, width))
    memory, at = _vectors(rng, n, width)
    memory[0, n:] = 0.0
    rest = np.array([*M[-1, n // 4 * 4 :], *[7.0] * 4])
    scales, c, target = memory[[0, 3, 5], :n]
    _scaling(M.ctypes.data, rest.ctypes.data, (*at[:4], S.ctypes.data, at[5]), n, width)
    np.testing.assert_allclose(memory[1, :n], (np.abs(M) * scales).max(1), rtol=1e-15)
    np.testing.assert_allclose(memory[2, :n], (np.abs(M) * scales[:, None]).max(0), rtol=1e-15)
    assert not memory[1:3, n:].any()
    np.testing.assert_allclose(S[:n, :n], (scales[:, None] * M * c).T, rtol=1e-15)
    assert not S[:n, n:].any()
    np.testing.assert_allclose(memory[5, :n], target / np.sqrt(c), rtol=1e-15)


@pytest.mark.parametrize(
    ("rows", "uneven"), [([1.0, 0.0, 2.1], False), ([1.0, 2.2, 0.0], True), ([0.4, 1.0, 1.0], True)]
)
def test_maxima_far_from_one_are_uneven_and_those_of_zero_are_not(rows, uneven):
    memory = np.zeros((3, 4))
    memory[0, :3], memory[2] = rows, 1.0
    assert bool(_even_out(tuple(row.ctypes.data for row in memory), 4)) is uneven
    np.testing.assert_array_equal(memory[1], np.where(memory[0] > 0.0, memory[0], 1.0))


@pytest.mark.parametrize("n", SIZES)
def test_sums_and_ratios_run_over_columns(n):
    rng, width = np.random.default_rng(n), int(padded.py_func(n))
    S = np.zeros((n, width))
    S[:, :n] = rng.standard_normal((n, n))
    before = S.copy()
    memory, at = _vectors(rng, n, width)
    memory[4, : n // 2] *= -1.0
    memory[:, n:] = 0.0
    best = _sums(S.ctypes.data, at, n, width)
    p, z, w, omega, factors, ratios = memory
    np.testing.assert_allclose(w, p + z[:n] @ before, atol=1e-14)
    np.testing.assert_allclose(omega, p + z[:n] @ np.abs(before), rtol=1e-14)
    np.testing.assert_allclose(S, before + factors[:n, None] * p, atol=1e-14)
    expected = np.where(factors < 0, p / np.where(factors < 0, -factors, 1.0), np.inf)
    np.testing.assert_allclose(ratios, expected, rtol=1e-15)
    assert best == ratios.min()


@pytest.mark.parametrize("n", SIZES)
def test_an_exchange_adds_multiples_of_a_column_and_leaves_the_factors_in_its_row(n):
    rng, width = np.random.default_rng(n), int(padded.py_func(n))
    T = np.zeros((n + 2, width))
    T[:, :n] = rng.standard_normal((n + 2, n))
    for c, row in ((0, 0), (n, n - 1), (n // 2, n // 2)):
        before, factors = T.copy(), rng.standard_normal(n + 2)
        _exchange(T.ctypes.data, factors.ctypes.data, c, row, n + 2, width)
        expected = before + factors[:, None] * before[c]
        expected[c] = factors[c] * before[c]
        expected[:, row] = factors
        np.testing.assert_allclose(T, expected, atol=1e-13)
        assert (T[:, row] == factors).all()


def test_bits_say_which_numbers_are_at_most_a_bound():
    numbers = np.array([3.0, 2.0, 1.0, np.inf, 2.0, 5.0, 1.0, np.inf, *[4.0] * 56])
    for bound, expected in ((1.0, [2, 6]), (2.0, [1, 2, 4, 6]), (0.5, []), (4.0, [0, 1, 2, 4, 6, *range(8, 64)])):
        bits, first = _first(numbers.ctypes.data, bound, 64)
        assert [i for i in range(64) if int(bits) >> i & 1] == expected
        assert not expected or first == expected[0]


@pytest.mark.parametrize("x", [1.0, 1.5, 1.999, 2.0, 3e-300, 8e307 / 2, 2.2250738585072014e-308])
def test_powers_of_two_are_exact(x):
    below, inverse = _powers(x)
    assert below <= x < 2.0 * below
    assert np.frexp(below)[0] == 0.5
    assert inverse * below == 1.0
