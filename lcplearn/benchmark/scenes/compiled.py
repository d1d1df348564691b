"""What torch.compile gains in a step of a scene: the same step of one body, eager and compiled."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from lcplearn.benchmark.harness.measuring import interleave
from lcplearn.benchmark.harness.study import Row
from lcplearn.benchmark.scenes.fused import BACKWARD, FORWARD, a_box, pull, push
from lcplearn.scenes.planar_block import PlanarBlock
from lcplearn.scenes.scene import Drive
from lcplearn.scenes.sliding_block import SlidingBlock

DT = 0.01
BLOCKS: dict[str, Any] = {
    "sliding block": SlidingBlock(mass=1.5, mu=0.4, dt=DT),
    "sliding block, traditional": SlidingBlock(mass=1.5, mu=0.4, dt=DT, form="traditional"),
    "block in a plane": PlanarBlock(mass=0.4, mu=0.3, dt=DT),
}
BOX = "box in space"
COMPILED = (*BLOCKS, BOX)  # blocks as one whole graph, a box with a break for its contacts


def compiled_rows(scene: str, batch: int, repeats: int) -> list[Row]:
    """A step by both, without and with gradient.

    Returns:
        formulation; step_us, CPU time of a step of one body compiled, and torch_us, eager; full_over_this, the one over
        the other; velocity_difference, the largest between the two [-], of gradients where there are any; seconds of
        the compilation.
    """
    if scene == BOX:
        body, state = a_box(batch, 0)
    else:
        body = BLOCKS[scene]
        state = torch.rand(batch, body.space.nq + body.space.nv, dtype=torch.float64) + 0.5
    nothing = Drive(torch.zeros(body.space.nv, dtype=torch.float64))

    def eager(state: Tensor) -> Tensor:
        return body.advance(state, nothing).state

    torch.compiler.reset()
    compiled = torch.compile(eager, fullgraph=scene != BOX)
    rows: list[Row] = []
    for name, use in ((FORWARD, push), (BACKWARD, pull)):
        calls: dict[str, Callable[[], Tensor]] = {
            "compiled": partial(use, compiled, state),
            "eager": partial(use, eager, state),
        }
        began = time.perf_counter()
        found = calls["compiled"]()
        seconds = time.perf_counter() - began
        wanted = calls["eager"]()
        timings = interleave(calls, repeats)
        rows.append({
            "formulation": name,
            "step_us": 1e6 / batch * timings["compiled"].cpu,
            "torch_us": 1e6 / batch * timings["eager"].cpu,
            "full_over_this": timings["eager"].over(timings["compiled"])[0],
            "velocity_difference": float((found - wanted).abs().max()),
            "seconds": seconds,
        })  # fmt: skip
    return rows
