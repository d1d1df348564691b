"""What models of pushes are judged by: end poses and forces against the recorded ones."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.datasets.pushes import PushData
from lcplearn.formulations.pushing.push_model import RADIUS, PushModel, PushPrediction
from lcplearn.training.figures_of_merit import figure


class PushErrors(NamedTuple):
    """Errors of each push, by the names of `figures_of_merit`; of forces where they are predicted and recorded."""

    values: dict[str, Float[Tensor, " b"]]

    def figures(self, rows: Tensor | None = None) -> dict[str, float]:
        """Mean errors (a median for the twist angle) over some pushes; all by default."""
        chosen = {name: value if rows is None else value[rows] for name, value in self.values.items()}
        return {
            name: float(value.median() if name == "twist_angle_deg" else value.mean()) for name, value in chosen.items()
        }


def errors(model: PushModel, data: PushData, prediction: PushPrediction) -> PushErrors:
    """Judge predictions of all pushes of `data`; a push whose prediction is not finite has infinite errors.

    Args:
        model: Whose object it is.
        data: What was recorded.
        prediction: What was predicted, push for push.
    """
    true = model.motion(data.pushes, data.outcome.pose)
    found = model.motion(data.pushes, prediction.pose)
    error = found - true
    values = {
        "deviation_mm": 1e3 * error.norm(dim=-1),
        "position_mm": 1e3 * error[:, :2].norm(dim=-1),
        "rotation_deg": torch.rad2deg(error[:, 2].abs() / RADIUS),
        "twist_angle_deg": _angle(found, true),
    }
    if prediction.force is not None and not bool(data.outcome.force.isnan().any()):
        values["force_direction_deg"] = _angle(prediction.force, data.outcome.force)
        values["force_size_n"] = (prediction.force.norm(dim=-1) - data.outcome.force.norm(dim=-1)).abs()
    return PushErrors({name: value.nan_to_num(torch.inf, torch.inf) for name, value in values.items()})


def intervals(found: PushErrors, data: PushData, *, draws: int = 1000, seed: int = 0) -> dict[str, tuple[float, float]]:
    """95 % bootstrap interval of each figure; pushes are drawn anew within each configuration."""
    generator = torch.Generator().manual_seed(seed)
    groups = [(data.configuration == k).nonzero()[:, 0] for k in data.configuration.unique()]
    drawn = []
    for _ in range(draws):
        rows = [group[torch.randint(len(group), (len(group),), generator=generator)] for group in groups]
        drawn.append(found.figures(torch.cat(rows)))
    bounds = torch.tensor((0.025, 0.975), dtype=torch.float64)
    return {
        name: tuple(torch.tensor([d[name] for d in drawn], dtype=torch.float64).quantile(bounds).tolist())
        for name in found.values
    }


def by_configuration(found: PushErrors, data: PushData) -> dict[str, dict[str, float]]:
    """Figures of each configuration that has pushes."""
    return {
        name: found.figures((data.configuration == k).nonzero()[:, 0])
        for k, name in enumerate(data.names)
        if bool((data.configuration == k).any())
    }


def format_score(
    figures: Mapping[str, float],
    spread: Mapping[str, tuple[float, float]],
    configurations: Mapping[str, Mapping[str, float]],
) -> str:
    """Two tables as text: all pushes with their intervals, and each configuration."""
    lines = [f"{'figure':<22}{'value':>9}   {'95 % interval':<16} meaning"]
    for name, value in figures.items():
        low, high = spread.get(name, (value, value))
        interval = f"{low:.4g} .. {high:.4g}" if math.isfinite(value) else "diverged"
        lines.append(f"{name:<22}{value:>9.4g}   {interval:<16} {figure(name).meaning}")
    width = max(len(name) for name in (*configurations, "configuration")) + 2
    lines += ["", f"{'configuration':<{width}}" + "".join(f"{name:>21}" for name in figures)]
    lines += [
        f"{name:<{width}}" + "".join(f"{values[key]:>21.4g}" for key in figures)
        for name, values in configurations.items()
    ]
    return "\n".join(lines)


def _angle(a: Tensor, b: Tensor) -> Tensor:
    """Degrees between vectors; a right angle where one is zero."""
    size = a.norm(dim=-1) * b.norm(dim=-1)
    cosine = (a * b).sum(-1) / torch.where(size == 0, 1.0, size)
    return torch.rad2deg(torch.where(size == 0, 0.0, cosine).clamp(-1.0, 1.0).acos())
