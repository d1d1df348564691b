"""`benchmark pushes`: gradients against differences, time of a push, models from few pushes, planning."""

import copy
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor

from lcplearn.benchmark.harness.figures import new_figure
from lcplearn.benchmark.harness.measuring import interleave
from lcplearn.benchmark.harness.study import Options, Row, Study, Table
from lcplearn.benchmark.pushes.planning import plan, wanted_poses
from lcplearn.datasets.pushes import PushData, read_pushes
from lcplearn.formulations.pushing import PushMLP, PushModel, Residual, Ridge, Supports
from lcplearn.formulations.pushing.supports import Latent
from lcplearn.training.push_figures import animate_push
from lcplearn.training.push_metrics import errors

COLUMNS = ("right", "milliseconds", "deviation", "success", "seconds", "rollouts")
NUMBERS = (10, 50, 200, 360)  # of 400: some must be left to judge on
MODELS: Mapping[str, Callable[..., PushModel]] = {
    "supports": Supports,
    "supports + process": Residual,
    "ellipsoid": partial(Supports, law="ellipsoid", height=False, rim=False),
    "ridge": Ridge,
    "MLP": PushMLP,
}
WORTH_SEEING = 20  # a push that turns the object
STEP = 1e-5  # of differences; logarithms, centimetres and radii
# What the plant differs by: logarithm of mu_c, height [cm], rim.
PLANTS = {
    "as learned": (0.0, 0.0, 0.0),
    "mu_c + 20 %": (0.182, 0.0, 0.0),
    "mu_c - 20 %": (-0.223, 0.0, 0.0),
    "height + 10 mm": (0.0, 1.0, 0.0),
}
PLANNERS = {"random, 30": (30, 0), "random, 300": (300, 0), "gradient": (12, 6)}  # guesses, steps


def run(options: Options) -> None:
    """Measure and print."""
    study = Study("pushes", options, ("table", "case", "method", "repeat"), COLUMNS)
    data = read_pushes(seed=options.seed)
    model = fitted(Supports(**thing(data)), data)
    for table, case, method, repeat in study.remaining(_plan(options.quick), seconds=20.0):
        row: Row = {}
        if table == "gradient":
            row = {"right": right_gradients(model, data, str(case))}
        elif table == "time":
            row = {"milliseconds": milliseconds(model, data, int(case))}
        elif table == "fit":
            row = {"seconds": seconds_to_fit(data)}
        elif table == "few":
            row = {"deviation": from_few(data, int(case), str(method), options.seed + int(repeat))}
        else:
            row = planning(model, data, str(case), str(method), 10 if options.quick else 100, options.seed)
        study.add((table, case, method, repeat), row)
    _say(study)
    animate_push(model, data, WORTH_SEEING, options.output / "push.gif")
    study.finish()


def _plan(quick: bool) -> Iterator[tuple[str, str | int, str, int]]:
    yield from (("gradient", name, "", 0) for name in ("mu_c", "height", "pressure x", "pressure y"))
    yield from (("time", batch, "", 0) for batch in (1, 400))
    yield "fit", 3, "", 0
    for number in NUMBERS[:1] if quick else NUMBERS:
        yield from (("few", number, name, k) for name in MODELS for k in range(2 if quick or number > 50 else 5))
    for plant in list(PLANTS)[: 1 if quick else None]:
        yield from (("plan", plant, planner, 0) for planner in PLANNERS)


def thing(data: PushData) -> dict[str, Any]:
    """What every model of pushes is built from."""
    return {"vertices": data.vertices.tolist(), "com": data.com.tolist(), "mass": data.mass}


def fitted(model: Any, data: PushData) -> Any:
    """The model, fitted to all of the data."""
    for _ in model.fit(data.pushes, data.outcome):
        pass
    return model


def right_gradients(model: Supports, data: PushData, name: str) -> float:
    """Share of pushes whose end pose has a derivative that agrees with central differences to 1e-4."""
    count = len(data.configuration)
    zero = torch.zeros(count, 3, dtype=torch.float64)
    column = {"mu_c": 0, "height": 1, "pressure x": 0, "pressure y": 1}[name]
    inside = name.startswith("pressure")
    numbers = model.numbers.detach().expand(count, -1).clone()
    weights = torch.tensor((0.3, -0.8, 0.5), dtype=torch.float64)  # one direction that sees all of a pose

    def end(shift: Tensor) -> Tensor:
        moved = torch.zeros_like(numbers).index_add(1, torch.tensor([column]), shift[:, None])
        latent = Latent(moved[:, :2], zero[:, 0], zero[:, :2], zero) if inside else None
        pose = model.roll(data.pushes, numbers if inside else numbers + moved, latent).pose
        return model.motion(data.pushes, pose) @ weights

    shift = torch.zeros(count, dtype=torch.float64, requires_grad=True)
    slope = torch.autograd.grad(end(shift).sum(), shift)[0]
    with torch.no_grad():
        true = (end(shift + STEP) - end(shift - STEP)) / (2.0 * STEP)
    scale = true.abs().clamp_min(0.05 * true.abs().median())
    return float(((slope - true).abs() <= 1e-4 * scale).double().mean())


def milliseconds(model: PushModel, data: PushData, batch: int) -> float:
    """Median wall time of predicting a push."""
    pushes = data.pushes.take(torch.arange(len(data.configuration))[:batch])
    with torch.no_grad():
        call: Callable[[], Any] = lambda: model.predict(pushes)  # noqa: E731
        call()
        return 1e3 * interleave({"": call}, 5)[""].wall / batch


def seconds_to_fit(data: PushData) -> float:
    """Wall time of fitting the supports' three numbers, and mu of the surfaces, to all pushes."""
    began = time.perf_counter()
    fitted(Supports(**thing(data)), data)
    return time.perf_counter() - began


def from_few(data: PushData, number: int, method: str, seed: int) -> float:
    """Mean deviation [mm] on all others, learned from some pushes."""
    order = torch.randperm(len(data.configuration), generator=torch.Generator().manual_seed(seed))
    torch.manual_seed(seed)  # of the network
    model = fitted(MODELS[method](**thing(data)), data.take(order[:number]))
    others = data.take(order[number:])
    with torch.no_grad():
        return errors(model, others, model.predict(others.pushes)).figures()["deviation_mm"]


def planning(model: Supports, data: PushData, plant: str, planner: str, tasks: int, seed: int) -> Row:
    """Push to poses that the plant reaches, planned with the model."""
    generator = torch.Generator().manual_seed(seed)
    start = data.pushes.take(torch.arange(len(data.configuration))[:: len(data.configuration) // tasks][:tasks])
    real = copy.deepcopy(model)
    with torch.no_grad():
        real.numbers.add_(torch.tensor(PLANTS[plant], dtype=torch.float64))
    wanted = wanted_poses(real, start, generator)
    guesses, steps = PLANNERS[planner]
    found = plan(model, real, start, wanted, guesses=guesses, gradient_steps=steps, generator=generator)
    median, share = float(found.deviation.median()), float(found.success.double().mean())
    return {"deviation": 1e3 * median, "success": share, "seconds": found.seconds, "rollouts": found.rollouts}


def _say(study: Study) -> None:
    def rows(table: str) -> list[dict[str, Any]]:
        return [row for row in study.rows if row["table"] == table]

    study.say(
        "Is the gradient of a push right?",
        "Share of the recorded pushes whose end pose has a derivative that agrees with central differences to 1e-4.",
        table=Table(("with respect to", "share"), [(row["case"], row["right"]) for row in rows("gradient")]),
    )
    study.say(
        "How long does a push take?",
        table=Table(("batch", "ms a push"), [(row["case"], row["milliseconds"]) for row in rows("time")]),
    )
    study.say(
        "How long does a fit take?",
        "mu_c, height and rim from 400 end poses, and mu of two surfaces from forces.",
        table=Table(("numbers", "s"), [(row["case"], row["seconds"]) for row in rows("fit")]),
    )
    groups: dict[tuple[Any, Any], list[float]] = {}
    for row in sorted(rows("few"), key=lambda row: (list(MODELS).index(row["method"]), row["case"])):
        groups.setdefault((row["method"], row["case"]), []).append(row["deviation"])
    study.say(
        "How many pushes does a model need?",
        "Mean deviation [mm] on all other pushes: mean, least and largest of the draws.",
        figure=_draw_few(groups),
        table=Table(
            ("model", "pushes", "mean", "least", "largest"),
            [(*key, sum(found) / len(found), min(found), max(found)) for key, found in groups.items()],
        ),
    )
    study.say(
        "Does it serve a planner?",
        "One push to a pose that the plant reaches; success is a deviation below 1 mm on the plant.",
        table=Table(
            ("plant", "planner", "success", "median deviation [mm]", "s a task", "rollouts a task"),
            [
                (row["case"], row["method"], row["success"], row["deviation"], row["seconds"], row["rollouts"])
                for row in rows("plan")
            ],
        ),
    )


def _draw_few(groups: dict[tuple[Any, Any], list[float]]) -> Any:
    figure, axes = new_figure(1, 1, width=6.5, height=4.0)
    for index, method in enumerate(dict.fromkeys(method for method, _ in groups)):
        found = {number: values for (name, number), values in groups.items() if name == method}
        means = [sum(values) / len(values) for values in found.values()]
        spread = [[m - min(v) for m, v in zip(means, found.values(), strict=True)]]
        spread += [[max(v) - m for m, v in zip(means, found.values(), strict=True)]]
        axes[0, 0].errorbar(list(found), means, spread, marker="o", capsize=3, color=f"C{index}", label=method)
    axes[0, 0].set(xscale="log", yscale="log", xlabel="pushes to learn from", ylabel="deviation of all others [mm]")
    axes[0, 0].set_xticks(NUMBERS, [str(number) for number in NUMBERS])
    axes[0, 0].set_yticks((1, 1.5, 2, 3, 5, 10), ("1", "1.5", "2", "3", "5", "10"))
    axes[0, 0].minorticks_off()
    axes[0, 0].grid(alpha=0.3)
    axes[0, 0].legend()
    return figure
