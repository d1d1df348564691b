"""Push an object to a wanted pose: shooting by the gradient through the rollout, beside random shooting."""

import time
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lcplearn.formulations.pushing import Supports
from lcplearn.formulations.pushing.push_model import jacobian
from lcplearn.scenes.pushed_object import rotate
from lcplearn.scenes.pushes import Push, Pushes

REACH = 0.03  # m; longest way of the finger from its touch
NEAR = 0.001  # m; a pose reached to this deviation counts as success
CLEARANCE = 0.002  # m between finger and edge before a push


class Plans(NamedTuple):
    """Pushes of one object to wanted poses.

    Attributes:
        deviation: Of the end pose from the wanted one, by the plant [m].
        success: Where that is below NEAR.
        seconds: Time of planning, of each.
        rollouts: Pushes that were simulated for each.
    """

    deviation: Float[Tensor, " b"]
    success: Bool[Tensor, " b"]
    seconds: float
    rollouts: int


def push_of(model: Supports, pose: Float[Tensor, "b 3"], action: Float[Tensor, "b 3"], edge: Tensor) -> Push:
    """A push of an edge: `action` is where along it (0 to 1), the angle to its normal [rad] and the way [m]."""
    corners = model.object.vertices
    inward = model.object.edges()[1]
    spot = corners[edge] + action[:, :1] * (corners.roll(-1, 0) - corners)[edge]
    direction = rotate(action[:, 1], inward[edge])
    start, end = spot - CLEARANCE * direction, spot + action[:, 2:] * direction
    return Push(pose, *(pose[:, :2] + rotate(pose[:, 2], point) for point in (start, end)))


def random_actions(count: int, generator: torch.Generator) -> Float[Tensor, "b 3"]:
    """Actions that keep from corners and from pushes along the edge."""
    low, high = torch.tensor((0.1, -0.6, 0.003)).double(), torch.tensor((0.9, 0.6, REACH)).double()
    return low + (high - low) * torch.rand(count, 3, generator=generator, dtype=torch.float64)


def wanted_poses(plant: Supports, start: Pushes, generator: torch.Generator) -> Float[Tensor, "b 3"]:
    """Poses that one push reaches in the plant, so that each task has a solution."""
    count = len(start.surface)
    edge = torch.randint(len(plant.object.vertices), (count,), generator=generator)
    push = push_of(plant, start.push.pose, random_actions(count, generator), edge)
    with torch.no_grad():
        return plant.predict(start._replace(push=push)).pose


def plan(
    model: Supports,
    plant: Supports,
    start: Pushes,
    wanted: Float[Tensor, "b 3"],
    *,
    guesses: int,
    gradient_steps: int,
    generator: torch.Generator,
) -> Plans:
    """Find one push for each start and wanted pose with the model, and try it on the plant.

    Random shooting takes the best of `guesses` random pushes; with gradient steps, the best few of them are improved
    by Gauss and Newton through the rollout, damped.
    """
    count, began = len(start.surface), time.perf_counter()
    every = start.take(torch.arange(count).repeat_interleave(guesses))
    target = wanted.repeat_interleave(guesses, 0)
    edge = torch.randint(len(model.object.vertices), (len(target),), generator=generator)
    action = random_actions(len(target), generator)
    best, _ = _error(model, every, target, action, edge)
    rollouts = guesses
    pick = best.norm(dim=-1).view(count, guesses).topk(FEW if gradient_steps else 1, largest=False).indices
    rows = (pick + guesses * torch.arange(count)[:, None]).flatten()
    every, target, edge, action, error = every.take(rows), target[rows], edge[rows], action[rows], best[rows]
    kept, damping = action, torch.full((len(rows),), 1e-3, dtype=torch.float64)
    for _ in range(gradient_steps):
        error, slope = _error(model, every, target, kept, edge, gradient=True)
        curvature = slope.mT @ slope
        damped = curvature + damping[:, None, None] * torch.diag_embed(curvature.diagonal(dim1=-2, dim2=-1) + 1e-12)
        step = torch.linalg.solve(damped, (slope.mT @ error[..., None])[..., 0])
        low, high = kept.new_tensor((0.05, -0.7, 0.001)), kept.new_tensor((0.95, 0.7, REACH))
        tried = (kept - step).clamp(low, high)
        after, _ = _error(model, every, target, tried, edge)
        better = after.norm(dim=-1) < error.norm(dim=-1)
        kept, error = torch.where(better[:, None], tried, kept), torch.where(better[:, None], after, error)
        damping = torch.where(better, damping / 4.0, damping * 8.0).clamp(1e-6, 1e6)
        rollouts += 2 * FEW
    choice = error.norm(dim=-1).view(count, -1).argmin(-1) + torch.arange(count) * (len(rows) // count)
    seconds = (time.perf_counter() - began) / count
    real, _ = _error(plant, start, wanted, kept[choice], edge[choice])
    deviation = real.norm(dim=-1)
    return Plans(deviation, deviation < NEAR, seconds, rollouts)


FEW = 3  # guesses that are improved


def _error(
    model: Supports, start: Pushes, wanted: Tensor, action: Tensor, edge: Tensor, *, gradient: bool = False
) -> tuple[Tensor, Tensor]:
    """Deviation from the wanted pose, as a vector [m], and its Jacobian with respect to the action."""
    action = action.detach().requires_grad_(gradient)
    with torch.set_grad_enabled(gradient):
        moved = start._replace(push=push_of(model, start.push.pose, action, edge))
        error = model.motion(moved, model.predict(moved).pose) - model.motion(moved, wanted)
    return error.detach(), jacobian(error, action) if gradient else error.new_zeros(0)
