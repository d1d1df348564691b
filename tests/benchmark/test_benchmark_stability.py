"""The noise study, the hard cases and the judgement of what methods do with them."""

import numpy as np
import pytest
import torch
from real_data import real_data

from lcplearn.benchmark.problems.hard_cases import hard_families, published_cases
from lcplearn.benchmark.solvers import methods
from lcplearn.benchmark.solvers.methods import Answer, gradient_error, solve
from lcplearn.benchmark.stability import noise as noise_study
from lcplearn.benchmark.stability import run as stability
from lcplearn.benchmark.stability.noise import stick_share
from lcplearn.benchmark.stability.sweeps import SWEEPS, sweep

CASES = hard_families()


def share(form, push, entries, sigma=1e-4):
    return stick_share(form, push, entries, sigma, samples=1000, seed=0)["sticks"]


@pytest.mark.parametrize("form", noise_study.FORMS)
@pytest.mark.parametrize("push", noise_study.PUSHES)
def test_without_noise_every_block_sticks(form, push):
    assert share(form, push, "all", 0.0) == 1


@pytest.mark.parametrize(
    ("form", "push", "low", "high"),
    [
        ("traditional", "u = 0", 0.20, 0.30),
        ("traditional", "u != 0", 0.0, 0.0),
        ("slack, known", "u != 0", 0.0, 0.0),
        ("slack + relu", "u != 0", 0.20, 0.30),
        ("slack", "u != 0", 1.0, 1.0),
        ("direct", "u != 0", 1.0, 1.0),
        ("structured", "u != 0", 1.0, 1.0),
    ],
)
def test_noise_on_all_entries_ends_sticking_where_velocity_comes_from_cancellation(form, push, low, high):
    assert low <= share(form, push, "all") <= high


def test_the_traditional_form_survives_noise_on_the_entries_that_cancel():
    """Noise on M12 or M21 is harmless for one sign of the push and on q1 or q2 mostly not."""
    found = {name: share("traditional", "u != 0", str(i)) for i, name in enumerate(noise_study.TRADITIONAL_ENTRIES)}
    assert [found[name] for name in ("M13", "M23", "M31", "M32", "M33", "q3")] == [1] * 6
    assert [found[name] for name in ("M11", "M22", "M12", "M21", "q1", "q2")] == pytest.approx(
        [0.50, 0.50, 0.75, 0.75, 0.26, 0.26], abs=0.05
    )


def test_perturbing_one_entry_changes_one_entry_of_each_sample():
    changed = noise_study.perturb(torch.Generator().manual_seed(0), torch.zeros(50, 7), 1.0, "one") != 0
    assert (changed.sum(-1) == 1).all()
    assert changed.any(0).all()


@pytest.mark.parametrize("case", [case for case in CASES if case.value is not None], ids=lambda case: case.name)
def test_what_a_case_calls_unique_belongs_to_a_solution(case):
    """Oracle: complementarity, row by row, of a z that has the value; an ill-conditioned z is known no better."""
    z = solve("pivoting", case.M[None], case.q[None]).z[0]
    w = case.M @ z + case.q
    omega = np.abs(case.q) + np.abs(case.M) @ np.abs(z)
    assert (z >= 0).all()
    assert (w >= -1e-12 * omega).all()
    assert (np.minimum(z, np.abs(w)) <= 1e-12 * np.where(z < np.abs(w), z.max(initial=0), omega)).all()
    assert stability.relative_error(case, z) <= case.tolerance


@pytest.mark.parametrize(("method", "every"), [("pivoting", 1), ("interior_point", 15)])  # 1 s a case
def test_no_hard_case_gets_a_wrong_answer(method, every):
    rows = [(case.name, stability.case_row(case, method)) for case in CASES[::every]]
    assert not [(name, row) for name, row in rows if row["verdict"] == "wrong"]


def test_published_cases_get_no_wrong_answer_from_pivoting():
    real_data("lcp_cases.npz")
    rows = [(case.name, stability.case_row(case, "pivoting")) for case in published_cases(30)]
    assert len(rows) > 40
    assert not [(name, row) for name, row in rows if row["verdict"] != "right"]


def test_a_false_claim_is_wrong_an_honest_failure_gives_up_and_a_bad_value_is_inexact():
    case = next(case for case in CASES if case.name == "ties")
    tolerance = np.array([1e-10])

    def judged(z, status, residual):
        answer = Answer(np.full((1, 3), z), [status], np.array([residual]), tolerance)
        return stability.verdict(case, answer, stability.relative_error(case, answer.z[0]), True, "pivoting")

    assert judged(1 / 3, "SOLVED", 1e-16) == "right"
    assert judged(1 / 3 + 1e-6, "SOLVED", 1e-11) == "inexact"
    assert judged(0.0, "UNSOLVED", 1.0) == "gives up"
    assert judged(0.0, "SOLVED", 1.0) == "wrong"
    unsolvable = next(case for case in CASES if case.family == "feasible, unsolvable")
    answer = Answer(np.zeros((1, 2)), ["SOLVED"], np.zeros(1), tolerance)
    assert stability.verdict(unsolvable, answer, float("nan"), True, "pivoting") == "wrong"


def test_a_solver_that_raises_is_wrong(monkeypatch):
    def broken(*_, **__):
        raise IndexError("no such row")

    monkeypatch.setattr("lcplearn.benchmark.solvers.methods.solve_lcp", broken)
    row = stability.case_row(CASES[0], "pivoting")
    assert row["status"] == "RAISED IndexError"
    assert row["verdict"] == "wrong"


def test_a_peer_that_claims_what_it_has_not_solved_is_wrong_and_one_that_says_so_gives_up(monkeypatch):
    def peer(claims):
        return lambda M, q: (np.zeros_like(q), np.full(len(q), claims))

    monkeypatch.setattr(methods, "peers", lambda: {"liar": peer(True), "modest": peer(False)})
    assert stability.case_row(CASES[0], "liar")["verdict"] == "wrong"
    assert stability.case_row(CASES[0], "modest")["verdict"] == "gives up"


def test_the_gradient_check_finds_a_wrong_gradient(monkeypatch):
    M, q = np.array([[2.0, 1.0], [0.0, 3.0]]), np.array([-1.0, -2.0])
    assert gradient_error("pivoting", M, q, np.eye(2), False) < 1e-5
    right = torch.autograd.grad
    monkeypatch.setattr(torch.autograd, "grad", lambda *a, **k: [1.5 * g for g in right(*a, **k)])
    assert gradient_error("pivoting", M, q, np.eye(2), False) > 0.1


@pytest.mark.parametrize("name", SWEEPS)
def test_the_easy_end_of_a_sweep_is_solved_to_rounding(name):
    row = sweep(name, 1.0, "pivoting", 0)
    assert row["solved"] == 1
    assert row["error"] < 1e-12


def test_a_block_whose_lcp_is_not_solved_does_not_count_as_at_rest(monkeypatch):
    def half(generator, force, sigma, entries):
        return noise_study.Outcome(torch.zeros_like(force), torch.arange(len(force)) % 2 == 0)

    monkeypatch.setitem(noise_study.FORMS, "half", half)
    found = stick_share("half", "u = 0", "all", 0.0, samples=10, seed=0)
    assert found == {"sticks": 0.5, "nearly_sticks": 0.5, "solved": 0.5}
