"""The clock counts each moment once, for the innermost part, and a training's epochs are the sum of their parts."""

import time

import pytest

from lcplearn.benchmark.__main__ import main
from lcplearn.benchmark.epoch.clock import Clock


def work(seconds: float) -> None:
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


class Busy:
    def outer(self) -> None:
        work(0.03)
        self.inner()

    @staticmethod
    def inner() -> None:
        work(0.02)

    def items(self):
        for _ in range(2):
            work(0.01)
            yield


def test_each_moment_counts_for_the_innermost_part():
    clock = Clock("rest")
    places = (("outer", Busy, "outer"), ("inner", Busy, "inner"), ("items", Busy, "items"))
    with clock.timing(places):
        busy = Busy()
        busy.outer()
        for _ in busy.items():
            work(0.01)
    found = clock.read()
    assert found == pytest.approx({"outer": 0.03, "inner": 0.02, "items": 0.02, "rest": 0.02}, abs=0.005)
    busy.outer()  # no longer timed
    assert clock.read()["outer"] == found["outer"]


def test_what_raises_closes_its_part():
    clock = Clock("rest")
    with pytest.raises(ZeroDivisionError), clock.part("wrong"):
        1 / 0  # noqa: B018
    work(0.01)
    assert clock.read()["rest"] > clock.read()["wrong"]


def test_the_parts_of_the_epochs_of_a_training_are_printed(capsys):
    main(["epoch", "trainer.max_epochs=3", "trainer.enable_progress_bar=false", "data.trajectories=2"])
    lines = capsys.readouterr().out.splitlines()
    means = {cells[1].strip(): float(cells[2]) for line in lines if len(cells := line.split("|")) == 7 and "." in line}
    total = means.pop("all")
    assert sum(means.values()) == pytest.approx(total, rel=0.02)
    assert all(means[part] > 0 for part in ("solve", "solve, backward", "model and loss", "torch, backward", "data"))
    assert any("2 epochs, the first left out" in line for line in lines)
