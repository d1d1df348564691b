"""Scratch memory of an element's contacts, cut into bare views (see `lcp/kernel/memory.py`).

To count references to arrays, and to ask for memory at each step, would take longer than a contact or two.
"""

import numba

from lcplearn.lcp.kernel.memory import address, integers, matrix, pointer, scratch_size, vector
from lcplearn.scenes.contact_kernel.compiling import compiled


@compiled
def bare(x):
    """A bare view of contiguous doubles."""
    return numba.carray(pointer(address(x), 0.0), x.shape)


@compiled
def bare_flags(x):
    """The same of booleans."""
    return numba.carray(pointer(address(x), False), x.shape)


@compiled
def row(at, n):
    """Numbers from an address on, and the address after them."""
    return vector(at, n), at + 8 * n


@compiled
def grid(at, m, n):
    """The same of a matrix."""
    return matrix(at, m, n), at + 8 * m * n


@compiled
def block(at, *shape):
    """The same with any number of dimensions."""
    x = numba.carray(pointer(at, 0.0), shape)
    return x, at + 8 * x.size


@compiled
def whole(at, n):
    """The same of integers."""
    return integers(at, n), at + 8 * n


@compiled
def flags(at, n):
    """The same of booleans."""
    return numba.carray(pointer(at, False), (n,)), at + 8 * n


def contact_scratch(C: int, nv: int) -> int:
    """Numbers of memory that the contacts of an element need, at most."""
    n = 3 * C
    return 5 * n * n + 3 * n * nv + nv * nv + nv + 30 * n + 16 + int(scratch_size.py_func(n))


@compiled
def modes_memory(at, C, nv):
    """What `settle_modes` works in."""
    n = 3 * C
    A, at = grid(at, n, n)
    left, at = grid(at, n, nv)
    right, at = grid(at, nv, n)
    b, at = row(at, n)
    soft, at = row(at, n)
    scales, at = row(at, n)
    x, at = row(at, n)
    y, at = row(at, n)
    order, at = whole(at, n)
    mobility, at = row(at, C)
    axes, at = grid(at, C, 2)
    weight, at = row(at, C)
    mode, _ = whole(at, C)
    return A, left, right, b, soft, scales, x, y, order, mobility, axes, weight, mode


@compiled
def cone_memory(at, C, nv):
    """What the LCPs of an element's contacts work in."""
    n = 3 * C
    D, at = grid(at, n, n)
    A, at = grid(at, n, n)
    H, at = grid(at, C, C)
    X, at = grid(at, C, n)
    M, at = row(at, n * n)
    q, at = row(at, n)
    u, at = row(at, n)
    r, at = row(at, n)
    impulse, at = row(at, n)
    force, at = row(at, n)
    axes, at = grid(at, C, 2)
    root, at = row(at, C)
    v_new, at = row(at, nv)
    old_load, at = row(at, C)
    old_friction, at = grid(at, C, 2)
    out, at = row(at, 4 * n + 8)
    soft, at = row(at, C)
    goal, at = row(at, C)
    scratch, _ = row(at, scratch_size(n))
    return D, A, H, X, M, q, u, r, axes, root, impulse, v_new, force, old_load, old_friction, scratch, out, soft, goal


@compiled
def element_memory(at, C, nv):
    """Of all contacts: which are needed, their numbers, sqrt of mobility, scale of speeds, and a matrix.

    Then of those that are needed: rows, target, mu, compliance, scale, load, friction, slip, sticks. What follows in
    memory is for their solution.
    """
    active, at = flags(at, C)
    index, at = whole(at, C)
    unit, at = row(at, C)
    scale, at = row(at, C)
    gram, at = grid(at, nv, nv)
    rows, at = grid(at, 3 * C, nv)
    target, at = row(at, C)
    mu, at = row(at, C)
    compliance, at = row(at, C)
    part_scale, at = row(at, C)
    load, at = row(at, C)
    friction, at = grid(at, C, 2)
    slip, at = grid(at, C, 2)
    sticks, at = flags(at, C)
    part = rows, target, mu, compliance, part_scale, load, friction, slip, sticks
    return (active, index, unit, scale, gram), part, at


def adjoint_scratch(C: int, nv: int, T: int) -> int:
    """Numbers of memory that the gradient of an element's contacts needs, at most."""
    n = (1 + T) * C
    return 2 * n * n + 3 * n * nv + 9 * n + 8 * C + 2 * nv


@compiled
def loaded_memory(at, C, nv, T):
    """Of the loaded contacts: rows, impulses, stick, mu, compliance, share of an impact, their numbers.

    Then gradients with respect to rows, impulses, target, mu and compliance. What follows is for `pull_back_contacts`.
    """
    n = (1 + T) * C
    rows, at = grid(at, n, nv)
    y, at = row(at, n)
    sticks, at = flags(at, C)
    mu, at = row(at, C)
    compliance, at = row(at, C)
    share, at = row(at, C)
    index, at = whole(at, C)
    rows_, at = grid(at, n, nv)
    y_, at = row(at, n)
    target_, at = row(at, C)
    mu_, at = row(at, C)
    compliance_, at = row(at, C)
    return (rows, y, sticks, mu, compliance, share, index), (rows_, y_, target_, mu_, compliance_), at


@compiled
def adjoint_memory(at, C, nv, T):
    """What `pull_back_contacts` works in."""
    n = (1 + T) * C
    slope, at = grid(at, n, n)
    right, at = grid(at, n, n)
    response, at = grid(at, n, nv)
    order, at = whole(at, n)
    scales, at = row(at, n)
    wanted, at = row(at, n)
    s, at = row(at, n)
    speed_gradient, at = row(at, n)
    slip, at = grid(at, C, T)
    unit, at = row(at, C)
    stuck, at = flags(at, C)
    push, at = row(at, nv)
    v, _ = row(at, nv)
    return slope, right, response, order, scales, wanted, s, speed_gradient, slip, unit, stuck, push, v


@compiled
def step_memory(at, C, nv):
    """What a step of contacts takes and gives, for a batch of one: see `steps._make_solve_all`."""
    target, at = block(at, 1, C)
    normal, at = block(at, 1, C, nv)
    tangents, at = block(at, 1, C, 2, nv)
    mu, at = block(at, 1, C)
    compliance, at = block(at, 1, C)
    free, at = block(at, 1, nv)
    mass, at = block(at, 1, nv)
    velocity, at = block(at, 1, nv)
    load, at = block(at, 1, C)
    friction, at = block(at, 1, C, 2)
    modes, at = numba.carray(pointer(at, 0), (1, C)), at + 8 * C
    sticks, at = numba.carray(pointer(at, False), (1, C)), at + 8 * C
    found = numba.carray(pointer(at, False), (1, 3))
    given, results = (target, normal, tangents, mu, compliance, free, mass), (velocity, load, friction, modes, sticks)
    return given, (*results, found), at + 8
