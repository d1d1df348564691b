"""Simulated recordings: what they are drawn from, and that they obey the scenes."""

import math

import pytest
import torch

from lcplearn.datasets import Recordings, Task, simulate_falling_block, simulate_sliding_block
from lcplearn.datasets.simulate import friction_labels
from lcplearn.scenes import FallingBlock, SlidingBlock

MU, MASS, DT, GRAVITY = 0.4, 1.5, 0.05, 9.81
LIMIT = MU * MASS * GRAVITY
SPLITS = ("train", "validation", "test", "test_long")


def splits(data: Task) -> list[Recordings]:
    return [getattr(data, name) for name in SPLITS]


def share_at_rest(recordings: Recordings) -> float:
    return (recordings.true_states[:, 1:, 1] == 0).double().mean().item()


def same(one: Task, other: Task) -> bool:
    return all(torch.equal(a.states[..., 1], b.states[..., 1]) for a, b in zip(splits(one), splits(other), strict=True))


def test_sliding_recordings_have_the_default_sizes_and_the_truth():
    """20 x 100 to train on, 40 x 100 for one step, 20 x 1000 for rollouts."""
    data = simulate_sliding_block()
    assert [tuple(part.drive.force.shape) for part in splits(data)] == [
        (20, 100, 1),
        (10, 100, 1),
        (40, 100, 1),
        (20, 1000, 1),
    ]
    assert all(part.states.shape[1] == part.drive.force.shape[1] + 1 for part in splits(data))
    assert all((part.steps == part.drive.force[..., 0].shape[1]).all() for part in splits(data))
    assert (data.name, data.dt) == ("sliding_block", DT)
    assert (data.truth, data.given) == ({"mu": MU, "mass": MASS}, {"gravity": GRAVITY})


@pytest.mark.parametrize("form", ["direct", "traditional"])
def test_sliding_recordings_are_rollouts_of_the_scene(form):
    part = simulate_sliding_block(mu=0.3, mass=0.7, dt=0.02).test
    start = torch.stack((part.states[:, 0, 0], part.states[:, 0, 1]), dim=-1)
    path = SlidingBlock(0.7, 0.3, 0.02, form=form).rollout(start, part.drive.force)
    torch.testing.assert_close(part.states[..., 1], path.velocities[..., 0], rtol=0, atol=1e-12)
    torch.testing.assert_close(part.states[..., 0], path.positions[..., 0], rtol=0, atol=1e-11)


def test_a_seed_fixes_the_recordings_and_another_changes_them():
    assert same(simulate_sliding_block(seed=3, noise=0.1), simulate_sliding_block(seed=3, noise=0.1))
    assert same(simulate_falling_block(seed=3, noise=0.1), simulate_falling_block(seed=3, noise=0.1))
    assert not same(simulate_sliding_block(seed=3), simulate_sliding_block(seed=4))
    assert not same(simulate_falling_block(seed=3), simulate_falling_block(seed=4))


def test_the_size_of_the_training_set_does_not_change_the_test_sets():
    small, large = simulate_sliding_block(trajectories=5, length=10), simulate_sliding_block(trajectories=50)
    assert torch.equal(small.test.states[..., 1], large.test.states[..., 1])
    assert torch.equal(small.test_long.states[..., 1], large.test_long.states[..., 1])


def test_measurement_noise_is_on_velocities_to_learn_from_only():
    """The tests are free of noise."""
    data = simulate_sliding_block(trajectories=200, noise=0.05)
    error = data.train.states[..., 1] - data.train.true_states[..., 1]
    assert error.std().item() == pytest.approx(0.05, rel=0.03)
    assert (data.validation.states[..., 1] != data.validation.true_states[..., 1]).any()
    for part in (data.test, data.test_long):
        assert torch.equal(part.states[..., 1], part.true_states[..., 1])
    moved = DT * data.train.true_states[:, 1:, 1].cumsum(dim=1)
    torch.testing.assert_close(data.train.states[:, 1:, 0], moved, rtol=0, atol=1e-12)


def test_the_force_keeps_its_level_until_it_switches():
    """Switch probability 0.1, standard deviation 1.2 mu m g, 5 % jitter."""
    forces = simulate_sliding_block(trajectories=400, length=200, jitter=0.0).train.drive.force[..., 0]
    assert (forces.diff(dim=1) != 0).double().mean().item() == pytest.approx(0.1, abs=0.005)
    assert forces.std().item() == pytest.approx(1.2 * LIMIT, rel=0.03)
    forces = simulate_sliding_block(trajectories=400, switch_probability=0.0).train.drive.force[..., 0]
    assert forces.std(dim=1).mean().item() == pytest.approx(0.05 * 1.2 * LIMIT, rel=0.03)


def test_the_asked_share_of_trajectories_starts_at_rest():
    for share in (0.0, 0.3, 1.0):
        start = simulate_sliding_block(share_from_rest=share).train.states[:, 0, 1]
        assert (start == 0).double().mean().item() == pytest.approx(share)


@pytest.mark.parametrize("share", [0.1, 0.4, 0.8])
def test_the_time_at_rest_can_be_asked_for(share):
    data = simulate_sliding_block(trajectories=100, share_at_rest=share)
    assert share_at_rest(data.train) == pytest.approx(share, abs=0.01)
    assert share_at_rest(data.test) == pytest.approx(share, abs=0.15)  # other forces of the same strength


def test_the_default_force_rests_about_two_fifths_of_the_time():
    assert share_at_rest(simulate_sliding_block(trajectories=400).train) == pytest.approx(0.42, abs=0.04)


@pytest.fixture(scope="module")
def labelled() -> dict[str, tuple[torch.Tensor, ...]]:
    """v, u, (v+, v-) after the step, and the labels of each kind."""
    kinds = ("physical", "lcp", "slack", "measured_slack")
    result = {}
    for kind in kinds:
        part = simulate_sliding_block(friction=kind).test
        after = part.states[:, 1:, 1]
        pair = torch.stack((torch.relu(after), torch.relu(-after)), dim=-1)
        result[kind] = (part.states[:, :-1, 1], part.drive.force[..., 0], pair, part.drive.friction)
    return result


def affine_residual(labels: tuple[torch.Tensor, ...], slack: bool) -> float:
    """Residual of the true affine law of `Direct`, or of `Slack` with slack friction [m/s]."""
    velocity, force, pair, friction = labels
    p = velocity + force * DT / MASS
    free = torch.stack((p, -p), dim=-1)
    change = friction - LIMIT if slack else -friction.flip(-1)
    return (pair - free - DT / MASS * change).abs().max().item()


def test_lcp_and_slack_labels_fit_the_affine_laws_and_measurable_ones_do_not(labelled):
    assert affine_residual(labelled["lcp"], slack=False) <= 1e-13
    assert affine_residual(labelled["slack"], slack=True) <= 1e-13
    assert affine_residual(labelled["physical"], slack=False) >= 0.1
    assert affine_residual(labelled["measured_slack"], slack=True) >= 0.1


def test_physical_and_slack_labels_are_complementary_to_velocity_and_lcp_labels_are_not(labelled):
    """A label is 0 up to rounding of the velocity change."""
    for kind in ("physical", "slack"):
        _, _, pair, friction = labelled[kind]
        assert (friction >= 0).all()
        assert (friction * pair).abs().max() <= 1e-11
    _, _, pair, friction = labelled["lcp"]
    assert (friction * pair).abs().max() >= 1
    assert (friction < 0).any()


def test_physical_friction_is_what_the_equation_of_motion_leaves(labelled):
    velocity, force, pair, friction = labelled["physical"]
    change = MASS * (pair[..., 0] - pair[..., 1] - velocity) / DT
    torch.testing.assert_close(friction[..., 0] - friction[..., 1], change - force, rtol=0, atol=1e-12)
    _, _, _, unused = labelled["measured_slack"]
    torch.testing.assert_close(unused, LIMIT - friction.flip(-1), rtol=0, atol=1e-12)


def test_labels_do_not_depend_on_the_form_of_the_block():
    v, u = torch.linspace(-1, 1, 7, dtype=torch.float64), torch.linspace(5, -5, 7, dtype=torch.float64)
    direct, traditional = SlidingBlock(MASS, MU, DT), SlidingBlock(MASS, MU, DT, form="traditional")
    for kind in ("physical", "lcp", "slack", "measured_slack"):
        assert torch.equal(friction_labels(direct, v, u, kind), friction_labels(traditional, v, u, kind))


def test_falling_recordings_are_rollouts_of_the_scene_that_never_penetrate():
    data = simulate_falling_block(noise=0.01)
    part = data.train
    start = torch.stack((part.states[:, 0, 0], part.true_states[:, 0, 1]), dim=-1)
    path = FallingBlock(data.given["mass"], data.dt).rollout(start, part.drive.force)
    assert torch.equal(part.true_states[..., 1], path.velocities[..., 0])
    assert torch.equal(part.states[..., 0], path.positions[..., 0])
    assert part.states[..., 0].min() == 0
    assert (data.name, data.given, data.truth) == ("falling_block", {"mass": 1.0}, {"gravity": 9.81})


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("train", {"trajectories": 0}),
        ("test_long", {"long_length": 0}),
        ("noise", {"noise": -0.1}),
        ("jitter", {"jitter": math.nan}),
        ("force_std", {"force_std": -1.0}),
        ("mu", {"mu": -0.1}),
        ("mass", {"mass": 0.0}),
        ("dt", {"dt": math.nan}),
        ("friction", {"friction": "fictitious"}),
        ("share_from_rest", {"share_from_rest": 1.5}),
        ("share_at_rest", {"share_at_rest": 1.0}),
        ("share_at_rest", {"share_at_rest": 0.5, "force_std": 1.0}),
        ("force_std", {"mu": 0.0}),
    ],
)
def test_a_wrong_argument_is_named(name, arguments):
    # a wrong literal is a TypeError first where the tests check types
    with pytest.raises((ValueError, TypeError), match=name):
        simulate_sliding_block(**arguments)


@pytest.mark.parametrize("simulate", [simulate_sliding_block, simulate_falling_block])
def test_no_split_holds_a_recording_of_another(simulate):
    data = simulate()
    parts = [part for part in (data.train, data.validation, data.test, data.test_long) if part is not None]
    drawn = [part.true_states[:, :20, -1] for part in parts]
    for k, ours in enumerate(drawn):
        for theirs in drawn[k + 1 :]:
            moving = (ours != 0).any(1)
            same = (ours[moving][:, None] == theirs[None]).all(-1)
            assert not same.any()
