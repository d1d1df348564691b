"""All steps of a push on the CPU, compiled: what `PushedObject.rollout` does, where no gradient is asked for."""

from math import cos, sin, sqrt
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lcplearn.scenes.contact_kernel.compiling import compiled, fingerprint
from lcplearn.scenes.pushing_kernel import finger_mode, memory_of, settle_element
from lcplearn.scenes.pushing_lcp import Bearing
from lcplearn.scenes.pushing_node import as_array


@compiled
def _touch(corners, tangents, inward, x, y, point, normal, tangent):
    """As `PushedObject._touch`, for a finger at (x, y) in the object's axes: the gap."""
    edge, gap = 0, -np.inf
    for i in range(len(corners)):
        outside = -((x - corners[i, 0]) * inward[i, 0] + (y - corners[i, 1]) * inward[i, 1])
        if outside > gap:
            edge, gap = i, outside
    ax, ay = corners[edge]
    after = corners[(edge + 1) % len(corners)]
    span = sqrt((after[0] - ax) ** 2 + (after[1] - ay) ** 2)
    along = (x - ax) * tangents[edge, 0] + (y - ay) * tangents[edge, 1]
    nearest = min(max(along, 0.0), span)
    normal[0], normal[1] = inward[edge]
    if along != nearest and gap > 0.0:
        point[0], point[1] = ax + nearest * tangents[edge, 0], ay + nearest * tangents[edge, 1]
        gap = sqrt((point[0] - x) ** 2 + (point[1] - y) ** 2)
        normal[0], normal[1] = (point[0] - x) / gap, (point[1] - y) / gap
    else:
        point[0], point[1] = x + gap * normal[0], y + gap * normal[1]
    tangent[0], tangent[1] = normal[1], -normal[0]
    return gap


@compiled
def _turn(angle, x, y):
    c, s = cos(angle), sin(angle)
    return c * x - s * y, s * x + c * y


@compiled
def _roll_element(
    outline, points, loads, transfer, wrench, finger, stride, length, mu, creep, iterations, memory, state, track,
    forces, flags,
):  # fmt: skip
    """Fill track [S + 1, 3] from its first row on, forces [S, 2] and flags [S, 3]; stop at what is not solved."""
    slip, load, side, x, point, normal, tangent = state
    corners, tangents, inward = outline
    for step in range(len(forces)):
        cx, cy, angle = track[step]
        u, v = _turn(-angle, stride[0], stride[1])
        fx, fy = _turn(-angle, finger[0] + step * stride[0] - cx, finger[1] + step * stride[1] - cy)
        gap = _touch(corners, tangents, inward, fx, fy, point, normal, tangent)
        if step == 0:
            for i in range(loads.size):
                slip[i, 0], slip[i, 1] = u / length + 1e-3 * points[i, 0], v / length + 1e-3 * points[i, 1]
        solved, settled, does = settle_element(
            points, loads, transfer, wrench, point, normal, tangent, (u * normal[0] + v * normal[1] - gap) / length,
            (u * tangent[0] + v * tangent[1]) / length, mu, creep, iterations, slip, load, side, memory, x,
        )  # fmt: skip
        flags[step, 0], flags[step, 1], flags[step, 2] = solved, settled, finger_mode(x, does)
        if not (solved and settled):
            flags[step:, 0] = 0
            return
        slip[:, :] = memory[8]
        f, g = (x[3] * normal[0] + x[4] * tangent[0]) / creep, (x[3] * normal[1] + x[4] * tangent[1]) / creep
        forces[step, 0], forces[step, 1] = _turn(angle, f, g)
        dx, dy = _turn(angle + length * x[2] / 2.0, length * x[0], length * x[1])
        track[step + 1, 0], track[step + 1, 1], track[step + 1, 2] = cx + dx, cy + dy, angle + length * x[2]


def _make(sources: str) -> Any:
    def _roll(outline, points, loads, transfer, wrench, finger, stride, length, mu, creep, iterations, out):
        """Roll each element on from the first row of its track (place of the centre, angle), all free of units."""
        sources  # noqa: B018, for the cache
        track, forces, flags = out
        K = loads.shape[1]
        memory = memory_of(K)
        state = (
            np.empty((K, 2)), np.empty(K), np.empty(K, np.int64), np.empty(5), np.empty(2), np.empty(2), np.empty(2)
        )  # fmt: skip
        for b in range(len(loads)):
            _roll_element(
                outline, points[b], loads[b], transfer[b], wrench[b], finger[b], stride[b], length[b], mu[b], creep,
                iterations, memory, state, track[b], forces[b], flags[b],
            )  # fmt: skip

    return compiled(_roll, cached=True)


_roll = _make(fingerprint("pushing_lcp.py", "pushing_step.py", "pushing_kernel.py", "pushing_rollout.py"))


def roll(
    outline: tuple[Tensor, ...],
    bearing: Bearing,
    start: Tensor,
    finger: Tensor,
    stride: Tensor,
    length: Tensor,
    mu: Tensor,
    *,
    steps: int,
    creep: float,
    iterations: int,
) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
    """Track [b, S + 1, 3] of centre of mass and angle, forces [b, S, 2], whether solved and settled, and modes.

    A push ends at the first step that is not solved or does not settle.
    """
    batch = len(start)
    wrench = start.new_zeros(batch, 3) if bearing.wrench is None else bearing.wrench
    track, forces = np.full((batch, steps + 1, 3), np.nan), np.full((batch, steps, 2), np.nan)
    flags = np.zeros((batch, steps, 3), np.int64)
    track[:, 0] = start
    arrays = (as_array(x) for x in (*bearing[:3], wrench, finger, stride, length, mu))
    _roll(tuple(as_array(x) for x in outline), *arrays, creep, iterations, (track, forces, flags))
    solved, settled, mode = torch.from_numpy(flags).unbind(-1)
    return torch.from_numpy(track), torch.from_numpy(forces), (solved.bool(), settled.bool(), mode)
