"""Names that may stand in settings, and the sentence on one that may not: with what was probably meant."""

import difflib
import functools
import re
from collections.abc import Iterable
from pathlib import Path

import yaml

from lcplearn.training.signatures import signature

TRAINER = "lightning.pytorch.trainer.trainer.Trainer"
FROM_DATA = {"dt", "gravity", "space", "given", "vertices", "com"}  # of a model, which takes them from its data
UNLIKELY = {"min_epochs"}  # what nobody means who writes something alike


def explain(message: str, conf: Path, own: Iterable[Path] = ()) -> str:
    """Turn Hydra's message about a mistyped override into one sentence with a suggestion.

    Args:
        message: Text of Hydra's error.
        conf: Folder of the configuration.
        own: Folders of the user's, whose settings may have been meant too.
    """
    named = re.search(r"Could not override '([\w.@/]+)'", message)
    missing = re.search(r"Could not find '([\w./]+)/([\w.-]+)'", message)
    if missing:
        group, choice = missing[1], missing[2]
        if group == "hydra/launcher":
            return f"There is no {group}={choice} among the installed ones; joblib's is in the extra 'sweep'."
        options = re.findall(r"^\t([\w-]+)$", message, re.MULTILINE)  # Hydra lists those of every folder it searches
        return f"There is no {group}={choice}; {suggestion(choice, options)}"
    if named:
        group, _, key = named[1].rpartition(".")
        in_files, in_code = vocabulary(conf, group)
        if key in in_code and key not in in_files:
            return f"'{named[1]}' is not set in conf/{group}; to add it, write +{named[1]}=..."
        if not group:
            return unknown(key, conf)
        if key in in_files:
            return (
                f"'{named[1]}' is set in the file of another {group.partition('.')[0]}= than the chosen one; "
                f"if the chosen one takes it, too, write +{named[1]}=..."
            )
        theirs = {name for folder in own for names in vocabulary(folder, group) for name in names}
        more = f" To add it, write +{named[1]}=..." if "." in group else ""  # model.learn, model.fixed: as a scene has
        return f"Unknown setting '{named[1]}'; {suggestion(key, in_files | in_code | theirs, f'{group}.')}{more}"
    several = re.search(r"Ambiguous value for argument '([^']+)'", message)
    if several:
        return f"{several[1]} are several values: -m before the settings trains one run after the other."
    unread = re.search(r"Error parsing override '(.*?)'", message)
    if unread:
        return f"'{unread[1]}' is no setting: write key=value, and in quotes what has special characters."
    return " ".join(message.split())  # Hydra breaks its lines


def unknown(key: str, conf: Path) -> str:
    """A key that does not stand at the top level, but maybe in a group."""
    top = vocabulary(conf, "")[0]
    groups = sorted(folder.name for folder in conf.iterdir() if folder.is_dir() and folder.name != "experiment")
    below = {f"{group}.{name}" for group in groups for names in vocabulary(conf, group) for name in names}
    exact = sorted(name for name in below if name.partition(".")[2] == key)
    if exact:
        return f"Unknown setting '{key}'; did you mean {' or '.join(map(repr, exact))}?"
    if not difflib.get_close_matches(key, top, n=1, cutoff=0.5):
        names = {name.partition(".")[2]: name for name in below if name.partition(".")[2] not in UNLIKELY}
        close = difflib.get_close_matches(key, names, n=1, cutoff=0.7)
        if close:
            return f"Unknown setting '{key}'; did you mean '{names[close[0]]}'?"
    return f"Unknown setting '{key}'; {suggestion(key, top)}"


@functools.cache  # a sweep asks for each of its runs
def vocabulary(conf: Path, group: str) -> tuple[set[str], set[str]]:
    """Keys of a group's files, or of a mapping in them (model.learn), and those that its targets accept besides."""
    folder, *inside = group.split(".")
    files = list((conf / folder).glob("*.yaml")) if group else [conf / "train.yaml"]
    contents = [yaml.safe_load(file.read_text()) or {} for file in files]
    contents = [content.get(folder, content) for content in contents]  # files of package _global_ name their group
    for name in inside:
        contents = [content[name] for content in contents if isinstance(content.get(name), dict)]
    in_files = {key for content in contents for key in content if not key.startswith("_")} - {"defaults"}
    if not group:
        return in_files | {folder.name for folder in conf.iterdir() if folder.is_dir()}, set()
    targets = {content["_target_"] for content in contents if "_target_" in content}
    targets |= {TRAINER} if group == "trainer" else set()
    in_code = {name for target in targets for name in signature(target) or {}} - {"**"}
    return in_files, in_code - FROM_DATA if group == "model" else in_code


def suggestion(key: str, known: Iterable[str], prefix: str = "") -> str:
    """What was probably meant, or else all that is known."""
    close = difflib.get_close_matches(key, [name for name in known if name not in UNLIKELY], n=1, cutoff=0.5)
    if close:
        return f"did you mean '{prefix}{close[0]}'?"
    return f"known are {', '.join(sorted(prefix + name for name in known)) or 'none'}."
