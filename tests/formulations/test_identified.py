"""Named numbers of scenes as parameters: within their domains, with the loop closed, for states of any size."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest
import torch
from torch import Tensor
from training.helpers import QUIET, short_fit

import lcplearn
from lcplearn.datasets import Recordings, Task, simulate_falling_block, simulate_sliding_block, windows
from lcplearn.datasets.spring import simulate_spring_block
from lcplearn.domains import NOT_NEGATIVE, Domain
from lcplearn.formulations import MLP, Formulation, Identified, Physical, Slack, build, loss_terms
from lcplearn.formulations.cube_corners import CubeCorners
from lcplearn.formulations.identified import clip_rows
from lcplearn.scenes import BouncingBlock, Drive, FallingBlock, SlidingBlock, Step, slide
from lcplearn.scenes.planar_body import PlanarBody, rectangle
from lcplearn.scenes.scene import Mode, Moving
from lcplearn.scenes.space import Space
from lcplearn.scenes.spring_block import SpringBlock
from lcplearn.training import Optimizer, fit

TWO_LINES = Space(positions=("x_1_m", "x_2_m"), velocities=("v_1_m_s", "v_2_m_s"))


@dataclass(frozen=True)
class TwoBlocks(Moving):
    """Two blocks of 1 kg, each on a line of its own."""

    space: ClassVar[Space] = TWO_LINES
    contacts: ClassVar[int] = 2
    numbers: ClassVar[Mapping[str, Domain]] = {"mu": NOT_NEGATIVE}

    mu: Tensor
    dt: float

    def advance(self, state: Tensor, drive: Drive) -> Step:
        position, velocity = self.space.split(state)
        velocity = slide(velocity + drive.force * self.dt, self.mu * 9.81 * self.dt)
        mode = torch.where(velocity == 0, int(Mode.STICK), int(Mode.SLIP))
        return Step(torch.cat((position + self.dt * velocity, velocity), dim=-1), mode)


def two_blocks(mu: tuple[float, float]) -> Task:
    scene = TwoBlocks(torch.tensor(mu, dtype=torch.float64), 0.05)
    parts = []
    for seed in range(3):
        generator = torch.Generator().manual_seed(seed)
        force = 6.0 * torch.randn(6, 30, 2, generator=generator, dtype=torch.float64)
        path = scene.rollout(torch.zeros(6, 4, dtype=torch.float64), force)
        states = torch.cat((path.positions, path.velocities), dim=-1)
        parts.append(Recordings(states, Drive(force), torch.full((6,), 30), states))
    return Task("two blocks", TWO_LINES, 0.05, *parts, truth={"mu_1": mu[0], "mu_2": mu[1]}, scene=scene)


def test_two_blocks_on_two_lines_are_learned_by_the_same_training(tmp_path: Path) -> None:
    task = two_blocks((0.4, 0.15))
    model = Identified(scene=TwoBlocks, dt=task.dt, learn={"mu": [0.05, 0.05]})
    metrics = fit(model, task, epochs=60, optimizer=Optimizer(lbfgs_after=40), folder=tmp_path, trainer=QUIET).metrics
    assert metrics is not None
    assert metrics["mu_1_error"] <= 1e-7
    assert metrics["mu_2_error"] <= 1e-7
    assert metrics["stick_accuracy"] == 1.0
    assert (tmp_path / "rollouts.png").is_file()
    loaded = lcplearn.load(tmp_path / "best.ckpt")
    assert loaded.physical_parameters() == model.physical_parameters()


def test_a_spring_and_its_friction_are_learned_with_the_loop_closed(tmp_path: Path) -> None:
    task = simulate_spring_block(trajectories=6, length=40, long_length=50)
    model = Identified(
        scene="lcplearn.scenes.spring_block.SpringBlock",
        dt=task.dt,
        given=task.given,
        learn={"stiffness": 10.0, "mu": 0.05},
    )
    fitted = short_fit(model, task, tmp_path, loss={"rollout": 1.0}, horizon=10, epochs=80,
                       optimizer=Optimizer(lbfgs_after=60), trainer=QUIET)  # fmt: skip
    assert fitted.metrics is not None
    assert fitted.metrics["stiffness_error"] <= 1e-5
    assert fitted.metrics["mu_error"] <= 1e-7


def test_gravity_is_learned_from_falls_and_landings(tmp_path: Path) -> None:
    task = simulate_falling_block(trajectories=6, length=40, long_length=60)
    model = Identified(scene=FallingBlock, dt=task.dt, given=task.given, learn={"gravity": 5.0})
    fitted = short_fit(model, task, tmp_path, loss={"rollout": 1.0}, horizon=10, epochs=80,
                       optimizer=Optimizer(lbfgs_after=60), trainer=QUIET)  # fmt: skip
    assert fitted.metrics is not None
    assert fitted.metrics["gravity_error"] <= 1e-9
    assert fitted.metrics["stick_accuracy"] == 1.0
    assert model.rollout(task.test.states[:, 0], task.test.drive.force).positions.min() == 0.0


def test_a_pulled_spring_holds_still_within_friction_and_swings_about_its_true_frequency() -> None:
    """Friction mu m g holds stretches up to mu m g / k; without it the period is 2 pi sqrt(m / k)."""
    still = SpringBlock(mass=1.0, mu=0.5, stiffness=10.0, dt=0.01)
    reach = 0.5 * 9.81 / 10.0
    for share, sticks in ((0.99, True), (1.01, False)):
        after = still.step(torch.tensor([share * reach, 0.0], dtype=torch.float64), torch.zeros(1).double())
        assert (after[1] == 0.0) == sticks
    free = SpringBlock(mass=1.0, mu=0.0, stiffness=(2 * torch.pi) ** 2, dt=1e-3)
    path = free.rollout(torch.tensor([1.0, 0.0], dtype=torch.float64), torch.zeros(1000, 1).double())
    crossings = torch.nonzero(path.positions[:-1, 0] * path.positions[1:, 0] < 0).flatten() * 1e-3
    assert crossings.tolist() == pytest.approx([0.25, 0.75], abs=2e-3)


def test_a_spring_pulls_where_the_block_is_after_the_step() -> None:
    """v' = (v + dt (u - k x) / m) / (1 + k dt^2 / m) without friction: however stiff, it does not gain."""
    state, force = torch.tensor([0.3, -1.0], dtype=torch.float64), torch.tensor([2.0], dtype=torch.float64)
    block = SpringBlock(mass=1.5, mu=0.0, stiffness=1e5, dt=0.1)
    after = block.step(state, force)[1]
    assert float(after) == pytest.approx((-1.0 + 0.1 * (2.0 - 1e5 * 0.3) / 1.5) / (1.0 + 1e5 * 0.1**2 / 1.5))
    path = block.rollout(state, torch.zeros(50, 1, dtype=torch.float64))
    assert path.positions[1:].abs().max() < 0.3


def test_numbers_stay_in_the_domain_that_the_scene_declares() -> None:
    model = Identified(scene=BouncingBlock, dt=0.1, learn={"mass": 2.0, "restitution": 0.5, "gravity": 9.81})
    assert model.physical_parameters() == pytest.approx({"mass": 2.0, "restitution": 0.5, "gravity": 9.81})
    with torch.no_grad():
        for parameter in model.parameters():
            parameter -= 30.0
    found = model.physical_parameters()
    assert found["mass"] > 0
    assert 0 < found["restitution"] < 1
    assert found["gravity"] == pytest.approx(-20.19)


@dataclass(frozen=True)
class Narrow(TwoBlocks):
    """Has a number between two ends, which are not 0 and 1."""

    numbers: ClassVar[Mapping[str, Domain]] = {"mu": Domain(0.2, 0.6, False, "a number from 0.2 to 0.6")}


def test_a_number_stays_between_any_two_ends() -> None:
    model = Identified(scene=Narrow, dt=0.1, learn={"mu": 0.3})
    assert model.physical_parameters() == pytest.approx({"mu": 0.3})
    with torch.no_grad():
        model.free["mu"] += 30.0
    assert model.physical_parameters() == pytest.approx({"mu": 0.6})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"learn": {"mue": 0.1}}, r"^learn: expected numbers of SlidingBlock \(mass, mu, gravity\), got mue"),
        ({"learn": {}}, "^learn: expected numbers"),
        (
            {"learn": {"mu": 0.0}, "given": {"mass": 1.0}},
            r"^learn\.mu: expected a number of at least 0, inside its bounds, got 0\.0",
        ),
        (
            {"learn": {"mu": 0.1}, "fixed": {"mue": 0.1}},
            r"^fixed: expected arguments of SlidingBlock that are not learned, got mue",
        ),
        ({"learn": {"mu": 0.1}, "fixed": {"mu": 0.1}}, r"^fixed: expected .* not learned, got mu"),
        ({"learn": {"mu": 0.1}, "given": {"mass": 1.0}, "clip": -1.0}, "^clip: expected a positive number, got -1.0"),
        (
            {"learn": {"mu": [0.1, [0.2]]}, "given": {"mass": 1.0}},
            r"^learn\.mu: expected a number, or lists of numbers",
        ),
        ({"learn": {"mu": 0.1}}, r"^given: expected mass of SlidingBlock, got none"),
        ({"learn": {"mu": 0.1}, "scene": "lcplearn.scenes.Nothing"}, "^scene: expected the dotted name of a class"),
        ({"learn": {"mu": 0.1}, "scene": Formulation}, "^scene: expected a dataclass"),
    ],
)
def test_a_wrong_argument_is_named(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Identified(**({"scene": SlidingBlock, "dt": 0.1} | arguments))
    with pytest.raises(TypeError, match=r"^Physical: expected keyword arguments only, got 0\.05 without a name"):
        Physical(0.05)


class Deaf(MLP):
    """Has a number that no prediction depends on."""

    def __init__(self, *, dt: float) -> None:
        super().__init__(dt=dt)
        self.stiffness = torch.nn.Parameter(torch.ones((), dtype=torch.float64))


def test_a_number_that_the_loss_does_not_depend_on_is_refused_before_training(tmp_path: Path) -> None:
    task = simulate_sliding_block(trajectories=2, length=5, long_length=5)
    with pytest.raises(ValueError, match=r"^model: expected a loss \(prediction\) that depends on .* got no stiffness"):
        fit(Deaf(dt=task.dt), task, folder=tmp_path / "run", trainer=QUIET)
    assert not (tmp_path / "run").exists()


def test_a_checkpoint_from_before_identified_still_loads(tmp_path: Path) -> None:
    """It names the old module, and has the logarithms of mu and of a mass that was not learned."""
    state = {"model.log_mu": torch.tensor(0.25).double().log(), "model.log_mass": torch.tensor(2.0).double().log()}
    for learn_mass, expected in ((True, {"mu": 0.25, "mass": 2.0}), (False, {"mu": 0.25})):
        arguments = {"dt": 0.1, "gravity": 9.81, "initial_mass": 2.0, "learn_mass": learn_mass}
        saved = {"class": "lcplearn.formulations.structured.Physical", "arguments": arguments}
        torch.save({"formulation": saved, "state_dict": state}, tmp_path / "old.ckpt")
        assert lcplearn.load(tmp_path / "old.ckpt").physical_parameters() == pytest.approx(expected)


def test_models_without_structure_see_positions_where_motion_depends_on_them() -> None:
    spring = simulate_spring_block(trajectories=1, length=2, long_length=2)
    table = simulate_sliding_block(trajectories=1, length=2, long_length=2)
    assert [build(MLP, task).inputs for task in (spring, table)] == [3, 2]
    assert build(MLP, spring, positions=False).inputs == 2


def test_a_model_and_data_that_lack_a_number_are_named() -> None:
    task = simulate_sliding_block(trajectories=1, length=2, long_length=2)
    with pytest.raises(ValueError, match=r"^model: Identified: missing a required.* argument: 'learn'"):
        build(Identified, task, scene=SlidingBlock)
    with pytest.raises(ValueError, match=r"^model: Slack: got an unexpected keyword argument 'width'"):
        build(Slack, task, width=3)
    with pytest.raises(ValueError, match=r"^given: expected the half_width of a cube, got gravity"):
        build(CubeCorners, task, learn={"mu": 0.1})


def test_a_threshold_is_softened_where_the_scene_has_one_and_left_alone_elsewhere() -> None:
    """Also with gradients clipped, for which each window has numbers of its own."""
    task = simulate_spring_block(trajectories=1, length=4, long_length=2)
    spring = build(Identified, task, scene=SpringBlock, learn={"mu": 0.05, "stiffness": 10.0})
    block = Identified(scene=SlidingBlock, dt=0.05, learn={"mu": 5.0}, given={"mass": 1.0}, clip=10.0)
    found = windows(task.train, 2)
    for model, softer in ((spring, False), (block, True)):
        exact = model.rollout_error(found)
        with model.softened(1.0):
            assert torch.equal(model.rollout_error(found), exact) != softer


def test_rows_are_clipped_at_their_median_norm_and_lost_ones_do_not_pass_for_a_plateau() -> None:
    nan, inf = float("nan"), float("inf")
    rows = torch.tensor([[3.0, 4.0], [0.6, 0.8], [0.0, 1.0], [0.0, 0.0], [nan, 1.0], [inf, 1.0]], dtype=torch.float64)
    clipped = [[1.2, 1.6], [0.6, 0.8], [0.0, 1.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]]  # at 2, twice the median of 1
    torch.testing.assert_close(clip_rows(rows, 2.0), torch.tensor(clipped, dtype=torch.float64))
    assert not clip_rows(rows[3:], 2.0).isfinite().all()
    assert torch.equal(clip_rows(rows[3:4], 2.0), rows[3:4])


def test_what_is_given_goes_to_the_device_of_what_is_learned() -> None:
    corners = rectangle(0.06, 0.04).tolist()
    model = Identified(scene=PlanarBody, dt=0.01, learn={"mu": 0.5}, given={"inertia": 7e-4, "corners": corners})
    for scene in (model.to("meta").moving(), model.moving_each(3)):
        assert scene.corners.device.type == "meta"  # type: ignore[attr-defined]


@pytest.mark.parametrize("term", ["prediction", "rollout"])
def test_the_gradient_of_a_window_is_clipped_whatever_the_loss(term: str) -> None:
    task = simulate_spring_block(trajectories=1, length=12, long_length=2)
    found = windows(task.train, 1)
    states = found.states.clone()
    states[0, 1] += 1e6  # one window is off by far
    sizes = []
    for clip in (None, 1.0):
        model = build(Identified, task, scene=SpringBlock, learn={"mu": 0.05, "stiffness": 10.0}, clip=clip)
        loss_terms(model, found._replace(states=states), {term: 1.0})[term].backward()
        sizes.append(max(float(p.grad.abs()) for p in model.parameters() if p.grad is not None))
    assert sizes[1] < 1e-3 * sizes[0]
