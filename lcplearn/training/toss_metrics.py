"""How far predicted tosses of a cube are from recorded ones: the figures of ContactNets, and a few more.

With recorded positions p and rotations R, predicted ones p^ and R^, the T rows of a toss (row 0 included) and corners
c_i = (+-h, +-h, +-h) of the published cube of half width h:

    position integral      100 / 2h   mean_t |p^ - p|                            percent of the cube's width
    rotation integral      180 / pi   mean_t angle(R^T R^)                       degrees
    penetration integral   100 / 2h   mean_t max(0, -min_i (p^ + R^ c_i)_z)      percent of the cube's width

The cube's symmetry is not used: its faces are tagged. A few tosses that come to rest on another face dominate the
means, so medians stand beside them. Source: Pfrommer, Halm, Posa, "ContactNets", CoRL 2020, figure 5.
"""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lcplearn.scenes.space import POSE, rotation_matrix

HORIZONS = (1, 4, 16, 32)  # steps after which restarted rollouts are compared
BOARD = -0.035  # [half widths] where the board is, seen from the recorded cubes at rest: not at z = 0
REST_SPEED = 0.5  # [half widths/s] and [rad/s]: every recorded toss is slower at its last row
CONTACT_HEIGHT = 0.05  # [half widths] above the board: with a corner below this a row counts as in contact
ON_FACE = math.cos(math.radians(10.0))  # tilt within which a cube lies on a face


class Summary(NamedTuple):
    """One figure over tosses."""

    mean: float
    median: float
    standard_error: float


def score_tosses(
    recorded: Float[Tensor, "N rows 13"],
    predicted: Float[Tensor, "N rows 13"],
    steps: Int[Tensor, " N"],
    half_width: float,
) -> dict[str, Float[Tensor, " N"]]:
    """All figures of whole tosses, by name with unit, a value for each toss.

    Args:
        recorded: Recorded states in SI units, padded after `steps`.
        predicted: Predicted ones, from row 0 of the recorded.
        steps: Steps of each toss.
        half_width: Half of the cube's width [m].
    """
    rows = torch.arange(recorded.shape[1]) <= steps[:, None]
    percent = 50.0 / half_width
    distance, angle = pose_errors(recorded, predicted)
    lowest, lowest_recorded = (lowest_corner(state, half_width) for state in (predicted, recorded))
    depth, depth_recorded = (-lowest).clamp(min=0.0), (-lowest_recorded).clamp(min=0.0)
    below_board = (BOARD * half_width - lowest).clamp(min=0.0)
    penetration, penetration_recorded = (percent * _mean(value, rows) for value in (depth, depth_recorded))
    end = torch.arange(len(steps)), steps
    face, cosine = _lower_face(predicted[end])
    face_recorded, _ = _lower_face(recorded[end])
    return {
        "position integral [% width]": percent * _mean(distance, rows),
        "rotation integral [deg]": _mean(angle, rows),
        "penetration integral [% width]": penetration,
        "penetration integral beyond the recorded [% width]": penetration - penetration_recorded,
        "penetration integral below the board [% width]": percent * _mean(below_board, rows),
        "largest penetration beyond the recorded [% width]": percent
        * (_largest(depth, rows) - _largest(depth_recorded, rows)),
        "end position error [% width]": percent * distance[end],
        "end rotation error [deg]": angle[end],
        "same face down at the end [share]": ((face == face_recorded) & (cosine > ON_FACE)).double(),
        "at rest at the end [share]": _at_rest(predicted[end], half_width).double(),
        "exactly at rest at the end [share]": (predicted[end][:, 7:] == 0.0).all(-1).double(),
    }


def score_restarts(
    rollout: Callable[[Float[Tensor, "B 13"], int], Float[Tensor, "B rows 13"]],
    recorded: Float[Tensor, "N rows 13"],
    steps: Int[Tensor, " N"],
    half_width: float,
) -> dict[str, Float[Tensor, " M"]]:
    """Errors h steps after a start at recorded rows 0, h, 2h, ...; for h = 1 also those of the velocity in contact.

    One-step errors do not rank systems: models with almost equal ones differ by half in rollouts, as friction at impact
    and friction in sliding make up for each other within a step. A network without contact has the smallest of all.

    Args:
        rollout: States from a start, over a number of steps.
        recorded, steps, half_width: As in `score_tosses`.

    Returns:
        By name with unit, a value for each restart.
    """
    percent, found = 50.0 / half_width, {}
    for horizon in HORIZONS:
        toss, row = torch.nonzero(torch.arange(0, recorded.shape[1]) + horizon <= steps[:, None], as_tuple=True)
        kept = row % horizon == 0
        toss, row = toss[kept], row[kept]
        before, after = recorded[toss, row], recorded[toss, row + horizon]
        reached = rollout(before, horizon)[:, -1]
        distance, angle = pose_errors(after, reached)
        name = "step" if horizon == 1 else "steps"
        found[f"position error after {horizon} {name} [% width]"] = percent * distance
        found[f"rotation error after {horizon} {name} [deg]"] = angle
        if horizon == 1:
            near = (BOARD + CONTACT_HEIGHT) * half_width
            touches = torch.minimum(lowest_corner(before, half_width), lowest_corner(after, half_width)) < near
            error = (reached - after)[touches]
            found["one-step velocity error in contact [m/s]"] = error[:, 7:10].norm(dim=-1)
            found["one-step angular velocity error in contact [rad/s]"] = error[:, 10:].norm(dim=-1)
    return found


def pose_errors(a: Float[Tensor, "*batch 13"], b: Float[Tensor, "*batch 13"]) -> tuple[Tensor, Tensor]:
    """Distance [m] and angle [deg] between the poses of two states."""
    difference = POSE.difference(b[..., :7], a[..., :7])
    return difference[..., :3].norm(dim=-1), torch.rad2deg(difference[..., 3:].norm(dim=-1))


def summarise(values: Float[Tensor, " N"]) -> Summary:
    """Mean, median and standard error of the mean (NaN for a single value, or where a value is not finite)."""
    error = float(values.std() / math.sqrt(len(values))) if len(values) > 1 else math.nan
    return Summary(float(values.mean()), float(values.quantile(0.5)), error)


def paired_difference(
    a: Float[Tensor, " N"], b: Float[Tensor, " N"], *, draws: int = 2000, seed: int = 0
) -> tuple[float, float, float]:
    """Mean of a - b over the same tosses, with its 95 % interval by resampling tosses (percentile bootstrap)."""
    difference = a - b
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randint(len(difference), (draws, len(difference)), generator=generator)
    low, high = difference[chosen].mean(1).quantile(torch.tensor([0.025, 0.975], dtype=difference.dtype)).tolist()
    return float(difference.mean()), low, high


def format_scores(scores: Mapping[str, Float[Tensor, " N"]]) -> str:
    """A table of means, medians and standard errors."""
    lines = [f"{'':<54}{'mean':>10}{'median':>10}{'std. error':>12}{'of':>8}"]
    for name, values in scores.items():
        mean, median, error = summarise(values)
        lines.append(f"{name:<54}{mean:>10.3f}{median:>10.3f}{error:>12.3f}{len(values):>8}")
    return "\n".join(lines)


def lowest_corner(state: Float[Tensor, "*batch 13"], half_width: float) -> Float[Tensor, "*batch"]:
    """Height over z = 0 of the cube's lowest corner: |R_z1| + |R_z2| + |R_z3| half widths below the centre."""
    up = rotation_matrix(_unit(state))[..., 2, :]
    return state[..., 2] - half_width * up.abs().sum(-1)


def _lower_face(state: Float[Tensor, "N 13"]) -> tuple[Tensor, Tensor]:
    """Number of the face that looks down most, 0 to 5, and the cosine of its tilt."""
    up = rotation_matrix(_unit(state))[:, 2]
    cosine, axis = up.abs().max(-1)
    return 2 * axis + (up.gather(1, axis[:, None])[:, 0] > 0.0), cosine


def _at_rest(state: Float[Tensor, "N 13"], half_width: float) -> Bool[Tensor, " N"]:
    return (state[:, 7:10].norm(dim=-1) < REST_SPEED * half_width) & (state[:, 10:].norm(dim=-1) < REST_SPEED)


def _unit(state: Float[Tensor, "*batch 13"]) -> Float[Tensor, "*batch 4"]:
    quaternion = state[..., 3:7]
    return quaternion / quaternion.norm(dim=-1, keepdim=True)


def _mean(values: Float[Tensor, "N T"], rows: Bool[Tensor, "N T"]) -> Float[Tensor, " N"]:
    return torch.where(rows, values, 0.0).sum(-1) / rows.sum(-1)


def _largest(values: Float[Tensor, "N T"], rows: Bool[Tensor, "N T"]) -> Float[Tensor, " N"]:
    return torch.where(rows, values, 0.0).amax(-1)
