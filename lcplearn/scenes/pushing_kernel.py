"""Steps of a push on the CPU, compiled, one element after the other: what `pushing_step.settle_by_lcp` does in torch.

Same linearised friction, same iteration. The LCP of `aligned_lcp` is condensed to the twist V, the normal and the
tangential force p and tau of the finger, f = p n + tau t. Where it is known which supports creep and which slide along
their facets t_i, and what the finger does, it is linear:

    S V - G (p, tau) = creep wrench - sum_i side_i limit_i t_i        S = sum_i (creeps) t_i t_i' + weight_i s_i s_i'
    sticks: N V = the finger's step;    slides: normal row of that, tau = -+mu p;    away: p = tau = 0

Here G = N' - sum_i side_i t_i (what f adds to limit_i). Supports and finger change their state until all inequalities
of the LCP hold. An element whose states do not come to rest is reported, for the LCP solver.
"""

from math import sqrt

import numpy as np

from lcplearn.lcp.kernel.jit import LARGEST
from lcplearn.scenes.contact_kernel.compiling import compiled
from lcplearn.scenes.pushing_lcp import SMALLEST_LOAD
from lcplearn.scenes.pushing_step import DAMP_FROM, SETTLED

ROUNDS = 20  # changes of state in one LCP, the latter half of them one by one, before it is left to the solver
ROUNDING = 1e-12  # of velocities and scaled forces, which are of order 1
AWAY, STICKS, SLIDES = 0, 2, 1  # what the finger does; -SLIDES: friction against its tangent


@compiled
def _row(x, y, u, v, row):
    """As `pushing_lcp._rows`: the direction (u, v) at the point (x, y)."""
    row[0], row[1], row[2] = u, v, x * v - y * u


@compiled
def dot(a, b):
    """Of the first three numbers."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def linearise(points, loads, transfer, slip, load, creep, along, across, weight, limit, passed, lifted):
    """As `aligned_lcp`: facet and curvature of each support's friction, scaled limit, what the finger adds to it."""
    smallest = 0.0
    for i in range(loads.size):
        smallest = max(smallest, SMALLEST_LOAD * loads[i])
    for i in range(loads.size):
        lifted[i] = load[i] < smallest
        limit[i] = creep * (smallest if lifted[i] else loads[i])
        passed[i, 0] = 0.0 if lifted[i] else transfer[i, 0]
        passed[i, 1] = 0.0 if lifted[i] else transfer[i, 1]
        borne, speed = creep * max(load[i], smallest), sqrt(slip[i, 0] ** 2 + slip[i, 1] ** 2)
        x, y = (slip[i, 0] / speed, slip[i, 1] / speed) if speed > 1e-12 else (1.0, 0.0)
        _row(points[i, 0], points[i, 1], x, y, along[i])
        _row(points[i, 0], points[i, 1], -y, x, across[i])
        weight[i] = borne / max(speed, borne)


@compiled
def equations(along, across, weight, limit, passed, side, finger, wrench, normal, tangent, arms, steps, mu, creep, A):
    """The linear equations A[:, :5] x = A[:, 5] of these states for x = (V, p, tau)."""
    A[:, :] = 0.0
    for a in range(3):
        A[a, 3], A[a, 4], A[a, 5] = -arms[0, a], -arms[1, a], creep * wrench[a]
    for i in range(weight.size):
        pull = side[i]
        by_normal = pull * (passed[i, 0] * normal[0] + passed[i, 1] * normal[1])
        by_tangent = pull * (passed[i, 0] * tangent[0] + passed[i, 1] * tangent[1])
        for a in range(3):
            A[a, 3] += by_normal * along[i, a]
            A[a, 4] += by_tangent * along[i, a]
            A[a, 5] -= pull * limit[i] * along[i, a]
            for b in range(3):
                A[a, b] += weight[i] * across[i, a] * across[i, b]
                if pull == 0:
                    A[a, b] += along[i, a] * along[i, b]
    for d in range(2):
        if finger == STICKS or (d == 0 and finger != AWAY):
            A[3 + d, :3] = arms[d]
            A[3 + d, 5] = steps[d]
        else:
            A[3 + d, 3 + d] = 1.0
            if d == 1:
                A[4, 3] = -finger * mu


@compiled
def eliminate(A, x):
    """Solve by Gauss with pivoting, in place; whether a pivot was left."""
    for k in range(5):
        best = k
        for i in range(k + 1, 5):
            if abs(A[i, k]) > abs(A[best, k]):
                best = i
        if not abs(A[best, k]) > 1e-15:
            return False
        for j in range(k, 6):
            A[k, j], A[best, j] = A[best, j], A[k, j]
        for i in range(k + 1, 5):
            factor = A[i, k] / A[k, k]
            for j in range(k + 1, 6):
                A[i, j] -= factor * A[k, j]
    for k in range(4, -1, -1):
        s = A[k, 5]
        for j in range(k + 1, 5):
            s -= A[k, j] * x[j]
        x[k] = s / A[k, k]
    return True


@compiled
def _improve(along, limit, passed, normal, tangent, arms, steps, mu, x, side, finger, one):
    """Change the states whose inequality x violates, or the first of them: how many there are, the finger's state."""
    f, g = x[3] * normal[0] + x[4] * tangent[0], x[3] * normal[1] + x[4] * tangent[1]
    violated = 0
    for i in range(side.size):
        most, speed = limit[i] + passed[i, 0] * f + passed[i, 1] * g, dot(along[i], x)
        state = side[i]
        if side[i] == 0 and abs(speed) > most + ROUNDING:
            state = 1 if speed > 0.0 else -1
        elif side[i] != 0 and (side[i] * speed < most - ROUNDING):
            state = 0
        if state != side[i]:
            if not (one and violated > 0):
                side[i] = state
            violated += 1
        elif most < -ROUNDING:
            violated += 1  # no friction fits a negative load: the finger must give way
    if one and violated > 0:
        return violated, finger
    p, tau, new = x[3], x[4], finger
    if finger == AWAY:
        if dot(arms[0], x) < steps[0] - ROUNDING:
            new = STICKS
    elif finger == STICKS:
        if abs(tau) > mu * p + ROUNDING:
            new = SLIDES if tau > 0.0 else -SLIDES
    elif p < -ROUNDING:
        new = AWAY
    elif finger * (steps[1] - dot(arms[1], x)) < -ROUNDING:
        new = STICKS
    return violated + int(new != finger), new


@compiled
def memory_of(K):
    """For an element with K supports."""
    return (
        np.empty((K, 3)), np.empty((K, 3)), np.empty(K), np.empty(K), np.empty((K, 2)), np.empty((2, 3)), np.empty(2),
        np.empty((5, 6)), np.empty((K, 2)), np.empty(K, np.bool_),
    )  # fmt: skip


@compiled
def place(point, normal, tangent, normal_step, tangent_step, arms, steps):
    """Write the finger's rows N and its step along them."""
    _row(point[0], point[1], normal[0], normal[1], arms[0])
    _row(point[0], point[1], tangent[0], tangent[1], arms[1])
    steps[0], steps[1] = normal_step, tangent_step


@compiled
def _solve(points, loads, transfer, wrench, normal, tangent, mu, creep, slip, load, side, finger, memory, x):
    """The LCP linearised at a slip and load, from the states given: whether it was solved, and the finger's state."""
    along, across, weight, limit, passed, arms, steps, A, _, lifted = memory
    linearise(points, loads, transfer, slip, load, creep, along, across, weight, limit, passed, lifted)
    for k in range(ROUNDS):
        equations(
            along, across, weight, limit, passed, side, finger, wrench, normal, tangent, arms, steps, mu, creep, A
        )
        if not eliminate(A, x):  # what slides all one way is held by nothing
            side[:], finger = 0, STICKS
            continue
        one = 2 * k >= ROUNDS
        violated, finger = _improve(along, limit, passed, normal, tangent, arms, steps, mu, x, side, finger, one)
        if violated == 0:
            return True, finger
    return False, finger


@compiled
def settle_element(
    points, loads, transfer, wrench, point, normal, tangent, normal_step, tangent_step, mu, creep, iterations, slip,
    load, side, memory, x,
):  # fmt: skip
    """Iterate one element; slip and load end as those that x was solved at: solved, settled, the finger's state.

    The velocity of the supports at x is left in the memory's last but one.
    """
    arms, steps, new, finger = memory[5], memory[6], memory[8], STICKS
    place(point, normal, tangent, normal_step, tangent_step, arms, steps)
    for i in range(loads.size):
        load[i] = loads[i]
        side[i] = 1 if slip[i, 0] ** 2 + slip[i, 1] ** 2 > (creep * loads[i]) ** 2 else 0
    before, last = np.inf, False
    for iteration in range(iterations):
        last = last or iteration == iterations - 1
        solved, finger = _solve(
            points, loads, transfer, wrench, normal, tangent, mu, creep, slip, load, side, finger, memory, x
        )
        change = 0.0
        for i in range(loads.size):
            new[i, 0], new[i, 1] = x[0] - x[2] * points[i, 1], x[1] + x[2] * points[i, 0]
            change += (new[i, 0] - slip[i, 0]) ** 2 + (new[i, 1] - slip[i, 1]) ** 2
        change = sqrt(change)
        if not change <= LARGEST or (last and not solved):
            return False, False, finger
        if last:
            return True, change < 10.0 * SETTLED, finger
        damp = iteration >= DAMP_FROM and change > 0.3 * before and change > SETTLED
        f = (x[3] * normal[0] + x[4] * tangent[0]) / creep
        g = (x[3] * normal[1] + x[4] * tangent[1]) / creep
        for i in range(loads.size):
            for d in range(2):
                slip[i, d] = 0.5 * (slip[i, d] + new[i, d]) if damp else new[i, d]
            load[i] = loads[i] + transfer[i, 0] * f + transfer[i, 1] * g
        last, before = solved and change < SETTLED, change
    return False, False, finger


@compiled
def finger_mode(x, finger):
    """`scene.Mode`."""
    if x[3] <= 0.0:
        return 2
    return 0 if finger == STICKS else 1
