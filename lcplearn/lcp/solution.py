"""What a solve returns: the solution, and a status that can be trusted for each batch element."""

from enum import IntEnum
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


class Status(IntEnum):
    """Verdict on one batch element; `message` says what is likely wrong and what helps."""

    SOLVED = 0
    INFEASIBLE = 1
    UNSOLVED = 2
    MAX_ITERATIONS = 3
    NONFINITE_INPUT = 4

    @property
    def message(self) -> str:
        return _MESSAGES[self]


_MESSAGES = {
    Status.SOLVED: "the residual, recomputed from the original data, is within tolerance",
    Status.INFEASIBLE: (
        "no z >= 0 has M z + q >= 0 (see `certificate`): check signs, for example a negative friction limit in q"
    ),
    Status.UNSOLVED: (
        "no method found a verified solution: M may be neither positive semidefinite nor a P-matrix, the problem may "
        "have no solution, or its data may be too badly scaled for `tol`"
    ),
    Status.MAX_ITERATIONS: "stopped by `max_iter` before a verdict: raise it",
    Status.NONFINITE_INPUT: "M or q holds NaN or infinity: the error is upstream of the LCP",
}


class LCPError(RuntimeError):
    """Raised by `solve_lcp(..., throw=True)` when an element is not SOLVED."""


class LCPSolution(NamedTuple):
    """Solution of a batch of LCPs 0 <= z, w = M z + q >= 0, z.w = 0.

    A NamedTuple, because `torch.func.vmap` accepts one as a return value.

    Attributes:
        z: The solution; exact zeros off `basis`. Best iterate where not SOLVED, NaN for NONFINITE_INPUT. With
            `smoothing` z and w are positive.
        w: M z + q; exact zeros on `basis`.
        basis: The solver's final basis: True where w_i = 0 is imposed. z_i may be zero there (degenerate).
        status: `Status` value of each element.
        residual: What `status` was judged by (see `residuals.py`), float64, before rounding to the caller's dtype.
        iterations: Pivots or interior-point steps.
        certificate: u >= 0 with M'u <= 0 and q.u < 0 where INFEASIBLE, zero elsewhere.
    """

    z: Float[Tensor, "*batch n"]
    w: Float[Tensor, "*batch n"]
    basis: Bool[Tensor, "*batch n"]
    status: Int[Tensor, "*batch"]
    residual: Float[Tensor, "*batch"]
    iterations: Int[Tensor, "*batch"]
    certificate: Float[Tensor, "*batch n"]

    def __repr__(self) -> str:
        try:
            values = self.status.flatten().tolist()
        except RuntimeError:  # under vmap and other transforms there are no values
            values = []
        counts = [f"{values.count(status)} {status.name} ({status.value})" for status in Status if status in values]
        fields = [f"{name}={value!r}" for name, value in zip(self._fields, self, strict=True)]
        return "\n  ".join([f"LCPSolution: {', '.join(counts) or 'no values'}", *fields])

    @property
    def solved(self) -> Bool[Tensor, "*batch"]:
        return self.status == Status.SOLVED

    @property
    def degenerate(self) -> Bool[Tensor, "*batch n"]:
        """Members at a kink, z_i = w_i = 0 up to 1e-8 of the largest entries: their gradient is one-sided."""
        z_scale = self.z.abs().amax(-1, keepdim=True) if self.z.shape[-1] else self.z
        w_scale = self.w.abs().amax(-1, keepdim=True) if self.w.shape[-1] else self.w
        return (self.z <= 1e-8 * z_scale) & (self.w <= 1e-8 * w_scale) & self.solved.unsqueeze(-1)

    def summary(self) -> dict[str, float]:
        """Figures for a training log: share of each status, worst residual of the solved, degenerate share."""
        count = max(self.status.numel(), 1)
        shares = {f"{status.name.lower()}_share": int((self.status == status).sum()) / count for status in Status}
        solved = self.residual[self.solved]
        return {
            **shares,
            "worst_residual": float(solved.max()) if solved.numel() else 0.0,
            "degenerate_share": float(self.degenerate.any(-1).sum()) / count,
        }

    def raise_if_unsolved(self) -> None:
        """Raise `LCPError` naming the elements that are not SOLVED, their status and what to do."""
        failed = torch.nonzero(~self.solved)
        if not len(failed):
            return
        shown: list[Any] = [tuple(index) for index in failed[:5].tolist()]
        statuses = sorted({Status(int(value)) for value in self.status[~self.solved].tolist()})
        reasons = "; ".join(f"{status.name}: {status.message}" for status in statuses)
        more = f" and {len(failed) - 5} more" if len(failed) > 5 else ""
        raise LCPError(f"{len(failed)} of {self.status.numel()} LCPs not solved, elements {shown}{more}. {reasons}")
