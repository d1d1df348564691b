"""Fetch published recordings and make the project's data files of them.

Usage: python -m lcplearn.datasets.get slides|tosses|pushes [--out FOLDER] [--source CLONE]

The recordings stay out of the repository. This command fetches the public source at a pinned commit with git, converts
it, checks a checksum, and prints the licence and where the file lies. After a break the same command goes on.
"""

import argparse
import hashlib
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lcplearn.datasets import contactnets, cube_slides, cube_tosses, push_logs, pushes
from lcplearn.datasets.files import replace

Arrays = Mapping[str, NDArray]


class Source(NamedTuple):
    """A public repository of recordings, and the data files that are made of it.

    Attributes:
        url: Where git fetches it.
        commit: The commit whose files are converted.
        folder: Folder of the recordings in it.
        licence: What to know before sharing copies.
        convert: Makes the arrays of each data file, by file name, of a clone.
        digest: SHA-256 of what `checked` gives, as the figures of README and docs used it.
        checked: The bytes that are checked; ValueError where the files lack them.
    """

    url: str
    commit: str
    folder: str
    licence: str
    convert: Callable[[Path], Mapping[str, Arrays]]
    digest: str
    checked: Callable[[Mapping[str, Arrays]], bytes]


def fetch(source: Source, clone: Path) -> None:
    """Bring the recordings of a source into a clone, or go on where an earlier try stopped.

    Only the folder of the recordings is checked out, and only its files are downloaded. git verifies them: a commit is
    the hash of its content.

    Raises:
        OSError: git is missing or could not reach the source.
    """
    clone.mkdir(parents=True, exist_ok=True)
    steps = (
        ("init", "--quiet"),
        ("sparse-checkout", "set", "--no-cone", f"/{source.folder}/", "/LICENSE*"),
        ("config", "remote.origin.url", source.url),
        ("config", "remote.origin.promisor", "true"),  # files not downloaded yet come from there
        ("fetch", "--progress", "--depth=1", "--filter=blob:none", "origin", source.commit),
        ("checkout", "--progress", "--detach", source.commit),
    )
    try:
        for step in steps:
            subprocess.run(["git", "-C", str(clone), *step], check=True)
    except FileNotFoundError:
        raise OSError("git: not found; install it, or name a clone brought from elsewhere: --source CLONE") from None
    except subprocess.CalledProcessError:
        raise OSError(
            f"{source.url}: git could not fetch it (its words stand above); the same command goes on later, "
            "and without a network a clone brought from elsewhere will do: --source CLONE"
        ) from None


def make(source: Source, clone: Path, out: Path) -> dict[str, Path]:
    """Convert a clone, check what came of it, and write the data files whole or not at all; none is overwritten.

    Returns:
        Path of each file that was written, by name.

    Raises:
        OSError: the folder of the recordings is missing, or a file can't be written.
        ValueError: the recordings are not those that the project knows.
    """
    files = source.convert(clone)
    found = hashlib.sha256(source.checked(files)).hexdigest()
    if found != source.digest:
        raise ValueError(
            f"{clone}: expected the recordings of commit {source.commit[:7]} (checksum {source.digest[:12]}), "
            f"got others ({found[:12]}); nothing was written"
        )
    paths = {name: out / name for name in files if not (out / name).exists()}
    for name, path in paths.items():
        # numpy types **arrays as flags
        replace(path, lambda file, arrays=files[name]: np.savez_compressed(file, **arrays))  # type: ignore[misc]
    return paths


def _convert_tosses(clone: Path) -> Mapping[str, Arrays]:
    tosses, slides = contactnets.convert(clone / CONTACT_NETS.folder)
    return {contactnets.TOSSES_FILE: tosses, cube_slides.FILE: slides}


def _checked_tosses(files: Mapping[str, Arrays]) -> bytes:
    """States of the tosses that the figures learn from and choose by."""
    arrays = files[contactnets.TOSSES_FILE]
    numbers, offsets = arrays["source_id"].tolist(), arrays["offsets"]
    rows = []
    for number in (*cube_tosses.LEARN, *cube_tosses.CHOOSE):
        if number not in numbers:
            raise ValueError(f"toss {number}: expected among the {len(numbers)} tosses of the source, got none")
        k = numbers.index(number)
        rows.append(arrays["state"][offsets[k] : offsets[k + 1]])
    return np.concatenate(rows).astype("<f8").tobytes()


def _convert_pushes(clone: Path) -> Mapping[str, Arrays]:
    return {pushes.FILE: push_logs.convert(clone)}


def _checked_pushes(files: Mapping[str, Arrays]) -> bytes:
    """End poses of one push of each configuration."""
    arrays = files[pushes.FILE]
    chosen = arrays["source_push"] == 9
    return arrays["post_pose7_mm"][chosen].astype("<f8").tobytes()


CONTACT_NETS = Source(
    url="https://github.com/DAIRLab/contact-nets",
    commit="c3dc21c94577ff4ed99123f0b00bfe57bb2d1d90",
    folder="data/tosses_processed",
    licence="BSD-3-Clause, copyright (c) 2020, Dynamic Autonomy and Intelligent Robotics Lab",
    convert=_convert_tosses,
    digest="85cb76b5651066687723f42b20c6028e09ecc3eaa2cb6f9adb9f6e6e8a6649f4",
    checked=_checked_tosses,
)
MLAB_EXP = Source(
    url="https://github.com/robinzhoucmu/MLab_EXP",
    commit="4d86db9438203f51c4368e5b886def5c402955f3",
    folder=push_logs.FOLDER,
    licence="Apache-2.0, copyright Jiaji Zhou, Manipulation Lab, Carnegie Mellon University",
    convert=_convert_pushes,
    digest="88b1947bd0f2bdd1e8b9d701c50ce41bf8048e95ba3ea23e1ccc57b755e23ae4",
    checked=_checked_pushes,
)
FILES = {
    "slides": (cube_slides.FILE, CONTACT_NETS),
    "tosses": (contactnets.TOSSES_FILE, CONTACT_NETS),
    "pushes": (pushes.FILE, MLAB_EXP),
}


def main(arguments: list[str] | None = None) -> None:
    """Fetch, convert, check and tell; what goes wrong ends the command with one sentence."""
    parser = argparse.ArgumentParser(prog="python -m lcplearn.datasets.get", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("name", choices=FILES, metavar="NAME", help=", ".join(FILES))
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(os.environ.get("LCPLEARN_DATA") or "data"),
        metavar="FOLDER",
        help="folder to write to (default: that of LCPLEARN_DATA, or data)",
    )
    parser.add_argument("--source", type=Path, metavar="CLONE", help="a clone that is there already; no network needed")
    options = parser.parse_args(arguments)
    name, source = FILES[options.name]
    clone = options.source or options.out / ".sources" / source.url.rpartition("/")[2]
    try:
        if options.source is None:
            fetch(source, clone)
        paths = make(source, clone, options.out)
    except (OSError, ValueError) as error:
        parser.exit(1, f"{error}\n")
    written = "".join(f"{path}\n" for path in paths.values())
    if name not in paths:
        written += f"{options.out / name} was there already, and stays as it is\n"
    sys.stdout.write(f"{written}licence of {name}: {source.licence}; LICENSE in {clone} goes with copies\n")


if __name__ == "__main__":
    main()
