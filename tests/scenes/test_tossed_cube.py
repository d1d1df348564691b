"""A tossed cube: flight, exact rest, and the loss that asks which impulses explain a recorded step."""

import torch

from lcplearn.scenes.scene import Drive, rollout
from lcplearn.scenes.tossed_cube import TossedCube

H, M, DT = 0.05, 0.4, 1 / 148
NUMBERS = {"half_width": H, "mass": M, "inertia": 0.8 * M * H**2, "mu": 0.2, "dt": DT}


def start(height: float = 3.0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    state = torch.randn(6, 13, generator=generator, dtype=torch.float64)
    state[:, 2] = height * H
    state[:, 3:7] /= state[:, 3:7].norm(dim=-1, keepdim=True)
    state[:, 10:] *= 5.0
    return state


def forces(steps: int) -> Drive:
    return Drive(torch.zeros(6, steps, 6, dtype=torch.float64))


def test_flight_is_a_parabola_until_something_touches():
    path = rollout(TossedCube(**NUMBERS), start(height=40.0), forces(20))
    fallen = -9.81 * DT**2 * 20 * 21 / 2  # velocities are those after a step
    expected = start(40.0)[:, 2] + 20 * DT * start(40.0)[:, 9] + fallen
    torch.testing.assert_close(path.positions[:, -1, 2], expected)


def test_rounded_corners_leave_the_faces_where_they_are_and_rest_is_exact():
    for radius in (0.0, 0.2 * H):
        path = rollout(TossedCube(**NUMBERS, radius=radius), start(), forces(500))
        assert bool(path.solved.all())
        assert torch.equal(path.velocities[:, -1], torch.zeros(6, 6, dtype=torch.float64))
        torch.testing.assert_close(
            path.positions[:, -1, 2], torch.full((6,), H, dtype=torch.float64), rtol=0, atol=1e-6
        )


def test_substeps_are_steps_of_a_shorter_time_under_the_same_force():
    push = Drive(0.1 * torch.randn(6, 40, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64))
    numbers = {**NUMBERS, "mu_impact": 0.15, "restitution": 0.3, "radius": 0.1 * H}
    fine = rollout(
        TossedCube(**{**numbers, "dt": DT / 3}), start(2.0), push.map(lambda x: x.repeat_interleave(3, dim=-2))
    )
    cube = TossedCube(**numbers, substeps=3)
    path = rollout(cube, start(2.0), push)
    assert torch.equal(path.states, fine.states[:, ::3])
    assert torch.equal(path.mode, fine.mode[:, 2::3])
    assert path.solved.shape == (6, 40)
    assert bool(path.solved.all())
    step = cube.advance(path.states[:, 20], push.at(20))
    torch.testing.assert_close(step.state, path.states[:, 21], rtol=0, atol=1e-9)
    assert torch.equal(step.mode, path.mode[:, 20])


def violation(states: torch.Tensor, **numbers: float | torch.Tensor) -> torch.Tensor:
    before, after = states[:, :-1].flatten(0, 1), states[:, 1:].flatten(0, 1)
    drive = Drive(torch.zeros(len(before), 6, dtype=torch.float64))
    return TossedCube(**{**NUMBERS, **numbers}).violation(before, drive, after)


def test_the_true_body_explains_its_own_steps_better_than_others():
    path = rollout(TossedCube(**NUMBERS), start(), forces(60))
    states = torch.cat((path.positions, path.velocities), dim=-1)
    true = float(violation(states).mean())
    for wrong in ({"mu": 0.05}, {"mu": 0.6}, {"ground": 0.1 * H}, {"ground": -0.1 * H}, {"inertia": 0.4 * M * H**2}):
        assert float(violation(states, **wrong).mean()) > 1.1 * true


def test_the_gradient_at_fixed_impulses_is_that_of_the_minimum():
    path = rollout(TossedCube(**NUMBERS), start(), forces(60))
    states = torch.cat((path.positions, path.velocities), dim=-1)[:, 15:40]
    for name, value, h in (("mu", 0.25, 1e-6), ("inertia", 0.7 * M * H**2, 1e-9), ("ground", 0.02 * H, 1e-8)):
        number = torch.tensor(value, dtype=torch.float64, requires_grad=True)
        (gradient,) = torch.autograd.grad(violation(states, **{name: number}).sum(), number)
        up, down = (float(violation(states, **{name: value + step}).sum()) for step in (h, -h))
        difference = (up - down) / (2 * h)
        assert abs(float(gradient) - difference) < 1e-3 * abs(difference)


def test_a_compliant_cube_does_not_creep_before_it_rests():
    path = rollout(TossedCube(**NUMBERS, mu_impact=0.15, restitution=0.3, radius=0.1 * H), start(), forces(160))
    speed = path.velocities.norm(dim=-1)
    assert bool((speed[:, -1] == 0.0).all())
    assert int(((speed > 0.0) & (speed < 1e-4)).sum(-1).max()) <= 2
