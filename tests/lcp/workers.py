"""What other processes run in test_torch_processes.py and test_devices.py; importable by name in a spawned process."""

import threading

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.utils.data import Dataset

from lcplearn import LCPLayer, solve_lcp
from lcplearn.lcp import interior_point, threads
from lcplearn.lcp.threads import in_slices


class SolvedProblems(Dataset):
    """Item k is the solution of 2 z + q, q = -(k + 1), solved by the worker that loads it."""

    def __len__(self) -> int:
        return 4

    def __getitem__(self, k: int) -> Tensor:
        return solve_lcp(2 * torch.eye(2, dtype=torch.float64), torch.full((2,), -k - 1.0, dtype=torch.float64)).z


def threads_of_two_slices() -> int:
    """How many threads take two slices that can only end together."""
    torch.set_num_threads(2)
    threads._pause.end = 0.0  # what this process or its parent ran before may have been late on a busy machine
    together = threading.Barrier(2, timeout=20.0)

    def task(start: int, _: int) -> int:
        if start < 2:
            together.wait()
        return threading.get_ident()

    return len(set(in_slices(task, 16, 1)[:2]))


class LearnedProblem(nn.Module):
    """A learned matrix shared by the batch, and a linear map to q."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.A = nn.Parameter(torch.eye(3, dtype=torch.float64) + 0.1 * torch.randn(3, 3, dtype=torch.float64))
        self.q = nn.Linear(2, 3, dtype=torch.float64)
        self.lcp = LCPLayer()

    def forward(self, x: Tensor) -> Tensor:
        return self.lcp(self.A @ self.A.mT, self.q(x)).z


def inputs() -> Tensor:
    return torch.randn(8, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def train_step_in_parallel(rank: int, folder: str) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/store", rank=rank, world_size=2)
    model = nn.parallel.DistributedDataParallel(LearnedProblem())
    model(inputs()[rank::2]).square().mean().backward()
    torch.save([p.grad for p in model.parameters()], f"{folder}/{rank}.pt")
    dist.barrier()  # who leaves first may end the other
    dist.destroy_process_group()


def compile_path(_: int) -> None:
    interior_point.ROUNDS_AT_ONCE = 1
    M, q = 2 * torch.eye(3, dtype=torch.float64) + 0.5 * torch.ones(4, 3, 3, dtype=torch.float64), torch.ones(4, 3)
    q = q.double() * torch.tensor([-1.0, 1.0, -2.0])
    compiled = torch.compile(interior_point.follow_path, backend="aot_eager", fullgraph=True)
    for found, expected in zip(compiled(M, q, max_iter=4), interior_point.follow_path(M, q, max_iter=4), strict=True):
        assert torch.equal(found, expected)
