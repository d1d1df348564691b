"""A study: measurements that are kept as they are made, and what was found, in figures and tables.

A command of `python -m lcplearn.benchmark` goes through its keys, measures each, and then says what it found:

    study = Study("solvers", options, key=("family", "method"), columns=("seconds", "residual"))
    for key in study.remaining(keys, seconds=2.0):      # skips what a stopped run has measured already
        study.add(key, {"seconds": ..., "residual": ...})
    study.say("Which solver is fastest?", "An answer.", table=Table(...), figure=figure)
    study.finish()

The folder then holds results.csv, a PNG of each figure, summary.json (which `benchmark report` reads) and a TensorBoard
run.
"""

import csv
import io
import json
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Value = str | float | int | bool
Row = dict[str, Value]
PACKAGES = ("lcplearn", "torch", "numba", "numpy", "quantecon", "mujoco", "drake")


@dataclass(frozen=True)
class Options:
    """What all commands share: the folder to write to, small sizes only, threads of torch and BLAS, the seed."""

    output: Path
    quick: bool = False
    threads: int = 1
    seed: int = 0


class Table(NamedTuple):
    """Columns, and rows of as many cells."""

    columns: Sequence[str]
    rows: Sequence[Sequence[Value]]


class Study:
    """The rows of one command in one folder, and what it says about them.

    Attributes:
        rows: All rows, those of an earlier, stopped run included; numbers and bools are floats, the rest text.

    Raises:
        ValueError: The folder holds a study with other settings or columns.
    """

    def __init__(self, name: str, options: Options, key: Sequence[str], columns: Sequence[str]) -> None:
        self.name, self.options, self.key = name, options, tuple(key)
        self.columns = (*key, *columns)
        self.folder = options.output
        self.path = self.folder / "results.csv"
        self._settings = f"{name} quick={options.quick} seed={options.seed} threads={options.threads}"
        self._sections: list[dict[str, object]] = []
        self._figures: list[str] = []
        self.folder.mkdir(parents=True, exist_ok=True)
        if self.path.exists():
            self._check_settings()
            _drop_torn_line(self.path)
            self.rows = read_rows(self.path)
            self._append("".join(f"# continued, {line}\n" for line in provenance()))
        else:
            self.rows = []
            lines = (f"settings: {self._settings}", *provenance())
            self._append("".join(f"# {line}\n" for line in lines) + ",".join(self.columns) + "\n")

    def remaining(
        self, keys: Iterable[Sequence[Value]], *, seconds: float | Callable[..., float]
    ) -> Iterator[tuple[Value, ...]]:
        """Go through the keys that have no row yet, with the time it will take and progress on stderr.

        Args:
            keys: A value for each name in `key`.
            seconds: Expected cost of a key, or a function of its values: what the full run says before it starts.
        """
        from tqdm import tqdm

        keys = [tuple(key) for key in keys]
        done = self._done()
        todo = [key for key in keys if self._text(key) not in done]
        cost = sum(seconds(*key) if callable(seconds) else seconds for key in todo)
        known = f", {len(keys) - len(todo)} of them known already" if len(todo) < len(keys) else ""
        sys.stderr.write(f"{self.name}: {len(keys)} measurements{known}; about {_duration(cost)} to go\n")
        # In a log file a line every half minute is enough.
        yield from tqdm(todo, unit="key", smoothing=0.1, mininterval=0.1 if sys.stderr.isatty() else 30.0)

    def add(self, key: Sequence[Value], *rows: Mapping[str, Value]) -> None:
        """Keep the rows of a key (at least one), on disk before this returns; a column left out is empty.

        Raises:
            ValueError: A row has a column that the study has not.
        """
        names = dict(zip(self.key, key, strict=True))
        full = [{**dict.fromkeys(self.columns, ""), **names, **row} for row in rows]
        for row in full:
            if set(row) != set(self.columns):
                raise ValueError(f"a row of {self.name} must have {list(self.columns)}; got {list(row)}")
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerows([[_written(row[column]) for column in self.columns] for row in full])
        self._append(text.getvalue())  # one write, so that a stopped run leaves whole keys
        self.rows += [{column: _value(_written(row[column])) for column in self.columns} for row in full]

    def say(self, heading: str, text: str = "", *, table: Table | None = None, figure: "Figure | None" = None) -> None:
        """State a finding: printed, and kept for the report. Headings that ask a question come first there."""
        section: dict[str, object] = {"heading": heading, "text": text}
        print(f"\n## {heading}\n" + (f"\n{text}\n" if text else ""))
        if table is not None:
            section["table"] = [[show(cell) for cell in row] for row in (table.columns, *table.rows)]
            print(format_table(table))
        if figure is not None:
            name = re.sub(r"[^a-z0-9]+", "_", heading.lower()).strip("_")
            section["figure"] = f"{name}.png"
            figure.savefig(self.folder / f"{name}.png", dpi=150)
            self._figures.append(name)
            print(f"\n{self.folder / name}.png")
        self._sections.append(section)

    def finish(self) -> None:
        """Write summary.json and the TensorBoard run; say what to look at."""
        from matplotlib.image import imread
        from torch.utils.tensorboard import SummaryWriter

        summary = {"name": self.name, "settings": self._settings, "sections": self._sections}
        (self.folder / "summary.json").write_text(json.dumps(summary, indent=1))
        for old in self.folder.glob("events.out.tfevents.*"):
            old.unlink()
        with SummaryWriter(str(self.folder)) as writer:
            for name in self._figures:
                writer.add_image(f"{self.name}/{name}", imread(self.folder / f"{name}.png"), dataformats="HWC")
            for section in self._sections:
                writer.add_text(f"{self.name}/{section['heading']}", str(section["text"]) or "-")
        print("\nWhat to look at first:")
        for section in self._sections:
            if str(section["heading"]).endswith("?"):
                picture = f"  ({self.folder / str(section['figure'])})" if "figure" in section else ""
                print(f"- {section['heading']}{picture}")
        print(f"All on one page: python -m lcplearn.benchmark report {self.folder}")

    def _done(self) -> set[tuple[str, ...]]:
        return {self._text([row[name] for name in self.key]) for row in self.rows}

    def _text(self, key: Iterable[Value]) -> tuple[str, ...]:
        return tuple(_written(_value(_written(value))) for value in key)

    def _append(self, text: str) -> None:
        with self.path.open("a") as file:
            file.write(text)

    def _check_settings(self) -> None:
        lines = self.path.read_text().splitlines()
        settings = lines[0].removeprefix("# settings: ") if lines else "nothing"
        header = next((line for line in lines if not line.startswith("#")), "")
        if settings != self._settings or header != ",".join(self.columns):
            raise ValueError(
                f"{self.path} holds a run of {settings!r}, this is {self._settings!r}: use another --output"
            )


def provenance() -> list[str]:
    """Lines that say where and with what figures were measured."""
    cpu = next(iter(re.findall(r"model name\s*: (.*)", _read("/proc/cpuinfo"))), platform.processor() or "unknown CPU")
    cores = len(re.findall(r"^processor", _read("/proc/cpuinfo"), re.MULTILINE)) or "?"
    load = _read("/proc/loadavg").split()[:1]
    packages = []
    for package in PACKAGES:
        try:
            packages.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            packages.append(f"{package} absent")
    return [
        f"machine: {cpu}, {cores} cores, {platform.system()} {platform.machine()}, load {' '.join(load) or '?'}",
        f"versions: Python {platform.python_version()}, {', '.join(packages)}",
        f"commit: {_commit()}",
        f"started: {datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
    ]


def read_rows(path: str | Path) -> list[Row]:
    """Rows of a results.csv, without its comment lines."""
    with Path(path).open(newline="") as file:
        lines = [line for line in file if not line.startswith("#")]
    return [{name: _value(text) for name, text in row.items()} for row in csv.DictReader(lines)]


def format_table(table: Table) -> str:
    """A markdown table, its columns aligned: text to the left, numbers to the right."""
    cells = [[show(cell).replace("|", "\\|") for cell in row] for row in (table.columns, *table.rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(table.columns))]
    text = [any(isinstance(row[i], str) for row in table.rows) for i in range(len(table.columns))]

    def line(row: Sequence[str]) -> str:
        pairs = zip(row, widths, text, strict=True)
        return "| " + " | ".join(cell.ljust(width) if left else cell.rjust(width) for cell, width, left in pairs) + " |"

    rules = ["-" * (width + 1) + ("-" if left else ":") for width, left in zip(widths, text, strict=True)]
    return "\n".join([line(cells[0]), f"|{'|'.join(rules)}|", *(line(row) for row in cells[1:])])


def show(value: Value) -> str:
    """A cell as people read it: three digits of a number, yes or no."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        value += 0.0  # no -0
        return "" if value != value else f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"
    return str(value)


def _written(value: Value) -> str:
    if isinstance(value, bool):
        return str(int(value))
    return repr(float(value)) if isinstance(value, float) else str(value)


def _value(text: str) -> Value:
    try:
        return float(text)
    except ValueError:
        return text


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _drop_torn_line(path: Path) -> None:
    """A run that was killed while it wrote may have left half a line."""
    content = path.read_bytes()
    whole = content[: content.rfind(b"\n") + 1]
    if whole != content:
        path.write_bytes(whole)


def _read(path: str) -> str:
    try:
        return Path(path).read_text()
    except OSError:
        return ""


def _commit() -> str:
    """The commit of the code that runs, marked where the checkout differs from it."""
    git = ["git", "-C", str(Path(__file__).parent)]
    try:
        head = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()
        dirty = subprocess.run([*git, "status", "--porcelain", "."], capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return "unknown (not a git checkout)"
    return head + (" with uncommitted changes" if dirty.strip() else "")
