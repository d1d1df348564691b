"""`benchmark models`: learned formulations on the same data and seeds, error against time, samples and noise."""

from collections.abc import Iterable, Sequence
from itertools import product
from typing import Any

import numpy as np
import torch

from lcplearn.benchmark.harness.study import Options, Row, Study, Table
from lcplearn.benchmark.models import figures as model_figures
from lcplearn.benchmark.models import modes
from lcplearn.benchmark.models.figures import median
from lcplearn.benchmark.models.training import (
    METRICS,
    MODE_COLUMNS,
    SIMULATED,
    SLIDES,
    WITH_SUPPORT,
    simulated,
    train_simulated,
    train_slides,
    warm_up,
)
from lcplearn.datasets import find
from lcplearn.scenes import Mode

KEY = ("part", "model", "noise", "size", "seed")
COLUMNS = (*METRICS, *MODE_COLUMNS, *WITH_SUPPORT, "entropy_bits")
BLANK: Row = dict.fromkeys(COLUMNS, float("nan"))
NOISES = (0.0, 0.01, 0.05)  # [m/s]
STEPS = (10, 30, 100, 300, 1000, 10_000)
SLIDE_COUNTS = (10, 40, 200)
QUICK_MODELS = ("affine", "mlp", "traditional", "relu", "structured", "physical")
CHAINED = ("stick and slip", "with separation")
MARKOV = {"previous mode stays": None, "markov_chain order 0": 0, "markov_chain order 1": 1, "markov_chain order 2": 2}


def run(options: Options) -> None:
    """Train, judge and report."""
    study = Study("models", options, KEY, COLUMNS)
    try:
        find("cube_slides.npz")
        left_out = ""
    except FileNotFoundError as error:
        left_out = f"Real slides were left out: {error}"
    warm_up()
    lifted = modes.simulate_modes(seed=options.seed, count=100 if options.quick else 400, steps=1000)
    for key in study.remaining(plan(options, slides=not left_out), seconds=expected_seconds):
        part, model, noise, size, seed = key
        if part == "simulated":
            row = train_simulated(str(model), float(noise), int(size), int(seed), lifted)
        elif part == "slides":
            row = train_slides(str(model), int(size), int(seed))
        else:
            row = markov_row(str(model), str(part), lifted, int(seed))
        study.add(key, BLANK | row)
    report(study, left_out)


def plan(options: Options, *, slides: bool) -> Iterable[tuple[Any, ...]]:
    """Keys of all rows. Seeds differ in data and start, and are the same for all models."""
    seeds = [options.seed + k for k in range(1 if options.quick else 3)]
    for seed in seeds:
        if options.quick:
            yield from _quick(seed, slides)
        else:
            yield from (("simulated", *rest, seed) for rest in product(SIMULATED, NOISES, STEPS))
            if slides:
                yield from (("slides", model, "", count, seed) for model, count in product(SLIDES, SLIDE_COUNTS))
        yield from ((part, model, "", 1000, seed) for part, model in product(CHAINED, MARKOV))


def _quick(seed: int, slides: bool) -> Iterable[tuple[Any, ...]]:
    for model, noise, steps in product(QUICK_MODELS, NOISES[:2], (100, 1000)):
        if steps == 1000 or noise == 0.01:
            if model == "mlp" and (noise == 0 or steps == 100):  # its training takes 10 times as long
                continue
            yield "simulated", model, noise, steps, seed
    if slides:
        yield from (("slides", model, "", 40, seed) for model in ("affine", "physical"))


def expected_seconds(part: Any, model: Any, noise: Any, size: Any, seed: Any) -> float:
    """Rough cost of a training of the full run."""
    if part == "slides":
        return 6.0
    if part != "simulated":
        return 0.05
    slow = {"mlp": 2.0, "force_mlp": 2.0, "traditional": 2.0, "psd": 2.0, "psd_skew": 2.0}
    return 0.7 + slow.get(str(model), 0.15 if "10-step" not in model else 0.8) * (0.5 + float(size) / 1000)


def markov_row(model: str, part: str, lifted: modes.ModeData, seed: int) -> Row:
    """A Markov chain fitted to the modes of half of the recordings and judged on the other half."""
    if part == "with separation":
        observed = lifted.mode
    else:
        recordings = simulated(1000, 0.0, seed)
        truth = recordings.test_long
        if truth is None or truth.true_states is None:
            raise ValueError("data: expected long simulated recordings")
        observed = torch.where(truth.true_states[:, 1:, 1] == 0, int(Mode.STICK), int(Mode.SLIP))
    half = len(observed) // 2
    order = MARKOV[model]
    if order is None:
        found = modes.score(observed[half:, :-1], observed[half:])
        return dict(zip(MODE_COLUMNS[:2], found, strict=True))
    predicted = modes.foretell(modes.chain(observed[:half], order), observed[half:])
    found = modes.score(predicted, observed[half:])
    row: Row = dict(zip(MODE_COLUMNS[:2], found, strict=True))
    return row | {"entropy_bits": modes.entropy(observed, order)}


def spread(rows: Sequence[Row], column: str) -> str:
    """Median and, with several seeds, the extremes."""
    values = sorted(float(row[column]) for row in rows if row[column] == row[column])
    if not values:
        return "-"
    middle = f"{np.median(values):.2g}"
    return middle if len(values) == 1 else f"{middle} ({values[0]:.2g} to {values[-1]:.2g})"


def report(study: Study, left_out: str) -> None:
    """Tables and figures."""
    rows = [row for row in study.rows if row["part"] == "simulated"]
    shown = [row for row in rows if row["size"] == 1000]
    names = list(dict.fromkeys(str(row["model"]) for row in rows))
    for noise in sorted({float(row["noise"]) for row in shown}):
        of_noise = [row for row in shown if row["noise"] == noise]
        study.say(
            f"Learned models, noise {noise:g} m/s",
            "1000 training steps; median over seeds (smallest to largest).",
            table=_table(of_noise, names),
        )
    study.say(
        "Which formulation should I learn?",
        "Error of a 100-step rollout and share of true sticks predicted exactly, against time; each dot a median over "
        "seeds for 1000 training steps, bars from the smallest to the largest.",
        figure=model_figures.against_time(shown, names),
    )
    study.say(
        "How much data does a formulation need?",
        "Error of a 100-step rollout and sticks predicted exactly; bars from the smallest to the largest seed.",
        figure=model_figures.against_samples(rows, names),
    )
    slides = [row for row in study.rows if row["part"] == "slides"]
    if slides:
        study.say(
            "Does it hold on real slides?",
            "Where real slides of a cube stop, learned from 40 of them, beside simulated blocks (noise 0.01 m/s).",
            table=_slides_table(slides),
            figure=model_figures.real_beside_simulated(slides, shown),
        )
    elif left_out:
        study.say("Real slides", left_out)
    _report_modes(study, shown)
    study.finish()


def _table(rows: Sequence[Row], names: Sequence[str]) -> Table:
    columns = {
        "velocity_rmse": "one step [m/s]", "rollout_rmse_100": "100 steps [m/s]", "rollout_rmse_1000": "1000 steps",
        "stick_accuracy": "stick", "false_stick": "false stick", "mu_error": "mu error", "train_seconds": "train [s]",
        "predict_us": "step [us]",
    }  # fmt: skip
    table: list[tuple[Any, ...]] = []
    for name in names:
        own = [row for row in rows if row["model"] == name]
        table.append((name, median(own, "parameters"), *(spread(own, column) for column in columns)))
    return Table(("model", "parameters", *columns.values()), table)


def _slides_table(slides: Sequence[Row]) -> Table:
    columns = ("stop_error_median_mm", "stop_error_p90_mm", "rest_share", "mu", "train_seconds")
    table: list[tuple[Any, ...]] = []
    for name, size in dict.fromkeys((str(row["model"]), float(row["size"])) for row in slides):
        own = [row for row in slides if (row["model"], row["size"]) == (name, size)]
        table.append((name, size, *(spread(own, column) for column in columns)))
    return Table(("model", "slides", *columns), table)


def _report_modes(study: Study, shown: Sequence[Row]) -> None:
    """Chains beside learned models, both with stick and slip only and with separation."""
    entries = []
    for part, name in product(CHAINED, MARKOV):
        own = [row for row in study.rows if (row["part"], row["model"]) == (part, name)]
        entries.append((part, name, own, MODE_COLUMNS[:2], ("", "")))
    learned = [row for row in shown if row["noise"] == 0.01]
    for name in dict.fromkeys(str(row["model"]) for row in learned):
        own = [row for row in learned if row["model"] == name]
        entries.append(("stick and slip", name, own, MODE_COLUMNS[:2], MODE_COLUMNS[2:]))
        if median(own, WITH_SUPPORT[0]) == median(own, WITH_SUPPORT[0]):
            entries.append(("with separation", f"{name}, normal force given", own, WITH_SUPPORT, ("", "")))
    table: list[tuple[Any, ...]] = [
        (part, name, *(median(own, c) for c in exact), *(median(own, c) if c else float("nan") for c in nearly),
         median(own, "entropy_bits"))
        for part, name, own, exact, nearly in entries
    ]  # fmt: skip
    heads = (
        "modes",
        "model",
        "all steps",
        "at changes",
        "all, |v| < 0.01",
        "at changes, |v| < 0.01",
        "entropy [bits]",
    )
    study.say(
        "Can a Markov chain foretell stick and slip?",
        "Share of modes foretold one step ahead: of all steps, and of those where the mode changes. Learned models "
        "(noise 0.01 m/s, 1000 steps) see velocity and force, chains only the modes before, of the true motion.",
        table=Table(heads, table),
        figure=model_figures.mode_bars(table),
    )
