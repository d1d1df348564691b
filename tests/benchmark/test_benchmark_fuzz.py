"""The hunt itself: it finds what is planted, and what it writes can be replayed."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from lcplearn.benchmark.fuzz import checks as fuzz_checks
from lcplearn.benchmark.fuzz import run as fuzz
from lcplearn.benchmark.fuzz.cases import Batch, batch
from lcplearn.benchmark.fuzz.checks import check, enumerate_solution, residual
from lcplearn.lcp.residuals import judge
from lcplearn.lcp.solution import Status

INFEASIBLE_M, INFEASIBLE_Q = np.array([[[0.0, 1], [-1, 0]]]), np.array([[-1.0, -1]])


@pytest.mark.parametrize("index", range(7))
def test_a_batch_is_the_same_each_time_it_is_made(index):
    one, other = batch(5, index), batch(5, index)
    assert one.kind == other.kind
    np.testing.assert_array_equal(one.M, other.M)
    np.testing.assert_array_equal(one.q, other.q)
    assert one.M.shape == (*one.q.shape, one.q.shape[1])


def test_residual_in_extended_precision_is_that_of_the_judge():
    rng = np.random.default_rng(0)
    for _ in range(20):
        M, q, z = rng.standard_normal((4, 4)), rng.standard_normal(4), rng.random(4)
        ours = residual(M, q, z)
        theirs = judge(torch.from_numpy(M), torch.from_numpy(q), torch.from_numpy(z), tol=1e-10).residual
        assert max(ours.natural, ours.rows) == pytest.approx(float(theirs), rel=1e-12)


def test_enumeration_finds_solutions_and_their_absence():
    np.testing.assert_allclose(enumerate_solution(np.eye(2), np.array([-1.0, 2])), [1, 0])
    assert enumerate_solution(INFEASIBLE_M[0], INFEASIBLE_Q[0]) is None


@pytest.mark.parametrize(
    ("lie", "found"),
    [
        ({"status": torch.tensor([Status.SOLVED.value])}, "wrong SOLVED"),
        ({"status": torch.tensor([Status.NONFINITE_INPUT.value])}, "nonfinite input"),
        ({"z": torch.full((1, 2), torch.nan)}, "not finite"),
        ({"z": torch.full((1, 2), -1.0)}, "sign"),
        ({"certificate": torch.zeros(1, 2)}, "certificate"),
    ],
)
def test_a_lie_is_found(lie, found, monkeypatch):
    truthful = fuzz_checks.solve_lcp

    def lying(M, q, **options):
        solution = truthful(M, q, **options)
        return solution._replace(**{k: v.to(getattr(solution, k).dtype) for k, v in lie.items()})

    case = Batch("integers", INFEASIBLE_M, INFEASIBLE_Q, solvable=False)
    assert not [finding for finding in check(case) if finding.check.startswith("pivoting:")]
    monkeypatch.setattr(fuzz_checks, "solve_lcp", lying)
    assert any(finding.check.endswith(found) for finding in check(case))


def test_a_false_infeasible_is_found_by_enumeration(monkeypatch):
    truthful = fuzz_checks.solve_lcp
    status = torch.tensor([Status.INFEASIBLE.value])
    monkeypatch.setattr(fuzz_checks, "solve_lcp", lambda *a, **k: truthful(*a, **k)._replace(status=status))
    monkeypatch.setattr(fuzz_checks, "_check_alone", lambda *a: [])
    case = Batch("integers", np.eye(2)[None], np.array([[-1.0, 1]]), solvable=True)
    assert {"pivoting: certificate", "missed"} <= {finding.check for finding in check(case)}


def test_a_finding_can_be_written_and_replayed(tmp_path, capsys):
    case = Batch("integers", np.stack([np.eye(2), 2 * np.eye(2)]), -np.ones((2, 2)), solvable=True)
    finding = fuzz_checks.Finding("pivoting: wrong SOLVED", "a test", [1])
    path = fuzz.write_finding(tmp_path, case, finding, seed=0, index=3)
    with np.load(path, allow_pickle=False) as file:
        np.testing.assert_array_equal(file["M"], 2 * np.eye(2)[None])
    with pytest.raises(SystemExit, match="0"):
        fuzz.run(SimpleNamespace(replay=path))
    assert "nothing wrong now" in capsys.readouterr().out


def test_a_crash_is_found_and_the_hunt_goes_on(tmp_path, monkeypatch):
    """The child that starts at batch 0 dies; the next one starts at batch 1 and finds nothing."""
    script = "import sys, pathlib; n = sys.argv[3]; sys.exit('boom' if n == '0' else 0)"
    popen = fuzz.subprocess.Popen
    monkeypatch.setattr(
        fuzz.subprocess, "Popen", lambda command, **k: popen([command[0], "-c", script, *command[3:]], **k)
    )
    fuzz.hunt(tmp_path, seed=0, seconds=1.5)
    (crash,) = tmp_path.glob("*.npz")
    with np.load(crash, allow_pickle=False) as file:
        assert str(file["check"]) == "crash"
        assert "boom" in str(file["message"])
