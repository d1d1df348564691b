"""A rollout is the repeated step, in a batch as alone."""

import pytest
import torch

from lcplearn.formulations import Structured
from lcplearn.scenes import BouncingBlock, Drive, FallingBlock, OneWayBlock, SlidingBlock, rollout
from lcplearn.scenes.planar_block import PlanarBlock
from lcplearn.scenes.planar_body import PlanarBody, PlanarStack
from lcplearn.scenes.spatial_body import SpatialBody, box_corners
from lcplearn.scenes.spring_block import SpringBlock
from lcplearn.scenes.tossed_cube import TossedCube

SCENES = [
    FallingBlock(1.5, 0.05),
    BouncingBlock(1.5, 0.5, 0.05),
    OneWayBlock(1.5, 0.4, 0.05),
    SlidingBlock(1.5, 0.4, 0.05),
    SlidingBlock(1.5, 0.4, 0.05, form="physical"),
    SlidingBlock(1.5, 0.4, 0.05, form="traditional"),
]


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: f"{type(scene).__name__}-{getattr(scene, 'form', '')}")
def test_a_batch_equals_its_trajectories_one_by_one_and_step_by_step(scene):
    generator = torch.Generator().manual_seed(1)
    start = torch.rand(3, 2, generator=generator, dtype=torch.float64)
    forces = 8 * torch.randn(3, 30, 1, generator=generator, dtype=torch.float64)
    together = scene.rollout(start, forces)
    for k in range(3):
        alone = scene.rollout(start[k], forces[k])
        torch.testing.assert_close(together.positions[k], alone.positions, rtol=0, atol=1e-13)
        torch.testing.assert_close(together.velocities[k], alone.velocities, rtol=0, atol=1e-13)
        assert torch.equal(together.mode[k], alone.mode)
    state = start
    for k in range(30):
        state = scene.step(state, forces[:, k])
        torch.testing.assert_close(torch.cat((together.positions, together.velocities), -1)[:, k + 1], state)


BODIES = [
    SpringBlock(mass=1.5, mu=0.4, stiffness=40.0, dt=0.05),
    PlanarBlock(mass=1.0, mu=0.3, dt=0.05),
    PlanarBody(corners=torch.tensor([[-0.1, -0.1], [0.1, -0.1], [0.0, 0.2]]).double(), inertia=1e-3, mu=0.3, dt=0.01),
    PlanarStack(lower=(0.2, 0.1), upper=(0.1, 0.1), masses=(1.0, 1.0), mu=(0.3, 0.3), dt=0.01),
    SpatialBody(corners=box_corners(torch.full((3,), 0.1, dtype=torch.float64)), inertia=1e-3, mu=0.3, dt=0.01),
    TossedCube(half_width=0.05, inertia=1e-3, mu=0.3, dt=0.01),
]


@pytest.mark.parametrize("scene", [SCENES[3], *BODIES], ids=lambda scene: type(scene).__name__)
def test_every_scene_takes_forces_or_a_drive(scene):
    start, forces = scene.space.origin(), torch.ones(3, scene.space.nv, dtype=torch.float64)
    paths = [scene.rollout(start, forces), scene.rollout(start, Drive(forces))]
    paths += [rollout(scene, start, forces), rollout(scene, start, Drive(forces))]
    assert all(torch.equal(path.states, paths[0].states) for path in paths)
    torch.testing.assert_close(scene.step(start, forces[0]), paths[0].states[1])


def test_gradients_flow_through_all_steps():
    """A block sliding for T steps loses mu g dt a step: dx_T/dmu = -g dt^2 T (T + 1) / 2."""
    mu = torch.tensor(0.1, dtype=torch.float64, requires_grad=True)
    start = torch.tensor([0.0, 5.0], dtype=torch.float64)
    path = SlidingBlock(1.0, mu, 0.1).rollout(start, torch.zeros(10, 1, dtype=torch.float64))
    path.positions[-1, 0].backward()
    assert mu.grad.item() == pytest.approx(-9.81 * 0.01 * 55, abs=1e-12)


def test_a_wrong_shape_is_named():
    scene = SlidingBlock(1.0, 0.1, 0.1)
    with pytest.raises(ValueError, match=r"^forces: expected shape .* got \[0, 1\]"):
        scene.rollout(torch.zeros(2), torch.zeros(0, 1))
    with pytest.raises(ValueError, match=r"^state: expected shape .* got \[1\]"):
        rollout(scene, torch.zeros(1), Drive(torch.zeros(5, 1)))
    with pytest.raises(ValueError, match=r"^friction: expected shape \[\*batch, 5, 2\], got \[6, 2\]"):
        rollout(scene, torch.zeros(2), Drive(torch.zeros(5, 1), torch.zeros(6, 2)))


@pytest.mark.parametrize("mover", [SCENES[0], *BODIES, Structured(dt=0.05)], ids=lambda mover: type(mover).__name__)
def test_a_step_refuses_columns_that_it_would_leave_aside(mover):
    state, force = mover.space.origin(), torch.zeros(mover.space.nv, dtype=torch.float64)
    one = torch.zeros(1, dtype=torch.float64)
    with pytest.raises(ValueError, match=r"^state: expected shape"):
        mover.step(torch.cat((state, one)), force)
    with pytest.raises(ValueError, match=r"^force: expected shape"):
        mover.step(state, torch.cat((force, one)))
