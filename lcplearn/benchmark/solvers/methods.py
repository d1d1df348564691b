"""Every method and installed peer behind one call, judged by one judge."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch

from lcplearn.benchmark.solvers.peers import peers
from lcplearn.lcp.residuals import TINY, default_tolerance, equilibrate, judge, multiply
from lcplearn.lcp.solution import Status
from lcplearn.lcp.solve import method_names, solve_lcp

# Keywords of `solve_lcp`; a new method of the layer is here by itself.
# The interior point ends on a basis, to rounding; stopped at a coarser tolerance it is the smoothed solution of
# that complementarity.
METHODS: dict[str, dict[str, Any]] = {
    **{name: {"method": name} for name in method_names() if name != "auto"},
    "smoothed 1e-10": {"smoothing": 1e-10},
    "smoothed 1e-7": {"smoothing": 1e-7},
    "smoothed 1e-4": {"smoothing": 1e-4},
}
EXACT = tuple(name for name, keywords in METHODS.items() if "smoothing" not in keywords and name != "diagonal")
SINGLE = " float32"  # after the name of a method: the same on data and solutions of that precision
PEER_TOLERANCE = 1e-6  # what peers claim to be solved may be this far off


class Answer(NamedTuple):
    """What a method returned for B problems.

    Attributes:
        z: [B, n], float64.
        statuses: Names of `Status` values, of which a peer knows SOLVED and UNSOLVED; or RAISED and an error's name.
        residual, tolerance: Ours, recomputed from z as it came back, and what it is held against: [B]. For a peer
            `equilibrated_residual` and 1e-6.
    """

    z: np.ndarray
    statuses: list[str]
    residual: np.ndarray
    tolerance: np.ndarray


def all_methods() -> tuple[str, ...]:
    """Ours, the exact ones in float32 too, and installed peers."""
    return (*METHODS, *(name + SINGLE for name in EXACT), *peers())


def keywords_of(method: str) -> tuple[dict[str, Any], torch.dtype]:
    """Keywords of `solve_lcp` and precision of a method of ours."""
    return METHODS[method.removesuffix(SINGLE)], torch.float32 if method.endswith(SINGLE) else torch.float64


def applies(method: str, M: np.ndarray) -> bool:
    """Whether a method is meant for such M: the diagonal one only if they are diagonal."""
    return not method.startswith("diagonal") or not np.where(np.eye(M.shape[-1]) == 1, 0, M).any()


def solve(method: str, M: np.ndarray, q: np.ndarray) -> Answer | None:
    """Solve B problems M [B, n, n], q [B, n] by one of `all_methods`; None if it doesn't apply.

    What raises has the status "RAISED" with the error's name: no numbers should make a solver do that.
    """
    try:
        return _solve(method, M, q)
    except (ArithmeticError, IndexError, RuntimeError, ValueError, np.linalg.LinAlgError) as error:
        bad = np.full(len(q), np.inf)
        return Answer(np.full(q.shape, np.nan), [f"RAISED {type(error).__name__}"] * len(q), bad, 0 * q[:, :0].sum(-1))


def _solve(method: str, M: np.ndarray, q: np.ndarray) -> Answer | None:
    if method in peers():
        if q.shape[1] == 0:
            return None
        z, claimed = peers()[method](M, q)
        statuses = ["SOLVED" if claim else "UNSOLVED" for claim in claimed]
        return Answer(z, statuses, equilibrated_residual(M, q, z), np.full(len(q), PEER_TOLERANCE))
    keywords, dtype = keywords_of(method)
    if not applies(method, M):
        return None
    with np.errstate(over="ignore"):
        data = [torch.from_numpy(np.ascontiguousarray(x)).to(dtype) for x in (M, q)]
    solution = solve_lcp(*data, **keywords)
    statuses = [Status(value).name for value in solution.status.tolist()]
    M, q, z = (x.double().numpy() for x in (*data, solution.z))
    return _judged(M, q, z, statuses, dtype, keywords.get("smoothing", 0.0))


def equilibrated_residual(M: np.ndarray, q: np.ndarray, z: np.ndarray) -> np.ndarray:
    """The residual by which methods are compared, part (a) of our own; inf for NaN.

    max |min(z, w)| / max |q| in units in which M has entries of size 1.

    Part (b) asks for the sign of rounding noise, of which peers promise nothing.

    Returns:
        [B].
    """
    data, offset, point = (torch.from_numpy(np.ascontiguousarray(x)) for x in (M, q, z))
    d = equilibrate(data)
    natural = torch.minimum(point / d, d * (multiply(data, point) + offset)).abs().amax(-1)
    residual = natural / (d * offset).abs().amax(-1).clamp_min(TINY)
    return torch.where(residual.isfinite(), residual, torch.inf).numpy()


def _judged(
    M: np.ndarray, q: np.ndarray, z: np.ndarray, statuses: list[str], dtype: torch.dtype, smoothing: float = 0.0
) -> Answer:
    tensors = (torch.from_numpy(np.ascontiguousarray(x)) for x in (M, q, z))
    residual, tolerance = (x.numpy() for x in judge(*tensors, tol=default_tolerance(dtype), smoothing=smoothing))
    if dtype == torch.float32 and q.shape[-1]:
        # what rounding of z to the caller's float32 costs, however well it was solved
        with np.errstate(invalid="ignore"):
            size = (np.abs(M) @ np.abs(z)[..., None])[..., 0].max(-1) / np.maximum(np.abs(q).max(-1), 1e-300)
            tolerance = np.maximum(tolerance, 10 * np.finfo(np.float32).eps * size)
    return Answer(z, statuses, residual, tolerance)


def gradient_error(method: str, M: np.ndarray, q: np.ndarray, read: np.ndarray | None, symmetric: bool) -> float:
    """Relative error of a directional derivative against one-sided finite differences, whichever side is nearer.

    Of what is unique: read @ z, or w where M is symmetric and positive semidefinite. The direction keeps what is
    unique so: M (1 + t s) with q + t read' r, or, where all of z or w is, with q + t (M (z r) + w r').

    Args:
        method: A method of ours, else NaN.
        M, q: One problem, [n, n] and [n].
        read: What is unique, [k, n], or None.
        symmetric: Whether M is symmetric and positive semidefinite.

    Returns:
        The error over the larger derivative. NaN if nothing is unique, or if neither side has a derivative that two
        step sizes agree about.
    """
    if method in peers() or len(q) == 0 or (read is None and not symmetric):
        return float("nan")
    keywords, dtype = keywords_of(method)
    start = solve_lcp(torch.from_numpy(np.array(M)), torch.from_numpy(np.array(q)), **keywords)
    z, w = start.z.numpy(), start.w.numpy()
    rng = np.random.default_rng(0)
    s = float(rng.standard_normal())
    if read is None or np.count_nonzero(read) == len(q) == len(read):
        dq = M @ (z * rng.standard_normal(len(q))) + w * rng.standard_normal(len(q))
    else:
        dq = read.T @ rng.standard_normal(len(read))
        dq *= np.abs(q).max() / np.abs(dq).max()
    unique = w if read is None else read @ z
    sizes = np.where(unique == 0, max(np.abs(unique).max(), 1e-300), np.abs(unique))
    readout = torch.from_numpy(rng.standard_normal(len(unique)) / sizes)

    def value(M: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        solution = solve_lcp(M, q, **keywords)
        if read is None:
            return readout @ solution.w.double()
        return readout @ (torch.from_numpy(read) @ solution.z.double())

    # our derivative in the method's dtype; differences always in float64, for float32 can't resolve them
    tensors = [torch.from_numpy(np.array(array)).to(dtype).requires_grad_() for array in (M, q)]
    gradients = torch.autograd.grad(value(*tensors), tensors, allow_unused=True)
    direction = (s * M, dq)
    ours = sum(
        float((g.double() * torch.from_numpy(d)).sum())
        for g, d in zip(gradients, direction, strict=True)
        if g is not None
    )

    def at(t: float) -> float:
        with torch.no_grad():
            return float(value(torch.from_numpy(M + t * direction[0]), torch.from_numpy(q + t * direction[1])))

    sides = [d for d in (_one_sided(at, 1.0), _one_sided(at, -1.0)) if d is not None]
    if not sides or not np.isfinite(ours):
        return float("nan")
    return min(abs(ours - d) / max(abs(ours), abs(d), 1e-3) for d in sides)


def _one_sided(at: Callable[[float], float], sign: float) -> float | None:
    """Derivative towards one side; None if two step sizes disagree."""
    fine, coarse = ((at(sign * h) - at(0.0)) / (sign * h) for h in (1e-6, 1e-5))
    return fine if abs(fine - coarse) <= 1e-3 * max(abs(fine), abs(coarse), 1e-3) else None
