"""The tossed cube in MuJoCo, with published parameters or tuned on the tosses that others learn from."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from lcplearn.datasets.cube_tosses import Tosses
from lcplearn.training.toss_metrics import score_tosses

SUBSTEPS = 4


@dataclass(frozen=True)
class MujocoCube:
    """A box, or eight spheres at its corners, on a plane; soft contacts, the elliptic cone and the default solver.

    The default cone, a pyramid, loses friction off its axes: twice the position error.

    Attributes:
        mu: Friction coefficient.
        timeconst, dampratio: `solref` of the contacts [s, 1].
        width: `solimp` width [m].
        ground: Height of the plane, over the half width.
        inertia: Over mass times square of the half width.
        radius: Of the spheres, over the half width; None is a box.
    """

    mu: float = 0.18
    timeconst: float = 0.02
    dampratio: float = 1.0
    width: float = 0.001
    ground: float = -0.035
    inertia: float = 0.797
    radius: float | None = None

    def xml(self, tosses: Tosses) -> str:
        """The model, in MuJoCo's language."""
        h = tosses.half_width
        contact = f'friction="{self.mu} 0 0" solref="{self.timeconst} {self.dampratio}" solimp="0.9 0.95 {self.width}"'
        if self.radius is None:
            geoms = f'<geom type="box" size="{h} {h} {h}" mass="0" {contact}/>'
        else:
            place, size = h * (1.0 - self.radius), h * self.radius
            geoms = "".join(
                f'<geom type="sphere" size="{size}" pos="{x * place} {y * place} {z * place}" mass="0" {contact}/>'
                for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)
            )  # fmt: skip
        moment = self.inertia * tosses.mass * h**2
        return f"""<mujoco>
<option timestep="{tosses.dt / SUBSTEPS}" gravity="0 0 {-tosses.gravity}" cone="elliptic"/><worldbody>
<geom type="plane" size="0 0 1" pos="0 0 {self.ground * h}" {contact}/>
<body><freejoint/><inertial pos="0 0 0" mass="{tosses.mass}" diaginertia="{moment} {moment} {moment}"/>{geoms}</body>
</worldbody></mujoco>"""

    def rollout(self, tosses: Tosses, start: Float[Tensor, "B 13"], steps: int) -> Float[Tensor, "B rows 13"]:
        """States over a number of steps, each of four substeps.

        A recorded velocity is the mean over the step before. At the start it is brought to the last substep; afterwards
        it is the difference of positions.
        """
        import mujoco
        from mujoco.rollout import rollout

        model = mujoco.MjModel.from_xml_string(self.xml(tosses))
        fall = torch.zeros(13, dtype=torch.float64)
        fall[9] = -tosses.gravity * (tosses.dt - model.opt.timestep) / 2.0
        time = torch.zeros(len(start), 1, dtype=torch.float64)
        first = torch.cat((time, start + fall), dim=-1).numpy()
        states, _ = rollout(model, mujoco.MjData(model), first, nstep=steps * SUBSTEPS)
        path = torch.from_numpy(np.ascontiguousarray(states[:, SUBSTEPS - 1 :: SUBSTEPS, 1:]))
        path = torch.cat((start.unsqueeze(1), path), dim=1)
        path[:, 1:, 7:10] = (path[:, 1:, :3] - path[:, :-1, :3]) / tosses.dt
        return path


def tune(tosses: Tosses, chosen: list[int], start: MujocoCube, *, evaluations: int = 300) -> MujocoCube:
    """Parameters of least position plus rotation integral [% width, deg] on some tosses, by Nelder and Mead.

    All parameters that the start has are tuned; inertia only with spheres, where it helps.
    """
    from scipy.optimize import minimize

    names = ["mu", "timeconst", "dampratio", "width", "ground"]
    names += [] if start.radius is None else ["inertia", "radius"]
    states, steps = tosses.states[chosen], tosses.steps[chosen]
    first = np.array([asdict(start)[name] for name in names])
    scale = np.where(first == 0.0, 0.01, np.abs(first))

    def cube(point: np.ndarray) -> MujocoCube:
        values = dict(zip(names, (first + scale * point).tolist(), strict=True))
        return replace(start, **values)

    def cost(point: np.ndarray) -> float:
        candidate = cube(point)
        inside = min(candidate.mu, candidate.dampratio, candidate.width, candidate.inertia) > 0.0
        inside = inside and candidate.timeconst > 2.0 * tosses.dt / SUBSTEPS
        inside = inside and (candidate.radius is None or 0.0 < candidate.radius < 1.0)
        if not inside:
            return 1e3
        return objective(score(candidate.rollout, tosses, states, steps))

    simplex = np.vstack([np.zeros(len(names)), 0.3 * np.eye(len(names))])
    options = {"maxfev": evaluations, "initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-3}
    return cube(minimize(cost, np.zeros(len(names)), method="Nelder-Mead", options=options).x)


def score(
    rollout: Callable[[Tosses, Tensor, int], Tensor],
    tosses: Tosses,
    states: Float[Tensor, "N rows 13"],
    steps: Int[Tensor, " N"],
) -> dict[str, Tensor]:
    """Figures of whole tosses from row 0."""
    longest = int(steps.max())
    return score_tosses(states[:, : longest + 1], rollout(tosses, states[:, 0], longest), steps, tosses.half_width)


def objective(scores: Mapping[str, Tensor]) -> float:
    """Position integral [% width] plus rotation integral [deg]."""
    return float(scores["position integral [% width]"].mean() + scores["rotation integral [deg]"].mean())
