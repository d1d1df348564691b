"""A rollout is the repeated step, in a batch as alone."""

import pytest
import torch

from lcplearn.scenes import BouncingBlock, Drive, FallingBlock, OneWayBlock, SlidingBlock, rollout

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
