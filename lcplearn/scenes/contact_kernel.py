"""Contact steps on the CPU, compiled, one element after the other: what `contact.py` does in torch, without the calls.

Same rows, same iteration, same rest. The LCPs go to the layer's kernel by its address, so that it is compiled once.
"""

from functools import cache
from hashlib import sha256
from inspect import unwrap
from math import sqrt
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from torch import Tensor

from lcplearn.lcp import pivoting
from lcplearn.scenes.friction_lcp import CREEP, DEAD_ZONE, FULL_RANK, MAX_ITERATIONS, ROUNDING, SETTLED, Answer, Problem

LARGEST = 1.7976931348623157e308  # of all doubles
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz", "arcp"}}


def compiled(function: Any, cached: bool = False) -> Any:
    """numba.njit; with a cache if asked for and a cache folder can be written."""
    function = unwrap(function)  # in tests jaxtyping wraps every function
    try:
        return numba.njit(cache=cached, **_OPTIONS)(function)
    except RuntimeError:  # "cannot cache function: no locator available"
        return numba.njit(**_OPTIONS)(function)


def fingerprint(*files: str) -> str:
    """Of the sources of a compiled function: numba watches one file, but a closure's values are part of its key."""
    folder = Path(__file__).parent
    return sha256(b"".join((folder / name).read_bytes() for name in files)).hexdigest()


def address_of(function: Any) -> int:
    """Where the code of a compiled function is; it must have been called with one set of types."""
    (code,) = function.overloads.values()
    return int(code.library.get_pointer_to_function(code.fndesc.llvm_cfunc_wrapper_name))


def _call_code(_: Any, address: Any, arguments: Any) -> Any:
    """Call compiled code at an address with a tuple of arguments of the types that it was compiled for."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        values = cgutils.unpack_tuple(builder, args[1])
        kind = ir.FunctionType(ir.VoidType(), [x.type for x in values])
        builder.call(builder.inttoptr(args[0], kind.as_pointer()), values)
        return context.get_dummy_value()

    return types.void(address, arguments), codegen


call: Any = intrinsic(_call_code)


@cache
def solver_address() -> int:
    """Where the layer's compiled solver is."""
    M, q = torch.eye(2, dtype=torch.float64), -torch.ones(2, dtype=torch.float64)
    pivoting.solve_batch(M, q, single_precision=False, max_iter=None)
    return address_of(pivoting.solve_range)


@compiled
def _solve_lcp(address, n, M, q, scratch, out):
    """Whether M [n, n], q [n] was solved; z and w are the first 2 n numbers of out."""
    # z [n], w [n], certificate [n], basis [n] bytes in n words, residual, status, iterations
    at, word = out.ctypes.data, 8
    call(
        address,
        (
            1, n, False, M.ctypes.data, q.ctypes.data, 1e-10, False, -1, False, scratch, at, at + word * n,
            at + word * 3 * n, at + word * 4 * n, at + word * (4 * n + 1), at + word * (4 * n + 2), at + word * 2 * n,
        ),
    )  # fmt: skip
    return out[4 * n + 1 : 4 * n + 2].view(np.int64)[0] == 0


@compiled
def _delassus(rows, mass, free, count, nv, D, u):
    """D = J mass^-1 J' and u = J free, for the first count rows."""
    for i in range(count):
        s = 0.0
        for k in range(nv):
            s += rows[i, k] * free[k]
        u[i] = s
        for j in range(i + 1):
            s = 0.0
            for k in range(nv):
                s += rows[i, k] * rows[j, k] / mass[k]
            D[i, j] = D[j, i] = s


@compiled
def _rotate(D, u, axes, K, A, r):
    """D and u in rows n, t, s instead of n, x, y."""
    for i in range(3 * K):
        for j in range(K):
            A[i, j] = D[i, j]
            c, s = axes[j, 0], axes[j, 1]
            A[i, K + j] = c * D[i, K + j] + s * D[i, 2 * K + j]
            A[i, 2 * K + j] = c * D[i, 2 * K + j] - s * D[i, K + j]
    for i in range(K):
        c, s = axes[i, 0], axes[i, 1]
        r[i], r[K + i], r[2 * K + i] = u[i], c * u[K + i] + s * u[2 * K + i], c * u[2 * K + i] - s * u[K + i]
        for j in range(3 * K):
            x, y = A[K + i, j], A[2 * K + i, j]
            A[K + i, j], A[2 * K + i, j] = c * x + s * y, c * y - s * x


@compiled
def _cholesky(H, n):
    """Lower factor in place; whether H is positive definite."""
    for j in range(n):
        for i in range(j, n):
            s = H[i, j]
            for k in range(j):
                s -= H[i, k] * H[j, k]
            if i == j:
                if not s > 0.0:
                    return False
                H[j, j] = sqrt(s)
            else:
                H[i, j] = s / H[j, j]
    return True


@compiled
def _condense(A, r, root, K, H, X):
    """Eliminate the rows s, f_s = -X (f, 1): X = root (1 + root A_ss root)^-1 root (A_s., r_s)."""
    for i in range(K):
        for j in range(K):
            H[i, j] = root[i] * A[2 * K + i, 2 * K + j] * root[j] + (1.0 if i == j else 0.0)
    _cholesky(H, K)
    width = 2 * K + 1
    for c in range(width):
        for i in range(K):
            s = root[i] * (A[2 * K + i, c] if c < 2 * K else r[2 * K + i])
            for k in range(i):
                s -= H[i, k] * X[k, c]
            X[i, c] = s / H[i, i]
        for i in range(K - 1, -1, -1):
            s = X[i, c]
            for k in range(i + 1, K):
                s -= H[k, i] * X[k, c]
            X[i, c] = s / H[i, i]
        for i in range(K):
            X[i, c] *= root[i]
    for i in range(2 * K):
        for k in range(K):
            a = A[i, 2 * K + k]
            for j in range(2 * K):
                A[i, j] -= a * X[k, j]
            r[i] -= a * X[k, 2 * K]


@compiled
def _cone_rows(A, r, target, mu, compliance, K, M_flat, q):
    """Rows lambda, a, sigma of `friction_lcp`, from A and r in rows n, t."""
    n = 3 * K
    M = M_flat[: n * n].reshape(n, n)
    M[:, :] = 0.0
    for i in range(2 * K):
        for j in range(K):
            M[i, j] = A[i, j] - A[i, K + j] * mu[j]
            M[i, K + j] = A[i, K + j]
    for i in range(K):
        M[i, i] += compliance[i]
        M[K + i, 2 * K + i] = 1.0
        M[2 * K + i, i] = 2.0 * mu[i]
        M[2 * K + i, K + i] = -1.0
        q[i], q[K + i], q[2 * K + i] = r[i] - target[i], r[K + i], 0.0


@compiled
def _apply(rows, mass, free, impulse, count, nv, v):
    for k in range(nv):
        s = 0.0
        for i in range(count):
            s += rows[i, k] * impulse[i]
        v[k] = free[k] + s / mass[k]


@compiled
def _mass_norm(mass, v, nv):
    s = 0.0
    for k in range(nv):
        s += mass[k] * v[k] * v[k]
    return sqrt(s)


@compiled
def _choose_axes(slip, friction, load, sticks, mu, scale, K, axes, root):
    """Facets along the slip or against the friction force, and the root of the weight across them."""
    for i in range(K):
        speed = sqrt(slip[i, 0] ** 2 + slip[i, 1] ** 2)
        creep = CREEP * scale[i]
        x, y = slip[i, 0], slip[i, 1]
        if sticks[i] or speed <= 10.0 * creep:
            x, y = -friction[i, 0], -friction[i, 1]
        length = sqrt(x * x + y * y)
        axes[i, 0], axes[i, 1] = (x / length, y / length) if length > 0.0 else (1.0, 0.0)
        floor = creep if sticks[i] else max(speed, creep)
        root[i] = sqrt(mu[i] * load[i] / floor) if floor > 0.0 else 0.0


@compiled
def _solve_cone(
    address, K, nv, rows, target, mu, compliance, free, mass, scale, numbers, v, load, friction, slip, sticks
):
    """Iterate the cone of K contacts; whether it was solved, and whether it settled."""
    D, A, H, X, M, q, u, r, axes, root, impulse, v_new, force, old_load, old_friction, scratch, out = numbers
    n = 3 * K
    _delassus(rows, mass, free, n, nv, D, u)
    for i in range(K):
        alone = D[i, i]
        load[i] = max(0.0, target[i] - u[i]) / alone
        friction[i, 0] = friction[i, 1] = 0.0
        slip[i, 0], slip[i, 1] = u[K + i], u[2 * K + i]
        sticks[i] = False
    v[:] = free
    size, old, was_damped = _mass_norm(mass, free, nv), np.inf, False
    solved = settled = False
    for iteration in range(MAX_ITERATIONS):
        _choose_axes(slip, friction, load, sticks, mu, scale, K, axes, root)
        _rotate(D, u, axes, K, A, r)
        _condense(A, r, root, K, H, X)
        _cone_rows(A, r, target, mu, compliance, K, M, q)
        solved = _solve_lcp(address, n, M, q, scratch, out)
        z, w = out[:n], out[n : 2 * n]
        for i in range(K):
            old_load[i], old_friction[i, 0], old_friction[i, 1] = load[i], friction[i, 0], friction[i, 1]
            load[i] = z[i]
            force[i], force[K + i] = z[i], z[K + i] - mu[i] * z[i]
        for i in range(K):
            s = -X[i, 2 * K]
            for j in range(2 * K):
                s -= X[i, j] * force[j]
            t, along = force[K + i], w[K + i] - z[2 * K + i]
            weight = root[i] * root[i]
            across = -s / (weight if weight > 0.0 else 1.0)
            c, e = axes[i, 0], axes[i, 1]
            friction[i, 0], friction[i, 1] = c * t - e * s, e * t + c * s
            slip[i, 0], slip[i, 1] = c * along - e * across, e * along + c * across
            sticks[i] = along == 0.0
            impulse[i], impulse[K + i], impulse[2 * K + i] = load[i], friction[i, 0], friction[i, 1]
        _apply(rows, mass, free, impulse, n, nv, v_new)
        change = 0.0
        for k in range(nv):
            change += mass[k] * (v_new[k] - v[k]) ** 2
        change = sqrt(change)
        settled = change <= SETTLED * (size + _mass_norm(mass, v_new, nv))
        if (settled and solved) or iteration == MAX_ITERATIONS - 1:
            break
        damped = change > 0.3 * old and iteration > 3 and not was_damped
        if damped:
            for k in range(nv):
                v_new[k] = 0.5 * (v[k] + v_new[k])
            for i in range(K):
                load[i] = 0.5 * (load[i] + old_load[i])
                friction[i, 0] = 0.5 * (friction[i, 0] + old_friction[i, 0])
                friction[i, 1] = 0.5 * (friction[i, 1] + old_friction[i, 1])
        v[:] = v_new
        old, was_damped = change, damped
    v[:] = v_new
    return solved, settled


@compiled
def _solve_plane(address, K, nv, T, rows, target, mu, compliance, free, mass, numbers, v, load, friction, slip, sticks):
    """The LCP of K contacts with at most one friction direction; whether it was solved."""
    D, M, q, u, impulse, scratch, out = (
        numbers[0], numbers[4], numbers[5], numbers[6], numbers[10], numbers[15], numbers[16]
    )  # fmt: skip
    count = (T + 1) * K
    _delassus(rows, mass, free, count, nv, D, u)
    if T == 0:
        n = K
        square = M[: n * n].reshape(n, n)
        for i in range(K):
            for j in range(K):
                square[i, j] = D[i, j]
            square[i, i] += compliance[i]
            q[i] = u[i] - target[i]
    else:
        n = 3 * K
        _cone_rows(D, u, target, mu, compliance, K, M, q)
    solved = _solve_lcp(address, n, M, q, scratch, out)
    for i in range(K):
        load[i] = impulse[i] = out[i]
        sticks[i] = False
        if T == 1:
            friction[i, 0] = impulse[K + i] = out[K + i] - mu[i] * out[i]
            slip[i, 0] = out[n + K + i] - out[2 * K + i]
            sticks[i] = slip[i, 0] == 0.0
    _apply(rows, mass, free, impulse, count, nv, v)
    return solved


@compiled
def _rests(C, nv, T, target, normal, tangents, compliance, mass, scale, v, load, sticks, gram):
    """As `contact._at_rest`."""
    if T == 0:
        return False
    gram[:, :] = 0.0
    held, whole_load = 0, 0.0
    for i in range(C):
        whole_load += load[i]
    for i in range(C):
        speed = 0.0
        for k in range(nv):
            speed += normal[i, k] * v[k]
        limit = DEAD_ZONE * scale[i] + compliance[i] * whole_load
        if not (abs(speed) <= limit and speed - target[i] <= limit):
            continue
        kept = 1 + (T if load[i] > 0.0 and sticks[i] else 0)
        held += kept
        for d in range(kept):
            row = normal[i] if d == 0 else tangents[i, d - 1]
            for k in range(nv):
                for j in range(k + 1):
                    gram[k, j] += row[k] * row[j] / sqrt(mass[k] * mass[j])
    if held < nv:
        return False
    largest = 0.0
    for k in range(nv):
        largest = max(largest, gram[k, k])
    for k in range(nv):
        gram[k, k] -= FULL_RANK * largest
    return _cholesky(gram, nv)


@compiled
def _workspace(C, nv, T):
    """Memory for an element with C contacts."""
    n = 3 * C
    return (
        np.empty((n, n)), np.empty((n, n)), np.empty((C, C)), np.empty((C, n)), np.empty(n * n), np.empty(n),
        np.empty(n), np.empty(n), np.empty((C, 2)), np.empty(C), np.empty(n), np.empty(nv), np.empty(n), np.empty(C),
        np.empty((C, 2)), np.empty(3 * n * n + 25 * n + 13), np.empty(4 * n + 8),
    )  # fmt: skip


@compiled
def _members(active, index):
    """Number of active contacts; their numbers go to index. Inlined, numba would compile for the count 0 apart."""
    count = 0
    for i in range(active.size):
        if active[i]:
            index[count] = i
            count += 1
    return count


@compiled
def _solve_element(
    address, C, nv, T, rest, target, normal, tangents, mu, compliance, free, mass, numbers, part, rows, index, active,
    gram, scale, v, load, friction, sticks,
):  # fmt: skip
    """Solve the contacts of one element: solved, settled, at rest. What is not needed is left out, then checked."""
    part_target, part_mu, part_compliance, part_scale, part_load, part_friction, part_slip, part_sticks = part
    size = _mass_norm(mass, free, nv)
    finite, added = True, 0
    for i in range(C):
        speed, alone = 0.0, 0.0
        for k in range(nv):
            speed += normal[i, k] * free[k]
            alone += normal[i, k] ** 2 / mass[k]
        scale[i] = sqrt(alone) * size
        load[i], sticks[i] = 0.0, False
        for d in range(T):
            friction[i, d] = 0.0
        active[i] = speed - target[i] < 0.0
        added += active[i]
        finite = finite and abs(speed - target[i]) <= LARGEST
    v[:] = free
    solved, settled = finite, True
    while added > 0:
        K = _members(active, index)
        for i in range(K):
            j = index[i]
            part_target[i], part_mu[i], part_compliance[i], part_scale[i] = target[j], mu[j], compliance[j], scale[j]
            for k in range(nv):
                rows[i, k] = normal[j, k]
                for d in range(T):
                    rows[(d + 1) * K + i, k] = tangents[j, d, k]
        if T == 2:
            solved, settled = _solve_cone(
                address, K, nv, rows, part_target, part_mu, part_compliance, free, mass, part_scale, numbers, v,
                part_load, part_friction, part_slip, part_sticks,
            )  # fmt: skip
        else:
            solved = _solve_plane(
                address, K, nv, T, rows, part_target, part_mu, part_compliance, free, mass, numbers, v, part_load,
                part_friction, part_slip, part_sticks,
            )  # fmt: skip
            settled = solved
        for i in range(K):
            j = index[i]
            load[j], sticks[j] = part_load[i], part_sticks[i]
            for d in range(T):
                friction[j, d] = part_friction[i, d]
        added = 0
        for i in range(C):
            speed = 0.0
            for k in range(nv):
                speed += normal[i, k] * v[k]
            finite = finite and abs(speed) <= LARGEST
            if not active[i] and speed - target[i] < -ROUNDING * scale[i]:
                active[i] = True
                added += 1
    solved = solved and finite
    at_rest = (
        rest
        and solved
        and settled
        and _rests(C, nv, T, target, normal, tangents, compliance, mass, scale, v, load, sticks, gram)
    )
    return solved, settled, at_rest


@compiled
def _parts(C):
    """Memory for the contacts that an element needs."""
    return (
        np.empty(C), np.empty(C), np.empty(C), np.empty(C), np.empty(C), np.empty((C, 2)), np.empty((C, 2)),
        np.empty(C, np.bool_),
    )  # fmt: skip


def _make_solve_all(sources: str) -> Any:
    def _solve_all(
        address, rest, target, normal, tangents, mu, compliance, free, mass, velocity, load, friction, sticks, flags
    ):
        sources  # noqa: B018, for the cache
        B, C, nv = normal.shape
        T = tangents.shape[2]
        numbers, part = _workspace(C, nv, T), _parts(C)
        rows, index, active = np.empty((3 * C, nv)), np.empty(C, np.int64), np.empty(C, np.bool_)
        gram, scale = np.empty((nv, nv)), np.empty(C)
        for b in range(B):
            flags[b, 0], flags[b, 1], flags[b, 2] = _solve_element(
                address, C, nv, T, rest, target[b], normal[b], tangents[b], mu[b], compliance[b], free[b], mass[b],
                numbers, part, rows, index, active, gram, scale, velocity[b], load[b], friction[b], sticks[b],
            )  # fmt: skip

    return compiled(_solve_all, cached=True)


_solve_all = _make_solve_all(fingerprint("contact_kernel.py", "friction_lcp.py"))


@cache
def contacts_address() -> int:
    """Where the compiled solver of contacts is; called as `_solve_all` is."""
    one, row, rows = np.ones((1, 1)), np.ones((1, 1, 1)), np.ones((1, 1, 1, 1))
    flags = np.empty((1, 3), np.bool_)
    _solve_all(
        solver_address(), True, -one, row, rows, one, one, one, one, one.copy(), one.copy(), row.copy(),
        flags[:, :1].copy(), flags,
    )  # fmt: skip
    return address_of(_solve_all)


def solve(problem: Problem, rest: bool) -> tuple[Answer, Tensor]:
    """What `contact.find` gives in torch: the answer, and where it is at rest."""
    target, normal, tangents, mu, compliance, free, mass = (x.detach().contiguous().numpy() for x in problem)
    velocity, load = np.empty_like(free), np.empty_like(target)
    friction, sticks = np.empty(tangents.shape[:3]), np.empty(target.shape, np.bool_)
    flags = np.empty((len(free), 3), np.bool_)
    _solve_all(
        solver_address(), rest, target, normal, tangents, mu, compliance, free, mass, velocity, load, friction, sticks,
        flags,
    )  # fmt: skip
    solved, settled, at_rest = torch.from_numpy(flags).unbind(-1)
    v, loads, forces, stuck = (torch.from_numpy(x) for x in (velocity, load, friction, sticks))
    slip = torch.full_like(forces, torch.nan)  # nobody asks
    return Answer(v, loads, forces, slip, stuck, solved, settled), at_rest
