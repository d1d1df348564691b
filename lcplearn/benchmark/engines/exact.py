"""Exact solutions of rigid bodies with Coulomb's friction, in closed form: nothing here simulates.

Each function takes times [T] and a friction coefficient and returns positions. Real arithmetic only decides which phase
a motion is in, so that a complex mu = mu + ih gives the derivative with respect to mu, to rounding (`slope`).
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

GRAVITY = 9.81  # [m/s^2]
LIES = 1.0  # [s] long after a box of 20 cm has fallen on its face
Solution = Callable[[np.ndarray, Any], np.ndarray]
_COMPLEX_STEP = 1e-30


def slope(solution: Solution, times: np.ndarray, mu: float) -> np.ndarray:
    """Derivative of positions with respect to mu, by a complex step."""
    return np.asarray(solution(times, mu + 1j * _COMPLEX_STEP)).imag / _COMPLEX_STEP


def rest(times: np.ndarray, mu: Any) -> np.ndarray:
    """A body that friction holds: [T, 1] zeros."""
    return np.zeros((len(times), 1)) * (0.0 * mu)


def pushed(times: np.ndarray, mu: Any, *, speed: float, pushes: Sequence[tuple[float, float]]) -> np.ndarray:
    """A block on level ground that slides along a line: [T, 1] m.

    Args:
        times: [s], ascending.
        mu: Friction coefficient.
        speed: At the start [m/s].
        pushes: (until [s], force over mass [m/s^2]), one after the other; after the last nothing pushes.
    """
    x, v, begin = 0.0 * mu, speed + 0.0 * mu, 0.0 * mu
    path = np.zeros(len(times), dtype=np.result_type(mu, 1.0))
    for until, push in (*pushes, (np.inf, 0.0)):
        # At most two phases: moving until it stops (if it does), then at rest or moving the other way.
        for _ in range(3):
            friction = mu * GRAVITY
            if np.real(v) == 0.0 and abs(push) <= np.real(friction):
                a, v, end = 0.0 * mu, 0.0 * mu, until + 0.0 * mu
            else:
                direction = np.sign(np.real(v)) or np.sign(push)
                a = push - direction * friction
                stop = -v / a if np.real(v) * np.real(a) < 0.0 else np.inf
                end = begin + stop if np.real(begin + stop) < until else until + 0.0 * mu
            now = (times >= np.real(begin)) & (times <= np.real(end))
            after = times[now] - begin
            path[now] = x + v * after + 0.5 * a * after**2
            if np.isinf(np.real(end)):
                return path[:, None]
            passed = end - begin
            stopped = np.real(end) < until and np.real(v) != 0.0
            x, v, begin = x + v * passed + 0.5 * a * passed**2, 0.0 * mu if stopped else v + a * passed, end
            if np.real(end) == until:
                break
    return path[:, None]


def slide_across_slope(times: np.ndarray, mu: Any, *, speed: float, angle: float) -> np.ndarray:
    """A block that starts sliding along the contour of a slope and curves down to a stop: [T, 2] m, across and down.

    With a = g sin(angle), p = mu g cos(angle) > a and k = p / a, the velocity at the angle phi from the downhill
    direction is, with u = tan(phi / 2),

        |v| = speed u^k / sin(phi),     t = speed / (2 a) [u^(k - 1) / (k - 1) + u^(k + 1) / (k + 1)] from u to 1,

    and positions are integrals of powers of u. It stops at u = 0, after speed p / (p^2 - a^2).
    """
    a = GRAVITY * np.sin(angle)
    k = mu * np.cos(angle) / np.sin(angle)

    def rest_of(u: Any, power: Any) -> Any:
        """Integral of u^(power - 1) from u to 1."""
        return (1 - np.where(u == 0.0, 0.0, np.where(u == 0.0, 1.0, u) ** power)) / power

    def time(u: Any) -> Any:
        return speed / (2 * a) * (rest_of(u, k - 1) + rest_of(u, k + 1))

    def rate(u: Any) -> Any:
        return -speed / (2 * a) * (u ** (k - 2) + u**k)

    low, high = np.zeros(len(times)), np.ones(len(times))
    for _ in range(200):  # time falls as u grows
        middle = 0.5 * (low + high)
        late = np.real(time(middle)) > times
        low, high = np.where(late, middle, low), np.where(late, high, middle)
    moving = times < np.real(time(np.zeros(1)))
    u = np.where(moving, 0.5 * (low + high), 0.0) + 0.0 * k
    # One step of Newton carries the derivative of u with respect to mu.
    u[moving] -= (time(u[moving]) - times[moving]) / rate(u[moving])
    down = speed**2 / (4 * a) * (rest_of(u, 2 * k - 2) - rest_of(u, 2 * k + 2))
    across = speed**2 / (2 * a) * (rest_of(u, 2 * k - 1) + rest_of(u, 2 * k + 1))
    return np.stack((across, down), axis=-1)


def bounce(times: np.ndarray, mu: Any, *, height: float, restitution: float) -> np.ndarray:
    """Gap under a ball that is dropped and bounces, at rest after infinitely many bounces: [T, 1] m."""
    fall = np.sqrt(2 * height / GRAVITY)
    gap = height - 0.5 * GRAVITY * times**2
    begin, up = fall, restitution * GRAVITY * fall
    while up > 1e-12:
        after = times - begin
        gap = np.where(after >= 0.0, up * after - 0.5 * GRAVITY * after**2, gap)
        begin, up = begin + 2 * up / GRAVITY, restitution * up
    return np.where(times >= begin, 0.0, gap)[:, None] * (1.0 + 0.0 * mu)


def onto_an_edge(times: np.ndarray, mu: Any, *, half_width: float, half_height: float, tilt: float) -> np.ndarray:
    """Where the centre of a box ends, along the ground, that is dropped on an edge: [T, 1] m, NaN before `LIES`.

    The edge sticks where it lands (plastic impact, enough friction), the box pivots about it and lies down. As it is
    flat, half_width^2 > 2 half_height^2, the second impact ends all motion (Housner 1963). Its end is the edge's place
    plus half a width, whatever happens in between; see `edge_friction`.
    """
    ahead = half_width * np.cos(tilt) - half_height * np.sin(tilt)  # of the edge is the centre when it lands
    path = np.full((len(times), 1), np.nan) * (1.0 + 0.0 * mu)
    path[times >= LIES] = half_width - ahead
    return path


def edge_friction(*, half_width: float, half_height: float, tilt: float, drop: float) -> float:
    """The friction coefficient that the edge of `onto_an_edge` needs to stick: at both impacts and as it pivots."""
    if half_width**2 <= 2 * half_height**2:
        raise ValueError(f"half_height: expected less than {half_width / np.sqrt(2)}, got {half_height}: it would rock")
    square = half_width**2 + half_height**2
    about_edge = square * 4 / 3  # moment of inertia over mass

    def arm(phi: Any) -> tuple[Any, Any]:
        return (
            half_width * np.cos(phi) - half_height * np.sin(phi),
            half_width * np.sin(phi) + half_height * np.cos(phi),
        )

    ahead, above = arm(tilt)
    landing = ahead * above / (about_edge - ahead**2)
    spin = ahead * np.sqrt(2 * GRAVITY * drop) / about_edge
    x, z = arm(np.linspace(tilt, 0.0, 1000))
    spin2 = spin**2 + 2 * GRAVITY * (above - z) / about_edge
    turn = GRAVITY * x / about_edge  # angular acceleration, which lowers the far side
    along, up = turn * z - spin2 * x, -turn * x - spin2 * z
    pivoting = np.abs(along) / (up + GRAVITY)
    return float(max(landing, pivoting.max(), half_height / half_width)) if (up + GRAVITY > 0).all() else np.inf
