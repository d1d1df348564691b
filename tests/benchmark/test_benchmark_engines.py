"""The Stick Bench: exact solutions against plain integration, ours sticks, engines are judged and not trusted."""

import numpy as np
import pytest

from lcplearn.benchmark.engines import exact, run
from lcplearn.benchmark.engines.cases import DROP, EDGE_MU, HALF, SCENES, TILT
from lcplearn.benchmark.engines.catalogue import ENGINES, installed
from lcplearn.benchmark.engines.engine import Path
from lcplearn.benchmark.harness.study import Options

ENGINE = {engine.name: engine for engine in ENGINES}
SCENE = {scene.name: scene for scene in SCENES}


def integrate(scene, dt=2e-5):
    """Coulomb's friction on a point mass by tiny steps: velocity shrinks by at most mu g dt."""
    down = np.array(scene.gravity)
    limit = scene.mu * -down[2] * dt
    v, x, path = np.array([scene.speed, 0.0]), np.zeros(2), [np.zeros(2)]
    for step in range(round(scene.duration / dt)):
        p = v + dt * (down[:2] + np.array([scene.push((step + 0.5) * dt), 0.0]))
        size = np.hypot(*p)
        after = np.zeros(2) if size <= limit else p * (1 - limit / size)
        x = x + dt * (v + after) / 2
        v = after
        path.append(x)
    return np.array(path)


@pytest.mark.parametrize("name", ["stop and go", "slide to a stop", "slide across a slope"])
def test_exact_motions_are_those_of_tiny_steps(name):
    scene = SCENE[name]
    path = integrate(scene)[::500]
    times = 0.01 * np.arange(len(path))
    assert np.abs(scene.solution(times, scene.mu) - path[:, scene.axes]).max() < 4e-5


@pytest.mark.parametrize("name", ["stop and go", "slide to a stop", "slide across a slope"])
def test_the_slope_of_an_exact_motion_is_its_difference_quotient(name):
    scene, h = SCENE[name], 1e-6
    times = np.linspace(0.0, scene.duration, 20)
    difference = (scene.solution(times, scene.mu + h) - scene.solution(times, scene.mu - h)) / (2 * h)
    np.testing.assert_allclose(exact.slope(scene.solution, times, scene.mu), difference, rtol=1e-5, atol=1e-7)


def test_an_exact_bounce_peaks_at_the_square_of_restitution_and_never_sinks():
    gap = exact.bounce(np.linspace(0.0, 3.0, 3001), 0.5, height=0.5, restitution=0.5)[:, 0]
    assert gap[400:700].max() == pytest.approx(0.125, rel=1e-3)
    assert gap.min() >= -1e-12
    assert gap[-1] == 0


def test_the_edge_of_the_dropped_box_sticks_and_a_slender_box_is_refused():
    assert exact.edge_friction(half_width=HALF[0], half_height=HALF[2], tilt=TILT, drop=DROP) < EDGE_MU
    with pytest.raises(ValueError, match="it would rock"):
        exact.edge_friction(half_width=0.05, half_height=0.1, tilt=TILT, drop=DROP)


@pytest.mark.parametrize("name", [scene.name for scene in SCENES if scene.rests and scene.rests[0][0] == 0.0])
def test_ours_does_not_creep_by_a_single_bit(name):
    scene = SCENE[name]
    for engine in (ENGINE["lcplearn"], ENGINE["lcplearn body"]):
        simulation = engine.build(scene, 0.01, scene.mu)
        if simulation is not None:
            path = simulation.path(20)
            assert (path.position[:, scene.axes] == 0.0).all()
            assert path.depth.max() == 0.0


def test_ours_lands_on_the_edge_and_lies_where_the_exact_solution_says():
    scene = SCENE["box dropped on an edge"]
    path = ENGINE["lcplearn"].build(scene, 0.01, scene.mu).path(200)
    assert run.creep(scene, path, 0.01) == 0
    assert path.position[-1, 0] == pytest.approx(scene.solution(0.01 * np.arange(201), scene.mu)[-1, 0], abs=1e-3)


def test_our_gradient_of_a_slide_is_exact_up_to_the_step_size():
    scene = SCENE["slide to a stop"]
    errors = [run.slopes(scene, e, e.build(scene, dt, scene.mu), dt)["slope_error"]
              for e in [ENGINE["lcplearn"]] for dt in (1e-2, 1e-3)]  # fmt: skip
    assert errors[1] < 0.2 * errors[0] < 0.01


def test_creep_is_the_speed_while_the_exact_body_rests_and_free_energy_is_found():
    scene, dt = SCENE["block on a slope"], 0.1
    time = dt * np.arange(21)
    position = np.stack((3e-6 * time, 0 * time, 0 * time), -1)
    assert run.creep(scene, Path(position, 0 * time, 0 * time), dt) == pytest.approx(3.0)
    assert run.energy_gain(scene, Path(position, 0.5 * time, 0 * time), dt) == pytest.approx(1.0)


@pytest.mark.parametrize("name", [name for name, engine in ENGINE.items() if engine.package])
def test_an_engine_builds_and_judges_every_scene(name):
    engine = ENGINE[name]
    if not installed(engine):
        pytest.skip(f"{engine.package} is not installed: pip install 'lcplearn[engines]'")
    for scene in SCENES:
        simulation = engine.build(scene, 0.005, scene.mu)
        if simulation is None:
            assert "Drake" in name
            continue
        path = simulation.path(10)
        error = path.position[:, scene.axes] - scene.solution(0.005 * np.arange(11), scene.mu)
        assert not np.nanmax(np.abs(error), initial=0.0) > 0.02
        assert np.isfinite(path.energy).all()


def test_the_study_runs_from_its_plan_to_its_figures(tmp_path, monkeypatch, capsys):
    """Measurements are replaced by numbers: what is tested is the plan, the tables and the figures."""
    row = dict.fromkeys(run.COLUMNS, 1e-3) | {"says": ""}
    monkeypatch.setattr(run, "SCENES", SCENES[:3])
    monkeypatch.setattr(run, "motion_row", lambda *_: row)
    monkeypatch.setattr(run, "creep_row", lambda *_: row)
    run.run(Options(tmp_path, quick=True))
    assert "Who sticks?" in capsys.readouterr().out
    assert len(list(tmp_path.glob("*.png"))) == 1 + 3
