"""The measured figures themselves: timing in turns, exponents, gradients against the truth, checks that can fail."""

import numpy as np
import pytest
import torch

from lcplearn import solve_lcp
from lcplearn.benchmark.acceptance import speed as speed_checks
from lcplearn.benchmark.acceptance.accuracy import check_family, check_gradient, check_hard
from lcplearn.benchmark.harness.measuring import exponent, interleave, peak_memory
from lcplearn.benchmark.harness.study import Options, Study, read_rows
from lcplearn.benchmark.problems import families as problems
from lcplearn.benchmark.solvers import run as solvers
from lcplearn.benchmark.solvers.gradients import gradient_errors, line, reference
from lcplearn.benchmark.solvers.peers import peers
from lcplearn.benchmark.solvers.run import families, measure, plan, size

FAMILIES = ("F1 sliding block direct n=2", "F3 polygon n=8", "F5 positive definite n=10")


def quick(folder) -> Options:
    return Options(folder, quick=True)


def test_time_of_twice_the_work_is_twice_as_long():
    x = np.random.default_rng(0).standard_normal((150, 150))

    def multiply(times):
        for _ in range(times):
            x @ x

    once, twice = interleave({"once": lambda: multiply(4), "twice": lambda: multiply(8)}, 9).values()
    assert twice.over(once)[0] == pytest.approx(2.0, rel=0.5)
    middle, low, high = twice.over(once)
    assert low <= middle <= high
    assert once.low <= once.wall <= once.high


def test_peak_memory_of_an_array_is_its_size():
    peak = peak_memory(lambda: np.ones(4_000_000))
    assert np.isnan(peak) or peak == pytest.approx(32e6, rel=0.1)


def test_exponent_of_a_power_law_is_its_power():
    assert exponent([1, 10, 100], [2, 2e3, 2e6]) == pytest.approx(3.0)
    assert np.isnan(exponent([1], [2]))


@pytest.mark.parametrize("family", [*FAMILIES, "F4 cube n=24", "F6 semidefinite n=20", "F7 nonsymmetric P n=10"])
def test_true_slopes_are_those_of_finite_differences(family):
    """The reference itself: planted slopes and extrapolated ones agree with a plain difference of solutions."""
    data = problems.RANDOM_FAMILIES[family](np.random.default_rng(0), 20)
    truth = reference(family, data, seed=1)
    path, h = truth.line, 1e-6

    def loss(t):
        at = data.M * (1 + t * path.F) * (1 + t * path.H), data.q + t * path.dq
        z = solve_lcp(*map(torch.from_numpy, at)).z.numpy()
        return np.einsum("bm,bmn,bn->b", path.c, path.A, z)

    difference = (loss(h) - loss(-h)) / (2 * h)
    assert truth.trusted.sum() >= 5
    np.testing.assert_allclose(difference[truth.trusted], truth.slope[truth.trusted], rtol=1e-4, atol=1e-8)


def test_a_gradient_of_the_transposed_problem_is_found_to_be_wrong():
    """What a known peer does for M that is not symmetric."""
    data = problems.nonsymmetric(np.random.default_rng(0), 20, 5)
    truth = reference("F7", data, seed=1)
    assert np.median(gradient_errors(data, truth, torch.float64, method="pivoting")) < 1e-12
    z = torch.from_numpy(data.z)
    basis = z > 0
    block = torch.where(basis[:, :, None] & basis[:, None], torch.from_numpy(data.M), 0.0)
    block = block + torch.diag_embed((~basis).double())
    weights = torch.where(basis, torch.from_numpy(truth.line.c), 0.0)
    for K, wrong in ((block.mT, False), (block, True)):
        h = torch.where(basis, -torch.linalg.solve(K, weights), 0.0).numpy()
        dM = data.M * (truth.line.F + truth.line.H)
        slope = (h * (truth.line.dq + (dM @ data.z[..., None])[..., 0])).sum(1)
        error = np.abs(slope - truth.slope)[truth.trusted] / np.abs(truth.slope[truth.trusted])
        assert (np.median(error) > 0.05) == wrong


def test_a_line_of_friction_problems_stays_solvable():
    data = problems.stacked_cubes(np.random.default_rng(0), 20)
    path = line("F4 cube n=24", data, seed=1)
    moved = data.M * (1 + 0.01 * path.F), data.q + 0.01 * path.dq
    assert solve_lcp(*map(torch.from_numpy, moved)).solved.all()


def test_each_applicable_method_has_a_row_and_residuals_are_of_its_precision(monkeypatch):
    monkeypatch.setattr(solvers, "LONGEST_QUICK", 60.0)  # a busy machine leaves no method out
    data = problems.sliding_block_direct(np.random.default_rng(0), 12)
    for dtype, limit in ((torch.float64, 1e-14), (torch.float32, 2e-6)):
        rows = {row["method"]: row for row in measure(FAMILIES[0], data, dtype, Options(None, quick=True))}
        assert {"pivoting", "interior_point", "diagonal", "smoothed 1e-4", *peers()} <= set(rows)
        assert rows["pivoting"]["worst_residual"] <= limit
        assert rows["pivoting"]["gradient_error"] <= 1e-6
        assert rows["smoothed 1e-4"]["residual"] > 1e-6
        for row in rows.values():
            assert row["forward_cpu_low_us"] <= row["forward_cpu_us"] <= row["forward_cpu_high_us"]


def test_families_cover_sizes_1_to_100_and_batches_1_to_10000():
    keys = list(plan(families(quick=False), quick=False))
    assert {1, 2, 10, 50, 96, 100} <= {size(family) for family, _, _ in keys}
    assert {batch for _, batch, _ in keys} == {1, 10, 100, 1000, 10_000}
    assert len(keys) == len(set(keys))


def test_a_study_of_solvers_prints_draws_and_continues(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(solvers, "QUICK_FAMILIES", FAMILIES[:2])
    monkeypatch.setattr(solvers, "QUICK_BATCHES", (100,))
    monkeypatch.setattr(solvers, "METHODS", {name: solvers.METHODS[name] for name in ("pivoting", "diagonal")})
    solvers.run(quick(tmp_path))
    assert "Which solver is fastest" in capsys.readouterr().out
    assert len(list(tmp_path.glob("*.png"))) == 3
    rows = read_rows(tmp_path / "results.csv")
    monkeypatch.setattr(solvers, "measure", lambda *_: pytest.fail("measured again"))
    monkeypatch.setattr(solvers, "_say", lambda *_: None)
    solvers.run(quick(tmp_path))
    assert read_rows(tmp_path / "results.csv") == rows


@pytest.mark.parametrize("family", ["F3 polygon n=8", "Murty n=2..20"])
def test_checks_of_families_pass(family, tmp_path):
    for method in ("pivoting", "interior_point", "pivoting float32"):
        assert check_family(family, quick(tmp_path), method=method, share=1.0).must_met


def test_a_solver_that_lies_fails_its_check(tmp_path, monkeypatch):
    from lcplearn.benchmark.acceptance import accuracy as accuracy_checks

    truthful = accuracy_checks.solve
    monkeypatch.setattr(accuracy_checks, "solve", lambda *a: truthful(*a)._replace(statuses=["UNSOLVED"] * 40))
    assert not check_family("F3 polygon n=8", quick(tmp_path), method="pivoting", share=1.0).must_met
    monkeypatch.setattr(accuracy_checks, "solve", lambda *a: (true := truthful(*a))._replace(z=2 * true.z))
    assert not check_family("F3 polygon n=8", quick(tmp_path), method="pivoting", share=1.0).must_met


def test_checks_of_hard_cases_and_gradients_pass(tmp_path):
    assert check_hard("ties and cycles", quick(tmp_path), method="pivoting").must_met
    for case in ("F3 polygon n=8", "redundant contacts k=8"):
        assert check_gradient(case, quick(tmp_path)).must_met


def test_without_a_peer_its_checks_say_that_they_were_skipped(tmp_path, monkeypatch):
    monkeypatch.setattr(speed_checks, "peers", dict)
    finding = speed_checks.check_quantecon("F3 polygon n=8", quick(tmp_path))
    assert "not installed" in finding.words
    assert np.isnan(finding.figure)


def test_a_panel_is_left_out_where_nothing_was_measured():
    from lcplearn.benchmark.acceptance.run import draw_ratios

    row = {"check": speed_checks.AGAINST_INTERIOR_POINT, "case": "F5", "figure": 30.0}
    peer = {"check": speed_checks.AGAINST_QUANTECON, "case": "F5", "figure": float("nan")}
    assert len(draw_ratios([row, peer]).axes) == 1
    assert draw_ratios([peer]) is None


def test_acceptance_says_what_is_below_its_floor(tmp_path, capsys, monkeypatch):
    from lcplearn.benchmark.acceptance import run as acceptance
    from lcplearn.benchmark.acceptance.check import Check, Finding

    checks = (
        Check("fine", "<= 1", "", "x", lambda quick: ["a"], lambda case, options: Finding(0.5, True, True), 1.0),
        Check("too slow", "<= 1", "", "x", lambda quick: ["a", "b"], lambda c, o: Finding(2.0, c == "a", False), 1.0),
    )
    monkeypatch.setattr(acceptance, "CHECKS", checks)
    acceptance.run(quick(tmp_path))
    assert "Below its floor: too slow." in capsys.readouterr().out
    assert isinstance(Study("acceptance", quick(tmp_path), ("check", "case"),
                            ("figure", "must_met", "goal_met", "words")).rows[0]["figure"], float)  # fmt: skip
