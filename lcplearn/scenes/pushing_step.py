"""One quasi-static step by Coulomb's exact cone: the LCP of `aligned_lcp`, until slip and loads settle."""

from types import ModuleType
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

import lcplearn
from lcplearn.scenes.numbers import compiled_code_may_see
from lcplearn.scenes.pushing_lcp import Bearing, Touch, aligned_lcp
from lcplearn.scenes.scene import Mode

SETTLED = 1e-9  # change of the supports' velocities between two iterates, in units of the finger's
DAMP_FROM = 4  # iterations; undamped, one in a hundred cycles


class Moved(NamedTuple):
    """A step, free of units: twist and force in the object's axes, velocity of the supports."""

    twist: Float[Tensor, "b 3"]
    force: Float[Tensor, "b 2"]
    mode: Int[Tensor, " b"]
    slip: Float[Tensor, "b k 2"]
    solved: Bool[Tensor, " b"]
    settled: Bool[Tensor, " b"]


def settle(bearing: Bearing, touch: Touch, slip: Float[Tensor, "b k 2"], *, creep: float, iterations: int) -> Moved:
    """Twist and force of a step, from a first guess of the supports' slip.

    The gradient is that of the last LCP, which at the fixed point is the cone's; zero for what is not solved.
    """
    kernel = compiled_pushing(slip)
    if kernel is None:
        return settle_by_lcp(bearing, touch, slip, creep=creep, iterations=iterations)
    twist, force, new, flags = kernel.settle(bearing, touch, slip, creep=creep, iterations=iterations)
    solved, settled, mode = flags.unbind(-1)
    moved = Moved(twist, force, mode, new, solved.bool(), settled.bool())
    rest = (~(moved.solved & moved.settled)).nonzero()[:, 0]
    if len(rest) == 0:
        return moved
    slow = settle_by_lcp(take(bearing, rest), take(touch, rest), slip[rest], creep=creep, iterations=iterations)
    return put(moved, rest, slow)


def settle_by_lcp(bearing: Bearing, touch: Touch, slip: Tensor, *, creep: float, iterations: int) -> Moved:
    """The same by `solve_lcp`: iterate without gradient, differentiate the last LCP."""
    load = bearing.loads.detach()
    before = torch.full_like(load[:, 0], torch.inf)
    active = torch.arange(len(load))
    with torch.no_grad():
        for iteration in range(iterations - 1):
            part, contact = take(bearing, active), take(touch, active)
            problem = aligned_lcp(part, contact, slip[active], load[active], creep=creep)
            z = lcplearn.solve_lcp(problem.M, problem.q).z
            new = _velocities(part.points, problem.twist(z))
            change = (new - slip[active]).flatten(1).norm(dim=-1)
            if iteration >= DAMP_FROM:
                slow = (change > 0.3 * before[active]) & (change > SETTLED)
                new = torch.where(slow[:, None, None], (slip[active] + new) / 2.0, new)
            slip, load, before = slip.clone(), load.clone(), before.clone()
            slip[active], before[active] = new, change
            load[active] = part.loads + (part.transfer @ problem.force(z, creep)[..., None])[..., 0]
            active = active[~(change < SETTLED)]  # each element stops by itself: none depends on its batch
            if len(active) == 0:
                break
    problem = aligned_lcp(bearing, touch, slip, load, creep=creep)
    solution = lcplearn.solve_lcp(problem.M, problem.q)
    twist = problem.twist(solution.z)
    new = _velocities(bearing.points, twist.detach())
    settled = (new - slip).flatten(1).norm(dim=-1) < 10.0 * SETTLED
    return Moved(twist, problem.force(solution.z, creep), finger_mode(solution.z), new, solution.solved, settled)


def compiled_pushing(x: Tensor) -> ModuleType | None:
    """`pushing_node`, imported on first use; None where it may not see the numbers, or they are not float64."""
    if x.dtype != torch.float64 or not compiled_code_may_see(x.device):
        return None
    from lcplearn.scenes import pushing_node

    return pushing_node


def finger_mode(z: Float[Tensor, "b n"]) -> Int[Tensor, " b"]:
    """Sliding speed and the two multipliers that are zero when the finger slides tell what it does."""
    normal, sum_, speed = z[:, -3], z[:, -2], z[:, -1]
    slides = (speed > 0) | (sum_ <= 0)
    mode = torch.where(slides, int(Mode.SLIP), int(Mode.STICK))
    return torch.where(normal <= 0, int(Mode.SEPARATION), mode)


def take(parts, index):  # type: ignore[no-untyped-def]
    """Some elements of a named tuple of tensors, or None."""
    return type(parts)(*(None if part is None else part[index] for part in parts))


def put(parts, index, some):  # type: ignore[no-untyped-def]
    """The same with some elements replaced."""
    return type(parts)(*(part.index_put((index,), new) for part, new in zip(parts, some, strict=True)))


def _velocities(points: Tensor, twist: Tensor) -> Tensor:
    turned = torch.stack((-points[..., 1], points[..., 0]), -1)
    return twist[:, None, :2] + twist[:, 2, None, None] * turned
