"""Time, memory and slopes: what is compared runs in turns in one process."""

import ctypes
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

SHORTEST = 1e-3  # a sample repeats its call until it is this long [s], far above the clock's resolution


class Timing(NamedTuple):
    """Time of a call [s]: median and quartiles of the wall clock, median and samples of the CPU time of all threads."""

    wall: float
    low: float
    high: float
    cpu: float
    cpu_samples: np.ndarray

    def over(self, other: "Timing") -> tuple[float, float, float]:
        """CPU time over that of a call it was interleaved with: median and quartiles of the ratios of neighbours."""
        low, middle, high = np.quantile(self.cpu_samples / other.cpu_samples, [0.25, 0.5, 0.75])
        return float(middle), float(low), float(high)


def interleave(calls: Mapping[str, Callable[[], Any]], repeats: int) -> dict[str, Timing]:
    """Time calls in turns, so that what slows the machine for a while slows them all.

    Each must have been called once before: compilation and first allocations don't belong to its time.
    """
    number = {name: _repeat_count(call) for name, call in calls.items()}
    samples: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            wall, cpu = time.perf_counter(), time.process_time()
            for _ in range(number[name]):
                call()
            elapsed = time.perf_counter() - wall, time.process_time() - cpu
            samples[name].append((elapsed[0] / number[name], elapsed[1] / number[name]))
    timings = {}
    for name, values in samples.items():
        wall_times, cpu_times = np.array(values).T
        low, middle, high = np.quantile(wall_times, [0.25, 0.5, 0.75])
        timings[name] = Timing(float(middle), float(low), float(high), float(np.median(cpu_times)), cpu_times)
    return timings


def _repeat_count(call: Callable[[], Any]) -> int:
    fastest = np.inf
    for _ in range(3):  # one of them may be interrupted
        start = time.perf_counter()
        call()
        fastest = min(fastest, time.perf_counter() - start)
        if fastest > SHORTEST:
            break
    return max(1, int(SHORTEST / max(fastest, 1e-7)))


def peak_memory(call: Callable[[], Any]) -> float:
    """Most memory [bytes] held at once during a call beyond what was held before it; NaN where Linux can't tell."""
    if not sys.platform.startswith("linux"):
        return float("nan")
    ctypes.CDLL(None).malloc_trim(0)  # give freed memory back, else a call would seem to need none
    try:
        Path("/proc/self/clear_refs").write_text("5")  # forget the earlier peak
        before = _resident("VmRSS")
        call()
        return float(max(_resident("VmHWM") - before, 0))
    except OSError:
        return float("nan")


def _resident(field: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field):
            return int(line.split()[1]) * 1024
    raise OSError(f"/proc/self/status has no {field}")


def exponent(x: Sequence[float], y: Sequence[float]) -> float:
    """p of the power law y = c x^p that fits best in the logarithm; NaN for fewer than two points."""
    if len(x) < 2:
        return float("nan")
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])
