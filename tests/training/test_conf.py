"""The configuration: every file composes, passes the check and builds what it names; mistakes get one sentence."""

from pathlib import Path
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from hydra.utils import instantiate
from omegaconf import OmegaConf
from training.helpers import ROOT

from lcplearn.benchmark.tosses.run import ABLATIONS
from lcplearn.datasets import Recordings, Task, simulate_falling_block, simulate_sliding_block
from lcplearn.datasets.simulate_planar import simulate_planar_block, simulate_planar_body
from lcplearn.datasets.spring import simulate_spring_block
from lcplearn.formulations import FORMULATIONS, Formulation, build
from lcplearn.formulations.pushing import PushModel
from lcplearn.scenes.scene import Drive
from lcplearn.scenes.space import POSE
from lcplearn.training.optimizer import Optimizer
from lcplearn.training.settings import SettingsError, check, check_torchrun
from lcplearn.training.signatures import signature
from lcplearn.training.vocabulary import TRAINER, explain

CONF = ROOT / "conf"


def names(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def settings(*overrides: str) -> dict[str, Any]:
    """The resolved settings; the run's folder, which only a run has, is made up."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        folder = [] if "logger=none" in overrides else ["logger.save_dir=runs"]
        config = compose("train", overrides=[*folder, *overrides])
    resolved = OmegaConf.to_container(config, resolve=True)
    assert isinstance(resolved, dict)
    return resolved


EVERY = [f"{group}={name}" for group in ("model", "loss", "optimizer", "trainer", "logger") for name in names(group)]
EVERY += [f"experiment={name}" for name in names("experiment")] + ["data=cube_slides model=mlp"]
EVERY += [" ".join(("experiment=cube_body", *more)) for more in ABLATIONS.values() if more]
EVERY = [choice.replace("model=identified", "data=spring model=identified") for choice in EVERY]
EVERY = [choice.replace("model=falling", "data=falling_block model=falling") for choice in EVERY]
EVERY = [choice.replace("model=planar", "data=planar_block model=planar") for choice in EVERY]
EVERY = [
    choice.replace("data=planar_block model=planar_body", "data=planar_body model=planar_body") for choice in EVERY
]
PUSHES = [choice for choice in EVERY if choice.startswith(("model=push_", "experiment=pushes_"))]
EVERY = [choice for choice in EVERY if choice not in PUSHES]


@pytest.fixture(scope="module")
def tasks() -> dict[str, Task]:
    """By a part of the names of its configurations; one of a sliding block is for everything else."""
    state = torch.eye(13, dtype=torch.float64)[3].expand(1, 2, 13)  # at rest, not turned
    one = Recordings(state, Drive(torch.zeros(1, 1, 6, dtype=torch.float64)), torch.tensor([1]))
    given = {"half_width": 0.05, "mass": 0.4, "gravity": 9.81, "inertia": 8e-4, "mu": 0.2, "restitution": 0.1}
    cube = Task(name="tosses", space=POSE, dt=0.01, train=one, validation=one, test=one, given=given)
    return {
        "sliding_block": simulate_sliding_block(trajectories=1, long_length=1),
        "falling_block": simulate_falling_block(trajectories=1, long_length=1),
        "data=spring": simulate_spring_block(trajectories=1, long_length=1),
        "planar_body": simulate_planar_body(trajectories=1, length=2),
        "planar": simulate_planar_block(trajectories=1, long_length=1),
        "model=cube": cube,
        "experiment=cube_body": cube,
        "experiment=cube_corners": cube,
    }


@pytest.mark.parametrize("choice", EVERY)
def test_every_configuration_passes_the_check_and_builds_its_model(choice: str, tasks: dict[str, Task]) -> None:
    chosen = settings(*choice.split())
    check(chosen, CONF)
    asked = instantiate(chosen["model"], _partial_=True, _convert_="all")
    task = next((task for name, task in tasks.items() if name in choice), tasks["sliding_block"])
    assert isinstance(build(asked.func, task, **asked.keywords), Formulation)
    assert isinstance(instantiate(chosen["optimizer"], _convert_="all"), Optimizer)


@pytest.mark.parametrize("choice", PUSHES)
def test_every_model_of_pushes_passes_the_check_and_is_built(choice: str) -> None:
    chosen = settings("data=pushes", choice)
    check(chosen, CONF)
    triangle = {"vertices": [[0.0, 0.0], [0.15, 0.0], [0.0, 0.15]], "com": [0.05, 0.05], "mass": 1.5}
    assert isinstance(instantiate(chosen["model"], **triangle, _convert_="all"), PushModel)


def test_every_formulation_has_a_configuration() -> None:
    others = [name for name in names("model") if not name.startswith("push_")]
    targets = {settings(f"model={name}")["model"]["_target_"].rpartition(".")[2] for name in others}
    planar = {"PlanarFriction", "PlanarDirect", "PlanarTraditional"}
    cubes = {"CubeCorners", "CubeNetwork"}
    assert targets == {cls.__name__ for cls in FORMULATIONS.values()} | {"Identified"} | planar | cubes


def test_every_experiment_says_its_claim_command_expectation_and_time() -> None:
    for path in (CONF / "experiment").glob("*.yaml"):
        text = path.read_text()
        assert all(f"# {word}:" in text for word in ("Claim", "Command", "Expected", "Time")), path.name
        assert f"experiment={path.stem}" in text


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("+modle=relu", "Unknown setting 'modle'; did you mean 'model'?"),
        ("+model.inital_mu=0.2", "Unknown setting 'model.inital_mu'; did you mean 'model.initial_mu'?"),
        ("model.initial_mu=abc", "model.initial_mu: expected float, got 'abc'"),
        ("model.b_network=3", "model.b_network: expected bool, got 3"),
        ("trainer.max_epochs=two", "trainer.max_epochs: expected int or None, got 'two'"),
        ("+trainer.max_epoch=2", "Unknown setting 'trainer.max_epoch'; did you mean 'trainer.max_epochs'?"),
        ("loss.prediction=-1", "loss.prediction: expected a finite number of at least 0, got -1"),
        ("+loss.huber=1", "Unknown setting 'loss.huber'; known are loss.complementarity"),
        ("loss.prediction=0", "loss: expected a positive weight"),
        ("loss.horizon=0", "loss.horizon: expected at least 1, got 0"),
        ("batch_size=64", "LBFGS needs the full batch: set batch_size=null, or optimizer=adam."),
        ("trainer.max_epochs=0", "trainer.max_epochs: expected at least 1, got 0"),
        ("trainer.check_val_every_n_epoch=null", "trainer.check_val_every_n_epoch: expected at least 1, got None"),
        ("patience=-1", "patience: expected at least 1, or null for never, got -1"),
        ("seed=-1", "seed: expected at least 0 and below 2^32, got -1"),
        ("model=slack +model.width=3", "Unknown setting 'model.width'; known are none."),
        ("+model.dt=0.1", "Unknown setting 'model.dt'"),
        ("data.dt=-0.1", "data.dt: expected a positive number, got -0.1"),
        ("data.noise=-1", "data.noise: expected at least 0, got -1"),
        ("model=mlp model.width=0", "model.width: expected a positive number, got 0"),
        ("optimizer.lr=0", "optimizer.lr: expected a positive number, got 0"),
        ("loss.horizon=101", "loss.horizon: expected at most data.length=100, got 101"),
        ("trainer.devices=9999", "trainer.devices=9999 would start 9999 processes on"),
        (
            "trainer.precision=32-true",
            "trainer.precision: expected 64-true, as sticking is judged at 1e-12 m/s, got 32",
        ),
        ("+lr=1", "Unknown setting 'lr'; did you mean 'optimizer.lr'?"),
        ("+epochs=3", "Unknown setting 'epochs'; did you mean 'trainer.max_epochs'?"),
        ("seed=true", "seed: expected int, got True"),
        ("threads=0", "threads: expected at least 1, got 0"),
        ("allow_changes=no", "allow_changes: expected bool, got 'no'"),
        ("data=spring model=identified model.learn=5", "model.learn: expected names and their starts, got 5"),
        ("data=spring model=identified model.learn.mu=abc", "model.learn.mu: expected float, got 'abc'"),
        ("stages=5", "stages: expected a list, [] for none, got 5"),
        ("~loss", "loss: expected the name of a file in conf/loss/, got None"),
        ("~trainer.max_epochs", "trainer.max_epochs: expected at least 1, got None"),
        ("ckpt_path=nope.ckpt", "ckpt_path=nope.ckpt is not a file; checkpoints are named runs/DATE_TIME/last.ckpt."),
        ("model=direct data.friction=null", "model=direct needs friction labels: set data.friction=physical"),
        ("data=cube_slides +data.friction=slack", "Unknown setting 'data.friction'"),
        ("data=pushes", "data=pushes needs a model of pushes: experiment=pushes_supports"),
        ("model=push_ridge", "a model of pushes needs data=pushes"),
        ("experiment=pushes_mlp loss.prediction=2", "loss can't be chosen with data=pushes"),
        ("experiment=pushes_mlp trainer.max_epochs=5", "trainer can't be chosen with data=pushes"),
        ("experiment=pushes_mlp patience=3", "patience can't be set with data=pushes"),
        ("experiment=pushes_mlp stages=[{epochs:1}]", "stages can't be set with data=pushes"),
        ("experiment=pushes_mlp seed=1 ckpt_path=README.md", "ckpt_path can't be set with data=pushes"),
        ("data=cube_slides model=slack", "model=slack needs friction labels, which only simulated blocks have."),
        ("data=planar_block model=slack", "model=slack is for a block on a line: in two directions the slacks don't"),
    ],
)
def test_a_mistake_gets_one_sentence_with_a_suggestion(overrides: str, message: str) -> None:
    with pytest.raises(SettingsError) as error:
        check(settings(*overrides.split()), CONF)
    assert str(error.value).startswith(message)
    assert "\n" not in str(error.value)


def test_recordings_of_ones_own_may_have_measured_friction() -> None:
    chosen = settings("model=direct")
    check(chosen | {"data": {"_target_": "mine.read_recordings_with_friction"}}, CONF)


def test_a_missing_checkpoint_is_compared_with_those_that_are_there(tmp_path: Path) -> None:
    (tmp_path / "last.ckpt").touch()
    with pytest.raises(SettingsError, match=r"did you mean .*last\.ckpt"):
        check(settings(f"ckpt_path={tmp_path / 'lst.ckpt'}"), CONF)


@pytest.mark.parametrize("overrides", ["trainer.strategy=ddp", "trainer.devices=2", "trainer.devices=[0,1]"])
def test_a_sweep_refuses_processes_that_would_start_it_again(overrides: str) -> None:
    chosen = settings(*overrides.split())
    check(chosen, CONF)
    with pytest.raises(SettingsError, match=r"use trainer\.strategy=ddp_fork"):
        check(chosen, CONF, multirun=True)
    for allowed in ("trainer.devices=1", "trainer.devices=[0]", "trainer.strategy=ddp_fork trainer.devices=2"):
        check(settings(*allowed.split()), CONF, multirun=True)


@pytest.mark.parametrize("more", ["", "devices=2", "strategy=ddp", "strategy=ddp_fork devices=2"])
def test_processes_of_torchrun_that_would_each_train_alone_are_refused(more: str) -> None:
    chosen = settings(*(f"trainer.{setting}" for setting in more.split()))
    with pytest.raises(SettingsError, match=r"started 2 processes: set trainer\.strategy=ddp and .*devices=2"):
        check(chosen, CONF, processes=2)
    together = ["trainer.strategy=ddp", "trainer.devices=2"]
    check(settings(*together), CONF, processes=2)
    check(settings(*together, "+trainer.num_nodes=3"), CONF, processes=6)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ("trainer.strategy=ddp", "torchrun's processes need one folder: add hydra.run.dir=runs/NAME."),
        ("-m seed=0,1", "torchrun trains one run: sweep (-m) without it, with trainer.strategy=ddp_fork."),
    ],
)
def test_processes_of_torchrun_that_would_write_two_runs_are_refused(arguments: str, sentence: str) -> None:
    with pytest.raises(SettingsError) as error:
        check_torchrun(arguments.split())
    assert str(error.value) == sentence
    check_torchrun(["trainer.strategy=ddp", "hydra.run.dir=runs/pair"])
    check_torchrun(["--cfg", "job"])


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        ("modle=relu", "Unknown setting 'modle'; did you mean 'model'?"),
        ("noise=1", "Unknown setting 'noise'; did you mean 'data.noise' or 'model.noise'?"),
        (
            "data.path=x",
            "'data.path' is set in the file of another data= than the chosen one; "
            "if the chosen one takes it, too, write +data.path=...",
        ),
        (
            "experiment=cube_body model.fixed.substep=4",
            "Unknown setting 'model.fixed.substep'; did you mean 'model.fixed.substeps'? "
            "To add it, write +model.fixed.substep=...",
        ),
        (
            "experiment=cube_body model.learn.gravity=9",
            "'model.learn.gravity' is set in the file of another model= than the chosen one; "
            "if the chosen one takes it, too, write +model.learn.gravity=...",
        ),
        (
            "model=affine,mlp",
            "model=affine,mlp are several values: -m before the settings trains one run after the other.",
        ),
        ("model", "'model' is no setting: write key=value, and in quotes what has special characters."),
        ("model=mpl", "There is no model=mpl; did you mean 'mlp'?"),
        (
            "hydra/launcher=jobl",
            "There is no hydra/launcher=jobl among the installed ones; joblib's is in the extra 'sweep'.",
        ),
        ("data.gravity=1.62", "'data.gravity' is not set in conf/data; to add it, write +data.gravity=..."),
        ("model.widht=3", "Unknown setting 'model.widht'; did you mean 'model.width'?"),
        ("trainer.epochs=3", "Unknown setting 'trainer.epochs'; did you mean 'trainer.max_epochs'?"),
        ("trainer.max_epoch=3", "Unknown setting 'trainer.max_epoch'; did you mean 'trainer.max_epochs'?"),
        (
            "trainer.accumulate_grad_batches=2",
            "'trainer.accumulate_grad_batches' is not set in conf/trainer; to add it, write "
            "+trainer.accumulate_grad_batches=...",
        ),
    ],
)
def test_hydras_messages_become_sentences_with_a_suggestion(overrides: str, sentence: str) -> None:
    with pytest.raises(HydraException) as error:
        settings(*overrides.split())
    assert explain(str(error.value), CONF) == sentence


def test_signatures_are_read_without_importing_their_modules() -> None:
    found = signature("lcplearn.formulations.baselines.MLP")
    assert found is not None
    assert {"dt", "space", "width", "depth", "activation"} <= set(found)
    assert signature("lcplearn.formulations.slack.NoSuchClass") is None
    assert signature("no_such_package.module.Class") is None
    trainer = signature(TRAINER)
    assert trainer is not None
    assert "max_epochs" in trainer
