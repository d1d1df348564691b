"""A flat object that a finger pushes over a table so slowly that inertia does not matter."""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

import lcplearn
from lcplearn.scenes.pushes import Push
from lcplearn.scenes.pushing_lcp import Bearing, Touch, ellipsoid_lcp, polygon_lcp
from lcplearn.scenes.pushing_step import Moved, compiled_pushing, finger_mode, put, settle, take

GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


class Grip(NamedTuple):
    """How an object stands and is touched.

    Attributes:
        points: Support points [m], in the object's frame.
        loads: Share of the weight on each, > 0; they sum to 1.
        levers: Load share that a unit moment of the finger's force about the table adds [1/m]; `plane_fit` has both.
        mu: Friction coefficient of the table.
        finger_mu: Friction coefficient of the finger.
        height: Height of the finger above the table [m].
        shift: Error of the finger's position, added to it [m], world; None for none.
        wrench: Further force and torque on the object in its own axes, in units of mu * weight (* radius); None.
    """

    points: Float[Tensor, "b k 2"]
    loads: Float[Tensor, "b k"]
    levers: Float[Tensor, "b k 2"]
    mu: Float[Tensor, " b"]
    finger_mu: Float[Tensor, " b"]
    height: Float[Tensor, " b"]
    shift: Float[Tensor, "b 2"] | None = None
    wrench: Float[Tensor, "b 3"] | None = None


class PushPath(NamedTuple):
    """What a push did, over S steps from the first touch on.

    Attributes:
        poses: Object's frame at the S + 1 instants, as `Push.pose`.
        forces: Force of the finger on the object during each step [N], world.
        mode: What the finger does on the edge during each step.
        finger: Finger at the S + 1 instants [m], world.
        solved: False where the LCP of a step has no verified solution; the pose is then the last iterate's.
        settled: False where the direction of slip did not come to rest; the friction cone is met roughly there.
    """

    poses: Float[Tensor, "b S+1 3"]
    forces: Float[Tensor, "b S 2"]
    mode: Int[Tensor, "b S"]
    finger: Float[Tensor, "b S+1 2"]
    solved: Bool[Tensor, "b S"]
    settled: Bool[Tensor, "b S"]


@dataclass(frozen=True)
class PushedObject:
    """Quasi-static pushing of a convex polygon on a few supports, with Coulomb friction under each.

    Each step solves for the twist that balances finger and friction. Friction is the exact cone: the LCP has two
    facets along the slip of the last iterate and is solved again until the slip settles (`aligned_lcp`).

    Gradient: of poses and forces with respect to all tensors of `Grip` and `Push`. Only the last LCP of each step is
    differentiated; at the fixed point that is the gradient of the cone's solution. The edge that is touched and
    whether a support is lifted are constants. What is not solved has the gradient zero.

    Status: `PushPath.solved` and `settled`, for each step.

    Args:
        vertices: Corners in the object's frame [m], counterclockwise.
        com: Centre of mass in the object's frame [m].
        mass: [kg].
        radius: Length that makes rotation comparable to translation [m]; the radius of gyration.
        gravity: [m/s^2].
        steps: Steps of a push from the first touch on.
        creep: Velocity, in units of the finger's, of a support that bears no more than its friction; it moves end
            poses of 15 mm pushes by less than 0.01 mm.
        iterations: LCPs a step at most.
        law: Friction under the supports: Coulomb's cone; a polygon in its place, which must not be differentiated
            (see `polygon_lcp`); or one ellipsoid of force and torque for all supports together.
        facets: Sides of the polygon.
    """

    vertices: Float[Tensor, "v 2"]
    com: Float[Tensor, "2"]
    mass: float
    radius: float = 0.05
    gravity: float = 9.81
    steps: int = 15
    creep: float = 1e-2
    iterations: int = 40
    law: Literal["cone", "polygon", "ellipsoid"] = "cone"
    facets: int = 16

    def __post_init__(self) -> None:
        edges = self.vertices.roll(-1, 0) - self.vertices
        corners = edges[:, 0] * edges.roll(-1, 0)[:, 1] - edges[:, 1] * edges.roll(-1, 0)[:, 0]
        if len(self.vertices) < 3 or not bool((corners > 0).all()):
            raise ValueError(f"vertices: expected a convex polygon, counterclockwise, got {self.vertices.tolist()}")
        if self.law not in ("cone", "polygon", "ellipsoid"):
            raise ValueError(f"law: expected 'cone', 'polygon' or 'ellipsoid', got {self.law!r}")
        if self.facets < 3:
            raise ValueError(f"facets: expected at least 3, got {self.facets}")
        for name in ("mass", "radius", "gravity", "steps", "creep", "iterations"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected a positive number, got {getattr(self, name)}")

    def rollout(self, push: Push, grip: Grip) -> PushPath:
        """Push, in `steps` equal steps of the finger from the first touch to the end of its path.

        Raises:
            ValueError: A tensor has another shape than `Push` and `Grip` say.
        """
        _check_shapes(push, grip)
        inputs = (*push, *grip, self.vertices, self.com)
        wanted = torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in inputs)
        if wanted or self.law != "cone" or compiled_pushing(push.pose) is None:
            return self._rollout_stepwise(push, grip)
        path = self._rollout_compiled(push, grip)
        rest = (~(path.solved & path.settled).all(-1)).nonzero()[:, 0]
        return put(path, rest, self._rollout_stepwise(take(push, rest), take(grip, rest))) if len(rest) else path

    def _rollout_stepwise(self, push: Push, grip: Grip) -> PushPath:
        centre, angle, finger, stride, length = self._start(push, grip)
        bearing = self._bearing(grip)
        slip: Tensor | None = None
        poses, forces, modes = [self._pose(centre, angle)], [], []
        solved, settled = [], []
        for step in range(self.steps):
            moved = rotate(-angle, stride)
            touch = self._touch(rotate(-angle, finger + step * stride - centre), moved, length, grip.finger_mu)
            if slip is None:  # every support follows the finger, turning a little
                slip = (moved / length[:, None])[:, None] + 1e-3 * bearing.points
            twist, force, mode, slip, good, calm = self._move(bearing, touch, slip.detach(), step)
            twist = twist * length[:, None]
            forces.append(rotate(angle, force))
            centre = centre + rotate(angle + twist[:, 2] / 2.0, twist[:, :2])
            angle = angle + twist[:, 2]
            poses.append(self._pose(centre, angle))
            modes.append(mode)
            solved.append(good)
            settled.append(calm)
        told = (torch.stack(parts, 1) for parts in (modes, solved, settled))
        return self._path(torch.stack(poses, 1), torch.stack(forces, 1), finger, stride, grip, *told)

    @torch.no_grad()
    def _rollout_compiled(self, push: Push, grip: Grip) -> PushPath:
        from lcplearn.scenes.pushing_rollout import roll

        centre, angle, finger, stride, length = self._start(push, grip)
        outline = ((self.vertices - self.com) / self.radius, *self.edges())
        track, forces, (solved, settled, mode) = roll(
            outline, self._bearing(grip), torch.cat((centre, angle[:, None]), -1), finger, stride, length,
            grip.finger_mu, steps=self.steps, creep=self.creep, iterations=self.iterations,
        )  # fmt: skip
        return self._path(
            self._pose(track[..., :2], track[..., 2]), forces, finger, stride, grip, mode, solved, settled
        )

    def _start(self, push: Push, grip: Grip) -> tuple[Tensor, ...]:
        """Centre of mass, angle, finger at the first touch, its step and the length of that; in units of the radius."""
        centre, angle = (push.pose[:, :2] + rotate(push.pose[:, 2], self.com)) / self.radius, push.pose[:, 2]
        start = push.start + self.first_touch(push)[:, None] * (push.end - push.start)
        finger = (start if grip.shift is None else start + grip.shift) / self.radius
        stride = (push.end - start) / (self.radius * self.steps)
        return centre, angle, finger, stride, stride.norm(dim=-1).clamp_min(1e-9)  # a finger that never touches rests

    def _path(
        self, poses: Tensor, forces: Tensor, finger: Tensor, stride: Tensor, grip: Grip, mode: Tensor, solved: Tensor,
        settled: Tensor,
    ) -> PushPath:  # fmt: skip
        newton = (grip.mu * self.mass * self.gravity)[:, None, None]
        count = torch.arange(self.steps + 1, dtype=finger.dtype)[:, None]
        fingers = (finger[:, None] + count * stride[:, None]) * self.radius
        return PushPath(poses, forces * newton, mode, fingers, solved, settled)

    def first_touch(self, push: Push) -> Float[Tensor, " b"]:
        """Fraction of the finger's way at which it touches the object; 1 where it never does."""
        ends = [rotate(-push.pose[:, 2], point - push.pose[:, :2]) for point in (push.start, push.end)]
        outside, later = (self.outside(point) for point in ends)
        fraction = outside / torch.where(outside == later, 1.0, outside - later)
        never = (outside > 0) & (later >= outside)
        entry = torch.where(outside > 0, fraction, 0.0).amax(-1)
        leaving = torch.where((outside <= 0) & (later > 0), fraction, torch.inf).amin(-1)
        misses = never.any(-1) | (entry > leaving) | (entry > 1.0)
        return torch.where(misses, 1.0, entry)

    def outside(self, point: Float[Tensor, "b 2"]) -> Float[Tensor, "b v"]:
        """Signed distance of a point in the object's frame to the line of each edge; positive outside."""
        inward = self.edges()[1]
        return -((point[:, None] - self.vertices) * inward).sum(-1)

    def edges(self) -> tuple[Float[Tensor, "v 2"], Float[Tensor, "v 2"]]:
        """Tangent and inward normal of each edge, in the object's frame."""
        edges = self.vertices.roll(-1, 0) - self.vertices
        tangents = edges / edges.norm(dim=-1, keepdim=True)
        return tangents, torch.stack((-tangents[:, 1], tangents[:, 0]), -1)

    def _touch(self, finger: Tensor, moved: Tensor, length: Tensor, mu: Tensor) -> Touch:
        """The point of the boundary next to the finger; beyond the end of an edge it is the corner."""
        tangents, inward = self.edges()
        corners = (self.vertices - self.com) / self.radius
        from_corner = finger[:, None] - corners
        outside = -(from_corner * inward).sum(-1)
        edge = outside.detach().argmax(-1)
        tangent, normal = tangents[edge], inward[edge]
        gap = outside.gather(1, edge[:, None])[:, 0]
        along = ((finger - corners[edge]) * tangent).sum(-1)
        span = (self.vertices.roll(-1, 0) - self.vertices).norm(dim=-1)[edge] / self.radius
        nearest = along.clamp(min=torch.zeros_like(span), max=span)
        beyond = (along != nearest) & (gap > 0)
        point = corners[edge] + nearest[:, None] * tangent
        to_corner = torch.where(beyond[:, None], point - finger, normal)
        distance = to_corner.norm(dim=-1)
        normal = to_corner / distance[:, None]
        gap = torch.where(beyond, distance, gap)
        point = torch.where(beyond[:, None], point, finger + gap[:, None] * normal)
        tangent = torch.stack((normal[:, 1], -normal[:, 0]), -1)
        normal_step = ((moved * normal).sum(-1) - gap) / length
        return Touch(point, normal, tangent, normal_step, (moved * tangent).sum(-1) / length, mu)

    def _bearing(self, grip: Grip) -> Bearing:
        return Bearing(
            (grip.points - self.com) / self.radius,
            grip.loads,
            grip.levers * (grip.mu * grip.height)[:, None, None],
            grip.wrench,
        )

    def _move(self, bearing: Bearing, touch: Touch, slip: Tensor, step: int) -> Moved:
        """One step by the friction law in use."""
        if self.law == "cone":
            return settle(bearing, touch, slip, creep=self.creep, iterations=self.iterations)
        if self.law == "ellipsoid":
            arm = (bearing.loads * bearing.points.norm(dim=-1)).sum(-1)
            problem = ellipsoid_lcp(touch, arm)
        else:  # the polygons turn from step to step, which averages their corners out
            supports = bearing.points.shape[1]
            order = torch.arange(supports, dtype=bearing.points.dtype)
            turn = ((GOLDEN * step + order / supports) % 1.0) * (2.0 * math.pi / self.facets)
            problem = polygon_lcp(bearing, touch, self.facets, turn, creep=self.creep)
        solution = lcplearn.solve_lcp(problem.M, problem.q)
        force = problem.force(solution.z, self.creep)
        if self.law == "ellipsoid":
            torque = touch.point[:, 0] * force[:, 1] - touch.point[:, 1] * force[:, 0]
            size = torch.cat((force, (torque / arm)[:, None]), -1).norm(dim=-1, keepdim=True)
            force = force / torch.where(size > 0, size, 1.0)
        calm = torch.ones_like(solution.solved)
        return Moved(problem.twist(solution.z), force, finger_mode(solution.z), slip, solution.solved, calm)

    def _pose(self, centre: Tensor, angle: Tensor) -> Tensor:
        return torch.cat((centre * self.radius - rotate(angle, self.com), angle[..., None]), -1)


def _check_shapes(push: Push, grip: Grip) -> None:
    """Compiled code reads as many numbers as it expects: nothing is broadcast."""
    b, k = len(push.pose), grip.points.shape[-2]
    shapes = {"pose": (b, 3), "start": (b, 2), "end": (b, 2), "points": (b, k, 2), "loads": (b, k), "levers": (b, k, 2)}
    shapes |= {"mu": (b,), "finger_mu": (b,), "height": (b,), "shift": (b, 2), "wrench": (b, 3)}
    for name, value in (push._asdict() | grip._asdict()).items():
        if value is not None and value.shape != shapes[name]:
            raise ValueError(f"{name}: expected shape {list(shapes[name])}, got {list(value.shape)}")


def plane_fit(
    points: Float[Tensor, "*b k 2"], com: Float[Tensor, "2"], weights: Float[Tensor, "*#b k"]
) -> tuple[Float[Tensor, "*b k"], Float[Tensor, "*b k 2"]]:
    """Load shares that balance the weight, and how a moment changes them: `Grip.loads` and `Grip.levers`.

    Loads are weights times a plane over the points, as on springs of these stiffnesses; three points that are no line
    leave no choice, and the weights do not matter.

    Args:
        points: Support points [m].
        com: Centre of mass, in the same frame [m].
        weights: Positive.
    """
    arms = points - com
    plane = torch.cat((torch.ones_like(arms[..., :1]), arms), -1)
    weighted = plane * weights[..., None]
    shares = weighted @ torch.linalg.inv(plane.mT @ weighted)
    return shares[..., 0], shares[..., 1:]


def rotate(angle: Float[Tensor, "*#b"], vectors: Float[Tensor, "*#b 2"]) -> Float[Tensor, "*b 2"]:
    """Turn vectors counterclockwise."""
    c, s = angle.cos(), angle.sin()
    x, y = vectors[..., 0], vectors[..., 1]
    return torch.stack((c * x - s * y, s * x + c * y), -1)
