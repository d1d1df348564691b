"""Break the code in one place at a time and see whether a test notices.

python tests/mutate.py [--only WORD] [--list]

The mutations stand in tests/mutations.py. Each is applied to a copy of the working tree, in which the tests that guard
it are run. Exit status 1 if one survives, or if its text is no longer found.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from mutations import MUTATIONS, Mutation

ROOT = Path(__file__).parents[1]


def copy_tree(target: Path) -> None:
    """Copy what git knows or would add, so without environments, runs and caches."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines():
        if (ROOT / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target / name)


def judge(mutation: Mutation, tree: Path, limit: float) -> str:
    """Apply one mutation, run its tests and take it back: caught, survived, stale or error."""
    path = tree / mutation.file
    text = path.read_text() if path.is_file() else ""
    if text.count(mutation.old) != 1:
        return "stale"
    environment = os.environ | {
        "PYTHONPATH": str(tree),
        "PYTHONDONTWRITEBYTECODE": "1",
        "OMP_NUM_THREADS": "1",
        "NUMBA_CACHE_DIR": str(
            tree / "cache"
        ),  # numba looks at the date of a file, which may be that of the one before
    }
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *mutation.tests.split()]
    if mutation.keyword:
        command += ["-k", mutation.keyword]
    try:
        path.write_text(text.replace(mutation.old, mutation.new))
        done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, timeout=limit)
    except subprocess.TimeoutExpired:
        return "caught"  # it runs for ever: whoever waits for the tests notices
    finally:
        path.write_text(text)
    if done.returncode not in (0, 1):  # 1: a test failed; others: none was run
        print(done.stdout[-2000:], done.stderr[-2000:], file=sys.stderr)
        return "error"
    return "caught" if done.returncode else "survived"


def main() -> None:
    """Run the mutations and print the score."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", metavar="WORD", help="those whose file, claim or origin has the word")
    parser.add_argument("--list", action="store_true", help="only say which there are, and which are stale")
    parser.add_argument("--limit", type=float, default=300.0, help="seconds for the tests of one")
    options = parser.parse_args()
    chosen = [each for each in MUTATIONS if options.only in f"{each.file} {each.breaks} {each.origin}"]
    counts = dict.fromkeys(("caught", "equivalent", "survived", "stale", "error"), 0)
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        copy_tree(tree)
        for number, mutation in enumerate(chosen, start=1):
            start = time.perf_counter()
            found = (ROOT / mutation.file).is_file() and (ROOT / mutation.file).read_text().count(mutation.old) == 1
            if mutation.equivalent or options.list:
                result = ("equivalent" if mutation.equivalent else "caught") if found else "stale"
            else:
                result = judge(mutation, tree, options.limit)
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
