"""Scene-minimal LCPs against the full contact LCP, and errors against exact motions."""

import pytest
import torch

from lcplearn.benchmark.scenes.cases import DURATION, SCENES, exact, random_states, start
from lcplearn.benchmark.scenes.contact_cases import body_rows, curve_rows
from lcplearn.benchmark.scenes.fused import fused_rows
from lcplearn.benchmark.scenes.run import motion_errors, motion_rows, roll, step_rows

ROWS = {"sliding block": 2, "one-way block": 1, "falling block": 1, "bouncing block": 1}


@pytest.mark.parametrize("scene", SCENES)
def test_every_formulation_steps_like_the_full_contact_lcp_to_rounding(scene):
    rows = step_rows(scene, 0.01, 1, repeats=1, seed=0)
    assert set(rows) == set(SCENES[scene])
    for row in rows.values():
        assert row["velocity_difference"] < 1e-13
        assert row["step_us"] > 0


@pytest.mark.parametrize(("scene", "rows"), ROWS.items())
def test_a_scene_builds_only_the_rows_it_needs(scene, rows):
    """Architecture: model only what a scene needs. The rows that are reported are those of the LCP that is solved."""
    import lcplearn.scenes.falling_block as falling
    import lcplearn.scenes.sliding_block as sliding

    solved = []
    original = sliding.solve_lcp

    def spy(M, q, **options):
        solved.append(M.shape[-1])
        return original(M, q, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sliding, "solve_lcp", spy)
        patch.setattr(falling, "solve_lcp", spy)
        SCENES[scene]["direct"].build(0.01)(random_states(scene, 5, 0))
    assert solved == [rows]
    assert SCENES[scene]["direct"].rows == rows
    assert SCENES[scene]["full"].rows == 4


@pytest.mark.parametrize("scene", SCENES)
def test_the_states_to_compare_contain_rest_and_motion(scene):
    states = random_states(scene, 200, 0)
    after = SCENES[scene]["full"].build(0.01)(states)
    moving = after[:, 1] != 0
    assert moving.any()
    assert scene == "bouncing block" or not moving.all()


@pytest.mark.parametrize("scene", SCENES)
def test_the_exact_motion_starts_right_and_obeys_newton_between_events(scene):
    time = torch.linspace(0, DURATION, 10_001, dtype=torch.float64)
    x, v = exact(scene, time)
    assert torch.equal(torch.stack((x[:1], v[:1]), -1), start(scene))
    acceleration = v.diff() / time.diff()
    expected = -9.81 if scene in ("falling block", "bouncing block") else -0.4 * 9.81
    steady = (acceleration - expected).abs() < 1e-6
    still = (v[1:] == 0) & (v[:-1] == 0)
    assert (steady | still).sum() > 0.995 * len(steady)
    assert (x.diff() - 0.5 * (v[1:] + v[:-1]) * time.diff()).abs().max() < 1e-3
    if scene in ("falling block", "bouncing block"):
        assert x.min() >= -1e-12


def errors_of(scene: str, dt: float) -> dict[str, float]:
    """`motion_errors` of the closed form, which steps like all others."""
    return motion_errors(scene, roll(SCENES[scene]["closed form"].build(dt), start(scene), round(DURATION / dt)), dt)


def test_the_rows_of_a_motion_have_its_errors_for_every_formulation():
    rows = motion_rows("bouncing block", 0.02, 1)
    assert set(rows) == set(SCENES["bouncing block"])
    for row in rows.values():
        assert row["position_error"] == pytest.approx(errors_of("bouncing block", 0.02)["position_error"], rel=1e-9)


@pytest.mark.parametrize(("dt", "percent"), [(0.1, 19.6), (0.03, 6.2), (0.01, 2.2), (0.001, 0.22)])
def test_a_falling_block_loses_before_impact_half_a_step_of_fall(dt, percent):
    assert errors_of("falling block", dt)["energy_error"] == pytest.approx(percent / 100, rel=0.03)


def test_the_first_bounce_peaks_a_quarter_as_high_and_the_gap_hardly_drifts():
    row = errors_of("bouncing block", 1e-3)
    assert row["end_error"] == pytest.approx(0.2506 - 0.25, abs=1e-4)
    assert row["penetration"] < 2e-5


@pytest.mark.parametrize("scene", SCENES)
def test_the_position_error_is_of_first_order_in_dt(scene):
    errors = [errors_of(scene, dt)["position_error"] for dt in (1e-2, 1e-3)]
    assert 4 < errors[0] / errors[1] < 25


def test_a_sliding_block_stops_within_half_a_step_of_its_start_speed():
    """Implicit Euler covers v0 dt / 2 less than the exact stopping distance, up to the step of the stop."""
    dt = 0.01
    path = roll(SCENES["sliding block"]["direct"].build(dt), start("sliding block"), 100)
    errors = motion_errors("sliding block", path, dt)
    assert errors["end_error"] == pytest.approx(2.0 * dt / 2, rel=0.05)
    assert errors["energy_error"] < 1e-12
    assert path[-1, 1] == 0


def test_a_body_builds_a_fraction_of_its_rows_and_finer_polygons_come_nearer_to_the_cone():
    hexagon = body_rows("hexagon in its plane", 16, 1, 0)[0]
    assert 0 < hexagon["rows"] < 0.5 * hexagon["full_rows"]
    cone, *polygons = body_rows("box in space", 16, 1, 0)
    assert cone["rows"] < 0.5 * cone["full_rows"] < 0.5 * polygons[0]["full_rows"]
    assert cone["solved"] == 1
    distances = [row["velocity_difference"] for row in (cone, *polygons[::-1])]
    assert distances == sorted(distances)


def test_a_curved_slide_converges_by_the_exact_cone_and_not_by_a_polygon():
    coarse, fine = ({row["formulation"]: row["position_error"] for row in curve_rows(dt, 1)} for dt in (2e-2, 4e-3))
    assert fine["exact cone"] < 0.3 * coarse["exact cone"]
    assert fine["polygon of 8"] > 0.5 * coarse["polygon of 8"]


def test_compiled_and_torch_step_alike_and_are_told_apart():
    pytest.importorskip("numba")
    for row in fused_rows("contact step", 1, 1, 0):
        assert row["velocity_difference"] < 1e-10
        assert row["torch_us"] > 2.0 * row["step_us"]
