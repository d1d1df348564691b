"""The twelve scenes of the Stick Bench: what stands where, what acts, and what exactly happens.

Every block is a box of 1 kg, 20 x 20 x 10 cm. A slope is level ground with a tilted gravity, so that x and y are always
along the ground, and z away from it.
"""

from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from lcplearn.benchmark.engines import exact
from lcplearn.benchmark.engines.exact import GRAVITY, Solution

MASS, HALF = 1.0, (0.1, 0.1, 0.05)  # [kg], [m]
MU, MARGIN = 0.5, 1.05  # a held body could be held with a friction coefficient that is 1.05 times smaller
FINGER_MASS, FINGER = 0.1, (0.02, 0.05, 0.02)  # [kg], half widths [m]
UPPER = (0.08, 0.08, 0.05)  # half widths of the upper block of a stack [m]
RADIUS, HEIGHT, RESTITUTION = 0.05, 0.5, 0.5  # of the ball: [m], gap at the start [m]
TILT, DROP, EDGE_MU = np.radians(20.0), 0.02, 1.2  # of the box that lands on an edge: [rad], [m]
ARM = 0.1  # [m] from the hinge to where creep is measured

Kind = Literal["block", "wall", "pinch", "stack", "edge", "joint", "ball"]


@dataclass(frozen=True)
class StickScene:
    """One scene.

    Attributes:
        name: What happens.
        kind: What an engine builds: a block on the ground; a block pressed to a wall (contact normal +x); a block
            between a wall and a finger that is pressed along -x; two blocks on one another; a tilted box above the
            ground; a hinge with dry friction; a ball above the ground.
        duration: [s].
        solution: Exact positions at some times, relative to the start [T, k]; NaN where only the end is known.
        axes: The k axes that it tells.
        rests: Intervals (from, to) in which the body of the exact solution rests [s].
        mu: Friction coefficient; of the hinge the breakaway torque [N m].
        slope: Angle [rad]; x points downhill, unless across is set: then y does.
        across: Whether the body starts along the contour of the slope.
        speed: At the start, along x [m/s].
        pushes: (until [s], force [N] along x): on the block, or along -x on what is pressed; a torque of the hinge.
        mu_matters: Whether the end depends on mu.
    """

    name: str
    kind: Kind
    duration: float
    solution: Solution = exact.rest
    axes: tuple[int, ...] = (0,)
    rests: tuple[tuple[float, float], ...] = ()
    mu: float = MU
    slope: float = 0.0
    across: bool = False
    speed: float = 0.0
    pushes: tuple[tuple[float, float], ...] = ()
    mu_matters: bool = False

    @property
    def gravity(self) -> tuple[float, float, float]:
        """Acceleration [m/s^2]; none for the hinge, whose axis is vertical."""
        if self.kind == "joint":
            return 0.0, 0.0, 0.0
        along = GRAVITY * float(np.sin(self.slope))
        return (0.0 if self.across else along, along if self.across else 0.0, -GRAVITY * float(np.cos(self.slope)))

    def push(self, time: float) -> float:
        """Force [N] or torque [N m] at a time; during a step it is that of its middle."""
        return next((force for until, force in self.pushes if time < until), 0.0)


LIMIT = MU * MASS * GRAVITY  # [N] that friction can hold on level ground
_GO = ((0.4, 0.95 * LIMIT), (0.7, 1.5 * LIMIT), (1.4, 0.0), (1.8, -0.95 * LIMIT), (2.1, -1.3 * LIMIT))
_SLIDE_MU, _SLIDE_SLOPE = 0.6, float(np.radians(20.0))


def pushed_block(margin: float) -> StickScene:
    """A block pushed with 1 / margin of what friction can hold."""
    push = ((np.inf, LIMIT / margin),)
    return StickScene(f"pushed block, margin {margin:g}", "block", 2.0, rests=((0.0, 2.0),), pushes=push)


SCENES: tuple[StickScene, ...] = (
    pushed_block(MARGIN),
    StickScene("block on a slope", "block", 2.0, rests=((0.0, 2.0),), slope=float(np.arctan(MU / MARGIN))),
    StickScene("block pressed to a wall", "wall", 2.0, axes=(2,), rests=((0.0, 2.0),),
               pushes=((np.inf, MARGIN * MASS * GRAVITY / MU),)),
    StickScene("pinched block", "pinch", 2.0, axes=(2,), rests=((0.0, 2.0),),
               pushes=((np.inf, MARGIN * MASS * GRAVITY / (2 * MU)),)),
    StickScene("stop and go", "block", 3.0,
               partial(exact.pushed, speed=0.0, pushes=tuple((until, force / MASS) for until, force in _GO)),
               rests=((0.0, 0.4), (0.85, 1.8), (2.2, 3.0)), pushes=_GO, mu_matters=True),
    StickScene("slide to a stop", "block", 0.6, partial(exact.pushed, speed=2.0, pushes=()),
               rests=((2.0 / (MU * GRAVITY), 0.6),), speed=2.0, mu_matters=True),
    StickScene("slide across a slope", "block", 0.5,
               partial(exact.slide_across_slope, speed=1.0, angle=_SLIDE_SLOPE), axes=(0, 1), rests=((0.2861, 0.5),),
               mu=_SLIDE_MU, slope=_SLIDE_SLOPE, across=True, speed=1.0, mu_matters=True),
    StickScene("box at rest", "block", 10.0, axes=(0, 1), rests=((0.0, 10.0),)),
    StickScene("stack of two on a slope", "stack", 2.0, rests=((0.0, 2.0),), slope=float(np.arctan(MU / MARGIN))),
    StickScene("box dropped on an edge", "edge", 2.0,
               partial(exact.onto_an_edge, half_width=HALF[0], half_height=HALF[2], tilt=float(TILT)),
               rests=((1.0, 2.0),), mu=EDGE_MU),
    StickScene("joint below breakaway", "joint", 2.0, rests=((0.0, 2.0),), pushes=((np.inf, MU / MARGIN),)),
    StickScene("bouncing ball", "ball", 1.5, partial(exact.bounce, height=HEIGHT, restitution=RESTITUTION), axes=(2,)),
)  # fmt: skip
