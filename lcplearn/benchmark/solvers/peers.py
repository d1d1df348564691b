"""The solvers that are compared: ours by their keywords, and the peers that are installed."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

# Keywords of `solve_lcp`. The interior point ends on a basis, to rounding; stopped at a coarser tolerance it is the
# smoothed solution of that complementarity.
METHODS: dict[str, dict[str, Any]] = {
    "pivoting": {"method": "pivoting"},
    "interior_point": {"method": "interior_point"},
    "smoothed 1e-10": {"smoothing": 1e-10},
    "smoothed 1e-7": {"smoothing": 1e-7},
    "smoothed 1e-4": {"smoothing": 1e-4},
    "diagonal": {"method": "diagonal"},
}


class Answer(NamedTuple):
    """What a peer returns: z [B, n], and which elements it claims to have solved [B]."""

    z: np.ndarray
    claimed: np.ndarray


Peer = Callable[[np.ndarray, np.ndarray], Answer]


@cache
def peers() -> dict[str, Peer]:
    """Other packages' solvers by name, those that are installed; each takes float64 M [B, n, n] and q [B, n]."""
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

    def solve(M: np.ndarray, q: np.ndarray) -> Answer:
        answer = Answer(np.empty(q.shape), np.empty(len(q), dtype=np.bool_))
        loop(np.ascontiguousarray(M, np.float64), np.ascontiguousarray(q, np.float64), *answer)
        return answer

    return solve
