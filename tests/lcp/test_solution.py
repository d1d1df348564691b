"""What a solution says about itself: the certificate, the messages, the summary."""

import doctest

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from lcp.oracles import has_solution

from lcplearn import LCPError, LCPLayer, Status, solve_lcp
from lcplearn.lcp import solve


def proves_infeasibility(M: torch.Tensor, q: torch.Tensor, u: torch.Tensor) -> bool:
    """u >= 0 with M'u <= 0 and q.u < 0: then u.(M z + q) < 0 for every z >= 0, so M z + q >= 0 has no solution."""
    return bool((u >= 0).all() and (M.mT @ u <= 1e-12 * M.abs().mT @ u).all() and q @ u <= -1e-9 * q.abs() @ u)


@settings(deadline=None, max_examples=100)
@given(st.data())
def test_infeasible_comes_with_a_certificate_and_anything_else_without(data):
    n = data.draw(st.integers(1, 6))
    M, q = (
        torch.from_numpy(data.draw(arrays(np.float64, shape, elements=st.integers(-3, 3)))) for shape in ((n, n), n)
    )
    M = M @ M.mT if data.draw(st.booleans()) else M
    solution = solve_lcp(M, q, method="pivoting")
    if solution.status == Status.INFEASIBLE:
        assert proves_infeasibility(M, q, solution.certificate)
        assert not has_solution(M.numpy(), q.numpy())
    else:
        assert not solution.certificate.any()


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
def test_an_infeasible_problem_is_proved_so_whatever_its_units(scale):
    """A negative friction limit: notes 2.5 with mu m g < 0."""
    M = scale * torch.tensor([[1.0, -1.0, 1.0], [-1.0, 1.0, 1.0], [-1.0, -1.0, 0.0]])
    q = torch.tensor([0.3, -0.3, -0.4]) / scale
    solution = solve_lcp(M, q)
    assert solution.status == Status.INFEASIBLE
    assert proves_infeasibility(M, q, solution.certificate)


def test_every_status_has_a_message_and_an_error_shows_that_of_each_status_met():
    assert all(len(status.message) > 20 for status in Status)
    M = torch.stack([-torch.eye(1), torch.eye(1), torch.eye(1)])
    q = torch.tensor([[-1.0], [-1.0], [torch.nan]])
    with pytest.raises(LCPError) as error:
        solve_lcp(M, q, throw=True)
    for status in (Status.INFEASIBLE, Status.NONFINITE_INPUT):
        assert f"{status.name}: {status.message}" in str(error.value)
    assert Status.UNSOLVED.message not in str(error.value)


def test_summary_shares_add_up_and_hold_plain_numbers():
    M = torch.stack([-torch.eye(1), torch.eye(1), torch.eye(1), torch.eye(1)])
    summary = solve_lcp(M, torch.tensor([[-1.0], [-1.0], [torch.nan], [0.0]])).summary()
    assert sum(summary[f"{status.name.lower()}_share"] for status in Status) == 1
    assert (summary["infeasible_share"], summary["degenerate_share"]) == (0.25, 0.25)
    assert all(type(value) is float for value in summary.values())


def test_throw_names_the_elements_and_the_reason():
    M, q = torch.eye(1).expand(3, 1, 1).clone(), torch.tensor([[-1.0], [torch.nan], [-1.0]])
    M[2] = -1
    with pytest.raises(LCPError, match=r"2 of 3 .*\(1,\), \(2,\).*NONFINITE_INPUT"):
        LCPLayer(throw=True)(M, q)


def test_summary_counts_statuses_and_kinks():
    M = torch.eye(2).expand(4, 2, 2).clone()
    q = torch.tensor([[-1.0, 1.0], [0.0, -1.0], [1.0, 1.0], [torch.nan, 0.0]])
    summary = solve_lcp(M, q).summary()
    assert summary["solved_share"] == 0.75
    assert summary["nonfinite_input_share"] == 0.25
    assert summary["degenerate_share"] == 0.25
    assert summary["worst_residual"] <= 1e-15


def test_the_worst_residual_of_a_summary_is_the_largest_of_the_solved():
    solution = solve_lcp(torch.eye(1).expand(3, 1, 1), torch.tensor([[-1.0], [1.0], [torch.nan]]))
    solution = solution._replace(residual=torch.tensor([1e-12, 3e-11, 1.0], dtype=torch.float64))
    assert solution.summary()["worst_residual"] == 3e-11


def test_repr_names_the_statuses_and_works_without_values():
    M, q = torch.stack([torch.eye(2), -torch.eye(2), torch.eye(2)]), -torch.ones(3, 2)
    text = repr(solve_lcp(M, q))
    assert text.startswith("LCPSolution: 2 SOLVED (0), 1 INFEASIBLE (1)\n  z=tensor(")
    assert "status=tensor([0, 1, 0])" in text
    seen = []
    torch.func.vmap(lambda q: seen.append(repr(solve_lcp(M[0], q))) or q)(q)
    assert seen[0].startswith("LCPSolution: no values")


def test_the_example_of_the_docstring_is_right():
    results = doctest.testmod(solve, extraglobs={"torch": torch})
    assert results.attempted >= 6
    assert results.failed == 0


@pytest.mark.parametrize(("size", "kink"), [(1e-9, True), (1e-7, False), (1e-5, False)])
def test_a_member_is_degenerate_only_below_a_hundred_millionth_of_the_others(size, kink):
    M, q = torch.eye(3), torch.tensor([-1.0, 1.0, size])
    assert solve_lcp(M, q).degenerate.tolist() == [False, False, kink]
    assert solve_lcp(M, -q).degenerate.tolist() == [False, False, kink]
