"""Contacts in, next velocity out: one step of any rigid scene with Coulomb's cone, exactly.

A scene gives gaps, Jacobians and a free velocity; `contact_step` finds the velocity after the step. It makes rows only
for contacts that close, checks the others afterwards, and adds what it was wrong about. Nothing here knows of shapes.
"""

from collections.abc import Callable
from functools import wraps
from types import ModuleType
from typing import Literal, NamedTuple, ParamSpec, TypeVar, get_args

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lcplearn.scenes.contact_solve import solve
from lcplearn.scenes.friction_lcp import Problem
from lcplearn.scenes.numbers import common_batch, compiled_code_may_see, one_batch
from lcplearn.scenes.scene import Mode

RestitutionLaw = Literal["newton", "continuous"]
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def outside_graphs(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """For what branches on data: torch.compile breaks its graph there, and the function runs as in eager code."""

    @wraps(function)
    def run(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        if torch.compiler.is_compiling():  # asked first, since torch.compiler.disable imports the compiler
            return torch.compiler.disable(function)(*args, **kwargs)
        return function(*args, **kwargs)

    return run


class Contacts(NamedTuple):
    """What may touch during a step; C contacts with T friction directions each (0, 1 in a plane, 2 in space).

    Attributes:
        gap: Distance before the step [m]; negative where bodies overlap.
        normal: Jacobian of the normal speed, positive where the gap opens.
        tangents: Jacobians of the slip along T orthonormal directions.
        mu: Friction coefficient; >= 0.
        bounce: What restitution asks for beyond using up the gap [m/s]; >= 0. See `rebound`.
        compliance: Normal speed by which a unit of normal impulse may sink [1/kg]; >= 0. It makes the split of forces
            among redundant contacts unique. Where a body slides and spins on four coplanar corners the split decides
            the velocity, too. 1e-6 to 1e-3 of 1 / mass; at rest a contact then lies compliance * dt * impulse deep.
    """

    gap: Float[Tensor, "*#batch C"]
    normal: Float[Tensor, "*#batch C nv"]
    tangents: Float[Tensor, "*#batch C T nv"]
    mu: Float[Tensor, "*#batch #C"]
    bounce: Float[Tensor, "*#batch #C"]
    compliance: Float[Tensor, "*#batch #C"]


class ContactStep(NamedTuple):
    """What a step of contacts gives.

    Attributes:
        velocity: Velocity after the step; exactly 0 where the body rests.
        normal_impulse: [N s]; >= 0.
        friction_impulse: Along the contact's T tangents [N s].
        mode: `Mode` of each contact.
        at_rest: Whether sticking contacts hold all of the velocity, so that its 0 was written and not computed.
        solved: Whether what was solved last (see NOTES 5.7) was, and by it no contact sinks, nor opens under load, by
            more than 1e-8 of the speeds in question. False where no velocity does that: between walls that close.
        settled: Whether the cone's fixed point was reached; always where there is at most one friction direction.
    """

    velocity: Float[Tensor, "*batch nv"]
    normal_impulse: Float[Tensor, "*batch C"]
    friction_impulse: Float[Tensor, "*batch C T"]
    mode: Int[Tensor, "*batch C"]
    at_rest: Bool[Tensor, "*batch"]
    solved: Bool[Tensor, "*batch"]
    settled: Bool[Tensor, "*batch"]


def check_law(restitution_law: str) -> None:
    """Refuse a law of restitution that there is not.

    Raises:
        ValueError: It is none of `RestitutionLaw`.
    """
    if restitution_law not in get_args(RestitutionLaw):
        known = " or ".join(map(repr, get_args(RestitutionLaw)))
        raise ValueError(f"restitution_law: expected {known}, got {restitution_law!r}")


def closing_speed(
    gap: Float[Tensor, "*#batch C"],
    before: Float[Tensor, "*#batch C"],
    free: Float[Tensor, "*#batch C"],
    dt: float,
    law: RestitutionLaw,
) -> Float[Tensor, "..."]:
    """Speed of an impact [m/s], of which a contact gives back restitution times as much.

    Args:
        gap: [m].
        before: Normal speed before the step [m/s].
        free: Normal speed after the step if nothing touched [m/s].
        dt: Step size [s].
        law: "newton" is the speed before the step, -before, of a contact that would close, and 0 up to the speed that
            the forces give it within the step: else a body that lies goes on bouncing ever lower. It jumps at both
            ends. "continuous" is the part of it that is left when the gap is used up, -before - max(gap, 0) / dt.
    """
    if law == "continuous":
        return torch.relu(-before - torch.relu(gap) / dt)
    gained = torch.relu(before - free)
    return torch.where((gap + dt * free < 0.0) & (-before > gained), -before, 0.0)


def rebound(
    gap: Float[Tensor, "*#batch C"],
    closing: Float[Tensor, "*#batch C"],
    restitution: Float[Tensor, "*#batch #C"],
    dt: float,
    law: RestitutionLaw,
) -> Float[Tensor, "..."]:
    """`Contacts.bounce` [m/s] for a closing speed.

    By "newton" the normal speed after an impact is restitution * closing, wherever in the step it falls: right speeds
    and heights. By "continuous" the gap after it is dt * restitution * closing: right positions, but on average a body
    rebounds slower than restitution says.
    """
    bounce = restitution * closing
    if law == "continuous":
        return bounce
    return torch.where(bounce > 0.0, torch.relu(bounce + gap / dt), 0.0)


@outside_graphs
def contact_step(
    contacts: Contacts,
    free: Float[Tensor, "*#batch nv"],
    mass: Float[Tensor, "*#batch nv"],
    dt: float,
    *,
    polygon: int | None = None,
    rest: bool = True,
) -> ContactStep:
    """Velocity after a step in which contacts don't penetrate and Coulomb's friction acts.

    v' = free + mass^-1 sum_i (n_i' lambda_i + T_i' f_i), where for each contact

        0 <= lambda ⟂ n v' + gap / dt - bounce + compliance lambda >= 0,
        |f| <= mu lambda,  and  f = -mu lambda T v' / |T v'|  where it slips.

    In space the cone is the fixed point of small LCPs (see `friction_lcp`), iterated without gradient; the gradient is
    that of the law at the modes that were found (see `contact_gradient`).

    Args:
        contacts: What may touch.
        free: Velocity after the step if nothing touched.
        mass: Diagonal of the mass matrix [kg, kg m^2].
        dt: Step size [s].
        polygon: None is the exact cone; k is a polygon of 2 k directions in its place, for comparison.
        rest: Whether a body that sticking contacts hold gets the velocity 0 to the last bit. Gradients don't change.

    Gradient:
        Implicit, with respect to all tensors; zero for what is not solved. At a change of mode it is one-sided. With a
        polygon it is wrong in practice: the velocity is a staircase.

    Source: Stewart and Trinkle 1996 (time stepping); NOTES 5.7 (cone, gradient, rest).
    """
    problem, batch = _flatten(contacts, free, mass, dt)
    kernel = None if polygon is not None else compiled_contacts(free.device)
    step = _in_torch(problem, polygon, rest) if kernel is None else kernel.solve(problem, rest)
    if len(batch) != 1:
        step = ContactStep(*(x.reshape((*batch, *x.shape[1:])) for x in step))
    if free.dtype is not torch.float64:
        step = ContactStep(*(x.to(free.dtype) for x in step[:3]), *step[3:])
    return step


def _in_torch(problem: Problem, polygon: int | None, rest: bool) -> ContactStep:
    found, at_rest = solve(problem, polygon, rest)
    # The value is exactly 0, and the gradient that of the computed velocity.
    velocity = torch.where(at_rest.unsqueeze(-1), found.velocity - found.velocity.detach(), found.velocity)
    slips = torch.where(found.sticks | at_rest.unsqueeze(-1), int(Mode.STICK), int(Mode.SLIP))
    mode = torch.where(found.normal > 0.0, slips, int(Mode.SEPARATION))
    return ContactStep(velocity, found.normal, found.friction, mode, at_rest, found.solved, found.settled)


def compiled_contacts(device: torch.device) -> ModuleType | None:
    """`contact_kernel.steps`, imported on first use; None where it may not see the numbers."""
    if not compiled_code_may_see(device):
        return None
    from lcplearn.scenes.contact_kernel import steps

    return steps


def _flatten(contacts: Contacts, free: Tensor, mass: Tensor, dt: float) -> tuple[Problem, torch.Size]:
    """One problem with a single batch dimension, in float64, and the batch dimensions that it stands for."""
    gap, normal, tangents, mu, bounce, compliance = contacts
    shapes = (x.shape[:-k] for x, k in ((gap, 1), (normal, 2), (tangents, 3), (mu, 1), (free, 1), (mass, 1)))
    batch = common_batch(*shapes, bounce.shape[:-1], compliance.shape[:-1])
    count, nv, directions = normal.shape[-2], normal.shape[-1], tangents.shape[-2]
    if directions > 2:
        raise ValueError(f"tangents: expected 0, 1 or 2 directions a contact, got {directions}")

    return (
        Problem(
            target=one_batch(bounce - gap / dt, batch, count),
            normal=one_batch(normal, batch, count, nv),
            tangents=one_batch(tangents, batch, count, directions, nv),
            mu=one_batch(mu, batch, count),
            compliance=one_batch(compliance, batch, count),
            free=one_batch(free, batch, nv),
            mass=one_batch(mass, batch, nv),
        ),
        batch,
    )
