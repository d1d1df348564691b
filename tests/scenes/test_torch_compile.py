"""Steps of scenes in code that torch.compile traces: blocks as one whole graph, contacts in a break between two.

In a process of its own: checks of shapes, on in tests only, can't be traced.
"""

import pytest
import torch
from torch import Tensor

from lcplearn.scenes import FallingBlock, OneWayBlock, SlidingBlock
from lcplearn.scenes.planar_block import PlanarBlock
from lcplearn.scenes.planar_body import PlanarBody
from lcplearn.scenes.scene import Drive
from lcplearn.scenes.spatial_body import SpatialBody, box_corners

pytestmark = pytest.mark.slow

SQUARE = torch.tensor([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]], dtype=torch.float64)
CUBE = box_corners(torch.tensor([0.05, 0.05, 0.05], dtype=torch.float64))
BLOCKS = {
    "one-way": OneWayBlock(mass=1.5, mu=0.4, dt=0.01),
    "direct": SlidingBlock(mass=1.5, mu=0.4, dt=0.01),
    "physical": SlidingBlock(mass=1.5, mu=0.4, dt=0.01, form="physical"),
    "traditional": SlidingBlock(mass=1.5, mu=0.4, dt=0.01, form="traditional"),
    "falling": FallingBlock(mass=1.5, dt=0.01),
    "planar": PlanarBlock(mass=0.4, mu=0.3, dt=0.01),
}
BODIES = {
    "rectangle": PlanarBody(corners=SQUARE, inertia=0.01, mu=0.4, dt=0.01),
    "cube": SpatialBody(corners=CUBE, inertia=0.001, mu=0.4, dt=0.01, mass=0.4),
}


def compare(_: int, whole: bool) -> None:
    """A compiled step and its gradient are those of eager code, for every block or every body."""
    for name, scene in (BLOCKS if whole else BODIES).items():
        torch.compiler.reset()
        nq, nv = scene.space.nq, scene.space.nv
        draw = torch.Generator().manual_seed(0)
        state = 0.1 * torch.rand(20, nq + nv, generator=draw, dtype=torch.float64) - 0.05
        if name == "cube":
            state[:, 3] = 1.0  # nearly level
        force = torch.randn(20, nv, generator=draw, dtype=torch.float64)

        def step(state: Tensor, force: Tensor, scene=scene) -> tuple[Tensor, Tensor]:
            after = scene.advance(state, Drive(force))
            return after.state, after.mode

        found = []
        for function in (torch.compile(step, backend="aot_eager", fullgraph=whole), step):
            inputs = state.clone().requires_grad_(), force.clone().requires_grad_()
            after, mode = function(*inputs)
            found.append((after, mode, *torch.autograd.grad(after.square().sum(), inputs)))
        assert len(found[0][1].unique()) > 1, name
        torch.testing.assert_close(found[0], found[1], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("whole", [True, False], ids=["blocks", "bodies"])
def test_a_compiled_step_and_its_gradient_are_those_of_eager_code(whole):
    torch.multiprocessing.spawn(compare, (whole,))
