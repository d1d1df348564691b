"""fit(): what it leaves, that it reproduces itself, and that it can be resumed."""

import dataclasses
import json
import logging
import signal
import warnings
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pytest
import torch
import yaml
from lightning.pytorch import Callback
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from training.helpers import QUIET, short_fit, small_data, tiny_data
from training.kill import kill_once

from lcplearn.datasets import Task, windows
from lcplearn.formulations import FORMULATIONS, MLP, Affine, Formulation, Physical, Structured, loss_terms
from lcplearn.scenes import PLANE
from lcplearn.training import Optimizer, TrainingDivergedError, TrainingInterrupted, figures, fit, load
from lcplearn.training.figures_of_merit import KEYS
from lcplearn.training.metrics import Predictions, evaluate, format_table
from lcplearn.training.trainer import quiet
from lcplearn.training.writing import replace, write_figures

FRICTION = {"direct": "physical", "slack": "slack"}


def parameters(model: Formulation) -> torch.Tensor:
    return torch.cat([p.detach().reshape(-1) for p in model.parameters()])


def test_the_structured_model_finds_mass_and_friction_to_machine_precision(tmp_path: Path) -> None:
    """README: velocity RMSE <= 1e-8, stick 1, false stick 0, rollout <= 1e-6, mu and mass error <= 1e-7."""
    data = small_data(trajectories=10, length=60)
    model = Structured(dt=data.dt)
    metrics = short_fit(model, data, tmp_path / "run", epochs=160, optimizer=Optimizer(lbfgs_after=100),
                        trainer=QUIET).metrics  # fmt: skip
    assert metrics is not None
    assert metrics["velocity_rmse"] <= 1e-8
    assert metrics["stick_accuracy"] == 1.0
    assert metrics["false_stick"] == 0.0
    assert metrics["rollout_rmse_1000"] <= 1e-6
    assert metrics["mu_error"] <= 1e-7
    assert metrics["mass_error"] <= 1e-7


def test_a_run_leaves_figures_checkpoints_settings_and_pictures(tmp_path: Path) -> None:
    data = small_data()
    result = short_fit(Structured(dt=data.dt), data, tmp_path / "run", pictures=True)
    names = {path.name for path in result.folder.iterdir()}
    assert names >= {"best.ckpt", "last.ckpt", "metrics.json", "config.yaml"}
    assert names >= {"one_step_map.png", "rollouts.png", "error_over_horizon.png"}
    metrics = json.loads((result.folder / "metrics.json").read_text())
    assert tuple(metrics) == (*KEYS, "mass")  # and what was learned
    assert metrics["rest_share"] is None  # slides only
    assert metrics["rollout_rmse_100"] is not None
    assert all(key in format_table(metrics) for key in KEYS if metrics[key] is not None)


def test_a_training_leaves_the_warnings_and_loggers_of_the_process_as_they_were(tmp_path: Path) -> None:
    logger = logging.getLogger("lightning.pytorch.utilities.rank_zero")
    before = (list(warnings.filters), logger.level)
    task = tiny_data()
    fit(Physical(dt=task.dt), task, epochs=1, folder=tmp_path, trainer=QUIET)
    assert (list(warnings.filters), logger.level) == before


def test_a_folder_with_a_run_is_not_overwritten(tmp_path: Path) -> None:
    data = tiny_data()
    short_fit(Physical(dt=data.dt), data, tmp_path / "run", epochs=1)
    with pytest.raises(ValueError, match="holds a run already"):
        short_fit(Physical(dt=data.dt), data, tmp_path / "run", epochs=1)


@pytest.mark.parametrize("name", FORMULATIONS)
def test_every_model_comes_back_from_its_checkpoint_with_default_loading(name: str, tmp_path: Path) -> None:
    data = tiny_data(friction=FRICTION.get(name))
    model = FORMULATIONS[name](dt=data.dt)
    short_fit(model, data, tmp_path, epochs=1)
    torch.load(tmp_path / "last.ckpt")  # weights_only is torch's default
    loaded = load(tmp_path / "best.ckpt", map_location="cpu")
    assert type(loaded) is type(model)
    test = data.test
    ours, theirs = (m.advance(test.states[:, 0], test.drive.at(0)).state for m in (model, loaded))
    assert torch.equal(ours, theirs)


def final_state(folder: Path) -> torch.Tensor:
    state = torch.load(folder / "last.ckpt")["state_dict"]
    return torch.cat([value.reshape(-1) for value in state.values()])


@pytest.mark.parametrize("batch_size", [None, 32])
@pytest.mark.parametrize("stopped_after", [2, 3])
def test_a_resumed_training_equals_an_uninterrupted_one(
    stopped_after: int, batch_size: int | None, tmp_path: Path
) -> None:
    """Adam for two epochs, then LBFGS: resumed at the switch and behind it, also with shuffled batches."""
    data = tiny_data(noise=0.01)
    for folder, epochs, checkpoint in (("whole", 4, None), ("first", stopped_after, None), ("second", 4, "first")):
        path = None if checkpoint is None else tmp_path / checkpoint / "last.ckpt"
        model = Structured(dt=data.dt)
        short_fit(model, data, tmp_path / folder, epochs=epochs, batch_size=batch_size, ckpt_path=path)
    assert torch.equal(final_state(tmp_path / "second"), final_state(tmp_path / "whole"))


def test_a_model_of_another_time_step_or_gravity_than_the_data_is_refused(tmp_path: Path) -> None:
    """It would learn, but another mass and friction."""
    data = tiny_data()
    for model, message in (
        (Structured(dt=2 * data.dt), "dt = 0.05 as in the data, got 0.1"),
        (Structured(dt=data.dt, gravity=1.62), "gravity = 9.81 as in the data, got 1.62"),
        (MLP(dt=data.dt, space=PLANE), "space = position_m as in the data, got x_m, y_m, angle_rad"),
    ):
        with pytest.raises(ValueError, match=f"^model: expected {message}$"):
            short_fit(model, data, tmp_path / "run")
    with pytest.raises(ValueError, match=r"^epochs: expected at least 1, got 0"):
        short_fit(Structured(dt=data.dt), data, tmp_path / "run", epochs=0)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"horizon": 0}, "^horizon: expected at least 1 step, got 0"),
        (
            {"trainer": {"check_val_every_n_epoch": 0}},
            "^trainer: expected check_val_every_n_epoch of at least 1, got 0",
        ),
        ({"trainer": {"check_val_every_n_epoch": None}}, "^trainer: expected .* got None"),
    ],
)
def test_a_wrong_argument_is_named_before_anything_is_written(
    arguments: dict[str, Any], message: str, tmp_path: Path
) -> None:
    data = tiny_data()
    with pytest.raises(ValueError, match=message):
        short_fit(Structured(dt=data.dt), data, tmp_path / "run", **arguments)
    assert not (tmp_path / "run").exists()


def test_epochs_are_asked_for_once(tmp_path: Path) -> None:
    data = tiny_data()
    with pytest.raises(ValueError, match=r"^trainer: expected the number of epochs as epochs="):
        short_fit(Physical(dt=data.dt), data, tmp_path / "run", epochs=200, trainer=QUIET | {"max_epochs": 5})
    assert not (tmp_path / "run").exists()


class Terminate(Callback):
    """Send the signal that a cluster sends, in the first epoch."""

    def on_train_batch_start(self, *arguments: Any) -> None:
        signal.raise_signal(signal.SIGTERM)


def test_a_training_stopped_by_a_signal_says_how_to_resume_and_loses_nothing(tmp_path: Path) -> None:
    data = tiny_data()
    before = signal.getsignal(signal.SIGTERM)
    trainer = QUIET | {"check_val_every_n_epoch": 1, "callbacks": [Terminate()]}
    with pytest.raises(TrainingInterrupted, match=r"resume with ckpt_path=.*last.ckpt") as stopped:
        short_fit(Structured(dt=data.dt), data, tmp_path / "stopped", trainer=trainer)
    assert signal.getsignal(signal.SIGTERM) is before
    short_fit(Structured(dt=data.dt), data, tmp_path / "resumed", ckpt_path=stopped.value.checkpoint)
    short_fit(Structured(dt=data.dt), data, tmp_path / "whole")
    assert torch.equal(final_state(tmp_path / "resumed"), final_state(tmp_path / "whole"))


def test_a_signal_in_the_last_epoch_comes_too_late(tmp_path: Path) -> None:
    data = tiny_data()
    trainer = QUIET | {"callbacks": Terminate()}
    result = short_fit(Structured(dt=data.dt), data, tmp_path / "run", epochs=1, trainer=trainer)
    assert result.metrics is not None


def last_epoch(folder: Path) -> int:
    return int(torch.load(folder / "last.ckpt")["epoch"])


@pytest.mark.parametrize("every", [1, 2])
def test_early_stopping_waits_for_lbfgs_and_for_the_last_stage(every: int, tmp_path: Path) -> None:
    """With a rate of 1e-300 nothing improves."""
    data, idle = tiny_data(), {"lr": 1e-300, "lbfgs_iterations": 1}
    more: dict[str, Any] = {"epochs": 12, "patience": 1, "trainer": QUIET | {"check_val_every_n_epoch": every}}
    lbfgs = Optimizer(lbfgs_after=8, **idle)
    short_fit(Physical(dt=data.dt), data, tmp_path / "lbfgs", optimizer=lbfgs, **more)
    assert last_epoch(tmp_path / "lbfgs") >= 8
    short_fit(Physical(dt=data.dt), data, tmp_path / "s", optimizer=Optimizer(**idle), stages=[{"epochs": 7}], **more)
    assert 7 <= last_epoch(tmp_path / "s") < 11  # and stops then


def test_no_optimizer_remembers_the_loss_of_the_stage_before(tmp_path: Path) -> None:
    data, seen = tiny_data(), []

    class Look(Callback):
        def on_train_batch_start(self, trainer: Any, *arguments: Any) -> None:
            seen.append([len(optimizer.state) for optimizer in trainer.optimizers])

    trainer = QUIET | {"callbacks": [Look()]}
    stages = [{"epochs": 2, "prediction": 0.0, "rollout": 1.0}]
    short_fit(Physical(dt=data.dt), data, tmp_path, optimizer=Optimizer(lbfgs_after=1), stages=stages, trainer=trainer)
    assert seen[1][0] > 0
    assert seen[2] == [0, 0]


def test_a_training_that_ends_by_its_number_of_steps_leaves_its_last_checkpoint(tmp_path: Path) -> None:
    data, few = tiny_data(), QUIET | {"max_steps": 2, "check_val_every_n_epoch": 10}
    result = short_fit(Physical(dt=data.dt), data, tmp_path, epochs=20, trainer=few, optimizer=Optimizer())
    assert load(tmp_path / "last.ckpt").physical_parameters() == result.model.physical_parameters()


def test_numbers_that_numpy_computed_come_back_from_checkpoints_and_settings(tmp_path: Path) -> None:
    data = tiny_data()
    data = dataclasses.replace(data, dt=np.float64(data.dt))
    model = Physical(dt=data.dt, gravity=np.float64(9.81))
    optimizer, loss = Optimizer(lr=np.float64(0.1)), {"prediction": np.float64(1.0)}
    short_fit(model, data, tmp_path, epochs=1, optimizer=optimizer, loss=loss)
    assert load(tmp_path / "best.ckpt").dt == data.dt
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["optimizer"]["lr"] == 0.1


def test_the_best_model_before_an_interruption_stays_the_best_after_it(tmp_path: Path) -> None:
    data = tiny_data()
    short_fit(Structured(dt=data.dt), data, tmp_path / "first", epochs=3)
    first = torch.load(tmp_path / "first" / "best.ckpt")["state_dict"]
    absurd = Optimizer(lr=50.0, lbfgs_after=5)  # whatever comes after the resumption is worse
    model = Structured(dt=data.dt)
    checkpoint = tmp_path / "first" / "last.ckpt"
    result = short_fit(model, data, tmp_path / "second", epochs=5, ckpt_path=checkpoint, optimizer=absurd,
                       allow_changes=True)  # fmt: skip
    assert all(torch.equal(value, first[f"model.{name}"]) for name, value in result.model.state_dict().items())


def test_a_training_resumed_with_other_data_has_no_best_model_yet(tmp_path: Path) -> None:
    """Its error on data without noise would never be reached again."""
    clean, noisy = tiny_data(), tiny_data(noise=0.3)
    short_fit(Physical(dt=clean.dt), clean, tmp_path / "first", epochs=40, optimizer=Optimizer(lbfgs_after=20))
    result = short_fit(Physical(dt=clean.dt), noisy, tmp_path / "second", epochs=42, allow_changes=True, patience=1,
                       optimizer=Optimizer(lbfgs_after=20), ckpt_path=tmp_path / "first" / "last.ckpt")  # fmt: skip
    assert result.validation > 0.01
    assert torch.load(tmp_path / "second" / "best.ckpt")["epoch"] > last_epoch(tmp_path / "first")


def test_equal_seeds_give_equal_parameters_and_others_do_not(tmp_path: Path) -> None:
    data = tiny_data()
    found = []
    for run, seed in enumerate((3, 3, 4)):
        torch.manual_seed(3)  # equal starts: the seed of `fit` draws the batches
        model = MLP(dt=data.dt, width=8)
        short_fit(model, data, tmp_path / str(run), batch_size=16, seed=seed, epochs=2)
        found.append(parameters(model))
    assert torch.equal(found[0], found[1])
    assert not torch.equal(found[0], found[2])


def test_a_finished_or_foreign_checkpoint_is_refused_in_one_sentence(tmp_path: Path) -> None:
    data = tiny_data()
    short_fit(Physical(dt=data.dt), data, tmp_path / "run", epochs=2)
    last = tmp_path / "run" / "last.ckpt"
    cases = [
        (Physical(dt=data.dt), 2, "has finished its 2 epochs: set trainer.max_epochs above 2"),
        (Physical(dt=data.dt, initial_mu=0.2), 4, "with model.initial_mu=its default, but the settings say 0.2"),
        (MLP(dt=data.dt), 4, "Physical, but the settings ask for .*MLP"),
    ]
    for model, epochs, message in cases:
        with pytest.raises(ValueError, match=message):
            short_fit(model, data, tmp_path / "again", epochs=epochs, ckpt_path=last)
    with pytest.raises(ValueError, match=r"was trained with loss .*prediction.*, but the settings say .*rollout"):
        short_fit(Physical(dt=data.dt), data, tmp_path / "again", ckpt_path=last, loss={"rollout": 1.0})


def test_a_loss_that_the_model_does_not_have_is_refused_before_training(tmp_path: Path) -> None:
    data = tiny_data()
    with pytest.raises(ValueError, match="violation"):
        short_fit(MLP(dt=data.dt), data, tmp_path / "run", loss={"violation": 1.0})
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(("name", "value"), [("judged_by", ("one_step", "stop")), ("chosen_by", "poses")])
def test_a_judge_that_nobody_knows_is_refused_before_training(name: str, value: Any, tmp_path: Path) -> None:
    data = dataclasses.replace(tiny_data(), **{name: value})
    with pytest.raises(ValueError, match=rf"^data\.{name}: expected one of .*, got '(stop|poses)'"):
        short_fit(Physical(dt=data.dt), data, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_device_that_is_not_there_is_one_sentence(tmp_path: Path) -> None:
    data = tiny_data()
    for devices in (0, "x"):
        with pytest.raises(ValueError, match="Lightning's Trainer can't use these settings") as error:
            short_fit(Physical(dt=data.dt), data, tmp_path / "run", trainer=QUIET | {"devices": devices})
        assert "\n" not in str(error.value)


def test_annealing_leaves_the_plateau_where_no_sample_slips(tmp_path: Path) -> None:
    data = tiny_data(length=5, initial_speed=0.0, trajectories=20)
    errors = {}
    for epochs in (0, 100):
        model = Physical(dt=data.dt, initial_mu=5.0, initial_mass=1.5, learn_mass=False)
        optimizer = Optimizer(lbfgs_after=140, anneal_epochs=epochs)
        short_fit(model, data, tmp_path / str(epochs), epochs=160, optimizer=optimizer, trainer=QUIET)
        errors[epochs] = abs(model.physical_parameters()["mu"] - 0.4)
    assert errors[0] == pytest.approx(4.6)
    assert errors[100] < 1e-6


def test_a_logger_of_another_kind_gets_the_figures_of_training_and_of_the_test(tmp_path: Path) -> None:
    data = tiny_data()
    logger = CSVLogger(tmp_path, name="", version="csv")
    short_fit(Physical(dt=data.dt), data, tmp_path / "run", logger=logger)
    header, *rows = (tmp_path / "csv" / "metrics.csv").read_text().splitlines()
    assert {"train/total", "val/loss", "parameters/mu", "test/velocity_rmse"} <= set(header.split(","))
    assert float(rows[-1].split(",")[header.split(",").index("test/velocity_rmse")]) > 0


def test_tensorboard_shows_losses_modes_residuals_parameters_figures_and_the_table(tmp_path: Path) -> None:
    data = small_data()
    logger = TensorBoardLogger(tmp_path, name="", version="tensorboard", default_hp_metric=False)
    short_fit(Structured(dt=data.dt), data, tmp_path / "run", logger=logger, pictures=True)
    events = EventAccumulator(str(tmp_path / "tensorboard"), size_guidance={"scalars": 0, "images": 0, "tensors": 0})
    tags = events.Reload().Tags()
    assert set(tags["scalars"]) >= {
        "train/total", "train/prediction", "val/loss", "val/rollout_rmse", "val/velocity_rmse", "val/stick_accuracy",
        "val/false_stick", "val/lcp_residual", "val/unsolved_share", "parameters/mu", "parameters/mu_true",
        "parameters/mass", "parameters/mass_true", "test/velocity_rmse",
    }  # fmt: skip
    assert {tag.partition("/")[0] for tag in tags["scalars"]} == {"parameters", "test", "train", "val"}
    assert set(tags["images"]) == {"test/one_step_map", "test/rollouts", "test/error_over_horizon"}
    assert "results/text_summary" in tags["tensors"]


def test_resuming_another_training_is_refused_by_name_or_written_down(tmp_path: Path) -> None:
    data, last = tiny_data(), tmp_path / "run" / "last.ckpt"
    short_fit(Physical(dt=data.dt), data, tmp_path / "run", epochs=2)
    other = tiny_data(noise=0.3)
    cases: list[tuple[Task, dict[str, Any], str]] = [
        (data, {"seed": 7}, "with seed=0, but the settings say 7: .* add allow_changes=true"),
        (data, {"batch_size": 8}, "with batch_size=None, but the settings say 8"),
        (data, {"optimizer": Optimizer(lr=0.5)}, "with optimizer.lbfgs_after=2, but the settings say None"),
        (other, {}, r"with data\.recordings=\w+, but the settings say"),
        (other, {"settings": {"data": {"noise": 0.3}}}, r"with data\.noise=its default, but the settings say 0\.3"),
    ]
    for recordings, changes, message in cases:
        with pytest.raises(ValueError, match=message):
            short_fit(Physical(dt=data.dt), recordings, tmp_path / "again", ckpt_path=last, **changes)
    assert not (tmp_path / "again").exists()
    short_fit(Physical(dt=data.dt), data, tmp_path / "again", ckpt_path=last, seed=7, allow_changes=True)
    resumed = yaml.safe_load((tmp_path / "again" / "config.yaml").read_text())["resumed"]
    assert resumed == {"from": str(last), "changed": {"seed": [0, 7]}, "epochs": 2}


class Poison(Callback):
    """From an epoch on, every prediction is NaN."""

    def __init__(self, epoch: int) -> None:
        self.epoch = epoch

    def on_train_epoch_start(self, trainer: Any, pl_module: Any) -> None:
        if trainer.current_epoch == self.epoch:
            for parameter in pl_module.parameters():
                parameter.data.fill_(float("nan"))


def test_a_training_that_diverges_says_so_and_keeps_the_last_finite_best(tmp_path: Path) -> None:
    data = tiny_data()
    trainer = QUIET | {"check_val_every_n_epoch": 1, "callbacks": [Poison(2)]}
    with pytest.raises(
        TrainingDivergedError, match=r"^Training diverged in epoch 3: .*'prediction'.*lower optimizer\.lr"
    ) as error:
        short_fit(MLP(dt=data.dt), data, tmp_path / "run", trainer=trainer, optimizer=Optimizer())
    assert "best.ckpt holds the best model before" in str(error.value)
    for name in ("best.ckpt", "last.ckpt"):
        assert bool(parameters(load(tmp_path / "run" / name)).isfinite().all())
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics == dict.fromkeys(KEYS) | {"diverged": str(error.value)}


def test_a_rollout_that_diverges_is_a_word_in_metrics_and_is_drawn_as_far_as_it_goes(tmp_path: Path) -> None:
    data = small_data()
    model = Affine(dt=data.dt)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.fill_(1e3)  # 1e3^1000 is more than a double holds
    metrics = evaluate(model, data)
    assert metrics["rollout_rmse_1000"] == float("inf")
    write_figures(tmp_path / "metrics.json", metrics)
    assert json.loads((tmp_path / "metrics.json").read_text())["rollout_rmse_1000"] == "diverged"
    assert "diverged" in format_table(metrics)
    for name, figure in figures.draw(Predictions(model, data)).items():
        figure.savefig(tmp_path / f"{name}.png")


def test_last_ckpt_is_written_every_time_and_never_knows_an_older_score_than_best_ckpt(tmp_path: Path) -> None:
    data, seen = tiny_data(), []

    class Look(Callback):
        """At the start of each epoch, read what kill -9 would leave."""

        def on_train_epoch_start(self, trainer: Any, pl_module: Any) -> None:
            if trainer.current_epoch > 0:
                best, last = (torch.load(tmp_path / "run" / name) for name in ("best.ckpt", "last.ckpt"))
                key = next(key for key in last["callbacks"] if key.startswith("BestCheckpoint"))
                scores = [float(saved["callbacks"][key]["best_model_score"]) for saved in (best, last)]
                seen.append((last["epoch"], scores[0] - scores[1]))

    trainer = QUIET | {"check_val_every_n_epoch": 1, "callbacks": [Look()]}
    short_fit(Structured(dt=data.dt), data, tmp_path / "run", trainer=trainer)
    assert seen == [(0, 0.0), (1, 0.0), (2, 0.0)]


def test_the_last_epoch_is_validated_and_may_be_the_best(tmp_path: Path) -> None:
    data = tiny_data()
    trainer = QUIET | {"check_val_every_n_epoch": 3}
    result = short_fit(Structured(dt=data.dt), data, tmp_path / "run", epochs=5, trainer=trainer)
    assert torch.load(tmp_path / "run" / "best.ckpt")["epoch"] == 4
    assert torch.equal(parameters(result.model), parameters(load(tmp_path / "run" / "last.ckpt")))


def test_without_any_force_no_mass_is_told(tmp_path: Path) -> None:
    data = tiny_data(force_std=0.0)
    with pytest.raises(ValueError, match=r"^model: expected learn_mass=False \(model=physical_mu\)"):
        short_fit(Physical(dt=data.dt), data, tmp_path / "run")
    result = short_fit(Structured(dt=data.dt), data, tmp_path / "run")
    assert set(result.model.physical_parameters()) == {"mu"}
    assert result.metrics is not None
    assert "mass" not in result.metrics


def test_a_run_moved_before_it_is_resumed_keeps_its_best_model(tmp_path: Path) -> None:
    data = tiny_data()
    short_fit(Structured(dt=data.dt), data, tmp_path / "first", epochs=3)
    (tmp_path / "first").rename(tmp_path / "moved")
    best = (tmp_path / "moved" / "best.ckpt").read_bytes()
    absurd = {"optimizer": Optimizer(lr=50.0, lbfgs_after=5), "allow_changes": True}  # all that follows is worse
    short_fit(
        Structured(dt=data.dt),
        data,
        tmp_path / "second",
        epochs=5,
        ckpt_path=tmp_path / "moved" / "last.ckpt",
        **absurd,
    )
    assert (tmp_path / "second" / "best.ckpt").read_bytes() == best


def test_a_file_that_could_not_be_written_whole_is_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "last.ckpt"
    path.write_bytes(b"old")

    def fails(file: BinaryIO) -> None:
        file.write(b"ne")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        replace(path, fails)
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("last.ckpt", b"old")]
    replace(path, lambda file: file.write(b"new"))
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("last.ckpt", b"new")]


def test_of_two_trainings_at_once_in_a_folder_the_second_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both have looked before either has written its settings."""
    data = tiny_data()
    short_fit(Physical(dt=data.dt), data, tmp_path / "run", epochs=1)
    before = (tmp_path / "run" / "last.ckpt").read_bytes()
    monkeypatch.setattr("lcplearn.training.fitting._new_folder", lambda folder: folder)
    with pytest.raises(ValueError, match="holds a run already"):
        short_fit(Physical(dt=data.dt), data, tmp_path / "run", epochs=1)
    assert (tmp_path / "run" / "last.ckpt").read_bytes() == before


def test_what_is_minimised_is_the_weighted_sum_and_what_is_best_is_judged_by_the_rollout(tmp_path: Path) -> None:
    data, seen = tiny_data(noise=0.01), []
    weights = {"prediction": 2.0, "rollout": 3.0}

    class Look(Callback):
        def on_train_batch_end(self, trainer: Any, pl_module: Any, outputs: Any, *rest: Any) -> None:
            terms = {name: float(value) for name, value in outputs.items()}
            seen.append(terms["total"] / (2.0 * terms["prediction"] + 3.0 * terms["rollout"]))

        def on_validation_end(self, trainer: Any, pl_module: Any) -> None:
            with torch.no_grad():
                terms = loss_terms(pl_module.model, windows(data.validation, 3), weights)
            found = trainer.callback_metrics
            seen.append(float(found["val/loss"] / (2.0 * terms["prediction"] + 3.0 * terms["rollout"])))
            seen.append(float(found["val/rollout_rmse"] / terms["rollout"].sqrt()))

    trainer = QUIET | {"check_val_every_n_epoch": 1, "callbacks": [Look()]}
    short_fit(Structured(dt=data.dt), data, tmp_path / "run", loss=weights, horizon=3, epochs=2, trainer=trainer)
    assert seen == pytest.approx(6 * [1.0])


def test_the_time_of_training_before_a_resumption_counts(tmp_path: Path) -> None:
    data, last = tiny_data(), tmp_path / "first" / "last.ckpt"
    short_fit(Structured(dt=data.dt), data, tmp_path / "first", epochs=2)
    torch.save(torch.load(last) | {"train_seconds": 1000.0}, last)
    result = short_fit(Structured(dt=data.dt), data, tmp_path / "second", ckpt_path=last)
    assert result.metrics is not None
    assert 1000.0 < (result.metrics["train_seconds"] or 0.0) < 1100.0
    assert 1000.0 < torch.load(tmp_path / "second" / "last.ckpt")["train_seconds"] < 1100.0


def test_adam_decays_by_a_cosine_to_zero_where_lbfgs_takes_over_or_training_ends() -> None:
    for optimizer, epochs in ((Optimizer(lr=0.2), 100), (Optimizer(lr=0.2, lbfgs_after=100), 300)):
        rates = [optimizer.learning_rate(epoch, epochs) for epoch in (0, 25, 50, 100)]
        assert rates == pytest.approx([0.2, 0.1 * (1 + 0.5**0.5), 0.1, 0.0])


def test_kill_9_leaves_checkpoints_that_load(tmp_path: Path) -> None:
    """`python tests/training/kill.py` does it 50 times, with large files and on two file systems."""
    for number, moment in enumerate((0.05, 0.3)):
        assert kill_once(tmp_path / str(number), tmp_path, 50, moment) == (0, 0)


def test_a_training_does_not_say_how_its_pictures_are_written(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        with quiet():
            logging.getLogger("matplotlib.animation").info("Animation.save using a writer")
        logging.getLogger("matplotlib.animation").info("not in a training")
    assert caplog.messages == ["not in a training"]
