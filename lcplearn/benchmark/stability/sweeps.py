"""One difficulty at a time: condition, scale, mass ratio, distance to the stick-slip boundary, step size."""

from typing import NamedTuple

import numpy as np

from lcplearn.benchmark.harness.study import Row
from lcplearn.benchmark.problems.families import ill_conditioned, mass_ratio_stack, positive_definite
from lcplearn.benchmark.solvers.methods import solve

BATCH = 20
FRICTION = 0.4 * 9.81  # [N] largest friction force of a block of 1 kg

SWEEPS: dict[str, list[float]] = {
    "condition": [10.0**k for k in range(0, 15, 2)],
    "scale": [10.0**k for k in range(-12, 13, 3)],
    "mass ratio": [10.0**k for k in range(0, 7)],
    "distance to slip": [10.0**k for k in range(-16, 1, 2)],
    "step size": [10.0**k for k in range(-8, 1)],
}
LABELS = {
    "condition": "condition number of M",
    "scale": "scale s of D M D, D = diag(s, 1, 1/s)",
    "mass ratio": "mass ratio of 4 stacked bodies",
    "distance to slip": "|push / friction limit - 1|",
    "step size": "step size dt [s]",
}


class Measurable(NamedTuple):
    """B problems with something unique, read [B, k, n] @ z = value [B, k], and the size to which errors relate."""

    M: np.ndarray
    q: np.ndarray
    read: np.ndarray
    value: np.ndarray
    size: np.ndarray


def sweep(name: str, x: float, method: str, seed: int) -> Row:
    """Solve the problems of one point of a sweep.

    Returns:
        solved (share), residual and error (largest of the batch), status in words.
    """
    problems = make(name, x, direct=method == "diagonal", seed=seed)
    answer = None if problems is None else solve(method, problems.M, problems.q)
    if problems is None or answer is None:
        return {"status": "does not apply"}
    error = np.abs((problems.read @ answer.z[..., None])[..., 0] - problems.value).max(-1) / problems.size
    solved = np.array([status == "SOLVED" for status in answer.statuses])
    return {
        "solved": float(solved.mean()),
        "residual": float(answer.residual.max()),
        "error": float(error.max()),
        "status": "all solved" if solved.all() else "not all solved",
    }


def make(name: str, x: float, *, direct: bool, seed: int) -> Measurable | None:
    """Problems of one point of a sweep; direct asks for the diagonal LCP of a block, None where there is none."""
    rng = np.random.default_rng(seed)
    if name == "distance to slip":
        sign = np.where(np.arange(BATCH) % 2 == 0, 1.0, -1.0)
        dt, limit = 0.01, FRICTION * rng.uniform(0.1, 10.0, BATCH)
        return _block(limit * dt * (1 + sign * x), limit, np.full(BATCH, dt), direct)
    if name == "step size":
        limit = FRICTION * rng.uniform(0.1, 1.0, BATCH)
        # half of them slide at 1 m/s or so, half are pushed from rest
        push = x * FRICTION * rng.uniform(0.0, 2.0, BATCH)
        p = np.where(np.arange(BATCH) % 2 == 0, push, rng.standard_normal(BATCH))
        return _block(p, limit, np.full(BATCH, x), direct)
    if direct:
        return None
    if name == "mass ratio":
        problems = mass_ratio_stack(4, x)
        scale = np.ones((1, 4))
    elif name == "condition":
        problems = ill_conditioned(rng, BATCH, 10, max(x, 1.0 + 1e-12))
        scale = np.ones((BATCH, 10))
    else:
        problems = positive_definite(rng, BATCH, 3)
        scale = np.broadcast_to(np.array([x, 1.0, 1 / x]), (BATCH, 3))
    M, q, z = problems
    if z is None:
        raise ValueError(f"{name}: the problems have no planted solution")
    read = scale[:, :, None] * np.eye(z.shape[1])
    size = np.abs(z).max(-1)
    M = scale[:, :, None] * M * scale[:, None, :]
    return Measurable(M, scale * q, read, z, np.where(size > 0, size, 1.0))


def _block(p: np.ndarray, limit: np.ndarray, dt: np.ndarray, direct: bool) -> Measurable:
    """Blocks of 1 kg that would move with p [m/s] without friction; errors relate to the larger of |p| and c."""
    c = limit * dt
    after = np.sign(p) * np.maximum(np.abs(p) - c, 0.0)
    size = np.maximum(np.abs(p), c)
    zero, one = np.zeros_like(p), np.ones_like(p)
    if direct:
        M = np.eye(2) / dt[:, None, None]
        q = np.stack([limit - p / dt, limit + p / dt], axis=-1)
        return Measurable(M, q, np.stack([one, -one], -1)[:, None], after[:, None], size)
    rows = [[dt, -dt, one], [-dt, dt, one], [-one, -one, zero]]
    M = np.stack([np.stack(row, -1) for row in rows], axis=-2)
    q = np.stack([p, -p, limit], axis=-1)
    return Measurable(M, q, np.stack([dt, -dt, zero], -1)[:, None], (after - p)[:, None], size)
