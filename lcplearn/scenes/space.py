"""What a state is: names and units of its columns, how positions advance, how far apart two states are."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

_SMALL_ANGLE = 1e-4  # [rad] below it series to fourth order are exact in doubles, and have no 0/0


@dataclass(frozen=True)
class Space:
    """The space that a body moves in. A state is its positions, then its velocities.

    With as many positions as velocities, x' = x + dt v. With one more, the last four positions are a unit quaternion
    (w, x, y, z) that turns body into world coordinates, the last three velocities are the angular velocity in body
    coordinates, and

        quaternion' = quaternion * exp(dt angular velocity).

    Attributes:
        positions: Column names of the positions, units included.
        velocities: Column names of the velocities, units included; the rotations come last.
        rotations: How many of the velocities are angular [rad/s].
    """

    positions: tuple[str, ...]
    velocities: tuple[str, ...]
    rotations: int = 0

    def __post_init__(self) -> None:
        quaternions = self.nq - self.nv
        if quaternions not in (0, 1) or (quaternions == 1 and self.rotations != 3):
            raise ValueError(
                "positions: expected as many as velocities, or one more and 3 rotations, "
                f"got {self.nq} positions, {self.nv} velocities, {self.rotations} rotations"
            )

    @property
    def nq(self) -> int:
        """Number of positions."""
        return len(self.positions)

    @property
    def nv(self) -> int:
        """Number of velocities."""
        return len(self.velocities)

    def origin(self) -> Float[Tensor, " nq_plus_nv"]:
        """The state of rest at position 0, unturned."""
        state = torch.zeros(self.nq + self.nv, dtype=torch.float64)
        if self.nq > self.nv:
            state[self.nq - 4] = 1.0
        return state

    def split(self, state: Float[Tensor, "*batch nq_plus_nv"]) -> tuple[Tensor, Tensor]:
        """Positions [*batch, nq] and velocities [*batch, nv] of a state.

        Raises:
            ValueError: state has another number of columns.
        """
        if state.ndim < 1 or state.shape[-1] != self.nq + self.nv:
            raise ValueError(
                f"state: expected shape [*batch, {self.nq + self.nv}] ({', '.join(self.positions + self.velocities)}), "
                f"got {list(state.shape)}"
            )
        return state[..., : self.nq], state[..., self.nq :]

    def normalised(
        self, state: Float[Tensor, "*batch nq_plus_nv"], name: str = "state"
    ) -> Float[Tensor, "*batch nq_plus_nv"]:
        """The state with a quaternion of norm 1, where it has one.

        Raises:
            ValueError: its norm is farther from 1 than rounded digits explain, 1e-3.
        """
        position, velocity = self.split(state)
        if self.nq == self.nv:
            return state
        norm = position[..., -4:].norm(dim=-1, keepdim=True)
        if not bool(((norm - 1.0).abs() < 1e-3).all()):
            worst = norm.flatten()[(norm - 1.0).abs().argmax()].item()
            raise ValueError(f"{name}: expected a quaternion of norm 1, got one of norm {worst:.6g}")
        return torch.cat((position[..., :-4], position[..., -4:] / norm, velocity), dim=-1)

    def advance(
        self, position: Float[Tensor, "*#batch nq"], velocity: Float[Tensor, "*#batch nv"], dt: float
    ) -> Float[Tensor, "..."]:
        """Positions after a time dt [s] at constant velocity; a quaternion comes back with norm 1."""
        if self.nq == self.nv:
            return position + dt * velocity
        moved = position[..., :-4] + dt * velocity[..., :-3]
        turned = quaternion_product(position[..., -4:], quaternion_exponential(dt * velocity[..., -3:]))
        turned = turned / turned.norm(dim=-1, keepdim=True)
        return torch.cat((moved, turned), dim=-1)

    def difference(self, a: Float[Tensor, "*#batch nq"], b: Float[Tensor, "*#batch nq"]) -> Float[Tensor, "..."]:
        """The constant velocity [*batch, nv] that leads from positions b to positions a in one second.

        The inverse of `advance`: advance(b, difference(a, b), 1) is a (for quaternions, a or -a: the same rotation).
        The gradient at a rotation by pi, where the shorter way changes sides, is that of one side.
        """
        if self.nq == self.nv:
            return a - b
        conjugate = torch.cat((b[..., -4:-3], -b[..., -3:]), dim=-1)
        turn = quaternion_logarithm(quaternion_product(conjugate, a[..., -4:]))
        return torch.cat((a[..., :-4] - b[..., :-4], turn), dim=-1)

    def speed(self, velocity: Float[Tensor, "*batch nv"], radius: float = 1.0) -> Float[Tensor, "*batch"]:
        """Size of a velocity [m/s], with angular velocities weighted by a radius [m]; its gradient at 0 is 0."""
        return torch.linalg.vector_norm(self._weighted(velocity, radius), dim=-1)

    def squared_speed(self, velocity: Float[Tensor, "*batch nv"], radius: float = 1.0) -> Float[Tensor, "*batch"]:
        """Square of `speed` [m^2/s^2], what losses are made of."""
        return self._weighted(velocity, radius).square().sum(-1)

    def _weighted(self, velocity: Tensor, radius: float) -> Tensor:
        if not self.rotations:
            return velocity
        linear = self.nv - self.rotations
        return torch.cat((velocity[..., :linear], radius * velocity[..., linear:]), dim=-1)


LINE = Space(positions=("position_m",), velocities=("velocity_m_s",))
TABLE = Space(positions=("x_m", "y_m"), velocities=("x_velocity_m_s", "y_velocity_m_s"))
PLANE = Space(
    positions=("x_m", "y_m", "angle_rad"),
    velocities=("x_velocity_m_s", "y_velocity_m_s", "angular_velocity_rad_s"),
    rotations=1,
)
POSE = Space(
    positions=("x_m", "y_m", "z_m", "quaternion_w", "quaternion_x", "quaternion_y", "quaternion_z"),
    velocities=(
        *("x_velocity_m_s", "y_velocity_m_s", "z_velocity_m_s"),
        *("body_x_angular_velocity_rad_s", "body_y_angular_velocity_rad_s", "body_z_angular_velocity_rad_s"),
    ),
    rotations=3,
)


def quaternion_product(a: Float[Tensor, "*#batch 4"], b: Float[Tensor, "*#batch 4"]) -> Float[Tensor, "... 4"]:
    """Hamilton's product of quaternions (w, x, y, z): the rotation b, then a."""
    a, b = torch.broadcast_tensors(a, b)
    scalar = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(-1, keepdim=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + torch.linalg.cross(a[..., 1:], b[..., 1:])
    return torch.cat((scalar, vector), dim=-1)


def quaternion_exponential(turn: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    """The unit quaternion of a rotation by |turn| [rad] about turn; smooth at 0."""
    square = turn.square().sum(-1, keepdim=True) / 4.0
    small = square < _SMALL_ANGLE**2
    half = torch.where(small, torch.ones_like(square), square).sqrt()
    cosine = torch.where(small, 1.0 - square / 2.0, half.cos())
    sinc = torch.where(small, 1.0 - square / 6.0, half.sin() / half)
    return torch.cat((cosine, sinc * turn / 2.0), dim=-1)


def quaternion_logarithm(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3"]:
    """The rotation vector [rad], at most pi long, of a unit quaternion; the inverse of `quaternion_exponential`."""
    shorter = torch.where(quaternion[..., :1] < 0.0, -quaternion, quaternion)
    scalar, vector = shorter[..., :1], shorter[..., 1:]
    square = vector.square().sum(-1, keepdim=True)
    small = square < _SMALL_ANGLE**2
    sine = torch.where(small, torch.ones_like(square), square).sqrt()
    # angle / sine; near 0 it is 2 (1 + s^2 / 6 + ...)
    ratio = torch.where(small, 2.0 + square / 3.0, 2.0 * torch.atan2(sine, scalar) / sine)
    return ratio * vector


def rotation_matrix(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """The matrix that turns body into world coordinates."""
    w, x, y, z = quaternion.unbind(-1)
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
