"""Learn contact and friction with a batched, differentiable LCP layer."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lcplearn.lcp.layer import LCPLayer
    from lcplearn.lcp.solution import LCPError, LCPSolution, Status
    from lcplearn.lcp.solve import solve_lcp
    from lcplearn.training.checkpoint import load

__version__ = "0.2.0"
__all__ = ["LCPError", "LCPLayer", "LCPSolution", "Status", "load", "solve_lcp"]

_HOMES = {
    "LCPError": "lcplearn.lcp.solution",
    "LCPLayer": "lcplearn.lcp.layer",
    "LCPSolution": "lcplearn.lcp.solution",
    "Status": "lcplearn.lcp.solution",
    "load": "lcplearn.training.checkpoint",
    "solve_lcp": "lcplearn.lcp.solve",
}


def __getattr__(name: str) -> Any:
    # Imported on first use, so that a command finds a user's mistake before it has paid seconds for torch.
    if name not in _HOMES:
        raise AttributeError(f"module 'lcplearn' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOMES[name]), name)
    return value


def __dir__() -> list[str]:
    return ["__version__", *__all__]
