"""A training of a model of pushes: what judges it, and what it leaves."""

import dataclasses
import json
import math
from pathlib import Path

import pytest
import torch
from pushes import push_file, thing

from lcplearn.datasets.pushes import PushData, read_pushes
from lcplearn.formulations.pushing import PushModel, PushPrediction, Ridge
from lcplearn.training.checkpoint import load
from lcplearn.training.push_figures import draw_pushes
from lcplearn.training.push_metrics import errors
from lcplearn.training.push_training import fit_pushes


class Parrot(PushModel):
    """Knows the end of every push that it was fitted to, and is 1 m off on others."""

    def fit(self, pushes, outcome):
        self.start, self.end = pushes.push.pose, outcome.pose
        yield {"seen": float(len(self.end))}

    def predict(self, pushes):
        same = (pushes.push.pose[:, None] == self.start).all(-1)
        pose = torch.where(same.any(1)[:, None], self.end[same.int().argmax(1)], 1.0 + pushes.push.pose)
        return PushPrediction(pose, None, torch.ones(len(pose), dtype=torch.bool))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> PushData:
    return read_pushes(push_file(tmp_path_factory.mktemp("pushes"), 12), folds=3)


def test_no_push_is_judged_by_a_model_that_was_fitted_to_it(data: PushData, tmp_path: Path) -> None:
    result = fit_pushes(Parrot(**thing(data)), data, folder=tmp_path / "run", progress=False)
    assert result.metrics["position_mm"] > 900.0
    torch.testing.assert_close(result.model.predict(data.pushes).pose, data.outcome.pose, rtol=0, atol=0)  # of all


class Lost(Ridge):
    """Its prediction of the last push is not finite."""

    def predict(self, pushes):
        found = super().predict(pushes)
        last = (torch.arange(len(found.pose)) == len(found.pose) - 1)[:, None]
        return found._replace(pose=found.pose.masked_fill(last, torch.nan))


def test_a_push_whose_prediction_is_not_finite_has_infinite_errors_and_is_said_and_drawn(
    data: PushData, tmp_path: Path
) -> None:
    model = Lost(**thing(data))
    list(model.fit(data.pushes, data.outcome))
    lost = errors(model, data, model.predict(data.pushes))
    assert all(value[-1] == torch.inf and value[:-1].isfinite().all() for value in lost.values.values())
    result = fit_pushes(Lost(**thing(data)), data, folder=tmp_path / "run", progress=False)
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["deviation_mm"] == "diverged"
    assert "nan" not in result.report
    assert len(list((tmp_path / "run").glob("*.png"))) == 2


def test_errors_are_those_that_were_put_in(data: PushData) -> None:
    """3 mm beside, 4 mm of a turn about the centre of mass; a force of half the size, turned by a right angle."""
    model = Ridge(**thing(data))
    motion = model.motion(data.pushes, data.outcome.pose) + torch.tensor((0.003, 0.0, 0.004), dtype=torch.float64)
    force = 0.5 * data.outcome.force.flip(-1) * torch.tensor((-1.0, 1.0), dtype=torch.float64)
    solved = torch.ones(12, dtype=torch.bool)
    found = errors(model, data, PushPrediction(model.pose(data.pushes, motion), force, solved)).figures()
    size = float(data.outcome.force.norm(dim=-1).mean())
    wanted = {"deviation_mm": 5.0, "position_mm": 3.0, "rotation_deg": math.degrees(0.004 / 0.05)}
    wanted |= {"force_direction_deg": 90.0, "force_size_n": size / 2}
    assert {name: found[name] for name in wanted} == pytest.approx(wanted)
    still = errors(model, data, PushPrediction(data.pushes.push.pose, 0.0 * force, solved)).figures()
    assert (still["twist_angle_deg"], still["force_direction_deg"]) == (90.0, 90.0)  # no direction is no hit
    nothing = data.outcome._replace(force=data.outcome.force * torch.nan)
    unknown = errors(
        model, dataclasses.replace(data, outcome=nothing), PushPrediction(data.outcome.pose, force, solved)
    )
    assert not any(name.startswith("force") for name in unknown.values)


def test_pictures_of_pushes_have_one_frame_for_each_configuration(data: PushData) -> None:
    model = Ridge(**thing(data))
    list(model.fit(data.pushes, data.outcome))
    assert len(draw_pushes(model, data, model.predict(data.pushes)).axes) == 2


def test_a_run_leaves_its_model_its_figures_and_pictures_and_is_not_overwritten(data: PushData, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    result = fit_pushes(Ridge(**thing(data)), data, folder=folder, progress=False)
    torch.testing.assert_close(
        load(folder / "best.ckpt").predict(data.pushes).pose, result.model.predict(data.pushes).pose, rtol=0, atol=0
    )
    assert json.loads((folder / "metrics.json").read_text()) == result.metrics
    assert list(folder.glob("*.png"))
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(ValueError, match="holds a run already"):
        fit_pushes(Ridge(**thing(data)), data, folder=folder, progress=False)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
