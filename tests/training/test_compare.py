"""Runs side by side."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from lcplearn import compare
from lcplearn.training.figures_of_merit import KEYS


def run(folder: Path, target: str, config: dict[str, Any] | None = None, **figures: float | None) -> None:
    folder.mkdir(parents=True)
    model = {"_target_": f"lcplearn.formulations.{target}"}
    (folder / "config.yaml").write_text(yaml.safe_dump({"model": model, "seed": 0} | (config or {})))
    (folder / "metrics.json").write_text(json.dumps(dict.fromkeys(KEYS) | figures))


def test_runs_that_differ_in_their_seed_share_a_row_of_medians(tmp_path: Path) -> None:
    for seed, error in enumerate((1e-9, 3e-9, 1e-3)):
        run(tmp_path / f"a{seed}", "structured.Structured", {"seed": seed}, velocity_rmse=error, predict_us=400.0)
    run(tmp_path / "b", "baselines.MLP", velocity_rmse=0.1, predict_us=40.0)
    rows = compare.read_runs([tmp_path])
    found = [(row.label, row.seeds, row.values["velocity_rmse"], row.extremes["velocity_rmse"]) for row in rows]
    assert found == [("Structured", 3, 3e-9, (1e-9, 1e-3)), ("MLP", 1, 0.1, (0.1, 0.1))]
    assert "3e-09 (1e-09 to 0.001)" in compare.format_table(rows)


def test_the_same_seed_twice_is_one_seed(tmp_path: Path) -> None:
    for name in "ab":
        run(tmp_path / name, "structured.Structured", velocity_rmse=0.1)
    (row,) = rows = compare.read_runs([tmp_path])
    assert (row.seeds, row.runs) == (1, 2)
    assert compare.format_table(rows).splitlines()[0].split("|")[2:4] == [" seeds ", " runs "]


def test_runs_of_other_training_share_no_row(tmp_path: Path) -> None:
    for epochs in (3, 100):
        run(tmp_path / str(epochs), "baselines.MLP", {"trainer": {"max_epochs": epochs, "gradient_clip_val": 1.0}})
    labels = {row.label for row in compare.read_runs([tmp_path])}
    assert labels == {"MLP trainer.max_epochs=3", "MLP trainer.max_epochs=100"}


def test_a_run_that_diverged_counts_as_worse_than_all_others(tmp_path: Path) -> None:
    """Five good runs stand above one good and four without a figure; a word and a missing figure count alike."""
    for seed in range(5):
        run(tmp_path / f"good{seed}", "structured.Structured", {"seed": seed}, velocity_rmse=0.02, stick_accuracy=0.9)
        run(tmp_path / f"bad{seed}", "baselines.MLP", {"seed": seed})
    figures = [{"velocity_rmse": 0.01, "stick_accuracy": 1.0}, {"velocity_rmse": "diverged"}]
    figures += 3 * [{"velocity_rmse": None, "diverged": "in epoch 2"}]
    for seed, values in enumerate(figures):
        (tmp_path / f"bad{seed}" / "metrics.json").write_text(json.dumps(dict.fromkeys(KEYS) | values))
    good, bad = rows = compare.read_runs([tmp_path])
    assert (good.label, bad.label, bad.seeds, bad.diverged) == ("Structured", "MLP", 5, 3)
    assert bad.values["velocity_rmse"] == float("inf")
    assert bad.values["stick_accuracy"] == -float("inf")
    assert compare.format_table(rows).count("diverged (0.01 to diverged)") == 1
    compare.draw(rows)


def test_the_median_of_an_even_number_is_a_diverged_one_if_half_of_them_are(tmp_path: Path) -> None:
    for seed, error in enumerate((0.01, 0.02, None, None)):
        run(tmp_path / str(seed), "baselines.MLP", {"seed": seed}, velocity_rmse=error)
    (row,) = compare.read_runs([tmp_path])
    assert row.values["velocity_rmse"] == float("inf")


def test_an_error_of_exactly_zero_comes_first(tmp_path: Path) -> None:
    run(tmp_path / "a", "baselines.MLP", velocity_rmse=0.1)
    run(tmp_path / "b", "relu.ReLU", velocity_rmse=0.0)
    assert [row.label for row in compare.read_runs([tmp_path])] == ["ReLU", "MLP"]


def test_tosses_are_sorted_drawn_and_joined_over_seeds_of_their_models(tmp_path: Path) -> None:
    for seed, error in enumerate((9.0, 8.0)):
        config = {"seed": seed, "model": {"_target_": "here.CubeCorners", "seed": seed}}
        run(tmp_path / f"a{seed}", "", config, position_integral=error, train_seconds=1.0, predict_us=9.0)
    run(tmp_path / "b", "baselines.MLP", position_integral=0.0, train_seconds=1.0, predict_us=9.0)
    rows = compare.read_runs([tmp_path])
    assert [(row.label, row.seeds) for row in rows] == [("MLP", 1), ("CubeCorners", 2)]
    (ax,) = compare.draw(rows).axes
    assert ax.get_ylabel() == "position error of a toss [% of width]"
    assert [float(line.get_ydata()[0]) for line in ax.lines] == [1e-17, 8.5]


def test_long_names_leave_the_picture_its_place(tmp_path: Path) -> None:
    for k in range(2):
        stages = [{"epochs": epochs, "horizon": 8, "lr": 0.01 * (k + 1)} for epochs in range(9)]
        run(tmp_path / str(k), "baselines.MLP", {"stages": stages}, velocity_rmse=0.1 + k, predict_us=9.0)
    figure = compare.draw(compare.read_runs([tmp_path]))
    figure.draw_without_rendering()
    assert figure.axes[0].get_position().width > 0.3
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert [name.partition("... ")[2] for name in names] == ["(row 1)", "(row 2)"]


def test_a_row_is_named_by_what_sets_it_apart(tmp_path: Path) -> None:
    for horizon in (1, 10):
        config = {"loss": {"horizon": horizon}, "logger": {"save_dir": f"runs/{horizon}"}}
        run(tmp_path / str(horizon), "baselines.MLP", config)
    assert [row.label for row in compare.read_runs([tmp_path])] == ["MLP loss.horizon=1", "MLP loss.horizon=10"]


def test_settings_that_only_one_kind_of_data_has_set_no_other_apart(tmp_path: Path) -> None:
    for name, settings in (("read_slides", {"path": None}), ("simulate", {"noise": 0.0, "mu": 0.4})):
        run(tmp_path / name, "baselines.MLP", {"data": {"_target_": f"here.{name}", **settings}})
    assert sorted(row.label for row in compare.read_runs([tmp_path])) == ["MLP data=read_slides", "MLP data=simulate"]


def test_settings_that_are_no_yaml_get_one_sentence(tmp_path: Path) -> None:
    run(tmp_path / "a", "baselines.MLP", velocity_rmse=0.5)
    (tmp_path / "a" / "config.yaml").write_text("model: [")
    with pytest.raises(SystemExit, match=r"config.yaml can't be read") as error:
        compare.main([str(tmp_path)])
    assert "\n" not in str(error.value)


def test_figures_that_are_no_numbers_get_one_sentence(tmp_path: Path) -> None:
    run(tmp_path / "a", "baselines.MLP", velocity_rmse=[0.5])  # type: ignore[arg-type]
    with pytest.raises(SystemExit, match=r"metrics\.json: velocity_rmse: expected a number, null or .* got \[0\.5\]"):
        compare.main([str(tmp_path)])


def test_the_table_holds_only_figures_that_a_run_has(tmp_path: Path) -> None:
    run(tmp_path / "a", "baselines.MLP", velocity_rmse=0.5, parameters=7)
    text = compare.format_table(compare.read_runs([tmp_path]))
    assert text.splitlines()[0].split() == ["|", "run", "|", "seeds", "|", "one-step", "[m/s]", "|", "parameters", "|"]
    assert text.splitlines()[2].split() == ["|", "MLP", "|", "1", "|", "0.5", "|", "7", "|"]


def test_the_command_prints_the_table_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(tmp_path / "a", "baselines.MLP", velocity_rmse=0.5, predict_us=9.0, train_seconds=1.0, rollout_rmse_100=1.0)
    compare.main([str(tmp_path / "a"), "--out", str(tmp_path / "out")])
    assert "| MLP" in capsys.readouterr().out
    assert (tmp_path / "out" / "compare.md").is_file()
    assert (tmp_path / "out" / "compare.png").stat().st_size > 5000


def test_a_folder_without_runs_gets_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="holds no finished run"):
        compare.main([str(tmp_path)])
