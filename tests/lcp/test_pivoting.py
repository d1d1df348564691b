"""The CPU kernel against enumeration, planted solutions, published cases and the hard families of the literature."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lcp.oracles import has_solution, natural_residual

from lcplearn.benchmark.problems import families as problems
from lcplearn.benchmark.problems.families import Problems
from lcplearn.lcp import pivoting
from lcplearn.lcp.residuals import judge
from lcplearn.lcp.solution import LCPSolution, Status


def solve(M, q, *, single_precision=False, max_iter=None, initial_basis=None, **options) -> LCPSolution:
    """A batch by the kernel, from arrays to arrays."""
    M, q = np.asarray(M, dtype=float), np.asarray(q, dtype=float)
    M, q = M.reshape(-1, *M.shape[-2:]), q.reshape(-1, q.shape[-1])
    M, q = (torch.from_numpy(np.ascontiguousarray(x)) for x in (M[0] if len(M) < len(q) else M, q))
    basis = None if initial_basis is None else torch.as_tensor(initial_basis)
    result, _ = pivoting.solve_batch(
        M, q, single_precision=single_precision, max_iter=max_iter, initial_basis=basis, **options
    )
    return LCPSolution(*(x.numpy() for x in result))


def adjoint(M, solution, grad_z, grad_w, need_M):
    """Gradients by the kernel, from arrays to arrays."""
    tensors = [torch.as_tensor(x) for x in (M, solution.z, solution.basis, solution.status, grad_z, grad_w)]
    return [None if x is None else x.numpy() for x in pivoting.solve_adjoint(*tensors, need_M)]


def check_contract(M: np.ndarray, q: np.ndarray, result: LCPSolution, tol: float = 1e-9) -> None:
    """What every result must satisfy, whatever its status."""
    solved = result.status == Status.SOLVED
    assert (result.z >= 0).all()
    assert (result.w[solved] >= 0).all()
    assert (result.z[~result.basis] == 0).all()
    assert (result.w[solved][result.basis[solved]] == 0).all()
    scale = np.abs(q).max(-1) + (np.abs(M) @ result.z[..., None])[..., 0].max(-1)
    error = np.abs((M @ result.z[..., None])[..., 0] + q - result.w).max(-1)
    assert (error[solved] <= tol * scale[solved]).all()
    for b in np.nonzero(result.status == Status.INFEASIBLE)[0]:
        u = result.certificate[b]
        assert (u >= 0).all()
        assert (M[b].T @ u <= 1e-12 * (np.abs(M[b]).T @ u)).all()
        assert q[b] @ u <= -1e-9 * (np.abs(q[b]) @ u) < 0
    assert (result.certificate[result.status != Status.INFEASIBLE] == 0).all()


@st.composite
def integer_lcps(draw):
    n = draw(st.integers(1, 6))
    entry = st.integers(-2, 2)
    M = draw(st.lists(st.lists(entry, min_size=n, max_size=n), min_size=n, max_size=n))
    q = draw(st.lists(entry, min_size=n, max_size=n))
    return np.array(M, dtype=float), np.array(q, dtype=float)


@settings(max_examples=60, deadline=None)
@given(integer_lcps())
def test_status_of_degenerate_integer_problems_agrees_with_enumeration(problem):
    M, q = problem
    result = solve(M, q)
    check_contract(M[None], q[None], result)
    if result.status[0] == Status.SOLVED:
        assert natural_residual(M, q, result.z[0]) < 1e-9
    if result.status[0] == Status.INFEASIBLE:
        assert not has_solution(M, q)


@settings(max_examples=200, deadline=None)
@given(integer_lcps())
def test_every_feasible_semidefinite_problem_of_small_integers_is_solved(problem):
    G, q = problem
    M = G @ G.T
    result = solve(M, q)
    assert result.status[0] in (Status.SOLVED, Status.INFEASIBLE)
    check_contract(M[None], q[None], result)


@pytest.mark.parametrize("name", problems.RANDOM_FAMILIES)
def test_every_member_of_the_random_families_is_solved_and_both_judges_agree(name):
    M, q, _ = problems.RANDOM_FAMILIES[name](np.random.default_rng(1), 100)
    result = solve(M, q)
    assert (result.status == Status.SOLVED).all()
    check_contract(M, q, result)
    verdict = judge(torch.from_numpy(M), torch.from_numpy(q), torch.from_numpy(result.z), tol=1e-10)
    np.testing.assert_allclose(result.residual, verdict.residual.numpy(), rtol=1e-3, atol=1e-12)
    assert (verdict.residual <= verdict.tolerance).all()


@pytest.mark.parametrize("name", problems.RANDOM_FAMILIES)
def test_data_rounded_to_float32_are_solved_to_their_precision(name):
    M, q, _ = problems.RANDOM_FAMILIES[name](np.random.default_rng(2), 50)
    M, q = M.astype(np.float32).astype(float), q.astype(np.float32).astype(float)
    result = solve(M, q, single_precision=True)
    check_contract(M, q, result, tol=2e-5)
    assert (result.residual[result.status == Status.SOLVED] <= 2e-6).all()
    assert (result.status == Status.SOLVED).mean() >= 0.98  # rounding can make a P-matrix of condition 1e12 none


@pytest.mark.parametrize("condition", [1e2, 1e6, 1e10])
@pytest.mark.parametrize("n", [5, 20, 50])
def test_planted_solution_of_a_positive_definite_problem_is_found_to_its_condition(n, condition):
    M, q, z = problems.ill_conditioned(np.random.default_rng(3), 20, n, condition)
    result = solve(M, q)
    assert (result.status == Status.SOLVED).all()
    assert np.abs(result.z - z).max() <= 1e-14 * condition * n


def _published_cases():
    path = Path(os.environ.get("LCPLEARN_DATA", "data")) / "lcp_cases.npz"
    if not path.exists():
        return None
    data = np.load(path)
    meta = {case["name"]: case for case in json.loads(str(data["meta_json"]))}
    return [(name, data[f"M/{name}"], data[f"q/{name}"], meta[name]["solvable"]) for name in data["names"]]


def test_published_cases_are_solved_or_recognised_as_unsolvable():
    cases = _published_cases()
    if cases is None:
        pytest.skip("lcp_cases.npz not found: set LCPLEARN_DATA to its folder")
    for name, M, q, solvable in cases:
        result = solve(M, q)
        if solvable == "yes":
            assert result.status[0] == Status.SOLVED, name
            assert natural_residual(M, q, result.z[0]) <= 1e-8 * np.abs(q).max(), name
        else:
            assert result.status[0] in (Status.INFEASIBLE, Status.UNSOLVED), name
        check_contract(M[None], q[None], result)


def test_noise_that_only_the_original_data_would_show_is_no_part_of_a_solution():
    """Found by `benchmark fuzz`: z_2 = 4e-25, one denormal in units of q, made the third row negative."""
    M = [[7.301955453740253, 0.39984287818552694, 0.0], [0.39984287818552694, 8.481759852506906, 1.0], [0.0, -1.0, 0.0]]
    result = solve(M, [-0.79401177669975, -1e300, 0.0])
    assert result.status[0] == Status.SOLVED
    assert result.z[0, 1] == 0


def test_published_cases_that_are_solvable_are_solved_when_their_data_are_rounded_to_float32():
    cases = _published_cases()
    if cases is None:
        pytest.skip("lcp_cases.npz not found: set LCPLEARN_DATA to its folder")
    for name, M, q, solvable in cases:
        M, q = (x.astype(np.float32).astype(float) for x in (M, q))
        if solvable == "yes" and np.isfinite(M).all():
            result = solve(M, q, single_precision=True)
            assert result.status[0] == Status.SOLVED, name
            assert natural_residual(M, q, result.z[0]) <= 1e-5 * np.abs(q).max(), name


HARD = {
    "Murty, large q": problems.murty(12),
    "Murty, q = -1": problems.murty(20, easy=True),
    "Fathi": problems.fathi(10),
    "ties": Problems(np.array([[[1.0, 2, 0], [0, 1, 2], [2, 0, 1]]]), -np.ones((1, 3)), np.full((1, 3), 1 / 3)),
    "mass ratio 10": problems.mass_ratio_stack(4, 10.0),
    "mass ratio 1e3": problems.mass_ratio_stack(3, 1e3),  # a fourth body: M itself, rounded, is 1e-7 off
    "inverse mass ratio 1e3": problems.mass_ratio_stack(4, 1e-3),
}


@pytest.mark.parametrize("name", HARD)
def test_hard_textbook_case_has_its_known_solution(name):
    M, q, z = HARD[name]
    result = solve(M, q)
    assert result.status[0] == Status.SOLVED
    np.testing.assert_allclose(result.z, z, rtol=1e-8)


@pytest.mark.parametrize("n", range(2, 11))
def test_hilbert_matrices_are_solved_to_rounding(n):
    M, q, _ = problems.hilbert(n)
    result = solve(M, q)
    assert result.status[0] == Status.SOLVED
    assert natural_residual(M[0], q[0], result.z[0]) <= 1e-12


@pytest.mark.parametrize("a", [1.5, 2.0, 3.0])
def test_newton_cycle_with_nonnegative_q_returns_zero_from_any_start(a):
    M = np.array([[1, 0, a], [a, 1, 0], [0, a, 1.0]])
    for start in range(8):
        basis = np.array([[bool(start >> i & 1) for i in range(3)]])
        result = solve(M, np.ones(3), initial_basis=basis)
        assert result.status[0] == Status.SOLVED
        assert (result.z == 0).all()


@pytest.mark.parametrize("k", [2, 4, 8])
def test_redundant_contacts_carry_their_load_together(k):
    M, q, _ = problems.redundant_contacts(k)
    result = solve(M, q)
    assert result.status[0] == Status.SOLVED
    assert result.z.sum() == pytest.approx(1.0, rel=1e-14)


@pytest.mark.parametrize("decades", [3, 6, 12])
def test_solution_is_equivariant_under_change_of_units(decades):
    M, q, z = problems.positive_definite(np.random.default_rng(4), 30, 3)
    D = 10.0 ** np.array([-decades, 0, decades])
    result = solve(D[:, None] * M * D, D * q)
    assert (result.status == Status.SOLVED).all()
    np.testing.assert_allclose(result.z * D, z, rtol=1e-9, atol=1e-14)
    result = solve(1e7 * M, 1e-5 * q)
    np.testing.assert_allclose(result.z * 1e12, z, rtol=1e-9, atol=1e-14)


@pytest.mark.parametrize("A", [0.4, 0.0, -0.8])
def test_painleve_rod_is_solved_unless_it_is_inconsistent(A):
    """A = 1 + 3 c (c - mu s) with tan = 2 and mu = 1, 4/3, 2."""
    for b in (-1.0, 1.0):
        expected = Status.SOLVED if b > 0 or A > 0 else Status.INFEASIBLE
        assert solve([[A]], [b]).status[0] == expected


@pytest.mark.parametrize(("M", "q"), [([[-1.0]], [-1.0]), ([[0, 1], [-1, 0]], [-1, -1]), ([[0.0]], [-1.0])])
def test_infeasible_problem_comes_with_its_certificate(M, q):
    result = solve(M, q)
    assert result.status[0] == Status.INFEASIBLE
    check_contract(np.array([M], dtype=float), np.array([q], dtype=float), result)


def test_infeasible_semidefinite_problems_are_always_proven():
    rng = np.random.default_rng(5)
    G = rng.standard_normal((50, 10, 3))
    M = G @ G.transpose(0, 2, 1)
    u = np.linalg.svd(G)[0][:, :, -1]  # M u = 0; u is not >= 0, so flip signs of rows and columns
    M, u = M * np.sign(u)[:, :, None] * np.sign(u)[:, None, :], np.abs(u)
    q = rng.standard_normal((50, 10))
    q -= u * ((q * u).sum(1, keepdims=True) + 1.0)
    result = solve(M, q)
    assert (result.status == Status.INFEASIBLE).all()
    check_contract(M, q, result)


@pytest.mark.parametrize("n", [2, 3, 5, 8])
def test_a_zero_row_that_asks_for_more_is_proven_infeasible(n):
    """Rounding in the dual of the other rows must not refute the proof."""
    rng = np.random.default_rng(n)
    M = np.eye(n) * rng.integers(1, 4, (200, n, 1))
    M[:, -1] = 0.0
    q = -rng.integers(1, 4, (200, n)).astype(float)
    result = solve(M, q)
    assert (result.status == Status.INFEASIBLE).all()
    check_contract(M, q, result)


def test_what_rounding_to_float32_makes_infeasible_is_not_called_so():
    """Redundant contacts have a solution; their data, rounded to float32, may have none by 1e-7."""
    rng = np.random.default_rng(0)
    G = rng.standard_normal((2000, 12, 4))
    M, q, _ = problems._plant(rng, G @ G.transpose(0, 2, 1))
    M, q = (x.astype(np.float32).astype(float) for x in (M, q))
    assert (solve(M, q, single_precision=True).status != Status.INFEASIBLE).all()
    M, q = np.diag([3.0, 0.0]), np.array([-3.0, -1.0])
    assert solve(M, q, single_precision=True).status[0] == Status.INFEASIBLE


def test_a_dual_that_violates_its_constraints_a_little_proves_nothing():
    """u = (1, 1) has M'u = (5e-12, 0), far below any pivot, and q.u < 0; yet z = (4e11, 4e11) solves this P-matrix."""
    M, q = np.array([[1.0, -1.0], [5e-12 - 1.0, 1.0]]), np.array([-1.0, -1.0])
    assert solve(M, q).status[0] != Status.INFEASIBLE


def test_feasible_problem_without_solution_is_unsolved():
    assert solve([[0, 1], [0, 1]], [-1, 0]).status[0] == Status.UNSOLVED


def test_huge_z_whose_w_is_rounding_noise_is_not_solved():
    assert solve([[2, -2], [1, -1]], [-2, -2]).status[0] != Status.SOLVED


@pytest.mark.parametrize("single", [False, True])
def test_the_solution_is_not_far_out_on_a_ray_of_solutions(single):
    """z = (1, 0, 0) + t (1, 1, 0) solves for all t >= 0; rounded to float32, t = 1e9 would have lost q."""
    result = solve([[-1, 1, 0], [1, -1, -1], [1, -1, 1]], [1, -1, 0], single_precision=single)
    assert result.z.tolist() == [[1.0, 0.0, 0.0]]
    assert result.w.tolist() == [[0.0, 0.0, 1.0]]


def test_solution_beyond_the_range_of_doubles_is_not_solved():
    result = solve([[1e-300]], [-1e100])
    assert result.status[0] != Status.SOLVED
    assert solve([[1e-300]], [-1.0]).z[0, 0] == pytest.approx(1e300)


@pytest.mark.parametrize("n", [3, 9, 17])
def test_a_solution_too_small_beside_q_to_be_judged_is_not_solved(n):
    """z_1 = 1e-6 is a denormal in units of q_0. A z_2 of 0 would leave w_2 = -0.5, and z_2 = 0.5 can be judged."""
    M, q = np.eye(n), np.ones(n)
    M[1, 1], M[2, 1], q[0], q[1], q[2] = 1e6, -1e6, 1e304, -1.0, 0.5
    result = solve(M, q)
    assert result.status[0] == Status.SOLVED
    np.testing.assert_allclose(result.z[0], [0.0, 1e-6, 0.5, *[0.0] * (n - 3)])
    M[2, 1], q[2] = -1e3, 1.0
    assert solve(M, q).status[0] == Status.UNSOLVED


def test_an_entry_of_z_that_is_lost_beside_a_q_near_the_largest_double_is_not_solved():
    """z_1 = .04 is a denormal in units of q_2: without it w_1 and w_3 are below zero by percents."""
    M = np.array([[3.76, -2.21, -1.93, 1.23], [1.52, 0.861, 0.917, -0.239], [2.57, -1.69, 0.181, -0.489],
                  [-0.174, 1.58, -0.0394, 0.694]])  # fmt: skip
    q = np.array([3.02, 0.862, 4.49e307, -2.68])
    assert solve(M, q).status[0] == Status.UNSOLVED
    q[2] *= 1e-8
    result = solve(M, q)
    assert result.status[0] == Status.SOLVED
    assert abs(result.z[0, 1] - 0.0434) < 1e-4


@pytest.mark.parametrize("budget", [10, 20, 40])
def test_no_problem_takes_more_iterations_than_max_iter(budget):
    generator = torch.Generator().manual_seed(0)
    M = torch.randint(-2, 3, (4000, 4, 4), generator=generator).double()
    q = torch.randint(-2, 3, (4000, 4), generator=generator).double()
    assert solve(M, q, max_iter=budget).iterations.max() <= budget


def test_stopped_by_max_iter_is_reported_and_more_iterations_solve_it():
    M, q, _ = problems.stacked_cubes(np.random.default_rng(6), 20)
    hard = solve(M, q).iterations > 10
    assert (solve(M, q, max_iter=3).status[hard] == Status.MAX_ITERATIONS).all()
    assert (solve(M, q, max_iter=1000).status == Status.SOLVED).all()


def test_nonfinite_element_is_reported_and_leaves_its_neighbours_alone():
    M, q, _ = problems.positive_definite(np.random.default_rng(7), 4, 5)
    expected = solve(M, q)
    M, q = M.copy(), q.copy()
    M[1, 2, 3], q[2, 0] = np.nan, np.inf
    result = solve(M, q)
    assert (result.status[[1, 2]] == Status.NONFINITE_INPUT).all()
    assert np.isnan(result.z[[1, 2]]).all()
    assert np.isnan(result.w[[1, 2]]).all()
    for field in ("z", "w", "basis", "status", "residual"):
        assert (getattr(result, field)[[0, 3]] == getattr(expected, field)[[0, 3]]).all()


def test_empty_problems_and_batches_are_solved():
    for B, n in ((0, 3), (4, 0), (0, 0)):
        M, q = torch.zeros(B, n, n), torch.zeros(B, n)
        result, _ = pivoting.solve_batch(M, q, single_precision=False, max_iter=None)
        assert result.z.shape == (B, n)
        assert result.status.shape == (B,)
        assert (result.status == Status.SOLVED).all()


def test_an_element_is_bitwise_independent_of_its_batch():
    M, q, _ = problems.stacked_cubes(np.random.default_rng(8), 7)
    alone = [solve(M[b], q[b]) for b in range(7)]
    infeasible = np.where(np.arange(24) == 0, -1.0, 0.0)
    order = np.random.default_rng(9).integers(0, 8, 300)
    many_M = np.concatenate([M, np.diag(infeasible)[None]])[order]
    many_q = np.concatenate([q, infeasible[None]])[order]
    together = solve(many_M, many_q)
    for place, b in enumerate(order):
        if b < 7:
            for one, all_ in zip(alone[b], together, strict=True):
                assert (one[0] == all_[place]).all()
        else:
            assert together.status[place] == Status.INFEASIBLE


def test_a_shared_matrix_gives_the_same_and_is_not_written_to():
    M, q, _ = problems.stacked_cubes(np.random.default_rng(10), 5)
    expected = solve(np.repeat(M[:1], 5, 0), q)
    before = M[:1].copy()
    for one, other in zip(expected, solve(M[:1], q), strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(M[:1], before)


def test_the_right_initial_basis_is_accepted_in_one_step():
    M, q, _ = problems.nonsymmetric(np.random.default_rng(11), 20, 20)
    cold = solve(M, q)
    warm = solve(M, q, initial_basis=cold.basis)
    assert (warm.iterations <= 1).all()
    np.testing.assert_allclose(warm.z, cold.z, rtol=1e-12, atol=1e-14)


def test_matrix_of_the_final_basis_is_nonsingular_with_redundant_contacts():
    M, q, _ = problems.stacked_cubes(np.random.default_rng(12), 50)
    result = solve(M, q)
    for b in range(50):
        A = np.nonzero(result.basis[b])[0]
        assert len(A) == 0 or np.linalg.cond(M[b][np.ix_(A, A)]) < 1e10


@pytest.mark.parametrize("shared", [False, True])
def test_adjoint_matches_central_differences(shared):
    rng = np.random.default_rng(13)
    M, q, _ = problems.nonsymmetric(rng, 4, 6)
    M = M[:1] if shared else M
    if shared:
        q = problems._plant(rng, np.repeat(M, 4, 0)).q
    cz, cw = rng.standard_normal((2, 4, 6))
    base = solve(M, q)
    assert (base.status == Status.SOLVED).all()
    grad_M, grad_q = adjoint(M[0] if shared else M, base, cz, cw, True)

    def value(M, q):
        result = solve(M, q)
        return (cz * result.z + cw * result.w).sum()

    for x, grad, rebuild in ((M, grad_M, lambda y: (y, q)), (q, grad_q, lambda y: (M, y))):
        direction = rng.standard_normal(x.shape)
        h = 1e-6
        slope = (value(*rebuild(x + h * direction)) - value(*rebuild(x - h * direction))) / (2 * h)
        assert (grad * direction).sum() == pytest.approx(slope, rel=1e-7)


def test_adjoint_skips_unsolved_elements_and_the_matrix_when_not_asked():
    M, q, _ = problems.positive_definite(np.random.default_rng(14), 3, 4)
    result = solve(M, q)
    ones = np.ones_like(q)
    result.status[1] = Status.UNSOLVED
    grad_M, grad_q = adjoint(M, result, ones, ones, False)
    assert grad_M is None
    assert (grad_q[1] == 0).all()
    assert (grad_q[[0, 2]] != 0).any()


def test_adjoint_at_a_singular_basis_is_exact_for_unique_quantities():
    M = np.ones((1, 3, 3))
    zero, ones = np.zeros((1, 3)), np.ones((1, 3))
    end = solve(M, -ones)._replace(z=ones / 3, basis=ones > 0)  # as an interior point ends
    _, grad_q = adjoint(M, end, ones, zero, True)
    assert grad_q.sum() == pytest.approx(-1.0)  # sum z = -q for equal q_i


@pytest.mark.parametrize("q", [-1.2345e-15, -1.2345e-22, -4e-307])
def test_a_solution_that_doubles_hold_in_part_only_is_not_solved(q):
    """z = 1.2345e-315 keeps nine of its digits."""
    assert solve([[1e300]], [q]).status[0] == Status.UNSOLVED
