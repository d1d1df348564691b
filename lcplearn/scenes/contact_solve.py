"""Contacts solved in torch, a batch at a time: rows for those that close, the cone's iteration, and rest.

What runs off the CPU, where a tracer looks on, with polygons; and what the compiled steps are held against.
"""

import torch
from torch import Tensor

from lcplearn.scenes.contact_gradient import attach_gradient
from lcplearn.scenes.friction_lcp import (
    CRUDE,
    DEAD_SLIP,
    DEAD_ZONE,
    FULL_RANK,
    LAST_RESORT,
    MAX_ITERATIONS,
    PLAIN,
    ROUNDING,
    SETTLED,
    STAYS,
    Answer,
    Problem,
    cone_lcp,
    frictionless_lcp,
    law_violation,
    normals_hold,
    polygon_lcp,
    regularisation,
)
from lcplearn.scenes.numbers import matvec


def solve(problem: Problem, polygon: int | None, rest: bool) -> tuple[Answer, Tensor]:
    """The answer with its gradient, and where it is at rest."""
    with torch.no_grad():
        found, at_rest = find(problem, polygon, rest)
    if torch.is_grad_enabled() and any(x.requires_grad for x in problem):
        loaded = found.normal > 0.0
        buckets = _buckets(loaded, loaded.any(-1) & found.solved)  # what is not solved need not be finite
        if polygon is None:
            found = attach_gradient(problem, found, buckets)
        else:
            found = _polygon_gradient(problem, found, polygon, buckets)
    return found, at_rest


def find(problem: Problem, polygon: int | None, rest: bool) -> tuple[Answer, Tensor]:
    """Solve with rows for the contacts that close alone, then for those it was wrong about; and where it is at rest.

    Elements with equally many rows go together.
    """
    answer = Answer.free_flight(problem)
    tolerance = ROUNDING * problem.speed_scale()
    new = problem.excess(problem.free) < 0.0
    active = new
    while (todo := new.any(-1)).any():
        for elements, rows in _buckets(active, todo):
            part = problem.pick(elements, rows)
            found = _iterate(part) if part.directions == 2 and polygon is None else _once(part, polygon)
            answer.put(elements, rows, found)
        new = (problem.excess(answer.velocity) < -tolerance) & ~active
        active = active | new
    answer = answer._replace(solved=answer.solved & normals_hold(problem, answer))
    return answer, _at_rest(problem, answer) if rest else torch.zeros_like(answer.solved)


def _buckets(active: Tensor, todo: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Elements [b] with equally many active contacts, and these contacts [b, K], for each number K > 0."""
    counts = torch.where(todo, active.sum(-1), 0)
    result = []
    for count in counts.unique().tolist():
        if count:
            elements = torch.nonzero(counts == count)[:, 0]
            rows = torch.nonzero(active[elements])[:, 1].reshape(-1, count)
            result.append((elements, rows))
    return result


def _once(part: Problem, polygon: int | None) -> Answer:
    """One LCP, for what needs no fixed point."""
    if part.directions == 0:
        return frictionless_lcp(part)
    if polygon is not None and part.directions == 2:
        return polygon_lcp(part, polygon)
    return cone_lcp(part, None)


def _iterate(part: Problem) -> Answer:
    """Newton's iteration for the cone; elements leave when they have settled."""
    guess = Answer.guess(part)
    result, todo = guess.clone(), torch.arange(len(part.free), device=part.free.device)
    old, was_damped = torch.full_like(part.free[:, 0], torch.inf), torch.zeros_like(guess.solved)
    for iteration in range(MAX_ITERATIONS):
        proximal, creep = regularisation(iteration)
        soft = proximal * part.mobility()
        softer = part._replace(compliance=part.compliance + soft, target=part.target + soft * guess.normal)
        new = cone_lcp(softer, guess, creep)
        change = part.mass_norm(new.velocity - guess.velocity)
        away = soft * (new.normal - guess.normal).abs() / part.speed_scale().clamp_min(1e-300)
        wrong = torch.maximum(law_violation(part, new), away.amax(-1))
        stays = change <= STAYS * (part.mass_norm(part.free) + part.mass_norm(new.velocity))
        enough = stays & (wrong <= CRUDE) & (iteration >= LAST_RESORT)
        new = new._replace(settled=(wrong <= SETTLED) | enough)
        result.put(todo, None, new)
        going = torch.nonzero(~(new.settled & new.solved))[:, 0]
        if not len(going):
            break
        # A step in two at most is halved, against cycles: always halved, the iterates would converge no faster.
        change = part.mass_norm(new.velocity - guess.velocity)
        damped = (change > 0.3 * old) & ~was_damped & (3 < iteration < PLAIN)
        guess = guess.toward(new, torch.where(damped, 0.5, 1.0)).pick(going)
        part, todo = part.pick(going), todo[going]
        old, was_damped = change[going], damped[going]
    return result


def _polygon_gradient(problem: Problem, found: Answer, polygon: int, buckets: list[tuple[Tensor, Tensor]]) -> Answer:
    """The same answer with its gradient, that of the LCP of the contacts that are loaded."""
    flies = (found.solved & ~(found.normal > 0.0).any(-1)).unsqueeze(-1)
    velocity = torch.where(flies, problem.free, found.velocity)
    normal, friction = found.normal.clone(), found.friction.clone()
    for elements, rows in buckets:
        part = _once(problem.pick(elements, rows), polygon)
        velocity = velocity.index_put((elements,), part.velocity)
        place = (elements.unsqueeze(-1), rows)
        normal, friction = normal.index_put(place, part.normal), friction.index_put(place, part.friction)
    return found._replace(velocity=velocity, normal=normal, friction=friction)


def _at_rest(problem: Problem, found: Answer) -> Tensor:
    """Where contacts leave no velocity but 0: the rows that hold it have full rank.

    A loaded contact with friction that sticks holds all its directions, one that only touches (redundant corners) or
    has no friction its normal.
    Where contacts are compliant a normal speed within what the whole load would let a contact sink counts as none: else
    the load would go on moving from corner to corner.
    """
    nv, directions = problem.free.shape[-1], problem.directions
    normal_speed = (problem.normal @ found.velocity.unsqueeze(-1)).squeeze(-1)
    limit = DEAD_ZONE * problem.speed_scale() + problem.compliance * found.normal.sum(-1, keepdim=True)
    touches = (normal_speed.abs() <= limit) & (problem.excess(found.velocity) <= limit)
    slip = torch.linalg.vector_norm(matvec(problem.tangents, found.velocity.unsqueeze(-2)), dim=-1)
    holds = touches & (problem.mu * found.normal > 0.0) & (found.sticks | (slip <= DEAD_SLIP * problem.speed_scale()))
    result = found.solved & found.settled & (touches.sum(-1) + directions * holds.sum(-1) >= nv)
    elements = torch.nonzero(result)[:, 0]
    if directions == 0 or not len(elements):
        return result & (directions > 0)
    kept = torch.cat((touches.unsqueeze(-1), holds.unsqueeze(-1).expand(*holds.shape, directions)), dim=-1)[elements]
    rows = torch.cat((problem.normal.unsqueeze(-2), problem.tangents), dim=-2)[elements]
    rows = (rows * kept.unsqueeze(-1) / problem.mass[elements].sqrt()[:, None, None]).flatten(1, 2)
    gram = rows.mT @ rows
    shift = FULL_RANK * gram.diagonal(dim1=-2, dim2=-1).amax(-1)
    identity = torch.eye(nv, dtype=gram.dtype, device=gram.device)
    result[elements] = torch.linalg.cholesky_ex(gram - shift[:, None, None] * identity).info == 0
    return result
