"""A tossed cube: flight, exact rest, and the loss that asks which impulses explain a recorded step."""

from unittest import mock

import pytest
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


ROUNDED = {**NUMBERS, "mu_impact": 0.15, "restitution": 0.3, "radius": 0.1 * H}
PUSH = Drive(0.1 * torch.randn(6, 40, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64))


@pytest.mark.parametrize("n", [2, 4, 7])
def test_with_substeps_a_flight_is_the_recorded_one(n: int):
    """A recorded velocity is the mean over the step before: both a start and what is reported are."""
    one, many = (rollout(TossedCube(**ROUNDED, substeps=k), start(40.0), forces(20)) for k in (1, n))
    torch.testing.assert_close(many.states, one.states, rtol=0, atol=1e-13)
    means = (many.positions[:, 1:, :3] - many.positions[:, :-1, :3]) / DT
    torch.testing.assert_close(many.velocities[:, 1:, :3], means, rtol=0, atol=1e-11)


def test_substeps_are_steps_of_a_shorter_time_from_the_velocity_of_the_last_of_them():
    n, height = 3, 4.0
    first, fine = start(height), {**ROUNDED, "dt": DT / n}
    first[:, 9] -= 9.81 * (DT - DT / n) / 2
    fine_path = rollout(TossedCube(**fine), first, PUSH.map(lambda x: x.repeat_interleave(n, dim=-2)))
    path = rollout(TossedCube(**ROUNDED, substeps=n), start(height), PUSH)
    torch.testing.assert_close(path.positions, fine_path.positions[:, ::n], rtol=0, atol=1e-12)
    early, middle, late = fine_path.mode.unflatten(1, (-1, n)).unbind(2)
    touching = torch.where(late != 2, late, torch.where(middle != 2, middle, early))
    assert torch.equal(path.mode, touching)
    assert bool((touching != late).any())  # an impact in an early substep is told
    assert path.solved.shape == (6, 40)
    assert bool(path.solved.all())
    behind = path.velocities - fine_path.velocities[:, ::n]
    falls = (fine_path.positions[:, ::n, 2] > 2.0 * H).nonzero()
    torch.testing.assert_close(behind[*falls.T, 2], torch.full((len(falls),), 9.81 * DT / 3, dtype=torch.float64))
    torch.testing.assert_close(behind[..., [0, 1, 3, 4, 5]], torch.zeros(6, 41, 5, dtype=torch.float64))


def test_with_substeps_a_cube_may_be_tossed_in_single_precision():
    cube = TossedCube(**ROUNDED, substeps=2)
    path = rollout(cube, start(2.5), PUSH.map(lambda x: x[:, :8]))
    single = rollout(cube, start(2.5).float(), PUSH.map(lambda x: x[:, :8].float()))
    torch.testing.assert_close(single.states.double(), path.states, rtol=0, atol=1e-3)


@pytest.mark.parametrize("n", [2, 3])
def test_with_substeps_steps_make_the_rollout_and_a_batch_is_its_elements(n: int):
    mu = torch.linspace(0.1, 0.4, 6, dtype=torch.float64)
    path = rollout(TossedCube(**{**ROUNDED, "mu": mu}, substeps=n), start(3.0), PUSH)
    state, touched = start(3.0), 0
    for k in range(40):
        step = TossedCube(**{**ROUNDED, "mu": mu}, substeps=n).advance(state, PUSH.at(k))
        torch.testing.assert_close(step.state, path.states[:, k + 1], rtol=0, atol=1e-9)
        assert torch.equal(step.mode, path.mode[:, k])
        state, touched = path.states[:, k + 1], touched + int((step.mode != 2).any(-1).sum())
    assert touched > 40
    for b in range(6):
        alone = rollout(TossedCube(**{**ROUNDED, "mu": mu[b]}, substeps=n), start(3.0)[b], PUSH.force[b])
        assert torch.equal(alone.states, path.states[b])


def test_with_substeps_compiled_rollouts_are_those_step_by_step_in_torch():
    cube = TossedCube(**ROUNDED, substeps=2)
    compiled = rollout(cube, start(2.5)[:3], PUSH.map(lambda x: x[:3, :25]))
    with mock.patch("lcplearn.scenes.spatial_body.compiled_contacts", return_value=None):
        stepped = rollout(cube, start(2.5)[:3], PUSH.map(lambda x: x[:3, :25]))
    torch.testing.assert_close(compiled.states, stepped.states, rtol=0, atol=1e-8)
    assert torch.equal(compiled.mode, stepped.mode)


def test_with_substeps_a_cube_at_rest_has_velocity_0_and_stays_bit_by_bit():
    path = rollout(TossedCube(**ROUNDED, substeps=4), start(), forces(500))
    assert torch.equal(path.velocities[:, -1], torch.zeros(6, 6, dtype=torch.float64))
    on = rollout(TossedCube(**ROUNDED, substeps=4), path.states[:, -1], forces(20))
    assert torch.equal(on.states, path.states[:, -1:].expand(-1, 21, -1))


def test_with_substeps_the_gradient_is_that_of_differences():
    def end(mu: torch.Tensor, ground: torch.Tensor, first: torch.Tensor) -> torch.Tensor:
        numbers = {**ROUNDED, "mu": mu, "ground": ground}
        return rollout(TossedCube(**numbers, substeps=3), first, forces(12)).states[:, -1].square().sum()

    given = (torch.tensor(0.2, dtype=torch.float64), torch.tensor(0.0, dtype=torch.float64), start(2.0))
    assert torch.autograd.gradcheck(
        end, [x.requires_grad_() for x in given], eps=1e-7, atol=1e-5, rtol=1e-4, nondet_tol=0.0
    )


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
