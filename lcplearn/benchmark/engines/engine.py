"""What the Stick Bench asks of an engine: to build a scene at a step size, and to step it."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from lcplearn.benchmark.engines.cases import StickScene


class Path(NamedTuple):
    """What a body did over n steps.

    Attributes:
        position: [n + 1, 3] from the start on, relative to it [m]; the ball's z is its gap.
        energy: Kinetic and potential [n + 1], of all bodies [J]; NaN where an engine does not tell.
        depth: How far bodies overlap [n + 1], at most [m].
    """

    position: np.ndarray
    energy: np.ndarray
    depth: np.ndarray


class Simulation(Protocol):
    """A scene in an engine, ready to go."""

    def path(self, steps: int) -> Path:
        """Start anew, step, and tell all."""
        ...

    def run(self, steps: int) -> None:
        """Step as fast as the engine can, and tell nothing: for timing."""
        ...

    def run_many(self, steps: int, batch: int) -> bool:
        """The same for a batch of copies, on one thread; False, and nothing done, where it has no batches."""
        ...

    def end_slope(self, steps: int) -> np.ndarray | None:
        """Derivative [3] of the last position with respect to mu, by the engine's own gradients; None: it has none."""
        ...


class Engine(NamedTuple):
    """An engine in one of its settings.

    Attributes:
        name: As on the page.
        package: To install; empty for ours.
        settings: What differs from its defaults, in words.
        build: Builds a scene at a step size [s] and a friction coefficient; None where it can't express the scene.
        step_sizes: [s], the coarsest first.
    """

    name: str
    package: str
    settings: str
    build: Callable[[StickScene, float, float], Simulation | None]
    step_sizes: tuple[float, ...] = (1e-2, 2e-3, 5e-4)
