"""Fit few numbers so that the mean deviation, not its square, is least."""

import math
from collections.abc import Callable, Iterator

import torch
from jaxtyping import Float
from torch import Tensor


def least_deviation(
    linearise: Callable[[Tensor], tuple[Float[Tensor, "b 3"], Float[Tensor, "b 3 p"]]],
    start: Float[Tensor, " p"],
    *,
    floor: float,
    expected: Float[Tensor, " p"],
    spread: Float[Tensor, " p"],
    noise: float,
    iterations: int = 20,
) -> Iterator[tuple[Float[Tensor, " p"], float]]:
    """Minimise the mean of sqrt(|e(x)|^2 + floor^2) over a batch of b, with a weak prior, by Gauss and Newton.

    The prior adds noise / (2 b) * sum ((x - expected) / spread)^2: few errors leave x near what is expected.

    Squares are weighted anew by the size of the last errors, and damped where a step does not improve
    (Levenberg and Marquardt).

    Args:
        linearise: x to errors and their Jacobian.
        start: First x.
        floor: Errors below this do not matter, which makes the loss smooth.
        expected, spread: Of x, before any error is seen.
        noise: Size of an error that nothing explains.
        iterations: Calls of `linearise` at most.

    Yields:
        The best x so far and its loss, each time it improves.
    """
    x, best_x, best, damping = start, start, math.inf, 1e-2
    curvature, slope = torch.eye(len(start), dtype=start.dtype), torch.zeros_like(start)
    for _ in range(iterations):
        error, jacobian = linearise(x)
        size = (error.square().sum(-1) + floor**2).sqrt()
        away = (x - expected) / spread
        loss = float(size.mean() + noise / (2.0 * len(size)) * away.square().sum())
        if loss < best:
            converged = best - loss < 1e-4 * loss
            best, best_x, damping = loss, x, damping / 4.0
            weighted = jacobian / size[:, None, None]
            curvature = torch.einsum("bip,biq->pq", weighted, jacobian) + (noise / spread**2).diag()
            slope = torch.einsum("bip,bi->p", weighted, error) + noise * away / spread
            yield best_x, best
            if converged:
                return
        else:
            damping *= 8.0
        damped = curvature + damping * curvature.diagonal().diag()
        step = torch.linalg.solve(damped, slope).clamp(-1.0, 1.0)
        if float(step.abs().max()) < 1e-5:
            return
        x = best_x - step
