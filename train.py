"""Train a formulation of contact: python train.py [key=value ...]; conf/train.yaml says what can be set."""

import os
import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

CONF = Path(__file__).parent / "conf"
TOP_LEVEL = ("seed", "threads", "batch_size", "patience", "ckpt_path", "data", "model", "loss", "optimizer", "trainer",
             "logger")  # fmt: skip


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
def main(config: DictConfig) -> float:
    """Build what the configuration says, train and test it; return the best validation loss, for sweepers."""
    from lcplearn.training.settings import check

    run = HydraConfig.get()
    settings = OmegaConf.to_container(config, resolve=True)
    check(settings, TOP_LEVEL, multirun=run.mode.name == "MULTIRUN")

    import torch
    from lightning import seed_everything
    from lightning.pytorch.utilities import rank_zero_only

    from lcplearn.training import TrainingInterrupted, fit
    from lcplearn.training.metrics import describe_model, format_table

    torch.set_num_threads(config.threads)
    seed_everything(config.seed, verbose=False)
    data = hydra.utils.instantiate(config.data, _convert_="all")
    model = hydra.utils.instantiate(config.model, dt=data.dt, gravity=data.gravity, _convert_="all")
    loss, trainer = dict(settings["loss"]), dict(settings["trainer"])
    rank_zero_only(print)(describe_model(model, data))
    try:
        result = fit(
            model,
            data,
            loss={name: weight for name, weight in loss.items() if name != "horizon"},
            horizon=loss["horizon"],
            epochs=trainer.pop("max_epochs"),
            batch_size=config.batch_size,
            optimizer=hydra.utils.instantiate(config.optimizer, _convert_="all"),
            patience=config.patience,
            folder=run.runtime.output_dir,
            ckpt_path=config.ckpt_path,
            seed=config.seed,
            logger=hydra.utils.instantiate(config.logger, _convert_="all"),
            trainer=trainer,
            settings=settings,
        )
    except TrainingInterrupted as stop:
        command = " ".join(["python", *sys.argv[:1], *run.overrides.task])
        raise KeyboardInterrupt(f"Stopped. To go on: {command} ckpt_path={stop.checkpoint}") from None
    if result.metrics is not None:
        print(f"\n{format_table(result.metrics)}\n\nrun folder: {os.path.relpath(result.folder)}")
    return result.validation


def sentence(error: Exception) -> str:
    """What a user can do about an error, in one sentence."""
    from lcplearn.training.settings import explain

    cause = error.__cause__ if isinstance(error, HydraException) and isinstance(error.__cause__, Exception) else error
    return explain(str(cause), CONF)


if __name__ == "__main__":
    debugging = os.environ.get("HYDRA_FULL_ERROR", "0") == "1"
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra hands errors on instead of printing them
    try:
        main()
    except KeyboardInterrupt as stop:
        sys.exit(f"\n{stop}" if str(stop) else 130)
    except (HydraException, OmegaConfBaseException, ValueError, FileNotFoundError) as error:
        if debugging:
            raise
        sys.exit(f"{sentence(error)}\n(HYDRA_FULL_ERROR=1 shows where.)")
