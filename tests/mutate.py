"""Break the code in one place at a time and see whether a test notices.

python tests/mutate.py [--only WORD] [--skip WORD] [--list]

The mutations stand in tests/mutations.py. Each is applied to a copy of the working tree, in which the tests that guard
it are run. Exit status 1 if one survives, or if its text is no longer found.
"""

import argparse
import importlib
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

from mutations import MUTATIONS, Mutation

ROOT = Path(__file__).parents[1]
LOG = "mutate.log"
# What every test file waits for; not lcplearn itself, which is imported from the mutated copy.
HEAVY = ("pytest", "torch", "lightning.pytorch", "hydra", "numba", "matplotlib.figure")


def copy_tree(target: Path) -> None:
    """Copy what git knows or would add, and the compiled kernel, which is the slowest thing to make."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    names += [str(path.relative_to(ROOT)) for path in (ROOT / "lcplearn").rglob("*.nb[ic]")]
    for name in names:
        if (ROOT / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target / name)


def run_tests(tree: Path, mutation: Mutation, log: Path) -> None:
    """Be a process that runs pytest in the copy, and ends with its status."""
    with log.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    os.chdir(tree)
    os.environ["PYTHONPATH"] = str(tree)  # of what the tests start
    sys.path[:] = [str(tree), *(path for path in sys.path if Path(path or ".").resolve() not in (ROOT, ROOT / "tests"))]
    arguments = [
        "-x",
        "-q",
        "-n0",
        "-p",
        "no:cacheprovider",
        "-W",
        "ignore::pytest.PytestAssertRewriteWarning",
        *mutation.tests.split(),
    ]
    arguments += ["-k", mutation.keyword] if mutation.keyword else []
    try:
        status = int(importlib.import_module("pytest").main(arguments))
    except BaseException:  # noqa: BLE001  # whatever it is, no test has failed
        traceback.print_exc()
        status = 99
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def status(tree: Path, mutation: Mutation, limit: float) -> int | None:
    """Exit status of a mutation's tests in the copy as it is: 1 if one failed, None if they took too long."""
    sys.stdout.flush()
    process = multiprocessing.get_context("fork").Process(target=run_tests, args=(tree, mutation, tree / LOG))
    process.start()
    process.join(limit)
    if process.is_alive():
        process.kill()
        return None
    return process.exitcode


def judge(mutation: Mutation, tree: Path, limit: float, unbroken: dict[tuple[str, str], int | None]) -> str:
    """Apply one mutation, run its tests and take it back: caught, survived, stale or error.

    `unbroken` remembers how the tests end without it.
    """
    path = tree / mutation.file
    text = path.read_text() if path.is_file() else ""
    if text.count(mutation.old) != 1:
        return "stale"
    key = (mutation.tests, mutation.keyword)
    if key not in unbroken:
        unbroken[key] = status(tree, mutation, limit)
    if (ends := unbroken[key]) == 0:
        times = path.stat()
        path.write_text(text.replace(mutation.old, mutation.new))
        try:
            ends = status(tree, mutation, limit)
        finally:
            path.write_text(text)
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))  # numba knows what it compiled by the date
        if ends in (0, 1):
            return "caught" if ends else "survived"
    print(f"{mutation.breaks}: pytest ended with {ends}\n{(tree / LOG).read_text()[-2000:]}", file=sys.stderr)
    return "error"


def main() -> None:
    """Run the mutations and print the score."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", metavar="WORD", help="those in whose entry the word stands")
    parser.add_argument("--skip", metavar="WORD", help="all but those in whose entry the word stands")
    parser.add_argument("--passing", action="store_true", help="the tests are known to pass: do not run them unbroken")
    parser.add_argument("--list", action="store_true", help="only say which there are, and which are stale")
    parser.add_argument("--limit", type=float, default=600.0, help="seconds for the tests of one")
    options = parser.parse_args()
    chosen = [each for each in MUTATIONS if options.only in (text := " ".join(map(str, each)))
              and not (options.skip and options.skip in text)]  # fmt: skip
    chosen.sort(key=lambda each: "pivoting" in each.file or "kernel" in each.file)  # they compile it anew
    if not options.list:
        os.environ |= {"PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
        sys.dont_write_bytecode = True
        for name in HEAVY:
            importlib.import_module(name)
    counts = dict.fromkeys(("caught", "equivalent", "survived", "stale", "error"), 0)
    with tempfile.TemporaryDirectory() as folder:
        tree, unbroken = Path(folder), {}
        copy_tree(tree)
        for number, mutation in enumerate(chosen, start=1):
            start = time.perf_counter()
            found = (ROOT / mutation.file).is_file() and (ROOT / mutation.file).read_text().count(mutation.old) == 1
            if mutation.equivalent or options.list:
                result = ("equivalent" if mutation.equivalent else "caught") if found else "stale"
            else:
                if options.passing:
                    unbroken[mutation.tests, mutation.keyword] = 0
                result = judge(mutation, tree, options.limit, unbroken)
            counts[result] += 1
            word = ("there" if result != "stale" else result) if options.list else result
            print(f"{number:3d}/{len(chosen)} {word:<10} {time.perf_counter() - start:5.1f} s  "
                  f"{mutation.file.removeprefix('lcplearn/')}: {mutation.breaks}"
                  + (f" ({mutation.equivalent})" if mutation.equivalent else ""), flush=True)  # fmt: skip
    if not options.list:
        print(", ".join(f"{count} {name}" for name, count in counts.items()))
    sys.exit(bool(counts["survived"] + counts["stale"] + counts["error"]))


if __name__ == "__main__":
    main()
