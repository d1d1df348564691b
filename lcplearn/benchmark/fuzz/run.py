"""`benchmark fuzz`: hunt for wrong statuses, NaN, crashes, hangs and batch dependence; each finding can be replayed.

Problems are checked in a child process, so that an abort is a finding too and not the end of the hunt.
"""

import argparse
import subprocess
import sys
import time
import traceback
from collections import Counter
from pathlib import Path

import numpy as np

from lcplearn.benchmark.fuzz.cases import Batch, batch
from lcplearn.benchmark.fuzz.checks import Finding, check

MOST_OF_A_CHECK = 5  # findings of one check and kind that are kept
PATIENCE = 120.0  # seconds without a new batch after which the child hangs


def run(options: argparse.Namespace) -> None:
    """Replay a finding, or hunt for `options.minutes` and write findings to `options.output`."""
    if options.replay:
        sys.exit(1 if replay(options.replay) else 0)
    options.output.mkdir(parents=True, exist_ok=True)
    batches = hunt(options.output, options.seed, 60.0 * options.minutes)
    found = sorted(options.output.glob("*.npz"))
    print(f"{batches} batches checked, {len(found)} findings kept in {options.output}")
    for path in found:
        print(f"python -m lcplearn.benchmark fuzz --replay {path}")


def hunt(folder: Path, seed: int, seconds: float) -> int:
    """Run children one after the other until time is up; returns the number of batches that they began."""
    end, index, progress = time.monotonic() + seconds, 0, folder / "batch_in_progress"
    while (left := end - time.monotonic()) > 0:
        progress.write_text(str(index))
        command = [sys.executable, "-m", "lcplearn.benchmark.fuzz.run", str(folder), str(seed), str(index), str(left)]
        child = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        hung = _wait(child, progress)
        errors = child.communicate()[1]
        index = int(progress.read_text())
        if hung or child.returncode != 0:
            lines = errors.strip().splitlines() or [""]
            message = "no answer" if hung else f"exit code {child.returncode}: {lines[-1]}"
            case = batch(seed, index)
            write_finding(
                folder, case, Finding("hang" if hung else "crash", message, list(range(len(case.q)))), seed, index
            )
        index += 1
    progress.unlink()
    return index


def _wait(child: subprocess.Popen[str], progress: Path) -> bool:
    """Wait for the child; kill it and return True if it makes no progress."""
    while True:
        try:
            child.wait(timeout=1.0)
            return False
        except subprocess.TimeoutExpired:
            if time.time() - progress.stat().st_mtime > PATIENCE:
                child.kill()
                return True


def search(folder: Path, seed: int, index: int, seconds: float) -> None:
    """The child: check one batch after the other, from number `index` on."""
    end, kept = time.monotonic() + seconds, Counter[tuple[str, str]]()
    while time.monotonic() < end:
        (folder / "batch_in_progress").write_text(str(index))
        case = batch(seed, index)
        for finding in check(case):
            kept[finding.check, case.kind] += 1
            if kept[finding.check, case.kind] <= MOST_OF_A_CHECK:
                write_finding(folder, case, finding, seed, index)
        index += 1


def write_finding(folder: Path, case: Batch, finding: Finding, seed: int, index: int) -> Path:
    """Keep a finding as an NPZ file: M, q, and as text its check, message and kind."""
    name = "".join(c if c.isalnum() else "_" for c in f"{finding.check} {case.kind}")
    path = folder / f"{name}_{seed}_{index}_{finding.elements[0]}.npz"
    np.savez(
        path,
        M=case.M[finding.elements],
        q=case.q[finding.elements],
        solvable=case.solvable,
        kind=case.kind,
        check=finding.check,
        message=" ".join(finding.message.split()),
    )
    return path


def replay(path: Path) -> list[Finding]:
    """Check the problems of a finding again and say what is wrong with them now."""
    with np.load(path, allow_pickle=False) as file:
        case = Batch(str(file["kind"]), file["M"], file["q"], bool(file["solvable"]))
        print(f"{path}: found as '{file['check']}' ({file['message']}); kind {case.kind}, M {list(case.M.shape)}")
    try:
        findings = check(case)
    except Exception:  # noqa: BLE001 - whatever the solver raises is what is being looked for
        findings = [Finding("crash", traceback.format_exc(), [0])]
    for finding in findings:
        message = " ".join(finding.message.split())
        print(f"  {finding.check}: {message} (elements {finding.elements[:5]})")
    if not findings:
        print("  nothing wrong now")
    return findings


if __name__ == "__main__":
    search(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4]))
