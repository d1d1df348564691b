"""The LCP as a torch module."""

from jaxtyping import Float
from torch import Tensor, nn

from lcplearn.lcp.solution import LCPSolution
from lcplearn.lcp.solve import check_options, solve_lcp


class LCPLayer(nn.Module):
    """`solve_lcp` with its keywords fixed, for use inside a model: `layer(M, q) -> LCPSolution`.

    It has no parameters: M and q come from the layers before it and receive gradients. See `solve_lcp` for shapes,
    statuses and the gradient at kinks.
    """

    def __init__(
        self,
        *,
        method: str = "auto",
        tol: float | None = None,
        max_iter: int | None = None,
        smoothing: float = 0.0,
        throw: bool = False,
    ) -> None:
        super().__init__()
        check_options(method, tol, max_iter, smoothing)
        self.method = method
        self.tol = tol
        self.max_iter = max_iter
        self.smoothing = smoothing
        self.throw = throw

    def forward(self, M: Float[Tensor, "*#batch n n"], q: Float[Tensor, "*#batch n"]) -> LCPSolution:
        return solve_lcp(
            M, q, method=self.method, tol=self.tol, max_iter=self.max_iter, smoothing=self.smoothing, throw=self.throw
        )

    def extra_repr(self) -> str:
        names = ("method", "tol", "max_iter", "smoothing", "throw")
        return ", ".join(f"{name}={getattr(self, name)!r}" for name in names)
