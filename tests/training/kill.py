"""Kill trainings with SIGKILL at random moments and look at what they leave.

python tests/training/kill.py --times 50 [--width 1000] [--folders /dev/shm /tmp]

Each training writes last.ckpt and best.ckpt every epoch (24 MB at width 1000), once with its folder on the first of two
file systems and the temporary folder on the second, once the other way round. Prints, for each, how many checkpoints
could not be loaded and how many trainings lost more than the epoch they were in.
"""

import argparse
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback

from lcplearn.datasets import simulate_sliding_block
from lcplearn.formulations import MLP
from lcplearn.training import fit, load


class Progress(Callback):
    """Write down which epoch begins."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def on_train_epoch_start(self, trainer: Any, pl_module: Any) -> None:
        beside = self.file.with_suffix(".part")  # a kill may come between the opening of a file and its writing
        beside.write_text(str(trainer.current_epoch))
        beside.replace(self.file)


def train(folder: Path, width: int) -> None:
    """Train until somebody ends it."""
    data = simulate_sliding_block(trajectories=2, length=5, validation_trajectories=1, test_trajectories=1,
                                  test_length=5, long_trajectories=1, long_length=5)  # fmt: skip
    trainer = {"check_val_every_n_epoch": 1, "enable_progress_bar": False, "callbacks": [Progress(folder / "epoch")]}
    fit(MLP(dt=data.dt, width=width), data, epochs=10**6, patience=None, folder=folder / "run", trainer=trainer)


def kill_once(folder: Path, temporary: Path, width: int, moment: float) -> tuple[int, int]:
    """Kill a training some seconds after its first checkpoint.

    Returns:
        How many of its two checkpoints can't be loaded, and how many whole epochs are lost.
    """
    folder.mkdir()
    process = os.fork()
    if process == 0:
        tempfile.tempdir = str(temporary)
        torch.set_num_threads(1)
        train(folder, width)
        os._exit(1)
    last = folder / "run" / "last.ckpt"
    while not last.is_file():
        assert os.waitpid(process, os.WNOHANG) == (0, 0), "the training ended by itself"
        time.sleep(0.01)
    time.sleep(moment)
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)
    broken = 0
    for path in (last, last.with_name("best.ckpt")):
        try:
            load(path)
        except ValueError as error:
            print(error, file=sys.stderr)
            broken += 1
    begun, done = int((folder / "epoch").read_text()), torch.load(last)["epoch"] + 1 if not broken else 0
    shutil.rmtree(folder)
    return broken, max(begun - done, 0)


def kill(times: int, width: int, folders: tuple[Path, Path], seed: int = 0) -> list[str]:
    """Kill `times` trainings with each of the two folders as the run's; return a line for each."""
    lines, draw = [], random.Random(seed)
    for here, there in (folders, folders[::-1]):
        with tempfile.TemporaryDirectory(dir=here) as run, tempfile.TemporaryDirectory(dir=there) as temporary:
            found = [
                kill_once(Path(run) / str(k), Path(temporary), width, draw.uniform(0.0, 1.0)) for k in range(times)
            ]
        broken, lost = sum(pair[0] for pair in found), sum(pair[1] > 0 for pair in found)
        lines.append(f"runs on {here}, temporary files on {there}: {times} killed, {broken} of {2 * times} checkpoints "
                     f"unloadable, {lost} lost a finished epoch")  # fmt: skip
    return lines


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=50)
    parser.add_argument("--width", type=int, default=1000, help="units of a layer; 1000 makes 24 MB")
    parser.add_argument("--folders", nargs=2, type=Path, default=(Path("/dev/shm"), Path("/tmp")))
    options = parser.parse_args()
    print("\n".join(kill(options.times, options.width, tuple(options.folders))))
