"""A point mass that slides on a table in two directions: friction in a disc."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.domains import NOT_NEGATIVE, POSITIVE, Domain, check_numbers
from lcplearn.lcp.solution import LCPSolution
from lcplearn.lcp.solve import solve_lcp
from lcplearn.scenes.contact import Contacts, contact_step
from lcplearn.scenes.numbers import Number, as_tensor, matvec, stack_numbers
from lcplearn.scenes.scene import Drive, Mode, Moving, Step
from lcplearn.scenes.space import TABLE, Space


def slide_in_plane(p: Float[Tensor, "*#batch 2"], c: Float[Tensor, "*#batch"] | float) -> Float[Tensor, "..."]:
    """Velocity after isotropic friction has taken what it can: S(p, c) = p max(0, 1 - c / |p|).

    Args:
        p: Velocity without friction [m/s].
        c: Largest velocity change that friction can cause in one step, mu g dt [m/s]; >= 0.

    Returns:
        Next velocity [m/s]; exactly 0 where |p| <= c. At |p| = c the gradient is 0, that of stick. NaN stays NaN.
    """
    speed = torch.linalg.vector_norm(p, dim=-1)
    slides = ~(speed <= c)  # true of NaN, too: what is not known does not rest
    factor = 1.0 - c / torch.where(slides, speed, 1.0)
    return torch.where(slides.unsqueeze(-1), factor.unsqueeze(-1) * p, 0.0)


def facet_normals(m: int, like: Tensor) -> Float[Tensor, "2 m"]:
    """Directions of the m facets of a regular polygon around the unit disc."""
    angles = torch.arange(m, dtype=like.dtype, device=like.device) * (2.0 * math.pi / m)
    return torch.stack((angles.cos(), angles.sin()))


def slide_on_facets(
    p: Float[Tensor, "*#batch 2"], c: Float[Tensor, "*#batch"], m: int
) -> tuple[Float[Tensor, "..."], LCPSolution]:
    """As `slide_in_plane`, with a polygon of m facets in place of the disc; and the solution of its LCP."""
    N = facet_normals(m, p)
    solution = solve_lcp(N.mT @ N, c.unsqueeze(-1) - p @ N)
    return matvec(N, solution.z), solution


@dataclass(frozen=True)
class PlanarBlock(Moving):
    """A point mass on a table under a force in the table's plane.

    v' = argmin_v 1/2 |v - p|^2 in the metric of mass, + c |v|,    p = v + dt u / mass,    c = mu load dt.

    exact:        with one mass the closed form S(p, c); with two (along x and y) the cone of `contact_step`.
    facets:       the disc of friction forces as a polygon of m facets n_j (columns of N): z = speeds along the facets,
                  w = slack friction. 0 <= z ⟂ N' N z + (c / mass - N' p) >= 0, v' = N z. m rows, sticks iff q >= 0.
    traditional:  the same polygon by its m vertices and a bound gamma on the speed, m + 1 rows.

    A polygon's error is 0.18, 0.085, 0.041 c (rms) at m = 8, 16, 32, and its velocity is a staircase in mu: don't
    differentiate it.

    Attributes:
        mass: [kg], one number, or a tuple of two: a mass along x and one along y.
        mu: Friction coefficient; >= 0.
        dt: Step size [s].
        gravity: [m/s^2]; the load is mass gravity, of the mean of two masses.
        form: Which of the three.
        m: Number of facets.

    Gradient: Of the exact forms, with respect to the state, the force and all numbers; at the change of stick and slip
        that of one side.

    Status: `Step.solved`; None for the closed form, which solves nothing.

    Raises:
        ValueError: A number is out of its domain, or form does not fit mass and m.

    Source: NOTES 5.7.
    """

    numbers: ClassVar[Mapping[str, Domain]] = {"mass": POSITIVE, "mu": NOT_NEGATIVE, "gravity": NOT_NEGATIVE}

    mass: Number | tuple[Number, Number]
    mu: Number
    dt: float
    gravity: Number = 9.81
    form: Literal["exact", "facets", "traditional"] = "exact"
    m: int = 8

    def __post_init__(self) -> None:
        check_numbers(self)
        if self.form not in ("exact", "facets", "traditional"):
            raise ValueError(f"form: expected 'exact', 'facets' or 'traditional', got {self.form!r}")
        if isinstance(self.mass, tuple) and len(self.mass) != 2:
            raise ValueError(f"mass: expected one number or two, got {len(self.mass)}")
        if self.form != "exact" and (self.m < 3 or isinstance(self.mass, tuple)):
            raise ValueError(f"form: {self.form!r} needs one mass and m >= 3 facets, got {self.mass!r} and {self.m}")

    @property
    def space(self) -> Space:
        """`TABLE`."""
        return TABLE

    @property
    def contacts(self) -> int:
        """One."""
        return 1

    def closed_form(self, velocity: Float[Tensor, "*#batch 2"], force: Float[Tensor, "*#batch 2"]) -> Tensor:
        """Next velocity [m/s] of a block with one mass."""
        if isinstance(self.mass, tuple):
            raise ValueError("mass: the closed form is for one mass, got two")
        return slide_in_plane(self._free(velocity, force), self._limit(velocity))

    def advance(self, state: Float[Tensor, "*#batch 4"], drive: Drive) -> Step:
        """Advance a state by one step; the mode is STICK or SLIP."""
        position, velocity = TABLE.split(state)
        if isinstance(self.mass, tuple):
            moved, solved = self._by_contact(velocity, drive.force)
        elif self.form == "exact":
            moved, solved = self.closed_form(velocity, drive.force), None
        else:
            moved, solved = self._by_polygon(self._free(velocity, drive.force))
        state = torch.cat(torch.broadcast_tensors(TABLE.advance(position, moved, self.dt), moved), dim=-1)
        mode = torch.where((moved == 0.0).all(-1, keepdim=True), int(Mode.STICK), int(Mode.SLIP))
        return Step(state, mode, None, solved)

    def _free(self, velocity: Tensor, force: Tensor) -> Tensor:
        mass = stack_numbers(*(self.mass if isinstance(self.mass, tuple) else (self.mass, self.mass)), like=velocity)
        return velocity + self.dt * force / mass

    def _limit(self, like: Tensor) -> Tensor:
        return as_tensor(self.mu, like) * as_tensor(self.gravity, like) * self.dt

    def _by_polygon(self, p: Tensor) -> tuple[Tensor, Tensor]:
        if self.form == "facets":
            velocity, solution = slide_on_facets(p, self._limit(p), self.m)
            return velocity, solution.solved
        angles = torch.arange(self.m, dtype=p.dtype, device=p.device) * (2.0 * math.pi / self.m)
        limit = self._limit(p).unsqueeze(-1)
        # Its vertices: the facets' polygon has them at half the angle, 1 / cos(pi / m) further out.
        corners = torch.stack(((angles + math.pi / self.m).cos(), (angles + math.pi / self.m).sin()))
        M = torch.nn.functional.pad(corners.mT @ corners, (0, 1, 0, 1))
        M[: self.m, self.m], M[self.m, : self.m] = 1.0, -1.0
        bound = limit / math.cos(math.pi / self.m)
        rows = torch.broadcast_tensors(*(-p @ corners).split(1, dim=-1), bound)
        solution = solve_lcp(M, torch.cat(rows, dim=-1))
        gamma = solution.z[..., -1:]
        velocity = p - matvec(corners, solution.z[..., :-1])
        return torch.where(gamma == 0.0, 0.0, velocity), solution.solved

    def _by_contact(self, velocity: Tensor, force: Tensor) -> tuple[Tensor, Tensor]:
        """The contact step in x, y and the height, which gravity presses onto the table."""
        p = self._free(velocity, force)
        masses = self.mass if isinstance(self.mass, tuple) else (self.mass, self.mass)
        load = 0.5 * (masses[0] + masses[1])
        mass = stack_numbers(*masses, load, like=p)
        fall = (-self.dt * as_tensor(self.gravity, p)).expand(p.shape[:-1]).unsqueeze(-1)
        axes, nothing = torch.eye(3, dtype=p.dtype, device=p.device), p.new_zeros(1)
        contacts = Contacts(
            gap=nothing,
            normal=axes[2:],
            tangents=axes[:2].unsqueeze(0),
            mu=as_tensor(self.mu, p).unsqueeze(-1),
            bounce=nothing,
            compliance=nothing,
        )
        found = contact_step(contacts, torch.cat((p, fall), dim=-1), mass, self.dt)
        return found.velocity[..., :2], found.solved & found.settled
