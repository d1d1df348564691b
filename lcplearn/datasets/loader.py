"""Batches of windows straight from memory: for data this small a DataLoader costs more than the training step."""

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from lcplearn.datasets.recordings import Windows


class WindowLoader:
    """Iterate over windows in batches, in a new seeded order each epoch, sharded over processes.

    Every rank gets the same number of batches of the same sizes. Without `batches` together they cover all windows;
    where the number of windows is not a multiple of world_size, up to world_size - 1 of them come twice.

    Attributes:
        windows: All windows.
        batch_size: Windows in a batch of one rank; None for all of its windows. The last batch may be smaller.
        batches: Batches of one rank in an epoch; where these take more windows than there are, all come again, in
            another order. None for one pass.
        shuffle: Whether the order is drawn anew each epoch.
        seed: Seed of the order; the same on every rank.
        epoch: Number of the epoch, which with the seed fixes the order; see `set_epoch`.

    Raises:
        ValueError: There are no windows, batches without batch_size, or one of batch_size, batches, rank and
            world_size is out of range.
    """

    def __init__(
        self,
        windows: Windows,
        *,
        batch_size: int | None = None,
        batches: int | None = None,
        shuffle: bool = True,
        seed: int = 0,
        rank: int | None = None,
        world_size: int | None = None,
    ) -> None:
        if windows.valid.shape[0] == 0:
            raise ValueError("windows: expected at least one window, got none")
        if batch_size is not None and batch_size < 1:
            raise ValueError(f"batch_size: expected at least 1, got {batch_size}")
        if batches is not None and (batch_size is None or batches < 1):
            raise ValueError(f"batches: expected at least 1, and a batch_size, got {batches} with {batch_size}")
        if (rank is None) != (world_size is None):
            raise ValueError(f"rank, world_size: expected both or neither, got {rank} and {world_size}")
        if rank is not None and world_size is not None and not 0 <= rank < world_size:
            raise ValueError(f"rank: expected 0 <= rank < world_size = {world_size}, got {rank}")
        self.windows = windows
        self.batch_size = batch_size
        self.batches = batches
        self.shuffle = shuffle
        self.seed = seed
        self.epoch = 0
        self._rank = rank
        self._world_size = world_size

    @property
    def sampler(self) -> "WindowLoader":
        """The loader itself: Lightning calls `sampler.set_epoch(epoch)` of a loader before each epoch."""
        return self

    def set_epoch(self, epoch: int) -> None:
        """Choose the order of the next iteration; call before each epoch, with the same number on every rank."""
        self.epoch = epoch

    def __len__(self) -> int:
        """Number of batches of this rank in an epoch."""
        shard = self._shard_size()
        return math.ceil(shard / (self.batch_size or shard))

    def __iter__(self) -> Iterator[Windows]:
        shard = self._shard()
        for indices in shard.split(self.batch_size or len(shard)):
            yield self.windows.map(lambda values, chosen=indices: values[chosen])  # type: ignore[misc]  # mypy 17335

    def _ranks(self) -> tuple[int, int]:
        # Asked for at each epoch: Lightning starts the process group after the loader is built.
        if self._rank is not None and self._world_size is not None:
            return self._rank, self._world_size
        distributed = torch.distributed.is_available() and torch.distributed.is_initialized()
        return (torch.distributed.get_rank(), torch.distributed.get_world_size()) if distributed else (0, 1)

    def _shard_size(self) -> int:
        if self.batches and self.batch_size:
            return self.batches * self.batch_size
        return math.ceil(self.windows.valid.shape[0] / self._ranks()[1])

    def _shard(self) -> Tensor:
        count = self.windows.valid.shape[0]
        rank, world_size = self._ranks()
        taken = self._shard_size() * world_size
        if self.shuffle:
            generator = torch.Generator().manual_seed(self.seed + 1_000_003 * self.epoch)  # distinct for seeds < 1e6
            passes = math.ceil(taken / count) if self.batches else 1
            order = torch.cat([torch.randperm(count, generator=generator) for _ in range(passes)])
        else:
            order = torch.arange(count)
        wrapped = torch.arange(rank, taken, world_size) % len(order)
        return order[wrapped].to(self.windows.valid.device)
