"""Recordings in one command: from a git repository in the raw format, without a network."""

import subprocess

import numpy as np
import pytest
from real_data import real_data

from lcplearn.datasets import contactnets, cube_slides, get


def git(*arguments: object) -> str:
    done = subprocess.run(["git", *map(str, arguments)], check=True, capture_output=True, text=True)
    return done.stdout.strip()


@pytest.fixture
def published(tmp_path):
    """A public repository with five tosses, and the source that names it."""
    folder = tmp_path / "published"
    tosses = folder / "data" / "tosses_processed"
    tosses.mkdir(parents=True)
    for path in real_data("contactnets_raw").glob("*.pt"):
        (tosses / path.name).write_bytes(path.read_bytes())
    (folder / "LICENSE").write_text("terms\n")
    (folder / "unrelated.bin").write_bytes(b"large")
    git("init", "-q", folder)
    git("-C", folder, "add", ".")
    git("-C", folder, "-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "tosses")
    for key in ("allowFilter", "allowAnySHA1InWant"):  # as public hosts have it
        git("-C", folder, "config", f"uploadpack.{key}", "true")
    return folder, get.CONTACT_NETS._replace(url=folder.as_uri(), commit=git("-C", folder, "rev-parse", "HEAD"))


def test_the_recordings_of_a_source_are_fetched_again_after_a_break_and_nothing_else(published, tmp_path):
    _, source = published
    clone = tmp_path / "clone"
    with pytest.raises(OSError, match="git could not fetch it"):
        get.fetch(source._replace(url="file:///nowhere"), clone)  # a break on the way
    get.fetch(source, clone)
    get.fetch(source, clone)  # nothing to do
    assert len(list((clone / source.folder).glob("*.pt"))) == 5
    assert (clone / "LICENSE").is_file()
    assert not (clone / "unrelated.bin").exists()


def test_recordings_that_the_project_does_not_know_are_refused_and_nothing_is_written(published, tmp_path):
    clone, source = published
    out = tmp_path / "out"
    with pytest.raises(ValueError, match="toss 518: expected among the 5 tosses"):
        get.make(source, clone, out)
    with pytest.raises(ValueError, match="checksum"):
        get.make(source._replace(checked=lambda files: b"other"), clone, out)
    assert not out.exists()


def test_the_checksums_are_those_of_the_data_that_the_figures_used():
    for name, source in (("cube_tosses.npz", get.CONTACT_NETS), ("planar_pushes.npz", get.MLAB_EXP)):
        with np.load(real_data(name), allow_pickle=False) as arrays:
            digest = get.hashlib.sha256(source.checked({name: dict(arrays)})).hexdigest()
        assert digest == source.digest


def test_one_command_makes_both_files_of_a_clone_and_prints_licence_and_place(published, tmp_path, monkeypatch, capsys):
    clone, source = published
    digest = get.hashlib.sha256(b"known").hexdigest()
    known = source._replace(checked=lambda files: b"known", digest=digest)
    monkeypatch.setitem(get.FILES, "tosses", (contactnets.TOSSES_FILE, known))
    get.main(["tosses", "--out", str(tmp_path / "out"), "--source", str(clone)])
    printed = capsys.readouterr().out
    assert "BSD-3-Clause" in printed
    assert str(tmp_path / "out" / "cube_tosses.npz") in printed
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["cube_slides.npz", "cube_tosses.npz"]
    (tmp_path / "out" / "cube_tosses.npz").write_bytes(b"mine")
    (tmp_path / "out" / "cube_slides.npz").unlink()
    get.main(["tosses", "--out", str(tmp_path / "out"), "--source", str(clone)])
    assert (tmp_path / "out" / "cube_tosses.npz").read_bytes() == b"mine"
    assert (tmp_path / "out" / "cube_slides.npz").exists()
    assert "cube_tosses.npz was there already, and stays as it is" in capsys.readouterr().out


def test_without_a_network_one_sentence_says_what_to_do(published, tmp_path, monkeypatch, capsys):
    _, source = published
    monkeypatch.setitem(get.FILES, "slides", (cube_slides.FILE, source._replace(url="file:///nowhere")))
    with pytest.raises(SystemExit) as stop:
        get.main(["slides", "--out", str(tmp_path / "out")])
    assert stop.value.code == 1
    assert "--source CLONE" in capsys.readouterr().err
