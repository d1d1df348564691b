"""What compiling contact steps is worth: the same step and rollout of a box, compiled and assembled in torch."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from lcplearn.benchmark.engines.cases import HALF, MASS
from lcplearn.benchmark.harness.measuring import interleave
from lcplearn.benchmark.harness.study import Row
from lcplearn.benchmark.scenes.contact_cases import DT, MU, box_states
from lcplearn.scenes.contact import contact_step
from lcplearn.scenes.scene import Drive, rollout
from lcplearn.scenes.space import POSE, rotation_matrix
from lcplearn.scenes.spatial_body import SpatialBody, box_corners

WHAT = ("contact step", "step of a body", "rollout of a body")
STEPS = 20  # of a rollout
COMPLIANCE = 1e-3  # which makes velocities unique
FORWARD, BACKWARD = "forward", "forward and backward"


@contextmanager
def _in_torch() -> Iterator[None]:
    with (
        patch("lcplearn.scenes.contact.compiled_contacts", lambda device: None),
        patch("lcplearn.scenes.spatial_body.compiled_contacts", lambda device: None),
    ):
        yield


def fused_rows(what: str, batch: int, repeats: int, seed: int) -> list[Row]:
    """The same by both, without and with gradient.

    Returns:
        formulation; step_us, CPU time of a step of one body compiled, and torch_us; full_over_this, the one over the
        other; velocity_difference, the largest between the two, relative [-], of gradients where there are any.
    """
    rows: list[Row] = []
    for name in (FORWARD, BACKWARD):
        call = _call(what, batch, seed, gradient=name == BACKWARD)

        def assembled(call: Callable[[], Any] = call) -> Tensor:
            with _in_torch():
                return call()

        found, wanted = call(), assembled()
        timings = interleave({"compiled": call, "torch": assembled}, repeats)
        per_step = 1e6 / batch / (STEPS if what == "rollout of a body" else 1)
        rows.append({
            "formulation": name,
            "step_us": per_step * timings["compiled"].cpu,
            "torch_us": per_step * timings["torch"].cpu,
            "full_over_this": timings["torch"].over(timings["compiled"])[0],
            "velocity_difference": float((found - wanted).abs().max() / wanted.abs().max()),
        })  # fmt: skip
    return rows


def a_box(batch: int, seed: int) -> tuple[SpatialBody, Tensor]:
    """A box, and states in which it lies on a face, an edge or a corner and slides; in the first, on a face."""
    inertia = MASS / 3 * (HALF[0] ** 2 + HALF[2] ** 2)
    corners = box_corners(torch.tensor(HALF, dtype=torch.float64))
    body = SpatialBody(corners=corners, inertia=inertia, mu=MU, dt=DT, mass=MASS, compliance=COMPLIANCE)
    return body, box_states(batch, seed)


def _call(what: str, batch: int, seed: int, gradient: bool) -> Callable[[], Tensor]:
    """Does it once; gives velocities, or the gradient with respect to free velocity or state."""
    body, state = a_box(batch, seed)
    if what == "contact step":
        position, before = POSE.split(state)
        turn, mass = rotation_matrix(position[..., 3:]), body._mass(state)
        start = body._free_velocity(before, turn, torch.zeros(6, dtype=torch.float64), mass)
        contacts = body._contacts(position, before, start, turn)
        step = lambda free: contact_step(contacts, free, mass, DT).velocity  # noqa: E731
    elif what == "step of a body":
        start, nothing = state, Drive(torch.zeros(6, dtype=torch.float64))
        step = lambda state: body.advance(state, nothing).state[..., POSE.nq :]  # noqa: E731
    else:
        start, nothing = state, Drive(torch.zeros(batch, STEPS, 6, dtype=torch.float64))
        step = lambda state: rollout(body, state, nothing).velocities[..., -1, :]  # noqa: E731
    return partial(pull, step, start) if gradient else partial(push, step, start)


@torch.no_grad()
def push(step: Callable[[Tensor], Tensor], start: Tensor) -> Tensor:
    """A step without gradient."""
    return step(start)


def pull(step: Callable[[Tensor], Tensor], start: Tensor) -> Tensor:
    """The gradient of a sum over a step with respect to its start."""
    start = start.detach().requires_grad_()
    return torch.autograd.grad(step(start).sum(), start)[0]
