"""`benchmark tosses`: learned bodies, simulators and a network on the same real tosses, and how many they need."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from torch import Tensor

from lcplearn.benchmark.harness.measuring import interleave
from lcplearn.benchmark.harness.study import Options, Row, Study, Table, Value
from lcplearn.benchmark.tosses.mujoco_cube import MujocoCube, tune
from lcplearn.benchmark.tosses.starts import denoised
from lcplearn.datasets.cube_tosses import Tosses, read_tosses, split
from lcplearn.formulations import Formulation, build
from lcplearn.formulations.cube_corners import CubeCorners
from lcplearn.scenes.scene import Drive, rollout
from lcplearn.scenes.spatial_body import box_corners
from lcplearn.scenes.tossed_cube import TossedCube
from lcplearn.train import CONF
from lcplearn.training import fit
from lcplearn.training.checkpoint import load
from lcplearn.training.toss_figures import error_against_tosses
from lcplearn.training.toss_metrics import paired_difference, score_tosses, summarise
from lcplearn.training.toss_scores import TOGETHER

POSITION, ROTATION = "position integral [% width]", "rotation integral [deg]"
COLUMNS = (
    *("position", "position_median", "position_error", "rotation", "rotation_median", "rotation_error"),
    *("penetration", "same_face", "at_rest", "exact", "unsolved"),
    *("more_position", "more_position_low", "more_position_high"),
    *("more_rotation", "more_rotation_low", "more_rotation_high", "microseconds", "corners", "training"),
)
CHECKPOINTS = {"body": "cube_body.ckpt", "corners": "cube_corners.ckpt"}
ENGINES = ("MuJoCo, published", "MuJoCo, tuned")
DENOISED = "body, denoised starts"
SYSTEMS = (*CHECKPOINTS, DENOISED, *ENGINES, "published", "free flight")
COUNTS = (1, 4, 16, 64)
LEARNED = {
    "position": "position [% width]", "rotation": "rotation [deg]", "at_rest": "at rest", "exact": "exactly",
    "unsolved": "unsolved", "corners": "corners [% half width]", "training": "training [s]",
}  # fmt: skip
ABLATIONS = {  # what is overridden in experiment=cube_body
    "as it is": (),
    "horizon of 32 rows": ("loss.horizon=32",),
    "horizon of 64 rows": ("loss.horizon=64",),
    "one friction": ("~model.learn.mu_impact",),
    "compliance learned": ("+model.learn.compliance=0.01",),
    "one substep": ("model.fixed.substeps=1",),
    "four substeps": ("model.fixed.substeps=4",),
    "continuous restitution": ("model.fixed.restitution_law=continuous",),
    "one substep, continuous restitution": ("model.fixed.substeps=1", "model.fixed.restitution_law=continuous"),
    "friction by a network": ("model=cube_network", "~model.learn.mu_impact"),
    "restitution by a network": ("model=cube_network", "model.corrects=restitution"),
    "force by a network": ("model=cube_network", "model.corrects=force"),
}
PREDICTS = Callable[[Tensor, int], tuple[Tensor, Tensor | None]]  # start, steps -> states, whether each step is right


def run(options: Options) -> None:
    """Measure and print. In quick form the 48 choosing tosses judge, so that one may look often."""
    study = Study("tosses", options, ("table", "system", "tosses", "seed"), COLUMNS)
    tosses = read_tosses()
    has_engine = find_spec("mujoco") is not None
    for table, system, number, seed in study.remaining(_plan(options, has_engine), seconds=20.0):
        learn, choose, judge = split(tosses.numbers, int(seed))
        judged = choose if options.quick else judge
        if table == "time":
            row: Row = {"microseconds": microseconds(tosses, str(system), int(number))}
        elif table == "number":
            folder, started = options.output / "runs" / f"{system}_{number}_{seed}", perf_counter()
            model = trained(f"cube_{system}", int(number), int(seed), folder)
            row = {"training": perf_counter() - started, "corners": corner_error(model)}
            row |= figures(tosses, judged, _of_model(model), None)[0]
        elif table == "ablation":
            folder = options.output / "runs" / f"{system} {seed}"
            model = trained("cube_body", int(number), int(seed), folder, *ABLATIONS[str(system)])
            row, _ = figures(tosses, choose, _of_model(model), None)
        else:
            predicts = system_of(str(system), tosses, learn, options)
            own = None if system == "body" else figures(tosses, judged, _of_model(checkpoint("body")), None)[1]
            row, _ = figures(denoised(tosses) if system == DENOISED else tosses, judged, predicts, own)
            row["corners"] = corner_error(checkpoint(str(system))) if system in CHECKPOINTS else float("nan")
        study.add((table, system, number, seed), dict.fromkeys(COLUMNS, float("nan")) | row)
    _say(study, has_engine)
    study.finish()


def _plan(options: Options, has_engine: bool) -> Iterator[tuple[str, str, int, int]]:
    yield from (("judged", name, 64, 0) for name in SYSTEMS if has_engine or name not in ENGINES)
    yield from (("time", name, batch, 0) for name in CHECKPOINTS for batch in (1, 64))
    if has_engine:
        yield "time", "MuJoCo, tuned", 1, 0
    seeds = [options.seed + k for k in range(1 if options.quick else 3)]
    for number in COUNTS[1:2] if options.quick else reversed(COUNTS):
        yield from (("number", name, number, seed) for name in CHECKPOINTS for seed in seeds)
    yield from (("ablation", name, 64, seed) for name in ABLATIONS for seed in seeds)
    yield "judged", "network", 64, 0


def checkpoint(name: str) -> Formulation:
    """A model that comes with the repository."""
    return load(Path(__file__).parents[3] / "data" / "checkpoints" / CHECKPOINTS[name], "cpu")


def corner_error(model: Formulation) -> float:
    """Root mean square error of learned corners [% of the half width], a common shift aside; NaN without any."""
    if not isinstance(model, CubeCorners):
        return float("nan")
    half_width = model.given["half_width"]
    corners = model.numbers()["corners"].detach()
    off = corners - box_corners(torch.full((3,), half_width, dtype=corners.dtype))
    return float(100.0 / half_width * (off - off.mean(0)).square().mean().sqrt())


def system_of(name: str, tosses: Tosses, learn: list[int], options: Options) -> PREDICTS:
    """What predicts states from a start; tuned or trained, if it has to be, on the tosses to learn from."""
    if name in CHECKPOINTS or name == DENOISED:
        return _of_model(checkpoint("body" if name == DENOISED else name))
    if name == "network":
        return _of_model(trained("cube_mlp", 64, 0, options.output / "runs" / "network"))
    if name in ENGINES:
        cube = MujocoCube()
        if name == "MuJoCo, tuned":
            cube = tune(tosses, learn, MujocoCube(radius=0.1), evaluations=20 if options.quick else 300)
        return lambda start, steps: (cube.rollout(tosses, start, steps), None)
    scene = TossedCube(
        half_width=tosses.half_width,
        mass=tosses.mass,
        gravity=tosses.gravity,
        inertia=tosses.inertia,
        mu=tosses.mu,
        restitution=tosses.restitution,
        ground=-1e6 if name == "free flight" else 0.0,
        dt=tosses.dt,
    )
    return partial(_roll, partial(rollout, scene))


def trained(experiment: str, number: int, seed: int, folder: Path, *more: str) -> Formulation:
    """Train what `python train.py experiment=... data.tosses=... seed=...`, and more overrides, trains."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        overrides = [f"experiment={experiment}", f"data.tosses={number}", f"seed={seed}", "data.judge=false"]
        config = compose("train", overrides=[*overrides, "logger=none", *more])
    data = replace(instantiate(config.data, _convert_="all"), judged_by=())  # who judges is no business of a training
    asked = instantiate(config.model, _partial_=True, _convert_="all")
    loss, trainer = (instantiate(part, _convert_="all") for part in (config.loss, config.trainer))
    result = fit(
        build(asked.func, data, **asked.keywords), data, horizon=loss.pop("horizon"), loss=loss,
        stages=instantiate(config.stages, _convert_="all"), epochs=trainer.pop("max_epochs"),
        batch_size=config.batch_size, batches=config.batches, optimizer=instantiate(config.optimizer),
        patience=config.patience, seed=seed,
        folder=folder, trainer={**trainer, "enable_progress_bar": False},
    )  # fmt: skip
    return result.model


def _of_model(model: Formulation) -> PREDICTS:
    return partial(_roll, lambda start, drive: model.rollout(start, drive.force))


@torch.no_grad()
def _roll(roll: Callable[[Tensor, Drive], Any], start: Tensor, steps: int) -> tuple[Tensor, Tensor | None]:
    path = roll(start, Drive(start.new_zeros(len(start), steps, 6)))
    return path.states, path.solved


def figures(
    tosses: Tosses, judged: list[int], predicts: PREDICTS, others: dict[str, Tensor] | None
) -> tuple[Row, dict[str, Tensor]]:
    """Figures of whole tosses from row 0, and by how much the errors exceed those of others on the same tosses."""
    states, steps = tosses.states[judged], tosses.steps[judged]
    predicted, unsolved = states[:, :1].repeat(1, states.shape[1], 1), 0
    for chosen in steps.argsort().split(TOGETHER):
        longest = int(steps[chosen].max())
        found, solved = predicts(states[chosen, 0], longest)
        predicted[chosen, 1 : longest + 1] = found[:, 1:]
        unsolved += 0 if solved is None else int((~solved & (torch.arange(longest) < steps[chosen, None])).sum())
    scores = score_tosses(states, predicted, steps, tosses.half_width)
    row: Row = {"unsolved": unsolved / int(steps.sum())}
    for name, key in (("position", POSITION), ("rotation", ROTATION)):
        mean, median, error = summarise(scores[key])
        row |= {name: mean, f"{name}_median": median, f"{name}_error": error}
        if others is not None:
            more = paired_difference(scores[key], others[key])
            row |= {f"more_{name}{end}": x for end, x in zip(("", "_low", "_high"), more, strict=True)}
    for name, key in (
        ("penetration", "penetration integral beyond the recorded [% width]"),
        ("same_face", "same face down at the end [share]"),
        ("at_rest", "at rest at the end [share]"),
        ("exact", "exactly at rest at the end [share]"),
    ):
        row[name] = float(scores[key].mean())
    return row, scores


def microseconds(tosses: Tosses, system: str, batch: int) -> float:
    """Median CPU time of a row, in rollouts of 100 rows: on an idle core that of the wall clock."""
    start = tosses.states[:batch, 0]
    cube = MujocoCube(radius=0.1)
    ours = system in CHECKPOINTS
    predicts = _of_model(checkpoint(system)) if ours else lambda x, steps: (cube.rollout(tosses, x, steps), None)
    call = partial(predicts, start, 100)
    call()
    return 1e4 * interleave({"": call}, 15)[""].cpu / batch


def _say(study: Study, has_engine: bool) -> None:
    judged = {str(row["system"]): row for row in study.rows if row["table"] == "judged"}
    study.say(
        "Who predicts tosses best?",
        f"Whole tosses from row 0 of each, on the {'choosing' if study.options.quick else 'judging'} tosses: mean, "
        "median in brackets, standard error of the mean. `more` is by how much an error exceeds that of `body` on the "
        "same tosses, with its 95 % interval." + ("" if has_engine else " MuJoCo is not installed: left out."),
        table=Table(
            (
                "system",
                "position [% width]",
                "more",
                "rotation [deg]",
                "more",
                "penetration",
                "at rest",
                "exactly",
                "unsolved",
            ),
            [[name, *_cells(row)] for name, row in judged.items()],
        ),
    )
    study.say(
        "How long does a row take?",
        "Microseconds of CPU time, rollouts of 100 rows; MuJoCo with four substeps a row.",
        table=Table(
            ("system", "tosses together", "us a row"),
            [[row["system"], row["tosses"], row["microseconds"]] for row in study.rows if row["table"] == "time"],
        ),
    )
    learned = [row for row in study.rows if row["table"] == "number"]
    rows = []
    for name in CHECKPOINTS:
        for number in dict.fromkeys(row["tosses"] for row in learned):
            those = [row for row in learned if row["system"] == name and row["tosses"] == number]
            rows.append([name, number, *(_spread(those, what) for what in LEARNED)])
    study.say(
        "How many tosses does a model need?",
        "Median over seeds (smallest to largest); a seed is another split, another start and another order.",
        table=Table(("model", "tosses", *LEARNED.values()), rows),
    )
    tried = {name: {row["seed"]: row for row in study.rows if row["system"] == name} for name in ABLATIONS}
    study.say(
        "What if the body were otherwise?",
        "`body` from 64 tosses with something changed, on the choosing tosses of each split: mean over the splits, and "
        "the difference to `body` as it is on the same tosses, smallest and largest of the splits.",
        table=Table(
            ("body", "position [% width]", "more", "rotation [deg]", "more", "exactly at rest"),
            [[name, *_changes(rows, tried["as it is"])] for name, rows in tried.items()],
        ),
    )
    for what, unit in (("position", "position integral [% of width]"), ("rotation", "rotation integral [deg]")):
        runs = {
            name: [(int(row["tosses"]), float(row[what])) for row in learned if row["system"] == name]
            for name in CHECKPOINTS
        }
        anchors = {name: float(row[what]) for name, row in judged.items() if name in (*ENGINES, "published")}
        study.say(f"{what} error against the number of tosses", "", figure=error_against_tosses(runs, anchors, unit))


def _cells(row: Row) -> list[str]:
    cells = []
    for name in ("position", "rotation"):
        cells.append(f"{row[name]:.2f} ({row[f'{name}_median']:.1f}) +- {row[f'{name}_error']:.2f}")
        low, high = row[f"more_{name}_low"], row[f"more_{name}_high"]
        cells.append("-" if low != low else f"{row[f'more_{name}']:+.2f} [{low:+.2f}, {high:+.2f}]")
    shares = (f"{row['at_rest']:.3f}", f"{row['exact']:.3f}", f"{row['unsolved']:.1e}")
    return [*cells, f"{row['penetration']:.2f}", *shares]


def _changes(rows: dict[Value, Row], others: dict[Value, Row]) -> list[str]:
    cells = []
    for what in ("position", "rotation"):
        more = sorted(float(row[what]) - float(others[seed][what]) for seed, row in rows.items())
        mean = sum(float(row[what]) for row in rows.values()) / len(rows)
        cells += [f"{mean:.2f}", f"{more[0]:+.2f} to {more[-1]:+.2f}"]
    return [*cells, f"{sum(float(row['exact']) for row in rows.values()) / len(rows):.3f}"]


def _spread(rows: list[Row], what: str) -> str:
    values = sorted(float(row[what]) for row in rows if row[what] == row[what])
    return f"{values[len(values) // 2]:.3g} ({values[0]:.3g} to {values[-1]:.3g})" if values else "-"
