"""A batch of contact problems, compiled: their solution and its gradient as one node of autograd."""

from collections.abc import Iterable, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lcplearn.lcp.kernel.calling import address_of
from lcplearn.lcp.kernel.memory import address as data_address
from lcplearn.lcp.pivoting import solver_address
from lcplearn.scenes.contact import ContactStep
from lcplearn.scenes.contact_kernel.adjoint import UNKNOWN, pull_back_contacts
from lcplearn.scenes.contact_kernel.compiling import compiled, fingerprint, refuse_batched
from lcplearn.scenes.contact_kernel.element import solve_element
from lcplearn.scenes.contact_kernel.memory import adjoint_scratch, bare, bare_flags, contact_scratch, loaded_memory
from lcplearn.scenes.contact_kernel.slices import by_slices
from lcplearn.scenes.friction_lcp import Problem

STICK, SLIP, SEPARATION = 0, 1, 2  # scene.Mode, as plain constants
SECONDS = 3e-7  # of a step, for each contact that may close: to decide on threads


def _make_solve_all(sources: str) -> Any:
    def _solve_all(
        address, rest, scratch, target, normal, tangents, mu, compliance, free, mass, velocity, load, friction, modes,
        sticks, flags,
    ):  # fmt: skip
        sources  # noqa: B018, for the cache
        B, C, nv = normal.shape
        T = tangents.shape[2]
        at = data_address(scratch)
        target, normal, tangents, mu, compliance = (
            bare(target), bare(normal), bare(tangents), bare(mu), bare(compliance)
        )  # fmt: skip
        free, mass, velocity, load, friction = bare(free), bare(mass), bare(velocity), bare(load), bare(friction)
        sticks, flags = bare_flags(sticks), bare_flags(flags)
        for b in range(B):
            flags[b, 0], flags[b, 1], flags[b, 2] = solve_element(
                address, C, nv, T, rest, target[b], normal[b], tangents[b], mu[b], compliance[b], free[b], mass[b],
                at, velocity[b], load[b], friction[b], sticks[b],
            )  # fmt: skip
            at_rest = flags[b, 2]
            if at_rest:
                velocity[b] = 0.0
            for i in range(C):
                modes[b, i] = SEPARATION
                if load[b, i] > 0.0:
                    modes[b, i] = STICK if at_rest or sticks[b, i] else SLIP

    return compiled(_solve_all, cached=True)


def _make_pull_back_all(sources: str) -> Any:
    def _pull_back_all(
        scratch, normal, tangents, mu, compliance, free, mass, load, friction, sticks, flags, velocity_, load_,
        friction_, target_, normal_, tangents_, mu_, compliance_, free_, mass_,
    ):  # fmt: skip
        """Gradients, from those of velocity, load and friction, for the contacts that are loaded; the rest are 0."""
        sources  # noqa: B018, for the cache
        B, C, nv = normal.shape
        T = tangents.shape[2]
        w = 1 + T
        loaded, gradients, at = loaded_memory(data_address(scratch), C, nv, T)
        rows, y, stuck, part_mu, soft, _, index = loaded
        rows_, y_, part_target_, part_mu_, part_soft_ = gradients
        normal, tangents, free, mass = bare(normal), bare(tangents), bare(free), bare(mass)
        velocity_, free_, mass_ = bare(velocity_), bare(free_), bare(mass_)
        for b in range(B):
            if not flags[b, 0]:
                continue
            free_[b] = velocity_[b]
            K = 0
            for i in range(C):
                if load[b, i] > 0.0:
                    index[K], stuck[K], part_mu[K], soft[K] = i, sticks[b, i], mu[b, i], compliance[b, i]
                    rows[w * K], y[w * K], y_[w * K] = normal[b, i], load[b, i], load_[b, i]
                    for t in range(T):
                        rows[w * K + 1 + t] = tangents[b, i, t]
                        y[w * K + 1 + t], y_[w * K + 1 + t] = friction[b, i, t], friction_[b, i, t]
                    K += 1
            if K == 0:
                continue
            pull_back_contacts(
                UNKNOWN, K, T, nv, rows, y, stuck, part_mu, soft, free[b], mass[b], velocity_[b], y_, at, free_[b],
                rows_, part_target_, part_mu_, part_soft_, mass_[b],
            )  # fmt: skip
            for i in range(K):
                j = index[i]
                target_[b, j], mu_[b, j], compliance_[b, j] = part_target_[i], part_mu_[i], part_soft_[i]
                normal_[b, j] = rows_[w * i]
                for t in range(T):
                    tangents_[b, j, t] = rows_[w * i + 1 + t]

    return compiled(_pull_back_all, cached=True)


_solve_all = _make_solve_all(fingerprint())
_pull_back_all = _make_pull_back_all(fingerprint())


@cache
def contacts_address() -> int:
    """Where the compiled solver of contacts is; called as `_solve_all` is."""
    one, row, rows = np.ones((1, 1)), np.ones((1, 1, 1)), np.ones((1, 1, 1, 1))
    modes, flags = np.ones((1, 1), np.int64), np.ones((1, 1), np.bool_)
    return address_of(
        _solve_all, solver_address(), True, np.ones(1), one, row, rows, one, one, one, one, one, one, row, modes, flags,
        flags,
    )  # fmt: skip


class Solved(NamedTuple):
    """Numpy arrays of what is found; flags [B, 3] are solved, settled, at rest. Other shapes as in `ContactStep`."""

    velocity: np.ndarray
    load: np.ndarray
    friction: np.ndarray
    modes: np.ndarray
    sticks: np.ndarray
    flags: np.ndarray


def solve(problem: Problem, rest: bool) -> ContactStep:
    """The step of a batch, differentiable."""
    if torch.is_grad_enabled() and any(x.requires_grad for x in problem):
        velocity, load, friction, modes, _, flags = _Contacts.apply(rest, *problem)
    else:
        velocity, load, friction, modes, _, flags = map(torch.from_numpy, _solve(_arrays(problem), rest))
    solved, settled, at_rest = flags.unbind(-1)
    return ContactStep(velocity, load, friction, modes, at_rest, solved, settled)


def _arrays(problem: Iterable[Tensor]) -> list[np.ndarray]:
    return [x.detach().contiguous().numpy() for x in problem]


def _solve(problem: Sequence[np.ndarray], rest: bool) -> Solved:
    target, _, tangents, *_, free, _ = problem
    found = Solved(
        np.empty_like(free), np.empty_like(target), np.empty(tangents.shape[:3]), np.empty(target.shape, np.int64),
        np.empty(target.shape, np.bool_), np.empty((len(free), 3), np.bool_),
    )  # fmt: skip
    _, C, _, nv = tangents.shape
    run, seconds = partial(_solve_all, solver_address(), rest), SECONDS * C
    by_slices(run, (*problem, *found), len(free), seconds, contact_scratch(C, nv))
    return found


class _Contacts(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rest: bool, *problem: Tensor) -> tuple[Tensor, ...]:
        ctx.given = _arrays(problem)
        ctx.found = _solve(ctx.given, rest)
        velocity, load, friction, *told = map(torch.from_numpy, ctx.found)
        ctx.save_for_backward(*problem, load, friction, *told[1:])
        ctx.mark_non_differentiable(*told)
        ctx.set_materialize_grads(False)
        return velocity, load, friction, *told

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        refuse_batched(x for x in gradients[:3] if x is not None)
        _ = ctx.saved_tensors  # raises where one was changed in place; the arrays are their memory
        given, (*known, _, sticks, flags) = ctx.given, ctx.found
        wanted = [
            np.zeros(x.shape) if g is None else g.contiguous().numpy()
            for g, x in zip(gradients[:3], known, strict=True)
        ]
        results = [np.zeros(x.shape) for x in given]
        _, C, T, nv = given[2].shape
        arrays, scratch = (*given[1:], *known[1:], sticks, flags, *wanted, *results), adjoint_scratch(C, nv, T)
        by_slices(_pull_back_all, arrays, len(given[0]), SECONDS * C, scratch)
        wants = ctx.needs_input_grad[1:]
        return (None, *(torch.from_numpy(x) if want else None for x, want in zip(results, wants, strict=True)))
