"""`benchmark against TREE`: speed of the kernel beside that of another checkout, in turns.

A change of the kernel must not slow a family down. `git worktree add ../before COMMIT` makes the checkout.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from tqdm import tqdm

import lcplearn
from lcplearn.benchmark.harness.study import Table, Value, format_table
from lcplearn.benchmark.problems.families import RANDOM_FAMILIES

FLOOR = 0.97  # of the other checkout's speed; differences of a few per cent are noise
BATCH, SMALL_BATCH = 1024, 4096  # the larger one up to n = 10, where a call's own time would show


def run(options: argparse.Namespace) -> None:
    """Time all families and print a table; exit status 1 if one is slower than FLOOR."""
    other = options.tree.resolve()
    if not (other / "lcplearn" / "__init__.py").is_file():
        raise ValueError(f"{options.tree}: expected a checkout of lcplearn; found no package lcplearn there")
    here = Path(lcplearn.__file__).parents[1]
    lines: list[list[Value]] = []
    with tempfile.TemporaryDirectory() as folder, _worker(other) as old, _worker(here) as new:
        for name, make in tqdm(RANDOM_FAMILIES.items(), unit="family"):
            file = Path(folder) / "problems.npz"
            count = SMALL_BATCH if int(name.split("n=")[1].split()[0]) <= 10 else BATCH
            M, q, _ = make(np.random.default_rng(options.seed), count)
            np.savez(file, M=M, q=q)
            pairs = np.array([[_ask(worker, file) for worker in (old, new)] for _ in range(options.rounds)])
            before, after = pairs.min(0) / count * 1e6
            low, middle, high = np.quantile(pairs[:, 0] / pairs[:, 1], [0.25, 0.5, 0.75])
            ratio = float(before / after)
            spread = f"{middle:.2f} ({low:.2f} to {high:.2f})"
            lines.append([name, float(before), float(after), ratio, spread, ratio >= FLOOR])
    columns = ("family", f"{other.name} [us]", "here [us]", "speed, fastest", "speed, median of rounds", "met")
    print(format_table(Table(columns, lines)))
    slower = [str(line[0]) for line in lines if not line[-1]]
    sys.exit(f"slower than {FLOOR} of {other}: {'; '.join(slower)}" if slower else 0)


def _worker(tree: Path) -> "subprocess.Popen[str]":
    environment = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("worker.py"))],
        cwd=tree, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip


def _ask(worker: "subprocess.Popen[str]", file: Path) -> float:
    assert worker.stdin is not None
    assert worker.stdout is not None
    worker.stdin.write(f"{file}\n")
    worker.stdin.flush()
    return float(worker.stdout.readline())
