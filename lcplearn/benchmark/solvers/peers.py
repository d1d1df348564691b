"""Solvers of other packages, those that are installed. A further one is one function in `peers`."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

# float64 M [B, n, n] and q [B, n] to z [B, n] and which elements it claims to have solved [B].
Peer = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@cache
def peers() -> dict[str, Peer]:
    """Other packages' solvers by name, those that are installed."""
    try:
        return {"quantecon": _quantecon()}
    except ImportError:
        return {}


def missing_peers() -> str:
    """A sentence on peers that are left out, or nothing."""
    return "" if peers() else "quantecon is not installed (pip install 'lcplearn[bench]'): no peer to compare with."


def _quantecon() -> Peer:
    """Lemke's method in numba; the batch is a loop inside numba too, with its scratch allocated once."""
    import numba
    from quantecon.optimize import lcp_lemke

    @numba.njit(nogil=True)
    def loop(M: Any, q: Any, z: Any, claimed: Any) -> None:
        n = q.shape[1]
        tableau, basis = np.empty((n, 2 * n + 2)), np.empty(n, dtype=np.int_)
        for b in range(len(q)):
            claimed[b] = lcp_lemke(M[b], q[b], tableau=tableau, basis=basis, z=z[b]).success

    def solve(M: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        z, claimed = np.empty(q.shape), np.empty(len(q), dtype=np.bool_)
        loop(np.ascontiguousarray(M, np.float64), np.ascontiguousarray(q, np.float64), z, claimed)
        return z, claimed

    return solve
