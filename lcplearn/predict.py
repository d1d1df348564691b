"""Predict with a trained model: python -m lcplearn.predict CHECKPOINT --input forces.csv --output motion.csv

CSV input has a header and a column `force` [N] (`force_1`, `force_2`, ... for models of several velocities), one row a
time step. Models that need measured friction also read `friction_plus` and `friction_minus` [N]. A column `time_s` or
`time` [s] must have the model's steps. NPZ input has `forces` [T, nv] or [N, T, nv], without nv where it is 1, and may
have `friction` [..., T, 2], `state` [..., nq + nv] and `dt` [s].

`--score DATA` judges the model on recordings instead: cube_slides.npz, or an NPZ file with `dt` and the arrays that
lcplearn.datasets.read_recordings names.

A model of pushes is judged by `--score PUSHES.npz`, a file like planar_pushes.npz; `--output` is then an NPZ file of
predictions, `post_pose` (pushes, 3) [m, m, rad] and `force` (pushes, 2) [N].

A model of tosses is judged by `--score TOSSES.npz`, a file like cube_tosses.npz; `--output` is then an NPZ file with
the predicted `state` and `offsets`. They are predicted from row 0 of each toss and nothing else of it.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn import __version__
from lcplearn.datasets import Task, read_all_cube_slides, read_recordings
from lcplearn.datasets.files import find, read_npz
from lcplearn.datasets.inputs import FRICTION, Inputs, read_inputs
from lcplearn.formulations import Formulation
from lcplearn.formulations.pushing import PushModel
from lcplearn.scenes.scene import STICK_SPEED, Trajectory
from lcplearn.training.checkpoint import load
from lcplearn.training.motion import draw, write


@torch.no_grad()
def predict(model: Formulation, inputs: Inputs, state: Float[Tensor, "*batch nq_plus_nv"] | None = None) -> Trajectory:
    """Roll the model out.

    Args:
        model: A trained model.
        inputs: Forces, and friction where the model needs it.
        state: Positions, then velocities, at the start; the inputs' own, else rest at 0, by default.

    Raises:
        ValueError: the model needs measured friction and the inputs have none, their time step is another than the
            model's, or the state is not finite or has a quaternion that is not of norm 1.
    """
    if inputs.dt is not None and abs(inputs.dt / model.dt - 1.0) > 1e-4:  # a CSV file has six digits of 1/148 s, say
        raise ValueError(
            f"The input has time steps of {inputs.dt:.6g} s, but the model was trained for {model.dt:.6g} s."
        )
    if model.needs_friction and inputs.friction is None:
        raise ValueError(
            f"{type(model).__name__} needs measured friction: the columns {' and '.join(FRICTION)} in a CSV file, "
            "or an array 'friction' in an NPZ file."
        )
    if state is None:
        state = inputs.state if inputs.state is not None else model.space.origin()
    if not bool(state.isfinite().all()):
        raise ValueError(f"state: expected finite positions and velocities, got {state.tolist()}.")
    state = model.space.normalised(state.double())
    return model.rollout(state, inputs.forces, inputs.friction if model.needs_friction else None)


def read_data(path: str | Path, model: Formulation) -> Task:
    """Read recordings to score a model on; all of them are the test.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a file of recordings, or one with another time step than the model's.
    """
    path = _found(path)
    slides = "offsets" in read_npz(path, (), optional=("offsets",))
    truth = tuple(model.physical_parameters())
    data = (
        read_all_cube_slides(path)
        if slides
        else read_recordings(path, space=model.space, given=model.given, truth=truth)
    )
    if abs(data.dt / model.dt - 1.0) > 1e-9:
        raise ValueError(f"{path} has time steps of {data.dt:.6g} s, but the model was trained for {model.dt:.6g} s.")
    if model.needs_friction and data.test.drive.friction is None:
        raise ValueError(f"{type(model).__name__} needs measured friction, and {path} has no array 'friction'.")
    return data


def _found(path: str | Path) -> Path:
    """A data file, looked for where train.py looks if it isn't there."""
    path = Path(path)
    return find(path.name) if not path.exists() and str(path.parent) in (".", "data") else path


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; what is wrong with a file ends it with one sentence."""
    parser = argparse.ArgumentParser(
        prog="python -m lcplearn.predict", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint", help="best.ckpt of a run")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--input", help="forces, CSV or NPZ")
    what.add_argument("--score", metavar="DATA", help="recordings to judge the model on, NPZ")
    parser.add_argument("--output", help="where to write: motion as CSV or NPZ, or the score as JSON")
    parser.add_argument("--state", nargs="+", type=float, metavar="NUMBER", help="start: positions, then velocities")
    parser.add_argument("--plot", metavar="PICTURE", help="picture of the motion: PNG, PDF or SVG")
    parser.add_argument(
        "--trust", action="store_true", help="import the model's class from any module that the file names"
    )
    parser.add_argument("--version", action="version", version=f"lcplearn {__version__}")
    options = parser.parse_args(arguments)
    if options.score and (options.state or options.plot):
        parser.error("--state and --plot go with --input")
    read = {Path(path).resolve() for path in (options.checkpoint, options.input or options.score)}
    for written in filter(None, (options.output, options.plot)):
        if Path(written).resolve() in read:
            sys.exit(f"{written} is what is read: choose another name, nothing is overwritten.")
    try:
        _score(options) if options.score else _predict(options)
    except OSError as error:
        sys.exit(f"{error.filename}: {error.strerror}." if error.filename and error.strerror else f"{error}.")
    except ValueError as error:
        sys.exit(str(error))


def _predict(options: argparse.Namespace) -> None:
    model = load(options.checkpoint, "cpu", trust=options.trust)
    if isinstance(model, PushModel):
        raise ValueError(f"{type(model).__name__} predicts pushes, not motion under forces: use --score PUSHES.npz.")
    state = None if options.state is None else torch.tensor(options.state, dtype=torch.float64)
    inputs = read_inputs(options.input, model.space)
    trajectory = predict(model, inputs, state)
    speed = model.space.speed(trajectory.velocities[..., 1:, :], model.radius)
    steps, still = trajectory.mode.shape[-2], float((speed < STICK_SPEED).double().mean())
    if options.output:
        write(options.output, trajectory, model)
    if options.plot:
        Path(options.plot).parent.mkdir(parents=True, exist_ok=True)
        draw(inputs.forces, trajectory, model).savefig(options.plot, dpi=120)
    unsolved = 0 if trajectory.solved is None else int((~trajectory.solved).sum())
    warning = (
        f"; {unsolved} of all steps without a verified solution: don't trust what follows them" if unsolved else ""
    )
    several = f"{len(trajectory.mode)} trajectories of " if trajectory.mode.ndim > 2 else ""
    print(
        f"{type(model).__name__}: {several}{steps} step{'s' * (steps > 1)} of {model.dt:.4g} s, "
        f"at rest after {still:.0%} of them{warning}"
    )


def _score(options: argparse.Namespace) -> None:
    from lcplearn.training.metrics import evaluate, format_table
    from lcplearn.training.writing import write_figures

    model = load(options.checkpoint, "cpu", trust=options.trust)
    if isinstance(model, PushModel):
        from lcplearn.training.push_scoring import score_pushes

        print(score_pushes(model, _found(options.score), options.output))
        return
    if "state" in read_npz(_found(options.score), (), optional=("state",), finite=False):
        _score_tosses(model, options)
        return
    metrics = evaluate(model, read_data(options.score, model))
    print(format_table(metrics))
    if options.output:
        write_figures(options.output, metrics)


def _score_tosses(model: Formulation, options: argparse.Namespace) -> None:
    from lcplearn.training import toss_scores

    tosses = toss_scores.read_for(_found(options.score), model)
    predicted = toss_scores.predict_tosses(model, tosses)
    print(toss_scores.report(model, predicted, tosses))
    if options.output:
        toss_scores.write_tosses(options.output, predicted, tosses)


if __name__ == "__main__":
    main()
