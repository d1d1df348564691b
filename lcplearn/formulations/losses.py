"""Loss terms: what of a window of measurements a formulation is asked to match."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import relu

from lcplearn.formulations.direct import KnownFriction
from lcplearn.formulations.formulation import Formulation
from lcplearn.formulations.relu import ReLU
from lcplearn.formulations.structured import FrictionLCP

VIOLATION_WIDTH = 2.0  # [m/s] speed from which friction must be fully used; least biased for noise of 0.01 m/s


class Windows(NamedTuple):
    """B windows of k steps from measured trajectories.

    Attributes:
        velocity: Measured velocity at the k + 1 ends of the steps [m/s].
        force: Force during each step [N].
        friction: Measured friction during each step [N], for `direct` and `slack`; None if there is none.
        valid: False for steps after the end of a recording; what stands there is ignored.
    """

    velocity: Float[Tensor, "B k+1"]
    force: Float[Tensor, "B k"]
    friction: Float[Tensor, "B k 2"] | None
    valid: Bool[Tensor, "B k"]


def loss_terms(model: Formulation, windows: Windows, weights: Mapping[str, float]) -> dict[str, Tensor]:
    """Evaluate the loss terms with positive weight; the training loss is the sum of weight times term.

    All terms are mean squares over the valid steps [m^2/s^2; complementarity: N^2 m^2/s^2].

    prediction:       error of one step: of (v+, v-) where the model decomposes velocity, else of v
    rollout:          error of v over all steps of the window, predicted from its first measured velocity
    complementarity:  (friction * (v+, v-))^2, `direct` and `slack` only
    nonnegativity:    max(0, -(v+, v-))^2, `direct` and `slack` only
    violation:        how badly the best friction explains a measured step, `structured` and `physical` only

    Args:
        model: The formulation to judge.
        windows: Measured windows; only `rollout` looks beyond the first step.
        weights: Weight of each term, by name; missing terms have weight zero.

    Returns:
        The unweighted terms, each a scalar.

    Raises:
        ValueError: an unknown term, a negative weight, a term that the model doesn't have, or missing friction.

    Source: notes section 3.1.1 (cost c, squared: errata 19); NOTES 6 (violation).
    """
    for name, weight in weights.items():
        if name not in _TERMS:
            raise ValueError(f"Loss term must be one of {', '.join(LOSS_TERMS)}, got {name!r}.")
        if not 0.0 <= weight < float("inf"):
            raise ValueError(f"Weight of loss term {name!r} must be finite and at least 0, got {weight}.")
    active = [name for name in LOSS_TERMS if weights.get(name, 0.0) > 0.0]
    if not active:
        raise ValueError(f"At least one loss term must have a positive weight: {', '.join(LOSS_TERMS)}.")
    known = _without_padding(windows)
    return {name: _TERMS[name](model, known) for name in active}


def _without_padding(windows: Windows) -> Windows:
    """Zero what isn't valid, so that padding (NaN, say) can't reach a gradient through 0 * NaN."""
    velocity, force, friction, valid = windows
    after = torch.where(valid, velocity[:, 1:], 0.0)
    before = torch.where(valid[:, :1], velocity[:, :1], 0.0)
    if friction is not None:
        friction = torch.where(valid[..., None], friction, 0.0)
    return Windows(torch.cat((before, after), dim=1), torch.where(valid, force, 0.0), friction, valid)


def _mean(values: Float[Tensor, "*shape"], valid: Bool[Tensor, "*shape"]) -> Float[Tensor, ""]:
    return torch.where(valid, values, 0.0).sum() / valid.sum().clamp(min=1)


def _parts(velocity: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 2"]:
    """Decompose a velocity into (v+, v-)."""
    return torch.stack((relu(velocity), relu(-velocity)), dim=-1)


def _first_friction(windows: Windows) -> Float[Tensor, "B 2"] | None:
    return None if windows.friction is None else windows.friction[:, 0]


def _prediction(model: Formulation, windows: Windows) -> Tensor:
    before, after, force = windows.velocity[:, 0], windows.velocity[:, 1], windows.force[:, 0]
    friction = _first_friction(windows)
    if isinstance(model, KnownFriction | ReLU):
        error = (model.velocity_parts(before, force, friction) - _parts(after)).square().sum(-1)
    else:
        error = (model.next_velocity(before, force, friction) - after).square()
    return _mean(error, windows.valid[:, 0])


def _rollout(model: Formulation, windows: Windows) -> Tensor:
    velocity, predicted = windows.velocity[:, 0], []
    for k in range(windows.force.shape[1]):
        friction = None if windows.friction is None else windows.friction[:, k]
        velocity = model.next_velocity(velocity, windows.force[:, k], friction)
        predicted.append(velocity)
    error = (torch.stack(predicted, dim=1) - windows.velocity[:, 1:]).square()
    return _mean(error, windows.valid)


def _known_friction_parts(model: Formulation, windows: Windows, term: str) -> Float[Tensor, "B 2"]:
    if not isinstance(model, KnownFriction):
        name = type(model).__name__
        raise ValueError(f"Loss term {term!r} needs a model of known friction (direct or slack), not {name}.")
    return model.velocity_parts(windows.velocity[:, 0], windows.force[:, 0], _first_friction(windows))


def _complementarity(model: Formulation, windows: Windows) -> Tensor:
    parts = _known_friction_parts(model, windows, "complementarity")
    friction = _first_friction(windows)
    if friction is None:
        raise ValueError("Loss term 'complementarity' needs windows with friction, and these have none.")
    return _mean((friction * parts).square().sum(-1), windows.valid[:, 0])


def _nonnegativity(model: Formulation, windows: Windows) -> Tensor:
    parts = _known_friction_parts(model, windows, "nonnegativity")
    return _mean(relu(-parts).square().sum(-1), windows.valid[:, 0])


def _violation(model: Formulation, windows: Windows) -> Tensor:
    if not isinstance(model, FrictionLCP):
        raise ValueError(f"Loss term 'violation' needs model structured or physical, not {type(model).__name__}.")
    before, after, force = windows.velocity[:, 0], windows.velocity[:, 1], windows.force[:, 0]
    unexplained = after - model.free_velocity(before, force)
    return _mean(violation(after, unexplained, model.velocity_limit(before)), windows.valid[:, 0])


def violation(
    after: Float[Tensor, "*batch"], unexplained: Float[Tensor, "*batch"], limit: Float[Tensor, "*#batch"]
) -> Float[Tensor, "*batch"]:
    """Find the friction that explains a step best, and return how badly it does.

    min over y of  (r - y)^2 + k (y + sign(v') l)^2 + max(0, |y| - l)^2,   k = min(|v'| / width, 1)

    The friction y (a change of velocity) should explain the step's remainder r = v' - b, oppose a fast motion with
    all that is allowed, and never exceed the limit l. No LCP is solved or differentiated.

    Args:
        after: Measured velocity v' after the step [m/s].
        unexplained: r, its difference to the predicted free velocity [m/s].
        limit: l = a c, the largest change of velocity by friction [m/s].

    Returns:
        The minimum [m^2/s^2].

    Gradient:
        With respect to r and l, at fixed y: the derivative through the minimiser vanishes (envelope theorem).

    Source: NOTES 6, losses.
    """
    gate = (after.abs() / VIOLATION_WIDTH).clamp(max=1.0)
    sliding = -torch.sign(after) * limit
    with torch.no_grad():
        # Convex and piecewise quadratic: the minimiser without the last term, or, where that is beyond the limit,
        # the one with it on the same side.
        inside = (unexplained + gate * sliding) / (1.0 + gate)
        beyond = (unexplained + gate * sliding + torch.sign(inside) * limit) / (2.0 + gate)
        y = torch.where(inside.abs() <= limit, inside, beyond)
    return (unexplained - y).square() + gate * (y - sliding).square() + relu(y.abs() - limit).square()


_TERMS: dict[str, Callable[[Formulation, Windows], Tensor]] = {
    "prediction": _prediction,
    "rollout": _rollout,
    "complementarity": _complementarity,
    "nonnegativity": _nonnegativity,
    "violation": _violation,
}
LOSS_TERMS = tuple(_TERMS)
