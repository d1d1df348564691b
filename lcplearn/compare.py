"""Put runs side by side: python -m lcplearn.compare RUNS...

RUNS are run folders, or folders above them. Runs that differ in their seed alone share a row: medians, with the
extremes in brackets. A run that diverged counts as worse than all others.
"""

import argparse
import json
import math
import statistics
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import yaml
from hydra.experimental.callback import Callback

from lcplearn import __version__
from lcplearn.training.figures_of_merit import KEYS, figure, in_order
from lcplearn.training.settings import flat

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Value = float | None
_LONGEST = 40  # letters of a name in the picture
# Settings that change nothing in what is learned; any other difference makes another row.
_SILENT = (
    "seed", "data.seed", "model.seed", "ckpt_path", "allow_changes", "logger.", "trainer.enable_progress_bar",
    "resumed.from",
)  # fmt: skip
# The far error that a picture shows: the first of these that a run has.
_FAR = {
    "deviation_mm": "deviation of end poses [mm]",
    "stop_error_median_mm": "where a slide stops: median error [mm]",
    "position_integral": "position error of a toss [% of width]",
    "rollout_rmse_1000": "error over 1000 steps [m/s]",
    "rollout_rmse_100": "error over 100 steps [m/s]",
}


class Row(NamedTuple):
    """Runs that share all settings but the seed.

    Attributes:
        label: What sets them apart from the other rows.
        runs: How many they are.
        seeds: How many different seeds they have.
        diverged: How many of them diverged in training.
        values: Median of each figure; None where no run has it, infinite where half of them or more have no number.
        extremes: Smallest and largest of each figure that has a median.
    """

    label: str
    runs: int
    seeds: int
    diverged: int
    values: dict[str, Value]
    extremes: dict[str, tuple[float, float]]


def read_runs(folders: Iterable[str | Path]) -> list[Row]:
    """Read metrics.json and config.yaml of all runs in or below the folders.

    Raises:
        ValueError: a folder without a finished run, or a file that can't be read.
    """
    paths: list[Path] = []
    for folder in folders:
        found = sorted({path.resolve().parent for path in Path(folder).rglob("metrics.json")})
        if not found:
            raise ValueError(f"{folder} holds no finished run: there is no metrics.json in or below it.")
        paths += [path for path in found if path not in paths]
    configs = [_read(path / "config.yaml", yaml.safe_load) for path in paths]
    groups: dict[str, list[int]] = {}
    for index, label in enumerate(_labels(configs)):
        groups.setdefault(label, []).append(index)
    metrics = [_figures(path / "metrics.json") for path in paths]
    rows = [
        _row(label, [configs[index] for index in group], [metrics[index] for index in group])
        for label, group in groups.items()
    ]
    return sorted(rows, key=_error)


def format_table(rows: Sequence[Row]) -> str:
    """A markdown table of the figures that any row has."""
    keys = in_order(key for row in rows for key, value in row.values.items() if value is not None)
    counts = ["seeds"]
    counts += ["runs"] if any(row.runs != row.seeds for row in rows) else []
    counts += ["diverged"] if any(row.diverged for row in rows) else []
    cells = [["run", *counts, *(figure(key).heading for key in keys)]]
    for row in rows:
        numbers = {"seeds": str(row.seeds), "runs": str(row.runs), "diverged": f"{row.diverged} of {row.runs}"}
        label = row.label.replace("|", "\\|")  # a bare one would end the cell
        cells.append([label, *(numbers[name] for name in counts), *(_cell(row, key) for key in keys)])
    widths = [max(len(line[column]) for line in cells) for column in range(len(cells[0]))]

    def line(texts: Sequence[str]) -> str:
        padded = [t.ljust(w) if i == 0 else t.rjust(w) for i, (t, w) in enumerate(zip(texts, widths, strict=True))]
        return "| " + " | ".join(padded) + " |"

    rule = "|" + "|".join("-" * (w + 1) + ("-" if i == 0 else ":") for i, w in enumerate(widths)) + "|"
    return "\n".join([line(cells[0]), rule, *(line(row) for row in cells[1:])])


def draw(rows: Sequence[Row]) -> "Figure":
    """Accuracy against cost: the error of a step against its time, that of a rollout against the time of training."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    there = {key for row in rows for key, value in row.values.items() if value is not None}
    far = next((key for key in _FAR if key in there), None)
    panels = [("predict_us", "velocity_rmse", "time of a step [us]", "error of a step [m/s]")]
    if far is not None:
        panels = panels if "velocity_rmse" in there else []
        panels.append(("train_seconds", far, "time of training [s]", _FAR[far]))
    figure = Figure(figsize=(4.6 * len(panels) + 2.6, 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    all_axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for ax, (x, y, xlabel, ylabel) in zip(all_axes, panels, strict=True):
        for index, row in enumerate(rows):
            # The table has all of a name that would cover the picture.
            name = row.label if len(row.label) <= _LONGEST else f"{row.label[:_LONGEST]}... (row {index + 1})"
            # Filled where it sticks, which tells the formulations apart more than any error.
            sticks = (row.values.get("stick_accuracy") or row.values.get("rest_share") or 0.0) >= 0.98
            ax.plot(
                _shown(row.values.get(x)), _shown(row.values.get(y)), "osD^v"[index // 10 % 5],
                color=f"C{index % 10}", fillstyle="full" if sticks else "none", markersize=9, mew=1.8, label=name,
            )  # fmt: skip
        ax.set(xscale="log", yscale="log", xlabel=xlabel, ylabel=ylabel)
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.xaxis.set_major_formatter(FormatStrFormatter("%g"))
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.margins(0.12)
        ax.grid(alpha=0.3)
    figure.legend(*all_axes[0].get_legend_handles_labels(), loc="outside right center", fontsize=9)
    figure.suptitle(
        "Accuracy against cost (filled: sticks in 98 % of cases or more; lower left is better)", fontsize=11
    )
    return figure


class CompareSweep(Callback):
    """Hydra callback: a sweep ends with the table and the picture of its runs."""

    def on_multirun_end(self, config: Any, **kwargs: Any) -> None:
        folder = Path(config.hydra.sweep.dir)
        if any(folder.rglob("metrics.json")):
            report([folder], folder)


def report(folders: Iterable[str | Path], out: str | Path) -> None:
    """Print the table and write compare.md and compare.png to a folder."""
    rows, out = read_runs(folders), Path(out)
    out.mkdir(parents=True, exist_ok=True)
    text = format_table(rows)
    (out / "compare.md").write_text(text + "\n")
    draw(rows).savefig(out / "compare.png", dpi=120)
    print(f"\n{text}\n\n{out / 'compare.png'}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; a folder that can't be compared ends it with one sentence."""
    parser = argparse.ArgumentParser(prog="python -m lcplearn.compare", description=__doc__.split("\n\n")[0])
    parser.add_argument("runs", nargs="+", metavar="RUNS", help="run folders, or folders above them")
    parser.add_argument("--out", default=".", help="folder for compare.md and compare.png (default: here)")
    parser.add_argument("--version", action="version", version=f"lcplearn {__version__}")
    options = parser.parse_args(arguments)
    try:
        report(options.runs, options.out)
    except (ValueError, OSError) as error:
        sys.exit(str(error))


def _read(path: Path, parse: Any) -> dict[str, Any]:
    try:
        values = parse(path.read_text())
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ValueError(f"{path} can't be read: {' '.join(str(error).split())}") from None
    if not isinstance(values, dict):
        raise ValueError(f"{path} holds no settings or figures.")
    return values


def _figures(path: Path) -> dict[str, Any]:
    """Figures of metrics.json, in which what is not finite is the word "diverged"; the sentence on it stays."""
    figures = _read(path, json.loads)
    for key, value in figures.items():
        if key == "diverged":
            continue
        figures[key] = math.inf if value == "diverged" else value
        if not isinstance(figures[key], float | int | None):
            raise ValueError(f'{path}: {key}: expected a number, null or "diverged", got {value!r}')
    return figures


def _labels(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Name of the model's class, and whatever else differs."""
    settings = [flat(config) for config in configs]
    names = {group: [_class_name(config, group) for config in settings] for group in ("model", "data")}
    labels = []
    for config, model, data in zip(settings, names["model"], names["data"], strict=True):
        parts = [model, *([f"data={data}"] if len(set(names["data"])) > 1 else [])]
        for key in sorted({key for other in settings for key in other}):
            if key.startswith(_SILENT) or key in ("model._target_", "data._target_"):
                continue
            # What a model or a data set brings along is no difference to others.
            owner = "model" if key.startswith("data.friction") else key.partition(".")[0]
            owners = names.get(owner, names["model"])
            mine = {"model": model, "data": data}.get(owner)
            values = [other.get(key) for other, name in zip(settings, owners, strict=True) if mine in (None, name)]
            if any(value != values[0] for value in values):
                parts.append(f"{key}={config.get(key)}")
        labels.append(" ".join(parts))
    return labels


def _class_name(config: Mapping[str, Any], group: str) -> str:
    return str(config.get(f"{group}._target_", "?")).rpartition(".")[2]


def _row(label: str, configs: Sequence[Mapping[str, Any]], runs: Sequence[Mapping[str, Any]]) -> Row:
    values: dict[str, Value] = {}
    extremes = {}
    for key in in_order((*KEYS, *(key for run in runs for key in run if key != "diverged"))):
        found = [run.get(key) for run in runs]
        if all(value is None for value in found):
            values[key] = None
            continue
        worst = -math.inf if figure(key).more_is_better else math.inf
        # Equal settings ask for equal figures: a run without one has diverged.
        counted = [worst if value is None or math.isinf(value) else value for value in found]
        # The higher or lower of two middle ones, not their mean: half a diverged pair is no figure.
        middle = statistics.median_low if worst < 0 else statistics.median_high
        finite = all(map(math.isfinite, counted))
        values[key], extremes[key] = (statistics.median if finite else middle)(counted), (min(counted), max(counted))
    seeds = {config.get("seed") for config in configs}
    return Row(label, len(runs), len(seeds), sum("diverged" in run for run in runs), values, extremes)


def _error(row: Row) -> float:
    """What rows are sorted by: the error of end poses, of stops, of tosses, or else of one step."""
    found = (row.values[key] for key in ("deviation_mm", "stop_error_median_mm", "position_integral", "velocity_rmse"))
    return next((value for value in found if value is not None), math.inf)


def _shown(value: Value) -> float:
    """A logarithmic axis has no zero."""
    return float("nan") if value is None or math.isinf(value) else max(value, 1e-17)


def _cell(row: Row, key: str) -> str:
    value = row.values.get(key)
    if value is None:
        return ""
    low, high = map(_number, row.extremes[key])
    return _number(value) + (f" ({low} to {high})" if low != high else "")


def _number(value: float) -> str:
    if math.isinf(value):
        return "diverged"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
