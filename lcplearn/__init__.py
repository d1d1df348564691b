"""Learn contact and friction with a batched, differentiable LCP layer."""

from typing import TYPE_CHECKING, Any

from lcplearn.lcp.layer import LCPLayer
from lcplearn.lcp.solution import LCPError, LCPSolution, Status
from lcplearn.lcp.solve import solve_lcp

if TYPE_CHECKING:
    from lcplearn.training.checkpoint import load

__all__ = ["LCPError", "LCPLayer", "LCPSolution", "Status", "load", "solve_lcp"]


def __getattr__(name: str) -> Any:
    # Loaded on first use: whoever wants only the LCP layer does not pay for the training code.
    if name == "load":
        from lcplearn.training.checkpoint import load

        return load
    raise AttributeError(f"module 'lcplearn' has no attribute {name!r}")
