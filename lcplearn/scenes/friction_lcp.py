"""The LCPs of contacts with dry friction: three rows a contact for the cone, 2 k + 2 for a polygon.

**The cone.** At each contact two facets +-t along the slip, and across it, along s, the cone's own curvature,

    |f_t| <= mu lambda,     f_s = -weight v_s,     weight = mu lambda / |slip|,

with slip and load of the iterate before. Where the iterate's facet sticks, or its slip is below 10 `CREEP`, t is
along the friction force, and the slip in the weight is at least `CREEP`. At the fixed point v_s = 0 (slip) or f_s = 0
(stick), so that this is Coulomb's law, and its derivative: what changes the weight multiplies v_s = 0.

f_s is condensed out of the Delassus matrix A = J mass^-1 J', and the facets make the rows lambda, a, sigma:

    0 <= lambda ⟂ v_n - target + compliance lambda >= 0
    0 <= a      ⟂ v_t + sigma >= 0                          f_t = a - mu lambda
    0 <= sigma  ⟂ 2 mu lambda - a >= 0

so that v_t = w_a - sigma is read from complementary variables, and is 0 to the last bit at stick.

Where contacts are redundant the loads that solve an LCP are many, and from one iterate to the next another contact
carries them. An iteration that has not settled after `PLAIN` LCPs goes on with a proximal term (`regularisation`): the
compliance grows by a share p of n mass^-1 n', the target by as much times the load of the iterate before. What it
settles at solves the same law. A small share keeps loads together, a large one ends cycles, and slows what converges.

Corners of a body that comes to rest may contradict each other: none may slip, yet each moves up or down at its own
speed of 1e-6 and less, and turns the body by it. Then they creep, as a slip of `CREEP` stands for none, and friction
grows from LCP to LCP. From `PLAIN` to `PATIENCE` LCPs a slip of `FINE_CREEP` stands for none; it has fewer right
digits. After `LAST_RESORT` a velocity that stays counts as settled if the law holds to `CRUDE`.

Source: NOTES 5.7; the rows of a polygon: Stewart and Trinkle 1996.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lcplearn.lcp.solve import solve_lcp
from lcplearn.scenes.numbers import matvec

MAX_ITERATIONS = 130  # of the cone's fixed point; the mean is about 2.5
PLAIN = 12  # of them before the proximal term
PATIENCE = 40  # of them before the proximal term grows, and grows again at the last resort
LAST_RESORT = 70
SETTLED = 3e-14  # violation of the law as a speed, relative to that of free flight and to what the load can cause
HEAVY = 3e5  # the latter up to so many times the former: where no velocity obeys the law, loads grow until all is small
DEAD_ZONE = 1e-6  # normal speed of a loaded contact that counts as none, relative to the free velocity
DEAD_SLIP = 1e-10  # slip of one, likewise
FULL_RANK = 1e-6  # smallest eigenvalue of the rows that hold a body at rest, relative to their largest diagonal
ROUNDING = 1e-13  # of speeds, relative to those of free flight
CREEP = 1e-8  # speed that stands for the slip at stick, likewise
FINE_CREEP = 1e-11
CREEPS = 10.0 * CREEP  # a slip as small as what a weight leaves over; it has no direction worth following
STAYS = 1e-10  # change of velocity from one iterate to the next, relative in the mass norm
CRUDE = 1e-8  # violation of the law, likewise


class Problem(NamedTuple):
    """Contacts of a batch of B elements: `contact.Contacts`, with the normal speed that each must at least have.

    Shapes: target, mu, compliance [B, C]; normal [B, C, nv]; tangents [B, C, T, nv]; free, mass [B, nv].
    """

    target: Tensor
    normal: Tensor
    tangents: Tensor
    mu: Tensor
    compliance: Tensor
    free: Tensor
    mass: Tensor

    @property
    def directions(self) -> int:
        return self.tangents.shape[-2]

    def pick(self, elements: Tensor, rows: Tensor | None = None) -> "Problem":
        """The elements [b], and of their contacts those in rows [b, K] (all, if None)."""
        place = elements if rows is None else (elements.unsqueeze(-1), rows)
        target, normal, tangents, mu, compliance = (x[place] for x in self[:5])
        return Problem(target, normal, tangents, mu, compliance, self.free[elements], self.mass[elements])

    def excess(self, velocity: Tensor) -> Tensor:
        """Normal speed of each contact beyond its target."""
        return matvec(self.normal, velocity) - self.target

    def mobility(self) -> Tensor:
        """n mass^-1 n' [B, C], the normal speed that a unit of load causes at a contact alone."""
        return (self.normal.square() / self.mass.unsqueeze(-2)).sum(-1)

    def mass_norm(self, velocity: Tensor) -> Tensor:
        """sqrt(v' mass v), the same unit for translation and rotation."""
        return (self.mass * velocity.square()).sum(-1).sqrt()

    def speed_scale(self) -> Tensor:
        """Largest normal speed [B, C] of a velocity with the energy of the free one and what the targets demand."""
        unit = self.mobility().sqrt()
        demanded = (self.target.relu() / unit.clamp_min(1e-300)).amax(-1)
        return unit * (self.mass_norm(self.free) + demanded)[:, None]


class Answer(NamedTuple):
    """Solution of a `Problem`; also where to go on from.

    Shapes: velocity [B, nv]; normal, sticks [B, C]; friction, slip [B, C, T]; solved, settled [B].
    """

    velocity: Tensor
    normal: Tensor
    friction: Tensor
    slip: Tensor
    sticks: Tensor
    solved: Tensor
    settled: Tensor

    @staticmethod
    def free_flight(problem: Problem) -> "Answer":
        zero, right = torch.zeros_like(problem.target), torch.ones_like(problem.free[:, 0], dtype=torch.bool)
        none = torch.zeros_like(problem.tangents[..., 0])
        return Answer(problem.free.clone(), zero, none, none.clone(), zero > 0.0, right, right.clone())

    @staticmethod
    def guess(problem: Problem) -> "Answer":
        """The free slip, and the load that stops each contact alone."""
        answer = Answer.free_flight(problem)
        load = torch.relu(-problem.excess(problem.free)) / problem.mobility()
        return answer._replace(normal=load, slip=matvec(problem.tangents, problem.free.unsqueeze(-2)))

    def clone(self) -> "Answer":
        return Answer._make(x.clone() for x in self)

    def pick(self, elements: Tensor, rows: Tensor | None = None) -> "Answer":
        """As `Problem.pick`."""
        place = elements if rows is None else (elements.unsqueeze(-1), rows)
        normal, friction, slip, sticks = (x[place] for x in self[1:5])
        velocity, solved, settled = self.velocity[elements], self.solved[elements], self.settled[elements]
        return Answer(velocity, normal, friction, slip, sticks, solved, settled)

    def put(self, elements: Tensor, rows: Tensor | None, part: "Answer") -> None:
        """Write what was found for a pick, in place; contacts of these elements outside of rows are left free."""
        place = elements if rows is None else (elements.unsqueeze(-1), rows)
        self.velocity[elements], self.solved[elements], self.settled[elements] = part[0], part[5], part[6]
        for whole, new in zip(self[1:5], part[1:5], strict=True):
            whole[place] = new

    def toward(self, new: "Answer", share: Tensor) -> "Answer":
        """The point at a share [B] of the way."""

        def mix(a: Tensor, b: Tensor) -> Tensor:
            return a + share.reshape(-1, *(1,) * (a.dim() - 1)) * (b - a)

        return new._replace(**{k: mix(getattr(self, k), getattr(new, k)) for k in ("velocity", "normal", "friction")})


def regularisation(iteration: int) -> tuple[float, float]:
    """The proximal term p n mass^-1 n' and the slip that stands for none in an iteration."""
    if iteration < PLAIN:
        return 0.0, CREEP
    if iteration < PATIENCE:
        return 1e-3, FINE_CREEP
    return 0.1 if iteration < LAST_RESORT else 1.0, CREEP


def frictionless_lcp(problem: Problem) -> Answer:
    """One row a contact."""
    A, speed, response = _delassus(problem, problem.normal)
    M = A + torch.diag_embed(problem.compliance)
    solution = solve_lcp(M, speed - problem.target)
    velocity = problem.free + matvec(response.mT, solution.z)
    none = torch.zeros_like(problem.tangents[..., 0])
    return Answer(velocity, solution.z, none, none, solution.z < 0.0, solution.solved, solution.solved)


def cone_lcp(problem: Problem, guide: Answer | None, creep: float = CREEP) -> Answer:
    """Three rows a contact; with two friction directions their facets and weights are those of the guide."""
    K, mu = problem.mu.shape[-1], problem.mu
    eye = torch.eye(K, dtype=mu.dtype, device=mu.device)
    if problem.directions == 1:
        axes = torch.ones_like(problem.tangents[..., :1, :1])
    else:
        axes, weight = _facets(problem, guide, creep)
    along = axes @ problem.tangents  # t, or t and s
    A, speed, response = _delassus(problem, torch.cat((problem.normal, *along.unbind(-2)), dim=-2))
    if problem.directions == 2:
        # f_s = -weight (A_s. f + speed_s), solved for f_s
        root = weight.sqrt()
        inner = eye + root.unsqueeze(-1) * A[:, 2 * K :, 2 * K :] * root[:, None]
        sources = torch.cat((A[:, 2 * K :, : 2 * K], speed[:, 2 * K :, None]), dim=-1)
        across = root.unsqueeze(-1) * torch.cholesky_solve(
            root.unsqueeze(-1) * sources, torch.linalg.cholesky_ex(inner)[0]
        )
        A_rows, A_across = A[:, : 2 * K, : 2 * K], A[:, : 2 * K, 2 * K :]
        A, speed = A_rows - A_across @ across[..., :-1], speed[:, : 2 * K] - matvec(A_across, across[..., -1])
    # columns lambda and a instead of lambda and f_t = a - mu lambda
    facets = torch.cat((A[..., :K] - A[..., K:] * mu.unsqueeze(-2), A[..., K:]), dim=-1)
    zero, one = torch.zeros_like(eye).expand(len(A), K, K), eye.expand(len(A), K, K)
    M = torch.cat(
        (
            torch.cat((facets, torch.cat((zero, one), dim=-2)), dim=-1),
            torch.cat((torch.diag_embed(2.0 * mu), -one, zero), dim=-1),
        ),
        dim=-2,
    )
    M = M + torch.diag_embed(torch.cat((problem.compliance, torch.zeros_like(mu), torch.zeros_like(mu)), dim=-1))
    q = torch.cat((speed[:, :K] - problem.target, speed[:, K:], torch.zeros_like(mu)), dim=-1)
    solution = solve_lcp(M, q)
    normal, a, sigma = solution.z.unflatten(-1, (3, K)).unbind(-2)
    slip_along = solution.w[:, K : 2 * K] - sigma
    forces = [normal, a - mu * normal]
    slips = [slip_along]
    if problem.directions == 2:
        forces.append(-matvec(across[..., :-1], torch.cat(forces, dim=-1)) - across[..., -1])
    velocity = problem.free + matvec(response.mT, torch.cat(forces, dim=-1))
    sticks = slip_along == 0.0
    if problem.directions == 2:
        # exact where a weight makes it small; what has no load slips as it will
        loaded = weight > 0.0
        across_speed = matvec(along[..., 1, :], velocity)
        slips.append(torch.where(loaded, -forces[2] / torch.where(loaded, weight, 1.0), across_speed))
        sticks = sticks & (loaded | (across_speed == 0.0))
    friction = (torch.stack(forces[1:], dim=-1).unsqueeze(-2) @ axes).squeeze(-2)
    slip = (torch.stack(slips, dim=-1).unsqueeze(-2) @ axes).squeeze(-2)
    return Answer(velocity, normal, friction, slip, sticks, solution.solved, solution.solved)


def law_violation(problem: Problem, answer: Answer) -> Tensor:
    """Largest violation [B] of |f| <= mu lambda and of f along -slip; relative, see `SETTLED`.

    |f - P(f - slip / a)| a, with P the projection onto the disc of radius mu lambda and a the mobility.
    """
    a, limit, scale = problem.mobility(), problem.mu * answer.normal, problem.speed_scale()
    pushed = answer.friction - answer.slip / a.unsqueeze(-1)
    size = torch.linalg.vector_norm(pushed, dim=-1)
    factor = torch.where(size > limit, limit / size.clamp_min(1e-300), 1.0)
    wrong = torch.linalg.vector_norm(answer.friction - factor.unsqueeze(-1) * pushed, dim=-1)
    return (a * wrong / (scale + torch.minimum(a * answer.normal, HEAVY * scale)).clamp_min(1e-300)).amax(-1)


def normals_hold(problem: Problem, answer: Answer) -> Tensor:
    """Where [B] no contact sinks, and none that is loaded opens, by more than `CRUDE`; and all is finite."""
    opening, scale = problem.excess(answer.velocity), problem.speed_scale()
    loaded = answer.normal > 0.0
    opening = torch.where(loaded, -(opening + problem.compliance * answer.normal).abs(), opening)
    return ((opening >= -CRUDE * scale) & opening.isfinite() & scale.isfinite()).all(-1)


def polygon_lcp(problem: Problem, k: int) -> Answer:
    """2 k + 2 rows a contact: force directions at equal angles, fixed to the tangents."""
    K, count = problem.mu.shape[-1], 2 * k
    half = [(math.cos(math.pi * i / k), math.sin(math.pi * i / k)) for i in range(k)]
    angles = torch.tensor([*half, *((-x, -y) for x, y in half)], dtype=problem.mu.dtype, device=problem.mu.device)
    along = (angles @ problem.tangents).flatten(1, 2)  # contact by contact
    A, speed, response = _delassus(problem, torch.cat((problem.normal, along), dim=-2))
    size = K * (count + 1)
    pattern = torch.eye(K, dtype=A.dtype, device=A.device).repeat_interleave(count, dim=0)  # row of each direction
    M = A.new_zeros(len(A), size + K, size + K)
    M[:, K:size, size:], M[:, size:, K:size] = pattern, -pattern.mT
    M = M + torch.nn.functional.pad(A, (0, K, 0, K))
    M = M + torch.nn.functional.pad(torch.diag_embed(problem.mu), (0, size, size, 0))
    M = M + torch.nn.functional.pad(torch.diag_embed(problem.compliance), (0, size, 0, size))
    q = torch.cat((speed[:, :K] - problem.target, speed[:, K:], torch.zeros_like(problem.mu)), dim=-1)
    solution = solve_lcp(M, q)
    z = solution.z
    velocity = problem.free + matvec(response.mT, z[:, :size])
    friction = z[:, K:size].unflatten(-1, (K, count)) @ angles
    slip = matvec(problem.tangents, velocity.unsqueeze(-2))
    return Answer(velocity, z[:, :K], friction, slip, z[:, size:] == 0.0, solution.solved, solution.solved)


def _facets(problem: Problem, guide: Answer | None, creep: float) -> tuple[Tensor, Tensor]:
    """Axes t, s [B, K, 2, 2] and the weight across [B, K], from the iterate before; constants for the gradient."""
    if guide is None:
        raise ValueError("guide: expected an iterate, got None")
    with torch.no_grad():
        slip = torch.linalg.vector_norm(guide.slip, dim=-1)
        scale = problem.speed_scale()
        sticks = guide.sticks | (slip <= 10.0 * creep * scale)
        direction = torch.where(sticks.unsqueeze(-1), -guide.friction, guide.slip)
        length = torch.linalg.vector_norm(direction, dim=-1, keepdim=True)
        some = length > 0.0
        t = torch.where(some, direction / torch.where(some, length, 1.0), direction.new_tensor([1.0, 0.0]))
        speed = torch.maximum(torch.where(guide.sticks, 0.0, slip), creep * scale)
        s = torch.stack((-t[..., 1], t[..., 0]), dim=-1)
        weight = torch.where(speed > 0.0, problem.mu * guide.normal / torch.where(speed > 0.0, speed, 1.0), 0.0)
        return torch.stack((t, s), dim=-2), weight


def _delassus(problem: Problem, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """J mass^-1 J', J free and mass^-1 J' (transposed) for Jacobian rows J [B, R, nv]."""
    response = rows / problem.mass.unsqueeze(-2)
    return rows @ response.mT, matvec(rows, problem.free), response
