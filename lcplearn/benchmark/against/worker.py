"""A process that times the solver of whichever checkout is on its path; see `run.py`, which starts two of them.

It reads the name of a file with M and q from each line of its input, and answers with the CPU time of a solve [s].
"""

import sys
import time

import numpy as np
import torch

from lcplearn import solve_lcp

SHORTEST = 0.02  # a sample repeats its call until it is this long [s]


def main() -> None:
    """Answer until the input ends."""
    torch.set_num_threads(1)
    for line in sys.stdin:
        with np.load(line.strip()) as file:
            M, q = (torch.from_numpy(file[name]) for name in "Mq")
        solve_lcp(M, q, method="pivoting")
        repeats = 1
        while (elapsed := _cpu_time(M, q, repeats)) < SHORTEST:
            repeats *= 2
        print(min(elapsed, *(_cpu_time(M, q, repeats) for _ in range(3))) / repeats, flush=True)


def _cpu_time(M: torch.Tensor, q: torch.Tensor, repeats: int) -> float:
    start = time.process_time()
    for _ in range(repeats):
        solve_lcp(M, q, method="pivoting")
    return time.process_time() - start


if __name__ == "__main__":
    main()
