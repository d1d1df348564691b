"""Windows cut from recordings, and their batches over epochs and processes."""

import collections

import pytest
import torch

from lcplearn.datasets import Recordings, WindowLoader, Windows, windows
from lcplearn.scenes import Drive


def ragged(steps: list[int]) -> Recordings:
    """Recording n has velocity 100 n + k at instant k and force 100 n + k in step k; padding is NaN."""
    horizon, nan = max(steps), float("nan")
    lengths = torch.tensor(steps)[:, None]
    instants = torch.arange(horizon + 1)
    value = 100.0 * torch.arange(len(steps))[:, None] + instants
    velocities = torch.where(instants <= lengths, value, nan)
    forces = torch.where(instants[:-1] < lengths, value[:, :-1], nan)
    states = torch.stack((-velocities, velocities), dim=-1)
    return Recordings(states, Drive(forces[..., None], torch.stack((forces, -forces), dim=-1)), lengths[:, 0])


@pytest.mark.parametrize("k", [1, 2, 4])
def test_windows_are_all_stretches_of_k_steps_and_no_padding(k):
    steps = [4, 6, 5]
    cut = windows(ragged(steps), k)
    starts = [100.0 * n + s for n, length in enumerate(steps) for s in range(length - k + 1)]
    assert cut.states[:, 0, 1].tolist() == starts
    assert cut.valid.all()
    assert torch.equal(cut.states[..., 1], torch.tensor(starts)[:, None] + torch.arange(k + 1))
    assert torch.equal(cut.states[..., 0], -cut.states[..., 1])
    assert torch.equal(cut.drive.force, cut.states[:, :-1, 1:])
    assert torch.equal(cut.drive.friction, torch.cat((cut.drive.force, -cut.drive.force), dim=-1))


def test_a_recording_shorter_than_a_window_is_masked_after_its_end():
    cut = windows(ragged([2, 5]), 4)
    assert cut.valid.tolist() == [[True, True, False, False], [True] * 4, [True] * 4]
    assert cut.states[0, :, 1].tolist() == [0, 1, 2, 2, 2]  # the last state goes on, without force
    assert cut.drive.force[0, :, 0].tolist() == [0, 1, 0, 0]
    assert bool(cut.drive.friction.isfinite().all())
    assert windows(ragged([2, 3]), 7).valid.sum(dim=1).tolist() == [2, 3]


def test_whole_recordings_are_the_longest_windows():
    data = ragged([2, 5, 3])
    cut = windows(data)
    known = ~data.states.isnan()
    assert torch.equal(cut.states[known], data.states[known])
    assert cut.valid.sum(dim=1).tolist() == [2, 5, 3]
    assert windows(data._replace(drive=Drive(data.drive.force))).drive.friction is None


def test_a_window_needs_a_step():
    with pytest.raises(ValueError, match=r"^k: expected at least 1 step, got 0"):
        windows(ragged([3]), 0)


def numbered(count: int) -> Windows:
    number = torch.arange(float(count))[:, None]
    states = number[..., None].expand(-1, 2, 2)
    return Windows(states, Drive(number[..., None]), torch.ones(count, 1, dtype=torch.bool))


def drawn(loader: WindowLoader) -> list[list[int]]:
    return [batch.states[:, 0, 0].int().tolist() for batch in loader]


@pytest.mark.parametrize("world_size", [1, 2, 3, 5])
@pytest.mark.parametrize("batch_size", [None, 1, 4, 100])
@pytest.mark.parametrize("shuffle", [True, False])
def test_ranks_get_equal_batches_that_together_cover_everything(world_size, batch_size, shuffle):
    """Two-process DDP deadlocks or forgets data otherwise. Nothing comes more than once beyond the padding."""
    for count in (1, 3, 10, 23):
        loaders = [
            WindowLoader(numbered(count), batch_size=batch_size, shuffle=shuffle, rank=rank, world_size=world_size)
            for rank in range(world_size)
        ]
        batches = [drawn(loader) for loader in loaders]
        sizes = [[len(batch) for batch in of_rank] for of_rank in batches]
        assert all(size == sizes[0] for size in sizes)
        assert all(len(loader) == len(sizes[0]) for loader in loaders)
        seen = collections.Counter(number for of_rank in batches for batch in of_rank for number in batch)
        assert set(seen) == set(range(count))
        assert sum(seen.values()) - count < world_size


def test_fields_of_a_batch_belong_together():
    data = windows(ragged([4, 6, 5]), 2)
    for batch in WindowLoader(data, batch_size=4):
        assert torch.equal(batch.states[:, :-1, 1:], batch.drive.force)
        assert torch.equal(batch.drive.friction[..., :1], batch.drive.force)
        assert batch.valid.shape == batch.drive.force.shape[:2]


def test_the_order_depends_on_seed_and_epoch_and_nothing_else():
    """A resumed run sees the batches that the unbroken one would have seen."""
    loader = WindowLoader(numbered(50), batch_size=7, seed=1)
    first = drawn(loader)
    assert drawn(loader) == first
    loader.set_epoch(1)
    second = drawn(loader)
    assert second != first
    other = WindowLoader(numbered(50), batch_size=7, seed=1)
    other.sampler.set_epoch(1)  # as Lightning does before each epoch
    assert drawn(other) == second
    assert drawn(WindowLoader(numbered(50), batch_size=7, seed=2)) != first
    assert drawn(WindowLoader(numbered(5), shuffle=False)) == [[0, 1, 2, 3, 4]]


def test_an_epoch_has_as_many_batches_as_asked_for_however_few_windows_there_are():
    """From one toss a training would else end before it has left its start."""
    few = drawn(WindowLoader(numbered(5), batch_size=4, batches=4))
    assert [len(batch) for batch in few] == [4, 4, 4, 4]
    order = [number for batch in few for number in batch]
    for k in range(3):
        assert sorted(order[5 * k : 5 * k + 5]) == [0, 1, 2, 3, 4]  # all of them before any comes again
    assert order[:5] != order[5:10]
    many = WindowLoader(numbered(50), batch_size=7, batches=2)
    assert drawn(many) == drawn(WindowLoader(numbered(50), batch_size=7))[:2]
    assert len(many) == 2
    ranks = [WindowLoader(numbered(50), batch_size=7, batches=2, rank=rank, world_size=2) for rank in (0, 1)]
    seen = [number for loader in ranks for batch in drawn(loader) for number in batch]
    assert len(set(seen)) == len(seen) == 28


def test_the_full_batch_is_the_default():
    assert len(WindowLoader(numbered(50))) == 1


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("batch_size", {"batch_size": 0}),
        ("batches", {"batches": 2}),
        ("batches", {"batch_size": 2, "batches": 0}),
        ("rank", {"rank": 2, "world_size": 2}),
        ("rank, world_size", {"rank": 0}),
    ],
)
def test_a_wrong_argument_is_named(name, arguments):
    with pytest.raises(ValueError, match=f"^{name}: expected .* got"):
        WindowLoader(numbered(3), **arguments)
    with pytest.raises(ValueError, match=r"^windows: expected at least one window, got none"):
        WindowLoader(numbered(0))


def test_the_process_group_says_which_shard_is_ours(monkeypatch):
    """The group may start after the loader was made, as it does in Lightning."""
    loader = WindowLoader(numbered(5), shuffle=False)
    assert drawn(loader) == [[0, 1, 2, 3, 4]]
    for name, value in (("is_initialized", True), ("get_rank", 1), ("get_world_size", 2)):
        monkeypatch.setattr(torch.distributed, name, lambda value=value: value)
    assert drawn(loader) == [[1, 3, 0]]
    assert len(loader) == 1
