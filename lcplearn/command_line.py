"""What train.py does around Hydra: mistakes are found before folders are made and torch is imported, runs get names.

No torch here. A run's folder is new, whatever else starts in the same second, and goes again if nothing came of it.
"""

import itertools
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import InterpolationResolutionError

from lcplearn import __version__
from lcplearn.training.settings import SettingsError, check

SWEEP = ("-m", "--multirun")
CONFIG_DIR = re.compile(r"^(?:--config-dir|-cd)[=\n](.+)$", re.MULTILINE)  # in arguments, a line each
CHECKED = 200  # runs of a sweep; those behind are checked when they start


class Command(NamedTuple):
    """A command line as Hydra is to see it.

    Attributes:
        arguments: The arguments.
        folder: The new folder of the run or sweep, None where the user named it or nothing runs.
    """

    arguments: list[str]
    folder: Path | None = None


def prepare(arguments: Sequence[str], conf: Path) -> Command:
    """Check all runs that a command line asks for, and make their folder.

    Args:
        arguments: What the user wrote behind train.py.
        conf: Folder of the configuration.

    Raises:
        SettingsError: a mistake that a check without torch can find, or a folder that can't be made.
        HydraException, OmegaConfBaseException: a mistake that Hydra finds.
    """
    arguments = [_quote_path(argument) for argument in _search(arguments)]
    options = [argument for argument in arguments if argument.startswith("-")]
    if any(option not in SWEEP for option in options):  # --cfg and the like, or Lightning's further processes
        return Command(arguments)
    sweep = bool(options)
    overrides = OverridesParser.create().parse_overrides([each for each in arguments if each not in options])
    jobs = list(itertools.islice(_jobs(overrides, sweep), CHECKED))
    config = None
    with initialize_config_dir(str(conf), version_base="1.3"):
        for job in jobs:
            config = compose("train", overrides=job, return_hydra_config=True)
            _check(config, conf, sweep)
    named = [override.key_or_group for override in overrides]
    if sweep and "hydra.sweep.subdir" not in named:
        arguments += _names(overrides)
    key = f"hydra.{'sweep' if sweep else 'run'}.dir"
    if config is None or key in named:
        return Command(arguments)
    folder = _new(Path(OmegaConf.select(config, key)), key)
    return Command([*arguments, f'{key}="{folder}"'], folder)


def settle(folder: Path | None) -> None:
    """Make runs/latest links to a folder in which something was trained; take one away in which nothing was."""
    if folder is None or not folder.is_dir():
        return
    files = [path for path in folder.rglob("*") if path.is_file()]
    if all(path.name == "multirun.yaml" or path.parent.name == ".hydra" for path in files):
        shutil.rmtree(folder)
        return
    with suppress(OSError):  # a disk without links, or another run that ends at the same moment
        _link(folder, folder.with_name("latest"))


def _link(folder: Path, latest: Path) -> None:
    """Make `latest` a folder of links to the files of a run or sweep.

    No link to the folder itself: TensorBoard follows those, and would show each run twice. So events stay out of it.
    """
    if latest.exists() and not all(path.is_symlink() or path.is_dir() for path in latest.rglob("*")):
        return  # somebody keeps files of their own there
    beside = latest.with_name(f".latest.{folder.name}")
    for path in folder.rglob("*"):
        below = path.relative_to(folder)
        if path.is_file() and not {".hydra", "tensorboard"} & set(below.parts):
            (beside / below).parent.mkdir(parents=True, exist_ok=True)
            (beside / below).symlink_to(Path(*[".."] * len(below.parts), folder.name, below))
    shutil.rmtree(latest, ignore_errors=True)
    beside.rename(latest)


def own_folders(arguments: Sequence[str]) -> list[Path]:
    """Folders of settings of the user's own that a command line names."""
    return [Path(folder) for folder in CONFIG_DIR.findall("\n".join(arguments))]


def version_line() -> str:
    """Name and version."""
    return f"lcplearn {__version__}"


def _jobs(overrides: Sequence[Override], sweep: bool) -> Iterator[list[str]]:
    """Overrides of each run; none where a sweeper of its own decides."""
    texts = [str(override.input_line) for override in overrides]
    if not sweep:
        yield texts
        return
    if any(text.lstrip("+").startswith("hydra/sweeper") for text in texts):
        return
    choices = []
    for override, text in zip(overrides, texts, strict=True):
        if override.is_sweep_override() and not override.is_discrete_sweep():
            return
        key = text.partition("=")[0]
        several = override.is_sweep_override()
        choices.append([f"{key}={value}" for value in override.sweep_string_iterator()] if several else [text])
    yield from map(list, itertools.product(*choices))


def _check(config: DictConfig, conf: Path, sweep: bool) -> None:
    task = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
    with open_dict(task):
        if task.get("logger"):
            task.logger.save_dir = "runs"  # the run's folder, which is not there yet
    try:
        settings = OmegaConf.to_container(task, resolve=True)
    except InterpolationResolutionError:  # it asks for what only a run has, and is checked there
        return
    assert isinstance(settings, dict)
    check({str(key): value for key, value in settings.items()}, conf, multirun=sweep)


def _names(overrides: Sequence[Override]) -> list[str]:
    """Name the runs of a sweep by what differs, 3_model=relu."""
    varied = {override.key_or_group for override in overrides if override.is_sweep_override()}
    varied -= {each.key_or_group for each in overrides if "/" in str(each.input_line).partition("=")[2]}
    if not varied:
        return []
    others = sorted({override.key_or_group for override in overrides} - varied)
    return [
        f"hydra.job.config.override_dirname.exclude_keys=[{','.join(others)}]",
        "hydra.sweep.subdir='${hydra.job.num}_${hydra.job.override_dirname}'",
    ]


def _new(folder: Path, key: str) -> Path:
    for number in itertools.count(1):
        chosen = folder if number == 1 else folder.with_name(f"{folder.name}_{number}")
        try:
            chosen.parent.mkdir(parents=True, exist_ok=True)
            chosen.mkdir()
        except FileExistsError:
            if not chosen.parent.is_dir():
                raise
        except OSError as error:
            raise SettingsError(
                f"Can't make the folder {chosen}: {error.strerror}; {key}=... puts it elsewhere."
            ) from None
        else:
            return chosen
    raise AssertionError


def _search(arguments: Sequence[str]) -> list[str]:
    """Hydra's --config-dir FOLDER as the setting that it stands for, so that what is below it is checked early too."""
    text = "\n".join(arguments)
    match = CONFIG_DIR.search(text)
    if match is None:
        return [*arguments]
    folder = Path(match[1])
    if not folder.is_dir():
        raise SettingsError(f"--config-dir {folder} is not a folder.")
    rest = text[: match.start()] + text[match.end() :]
    return [*filter(None, rest.split("\n")), f"hydra.searchpath=['file://{folder.resolve()}']"]


def _quote_path(argument: str) -> str:
    """Hydra's grammar wants paths with = in quotes, and a sweep's folders have one in their names."""
    match = re.fullmatch(r"ckpt_path=([^'\"{}\[\]]*=[^'\"{}\[\]]*)", argument)
    return f'ckpt_path="{match[1]}"' if match else argument
