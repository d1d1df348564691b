"""A box is tossed, tumbles, slides and comes to rest exactly: physics without learning, and README's moving picture.

python examples/tossed_box.py            # says when it rests
python examples/tossed_box.py box.gif    # and draws it
"""

import sys
from pathlib import Path

import torch
from torch import Tensor

from lcplearn.scenes import POSE, Mode, SpatialBody, Trajectory, box_corners
from lcplearn.scenes.space import rotation_matrix

DT = 0.005  # [s]
HALF = torch.tensor([0.06, 0.05, 0.04], dtype=torch.float64)  # half widths [m]
FACES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))


def toss(steps: int = 300) -> tuple[SpatialBody, Trajectory]:
    """Toss the box and see where it goes."""
    mass = 0.4  # [kg]
    squares = (2 * HALF).square()
    inertia = tuple((mass / 12 * (squares.sum() - squares[k])).item() for k in range(3))
    box = SpatialBody(corners=box_corners(HALF), inertia=inertia, mass=mass, mu=0.25, restitution=0.3, dt=DT)
    position, turn = [-0.45, 0.0, 0.30], [0.90, 0.25, 0.30, 0.20]
    velocity, spin = [1.3, 0.15, 0.6], [3.0, 14.0, 4.0]
    state = torch.tensor([*position, *turn, *velocity, *spin], dtype=torch.float64)
    state[3:7] /= state[3:7].norm()
    return box, box.rollout(state, torch.zeros(steps, 6, dtype=torch.float64))


def draw(box: SpatialBody, path: Trajectory, file: Path, every: int = 5, hold: int = 15) -> None:
    """Write a GIF of the motion beside its speed."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.animation import FuncAnimation, PillowWriter
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    centre, turn = path.positions[:, :3], rotation_matrix(path.positions[:, 3:])
    corners = centre[:, None] + box.corners @ turn.mT  # [T + 1, 8, 3]
    speed = speed_of(path.velocities)
    time = DT * torch.arange(len(speed))
    figure = plt.figure(figsize=(7.2, 3.0), dpi=80)
    scene = figure.add_axes((-0.02, -0.25, 0.66, 1.5), projection="3d")
    plot = figure.add_axes((0.71, 0.2, 0.27, 0.62))
    scene.computed_zorder = False

    def frame(k: int) -> None:
        scene.clear()
        scene.set(xlim=(-0.55, 0.65), ylim=(-0.25, 0.25), zlim=(0.0, 0.5))
        scene.set_box_aspect((1.2, 0.5, 0.5), zoom=1.25)
        scene.set_axis_off()
        scene.view_init(elev=16, azim=-80)
        ground = [[(-0.6, -0.25, 0), (0.7, -0.25, 0), (0.7, 0.25, 0), (-0.6, 0.25, 0)]]
        scene.add_collection3d(Poly3DCollection(ground, facecolor="#e3e8ef", zorder=0))
        scene.plot(*centre[: k + 1].T, color="#9aa7b8", linewidth=1, zorder=1)
        still = bool((path.velocities[k] == 0).all())
        colour, shades = ("#2a9d5c", "Greens") if still else ("#3b76c4", "Blues")
        faces = [[corners[k, j].tolist() for j in face] for face in FACES]
        shaded = matplotlib.colormaps[shades]([0.55, 0.6, 0.65, 0.7, 0.8, 0.85])
        scene.add_collection3d(Poly3DCollection(faces, facecolors=shaded, edgecolor="white", zorder=2))
        plot.clear()
        plot.semilogy(time[: k + 1], speed[: k + 1].clamp_min(1e-18), color=colour)
        plot.set(xlim=(0, float(time[-1])), ylim=(1e-4, 1e1), xlabel="time [s]", title="speed [m/s]")
        if still:
            plot.text(0.96, 0.05, "exactly 0", transform=plot.transAxes, color=colour, ha="right", fontsize=12)

    frames = [*range(0, len(speed), every), *[len(speed) - 1] * hold]
    animation = FuncAnimation(figure, frame, frames=frames, init_func=lambda: None)
    animation.save(file, writer=PillowWriter(fps=1 / (DT * every)))
    plt.close(figure)


def speed_of(velocities: Tensor) -> Tensor:
    """Speed of the centre, and of a corner turning about it [m/s]."""
    return POSE.squared_speed(velocities, float(HALF.norm())).sqrt()


def main(steps: int = 300, file: Path | None = None) -> float:
    """Toss; return the time from which on no bit moves [s]."""
    torch.set_num_threads(1)
    box, path = toss(steps)
    assert path.solved is not None
    assert path.solved.all()
    moving = (path.velocities != 0).any(dim=-1).nonzero()
    rest = DT * (int(moving[-1]) + 1)
    touching = (path.mode != Mode.SEPARATION).any(dim=-1).float().mean()
    print(f"in touch with the ground {touching:.0%} of the time; from {rest:.3f} s on no bit of it moves")
    if file is not None:
        draw(box, path, file)
        print(file)
    return rest


if __name__ == "__main__":
    main(file=Path(sys.argv[1]) if len(sys.argv) > 1 else None)
