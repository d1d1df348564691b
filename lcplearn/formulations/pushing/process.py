"""A Gaussian process on what varies from push to push, seen through the Jacobian of the rollout."""

from collections.abc import Iterator, Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lcplearn.formulations.pushing.features import Features, near, same

# What varies from push to push: columns of the latent vector, and its standard deviation at the start of learning.
LATENTS: Mapping[str, tuple[slice, float]] = {
    "offset": (slice(0, 2), 0.05),  # of the centre of pressure [radius]
    "log_mu": (slice(2, 3), 0.1),  # of the finger's friction
    "normal": (slice(3, 4), 0.005),  # error of the finger's position, along the normal and the tangent [radius]
    "tangent": (slice(4, 5), 0.005),
    "wrench": (slice(5, 8), 0.05),  # force and torque [mu * weight * (1, radius)]
    "motion": (slice(8, 11), 0.3),  # of the end pose itself [mm]
}
LATENT_COUNT = 11
LENGTHS = {"body": 0.6, "direction": 0.5, "world": 2.0, "heading": 1.0}  # [RADIUS], or of unit vectors
NOISE = 0.8  # [mm] at the start of learning
SMALL = -4.6  # logarithm of the spread that the prior expects
Terms = Mapping[str, tuple[str, ...]]


class Process(nn.Module):
    """Latents as sums of functions of a push, with a closed posterior.

    Left-over end poses are the Jacobian of the rollout times the latents, plus noise. The spread of each function,
    length scales and noise maximise the marginal likelihood, with a weak prior under which functions vanish that the
    data do not ask for.

    Args:
        terms: Functions of each latent: of everything ("all"), of which edge, or which configuration (geometry and
            surface) it is, of where on the object and in which direction it is pushed ("contact"), or of where it
            stands ("place").
        known: Number of pushes that it was fitted to.
        steps: Steps of Adam on the likelihood.
    """

    def __init__(self, terms: Terms, known: int, steps: int) -> None:
        super().__init__()
        self.terms, self.steps = terms, steps
        spreads = [LATENTS[name][1] for name in terms for _ in terms[name]]
        scales = torch.tensor([*spreads, *LENGTHS.values(), NOISE], dtype=torch.float64)
        self.log_scales: Tensor
        self.register_buffer("log_scales", scales.log())
        self.columns = [k for name in terms for k in range(LATENT_COUNT)[LATENTS[name][0]]]
        self.register_buffer("weights", torch.zeros(known, len(self.columns)))  # single precision makes files small

    def fit(
        self, features: Features, through: Float[Tensor, "b 3 l"], left: Float[Tensor, "b 3"]
    ) -> Iterator[dict[str, float]]:
        """Learn from what is left of end poses [mm]; `through` is their Jacobian with respect to all latents."""
        scales = self.log_scales.clone().requires_grad_()
        optimizer = torch.optim.Adam([scales], lr=0.15)
        # The end pose alone is three independent processes of one covariance: a matrix of a third of the size.
        direct = set(self.terms) == {"motion"}
        target = left if direct else left.reshape(-1, 1)
        for step in range(self.steps + 1):
            functions = self.functions(features, features, scales)
            covariance = functions["motion"] if direct else _seen(functions, through)
            covariance = covariance + (2.0 * scales[-1]).exp() * torch.eye(len(target), dtype=torch.float64)
            prior = ((scales[: -len(LENGTHS) - 1] - SMALL) / 4.0).square().sum() / 2.0
            factor = torch.linalg.cholesky(covariance.detach())
            alpha = torch.cholesky_solve(target, factor)
            count = target.shape[1]
            loss = 0.5 * (target * alpha).sum() + count * factor.diagonal().log().sum() + prior.detach()
            yield {"log_likelihood": -float(loss)}
            if step < self.steps:  # the derivative by its formula: through the factor it takes three times as long
                slope = (count * torch.cholesky_inverse(factor) - alpha @ alpha.mT) / 2.0
                optimizer.zero_grad()
                torch.autograd.backward((covariance, prior), (slope, None))
                optimizer.step()
        self.log_scales = scales.detach()
        self.weights = torch.einsum("bil,bi->bl", through, alpha.reshape(-1, 3))[:, self.columns].float()

    def mean(self, features: Features, known: Features) -> Float[Tensor, "b l"]:
        """Posterior mean of all latents; zero for those without terms."""
        weights = torch.zeros(len(known.edge), LATENT_COUNT, dtype=torch.float64)
        weights[:, self.columns] = self.weights.double()
        found = torch.zeros(len(features.edge), LATENT_COUNT, dtype=torch.float64)
        for name, function in self.functions(features, known, self.log_scales).items():
            columns = LATENTS[name][0]
            found[:, columns] = function @ weights[:, columns]
        return found

    def functions(self, a: Features, b: Features, log_scales: Tensor) -> dict[str, Float[Tensor, "na nb"]]:
        """Covariance of each latent between two sets of pushes."""
        lengths = log_scales[-len(LENGTHS) - 1 : -1].exp()
        configuration = same(a.geometry, b.geometry) * same(a.surface, b.surface)
        contact = near(a.body, b.body, lengths[0]) * near(a.direction, b.direction, lengths[1])
        kinds = {
            "all": torch.ones_like(contact),
            "edge": same(a.edge, b.edge),
            "configuration": configuration,
            "contact": contact,
            "contact*configuration": contact * configuration,
            "place": near(a.world, b.world, lengths[2]) * near(a.heading, b.heading, lengths[3]),
        }
        spreads = iter((2.0 * log_scales[: -len(LENGTHS) - 1]).exp())
        return {
            name: torch.stack([next(spreads) * kinds[kind] for kind in own]).sum(0) for name, own in self.terms.items()
        }


def _seen(functions: Mapping[str, Tensor], through: Tensor) -> Tensor:
    """Covariance of end poses: latents through the Jacobian."""
    total = torch.zeros((), dtype=torch.float64)
    for name, function in functions.items():
        own = through[..., LATENTS[name][0]]
        total = total + torch.einsum("ial,jbl,ij->iajb", own, own, function)
    return total.flatten(2, 3).flatten(0, 1)
