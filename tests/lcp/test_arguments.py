"""What the keywords of `solve_lcp` and `LCPLayer` do, and what a wrong argument gets."""

import pytest
import torch
from lcp.oracles import planted, random_family

from lcplearn import LCPLayer, Status, solve_lcp


@pytest.mark.parametrize(("method", "verdict"), [("pivoting", Status.INFEASIBLE), ("interior_point", Status.UNSOLVED)])
def test_limit_on_iterations_is_reported_as_such_and_lifted_by_a_larger_one(method, verdict):
    M, q = torch.tensor([[1.0, -1.0], [-1.0, 1.0]]), -torch.ones(2)
    limited = solve_lcp(M, q, method=method, max_iter=1)
    assert limited.status == Status.MAX_ITERATIONS
    assert limited.iterations <= 1
    assert solve_lcp(M, q, method=method, max_iter=1000).status == verdict


def test_solvable_problem_is_solved_once_the_limit_allows_it():
    generator = torch.Generator().manual_seed(6)
    M = random_family("condition 1e10", 4, 50, generator)
    q, _ = planted(M, generator)
    assert (solve_lcp(M, q, method="pivoting", max_iter=1).status == Status.MAX_ITERATIONS).all()
    assert solve_lcp(M, q, method="pivoting", max_iter=10_000).solved.all()


@pytest.mark.parametrize("method", ["pivoting", "interior_point"])
def test_values_are_good_to_rounding_whatever_tol_calls_solved(method):
    generator = torch.Generator().manual_seed(7)
    M = random_family("nonsymmetric definite", 16, 10, generator)
    q, _ = planted(M, generator)
    strict, loose = (solve_lcp(M, q, method=method, tol=tol) for tol in (1e-300, 1e-2))
    assert loose.solved.all()
    assert strict.residual.max() <= 1e-13
    assert loose.residual.max() <= 1e-10


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda M, q: solve_lcp(M.numpy(), q), "M: expected a torch.Tensor; got ndarray"),
        (lambda M, q: solve_lcp(M.int(), q), "M: expected float32 or float64; got torch.int32"),
        (lambda M, q: solve_lcp(M, q.float()), "M, q: expected one dtype and device"),
        (lambda M, q: solve_lcp(M[:, :2], q), r"M: expected shape \[\*batch, n, n\]; got \[3, 2\]"),
        (lambda M, q: solve_lcp(M, q[:2]), r"q: expected shape \[\*batch, 3\]"),
        (lambda M, q: solve_lcp(M.expand(2, 3, 3), q.expand(4, 3)), "expected batch dimensions that broadcast"),
        (lambda M, q: solve_lcp(M, q, method="lemke"), "method: expected one of auto, pivoting"),
        (lambda M, q: solve_lcp(M, q, tol=-1.0), "tol: expected a positive"),
        (lambda M, q: solve_lcp(M, q, tol=0.0), "tol: expected a positive"),
        (lambda M, q: solve_lcp(M, q, max_iter=0), "max_iter: expected a positive integer"),
        (lambda M, q: solve_lcp(M, q, smoothing=-1.0), "smoothing: expected a finite"),
        (
            lambda M, q: solve_lcp(M, q, smoothing=0.1, method="diagonal"),
            "method: expected one of auto, interior_point for smoothing",
        ),
        (lambda M, q: LCPLayer(method="newton"), "method: expected one of"),
        (lambda M, q: solve_lcp(M.to_sparse(), q), "M: expected a dense tensor; got torch.sparse_coo"),
        (lambda M, q: solve_lcp(M, q, tol=torch.tensor(1e-9)), "tol: expected a positive"),
        (lambda M, q: solve_lcp(M, q, max_iter=2**63), "max_iter: expected a positive integer"),
        (lambda M, q: solve_lcp(M, q, smoothing=torch.tensor(0.1)), "smoothing: expected a finite"),
        (lambda M, q: solve_lcp(M, q, smoothing=None), "smoothing: expected a finite"),
        (lambda M, q: solve_lcp(M, q, initial_basis=[True] * 3), r"initial_basis: expected a bool .* got list"),
        (
            lambda M, q: solve_lcp(M, q, initial_basis=q),
            r"initial_basis: expected a bool .* got torch.float64 \[3\] on cpu",
        ),
        (lambda M, q: solve_lcp(M, q, initial_basis=q[:2] > 0), r"of shape \[3\] on cpu; got torch.bool \[2\]"),
        (lambda M, q: solve_lcp(M, q, initial_basis=(q > 0).to("meta")), r"on cpu; got torch.bool \[3\] on meta"),
        (
            lambda M, q: solve_lcp(M, q, initial_basis=q > 0, method="diagonal"),
            "method: expected auto or pivoting for initial_basis",
        ),
    ],
)
def test_wrong_argument_raises_a_value_error_that_names_it(call, message):
    with pytest.raises(ValueError, match=message):
        call(torch.eye(3), torch.ones(3))
