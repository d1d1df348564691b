"""Contact steps and rollouts of a batch on several threads: the same bits, and none for small work.

The threads themselves, and that a forked process has its own, are tested in tests/lcp.
"""

import pytest
import torch
from scenes.contact_scenes import DT, boxes
from torch import Tensor

from lcplearn.lcp import threads
from lcplearn.scenes.contact import Contacts, contact_step
from lcplearn.scenes.scene import Drive, rollout
from lcplearn.scenes.tossed_cube import TossedCube

pytest.importorskip("numba")
pytestmark = pytest.mark.usefixtures("double_precision", "no_pause")


def _step(count: int) -> list[Tensor]:
    """A step of boxes and its gradients."""
    contacts, free, mass = boxes(count, 3, compliance=1e-3)
    given = [x.clone().requires_grad_() for x in (*contacts, free, mass)]
    step = contact_step(Contacts(*given[:6]), *given[6:], DT)
    loss = step.velocity.square().sum() + step.friction_impulse.square().sum()
    return [*(x.detach() for x in step), *torch.autograd.grad(loss, given)]


def _toss(count: int, steps: int = 30) -> list[Tensor]:
    """A rollout of tossed cubes and its gradients."""
    draw = torch.Generator().manual_seed(1)
    start = torch.zeros(count, 13)
    start[:, 2], start[:, 3] = 0.1, 1.0
    start[:, 7:] = torch.randn(count, 6, generator=draw)
    start.requires_grad_()
    mu = torch.full((count,), 0.3).requires_grad_()
    cube = TossedCube(half_width=0.05, inertia=6e-4, mu=mu, dt=0.007, mass=0.4, radius=0.005)
    path = rollout(cube, start, Drive(torch.zeros(count, steps, 6)))
    loss = path.positions[..., :3].sum()
    return [*(x.detach() for x in path if x is not None), *torch.autograd.grad(loss, (start, mu))]


@pytest.mark.parametrize(("run", "count"), [(_step, 2000), (_toss, 100)])
def test_every_bit_is_the_same_on_any_number_of_threads(run, count, monkeypatch):
    cuts, sliced = [], threads.in_slices

    def spy(task, count, size, **more):
        cuts.append(size < count)
        return sliced(task, count, size, **more)

    monkeypatch.setattr("lcplearn.scenes.contact_kernel.slices.in_slices", spy)
    results = []
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        results.append(run(count))
    assert cuts == [True] * 6  # forwards and backwards
    for several in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], several, strict=True))


@pytest.mark.parametrize("run", [_step, _toss])
def test_small_work_wakes_no_thread(run, monkeypatch):
    def pool():
        raise AssertionError("a pool was asked for")

    monkeypatch.setattr(threads, "_pool", pool)
    torch.set_num_threads(2)
    run(10)
    with pytest.raises(AssertionError, match="a pool was asked for"):
        run(2000)
