"""Train a formulation of contact: python train.py [key=value ...], or installed: lcplearn train [key=value ...]

conf/train.yaml says what can be set. HYDRA_FULL_ERROR=1 shows the whole traceback of an error.
"""

import math
import os
import shlex
import sys
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, InstantiationException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

DEBUGGING = os.environ.get("HYDRA_FULL_ERROR") == "1"
PROCESSES = int(os.environ.get("WORLD_SIZE", 1)) if "TORCHELASTIC_RUN_ID" in os.environ else 1  # torchrun's
MISTAKES = (HydraException, OmegaConfBaseException, ValueError, OSError, ArithmeticError)
HERE = Path(__file__)
# The configuration lies in the package where a wheel was installed, and beside it in the repository.
CONF = next(folder for folder in (HERE.parent / "conf", HERE.parents[1] / "conf") if folder.is_dir())


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="train")
def main(config: DictConfig) -> float:
    """Build what the configuration says, train and test it; return the best validation error, for sweepers."""
    try:
        return train(config)
    except (*MISTAKES, KeyboardInterrupt) as error:
        if DEBUGGING:
            raise
        sys.exit(sentence(error))  # no Exception, so that Hydra adds nothing to it


def train(config: DictConfig) -> float:
    """Check the configuration, then build, fit and test; errors are the caller's."""
    from lcplearn.training.settings import check

    run = HydraConfig.get()
    sweep = run.mode is RunMode.MULTIRUN
    settings: dict[str, Any] = dict(OmegaConf.to_container(config, resolve=True))  # type: ignore[arg-type]
    check(settings, CONF, multirun=sweep, processes=PROCESSES)

    import torch
    from lightning import seed_everything
    from lightning.pytorch.utilities import rank_zero_only

    from lcplearn.datasets.pushes import PushData
    from lcplearn.formulations import build
    from lcplearn.training import TrainingDivergedError, TrainingInterrupted, fit
    from lcplearn.training.metrics import describe_model, format_table

    torch.set_num_threads(config.threads)
    seed_everything(config.seed, verbose=False)
    data = hydra.utils.instantiate(config.data, _convert_="all")
    if isinstance(data, PushData):
        return train_pushes(config, data, settings, run.runtime.output_dir)
    asked = hydra.utils.instantiate(config.model, _partial_=True, _convert_="all")
    model = build(asked.func, data, **asked.keywords)
    loss, trainer = dict(settings["loss"]), dict(settings["trainer"])
    rank_zero_only(print)(describe_model(model, data))
    try:
        result = fit(
            model,
            data,
            horizon=loss.pop("horizon", 1),
            loss=loss,
            stages=settings["stages"],
            epochs=trainer.pop("max_epochs"),
            batch_size=config.batch_size,
            batches=config.batches,
            optimizer=hydra.utils.instantiate(config.optimizer, _convert_="all"),
            patience=config.patience,
            folder=run.runtime.output_dir,
            ckpt_path=config.ckpt_path,
            allow_changes=config.allow_changes,
            seed=config.seed,
            logger=hydra.utils.instantiate(config.logger, _convert_="all"),
            trainer=trainer,
            settings=settings,
        )
    except TrainingDivergedError as error:
        if not sweep:
            raise
        print(error)  # a sweep goes on
        return math.inf
    except TrainingInterrupted as stop:
        raise KeyboardInterrupt(f"Stopped; to go on: {_command_from(stop.checkpoint)}") from None
    if result.metrics is not None:
        learned = ", ".join(f"{name} = {value:.6g}" for name, value in result.model.physical_parameters().items())
        print(f"\n{format_table(result.metrics)}" + (f"\n\nlearned: {learned}" if learned else ""))
        print(f"\nrun folder: {os.path.relpath(result.folder)}")
    return result.validation


def _command_from(checkpoint: Path) -> str:
    """The command line of this run, resumed."""
    overrides = HydraConfig.get().overrides
    searched = [override for override in overrides.hydra if override.startswith("hydra.searchpath=")]
    task = [override for override in overrides.task if not override.startswith("ckpt_path=")]
    name = "lcplearn train" if Path(sys.argv[0]) == HERE else "python train.py"
    return f"{name} {shlex.join([*searched, *task, f'ckpt_path={os.path.relpath(checkpoint)}'])}"


def train_pushes(config: DictConfig, data: Any, settings: dict[str, Any], folder: str) -> float:
    """Models of pushes fit themselves: cross-validate one, and fit it to all pushes."""
    import hydra.utils

    from lcplearn.training.push_training import fit_pushes

    thing = {"vertices": data.vertices.tolist(), "com": data.com.tolist(), "mass": data.mass}
    model = hydra.utils.instantiate(config.model, **thing, _convert_="all")
    logger = hydra.utils.instantiate(config.logger, _convert_="all")
    progress = config.trainer.get("enable_progress_bar", True)
    result = fit_pushes(model, data, folder=folder, logger=logger, settings=settings, progress=progress)
    learned = ", ".join(f"{name} = {value:.4g}" for name, value in model.physical_parameters().items())
    print(f"\npushes that were left out:\n{result.report}" + (f"\n\nlearned from all: {learned}" if learned else ""))
    print(f"\nrun folder: {os.path.relpath(result.folder)}")
    return result.metrics["deviation_mm"]


def sentence(error: BaseException) -> str:
    """What a user can do about an error, in one sentence."""
    from lcplearn.command_line import own_folders
    from lcplearn.training.vocabulary import explain

    failed_call = isinstance(error, InstantiationException) and error.__cause__ is not None
    cause = error.__cause__ if failed_call else error
    if isinstance(cause, OSError) and cause.filename and cause.strerror:
        return f"{cause.filename}: {cause.strerror}."
    return explain(str(cause) or "Stopped.", CONF, own_folders(sys.argv))


def command(arguments: list[str]) -> None:
    """Check what can be checked at once, then let Hydra run it."""
    from lcplearn.command_line import prepare, settle, version_line
    from lcplearn.training.settings import check_torchrun

    if arguments == ["--version"]:
        print(version_line())
        return
    folder = None
    try:
        if PROCESSES > 1:
            check_torchrun(arguments)
        else:
            sys.argv[1:], folder = prepare(arguments, CONF)
        main()
    except (*MISTAKES, KeyboardInterrupt) as error:
        if DEBUGGING:
            raise
        sys.exit(sentence(error))
    finally:
        settle(folder)


def run() -> None:
    """Do what the command line says."""
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra hands errors on instead of printing them
    command(sys.argv[1:])


if __name__ == "__main__":
    run()
