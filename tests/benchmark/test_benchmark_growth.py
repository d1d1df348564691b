"""Large problems: cubes apart are what each is alone, and a study of growth measures, draws and says how they grow."""

import numpy as np
import torch

from lcplearn import solve_lcp
from lcplearn.benchmark.growth import run as growth
from lcplearn.benchmark.harness.study import Options, read_rows


def test_cubes_apart_are_solved_as_each_alone():
    M, q, _ = growth.separate_cubes(np.random.default_rng(0), 3, 2)
    together = solve_lcp(torch.from_numpy(M), torch.from_numpy(q))
    for k in (0, 24):
        rows = slice(k, k + 24)
        alone = solve_lcp(torch.from_numpy(M[:, rows, rows].copy()), torch.from_numpy(q[:, rows].copy()))
        torch.testing.assert_close(together.w[:, rows], alone.w, rtol=1e-9, atol=1e-9)
        assert not M[:, rows, 24 - k : 48 - k].any()


def test_a_study_of_growth_measures_draws_and_says_the_powers(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(growth, "CASES", {name: (make, sizes[:2]) for name, (make, sizes) in growth.CASES.items()})
    growth.run(Options(tmp_path, quick=True))
    rows = read_rows(tmp_path / "results.csv")
    assert [row["n"] for row in rows] == [48, 96, 48, 96, 50, 100]
    for row in rows:
        assert row["solved"] == 1
        assert row["worst_residual"] < 1e-12
        assert 0 < row["forward_low_ms"] <= row["forward_ms"] <= row["forward_high_ms"]
        assert row["backward_ms"] > 0
    assert "Powers of n" in capsys.readouterr().out
    assert len(list(tmp_path.glob("*.png"))) == 1
