"""A problem of islands, that no entry of M connects, has the answers of its islands, whatever the order of its rows."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lcp.oracles import has_solution, natural_residual, planted, random_family

from lcplearn import Status, solve_lcp
from lcplearn.lcp.kernel.islands import FEWEST_ROWS
from lcplearn.lcp.residuals import judge

small = st.integers(-2, 2)


def side_by_side(blocks, order):
    """One problem [1, n, n], [1, n] of the blocks (M, q), its rows in the given order; and the rows of each block."""
    M, q = torch.block_diag(*(M for M, _ in blocks)), torch.cat([q for _, q in blocks])
    place = torch.argsort(order)
    rows = [part.sort().values for part in place.split([len(q) for _, q in blocks])]
    return M[order][:, order].unsqueeze(0), q[order].unsqueeze(0), rows


def filled(blocks):
    """The blocks, again and again, until there are enough rows for islands to be looked for."""
    rows = sum(len(q) for _, q in blocks)
    return blocks * (2 * FEWEST_ROWS // rows + 1)


@st.composite
def blocks_of(draw, kind):
    """Some LCPs of small integers: of any matrix, or of a positive semidefinite one with a skew part."""

    def entries(*shape):
        count = math.prod(shape)
        return np.array(draw(st.lists(small, min_size=count, max_size=count)), float).reshape(shape)

    blocks = []
    for _ in range(draw(st.integers(2, 4))):
        n = draw(st.integers(1, 4))
        M, q = entries(n, n), entries(n)
        if kind == "semidefinite":
            K = entries(n, n)
            M = M @ M.T + K - K.T
        blocks.append((torch.from_numpy(M), torch.from_numpy(q)))
    return blocks


@settings(max_examples=60, deadline=None)
@given(st.data(), st.sampled_from(["any", "semidefinite"]))
def test_it_is_solved_where_all_islands_can_be_and_infeasible_where_one_is(data, kind):
    blocks = filled(data.draw(blocks_of(kind)))
    order = torch.tensor(data.draw(st.permutations(range(sum(len(q) for _, q in blocks)))))
    M, q, rows = side_by_side(blocks, order)
    solution = solve_lcp(M, q)
    status = Status(int(solution.status))
    possible = [has_solution(A.numpy(), b.numpy()) for A, b in blocks]
    if kind == "semidefinite":
        assert status is (Status.SOLVED if all(possible) else Status.INFEASIBLE)
    if status is Status.SOLVED:
        assert all(possible)
        assert natural_residual(M[0].numpy(), q[0].numpy(), solution.z[0].numpy()) <= 1e-9
    if status is Status.INFEASIBLE:
        assert not all(possible)
        u = solution.certificate[0]
        assert u.min() >= 0
        assert (M[0].T @ u).max() <= 1e-9 * u.max()
        assert q[0] @ u < 0
        guilty = [bool(u[part].any()) for part in rows]
        assert not any(can for can, blamed in zip(possible, guilty, strict=True) if blamed)
    else:
        assert not solution.certificate.any()


def random_blocks(seed, sizes=(5, 9, 3, 14), kind="nonsymmetric definite"):
    generator = torch.Generator().manual_seed(seed)
    blocks = []
    for n in sizes:
        M = random_family(kind, 1, n, generator)
        blocks.append((M[0], planted(M, generator)[0][0]))
    order = torch.randperm(sum(sizes), generator=generator)
    return *side_by_side(blocks, order), blocks


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("seed", range(5))
def test_each_island_gets_every_bit_that_it_would_get_alone(seed, dtype):
    M, q, rows, _ = random_blocks(seed)
    M, q = M.to(dtype).requires_grad_(), q.to(dtype).requires_grad_()
    solution = solve_lcp(M, q)
    grad_M, grad_q = torch.autograd.grad(solution.z.square().sum(), (M, q))
    residual, iterations = 0.0, 0
    for part in rows:
        A, b = M[0][part][:, part].detach().requires_grad_(), q[0, part].detach().requires_grad_()
        alone = solve_lcp(A, b)
        for name in ("z", "w", "basis"):
            assert torch.equal(getattr(solution, name)[0, part], getattr(alone, name))
        residual, iterations = max(residual, float(alone.residual)), iterations + int(alone.iterations)
        slopes = torch.autograd.grad(alone.z.square().sum(), (A, b))
        tight = {"rtol": 1e-9, "atol": 1e-12} if dtype is torch.float64 else {"rtol": 1e-4, "atol": 1e-5}
        torch.testing.assert_close((grad_M[0][part][:, part], grad_q[0, part]), slopes, **tight)
    assert float(solution.residual) == residual
    assert int(solution.iterations) == iterations


def test_rows_that_do_nothing_leave_every_bit_of_the_others():
    generator = torch.Generator().manual_seed(0)
    M = random_family("nonsymmetric definite", 40, 12, generator)
    q, _ = planted(M, generator)
    wide, wide_q = torch.eye(40).repeat(40, 1, 1), torch.ones(40, 40)
    wide[:, 7:19, 7:19], wide_q[:, 7:19] = M, q
    solution, alone = solve_lcp(wide, wide_q), solve_lcp(M, q)
    assert torch.equal(solution.z[:, 7:19], alone.z)
    assert torch.equal(solution.status, alone.status)
    assert not solution.z[:, :7].any()
    assert torch.equal(solution.w[:, 19:], wide_q[:, 19:])


@pytest.mark.parametrize("tol", [1e-16, 1e-14, 1e-12, 1e-10])
@pytest.mark.parametrize("kind", ["condition 1e10", "semidefinite"])
def test_the_judge_of_the_whole_problem_agrees_with_every_solved(tol, kind):
    for seed in range(20):
        M, q, _, _ = random_blocks(seed, kind=kind)
        solution = solve_lcp(M, q, tol=tol, method="pivoting")
        judged = judge(M, q, solution.z, tol=tol)
        if solution.solved:
            assert float(judged.residual) <= float(judged.tolerance)


def test_a_budget_of_pivots_is_that_of_the_whole():
    M, q, _, _ = random_blocks(1)
    enough = int(solve_lcp(M, q).iterations)
    assert int(solve_lcp(M, q, max_iter=enough).status) == Status.SOLVED
    for budget in (1, enough // 2):
        short = solve_lcp(M, q, max_iter=budget)
        assert int(short.status) == Status.MAX_ITERATIONS
        assert int(short.iterations) <= budget


def test_single_rows_need_a_pivot_each():
    n = 2 * FEWEST_ROWS
    M, q = torch.eye(n), -torch.ones(n)
    short, enough = (solve_lcp(M, q, max_iter=budget) for budget in (n - 1, n))
    assert int(short.status) == Status.MAX_ITERATIONS
    assert int(short.iterations) == n - 1
    assert enough.solved


@pytest.mark.parametrize("status", [Status.INFEASIBLE, Status.MAX_ITERATIONS])
def test_the_residual_of_what_is_not_solved_is_that_of_its_z_or_infinite(status):
    M, q, rows, _ = random_blocks(1)
    if status is Status.INFEASIBLE:
        M[0, rows[2]], q[0, rows[2]] = 0.0, -1.0
    solution = solve_lcp(M, q, max_iter=5 if status is Status.MAX_ITERATIONS else None)
    assert int(solution.status) == status
    own = float(judge(M, q, solution.z, tol=1e-10).residual)
    assert float(solution.residual) in (pytest.approx(own), float("inf"))


def test_islands_start_from_the_initial_basis():
    M, q, _, blocks = random_blocks(2)
    solution = solve_lcp(M, q)
    again = solve_lcp(M, q, initial_basis=solution.basis)
    assert torch.equal(again.basis, solution.basis)
    assert int(again.iterations) == sum(bool((b < 0).any()) for _, b in blocks)  # a round each


@pytest.mark.parametrize(
    ("a", "b"), [(1e-320, -1.0), (1e300, -1e-300), (1e-200, -1e200), (1.0, -1e-310), (1.0, -1e-300)]
)
def test_single_rows_at_the_ends_of_the_range_of_doubles_are_never_wrongly_solved(a, b):
    n = 2 * FEWEST_ROWS
    M, q = torch.eye(n).unsqueeze(0), torch.ones(1, n)
    M[0, 3, 3], q[0, 3] = a, b
    solution = solve_lcp(M, q)
    if solution.solved:
        judged = judge(M, q, solution.z, tol=1e-10)
        assert float(judged.residual) <= 1e-10


def test_a_batch_may_hold_whole_problems_and_islands():
    islands, q_islands, _, _ = random_blocks(3)
    generator = torch.Generator().manual_seed(4)
    whole = random_family("nonsymmetric definite", 3, 31, generator)
    q_whole, _ = planted(whole, generator)
    M, q = torch.cat((whole[:2], islands, whole[2:])), torch.cat((q_whole[:2], q_islands, q_whole[2:]))
    solution = solve_lcp(M, q)
    assert solution.solved.all()
    for k in range(4):
        assert all(torch.equal(a[k], b) for a, b in zip(solution, solve_lcp(M[k], q[k]), strict=True))
