"""The figures of predicted tosses, against closed forms and another implementation."""

import math

import pytest
import torch
from real_data import real_data

from lcplearn.datasets.cube_tosses import read_tosses
from lcplearn.scenes.space import POSE
from lcplearn.training.toss_metrics import paired_difference, score_restarts, score_tosses, summarise

H = 0.05


def resting(rows: int = 4) -> torch.Tensor:
    state = torch.zeros(1, rows, 13, dtype=torch.float64)
    state[..., 2], state[..., 3] = H, 1.0
    return state


def test_closed_forms_of_a_shifted_turned_and_sunk_cube():
    recorded, steps = resting(), torch.tensor([3])
    shifted = recorded.clone()
    shifted[:, 1:, 0] += 2 * H  # a width away in 3 of 4 rows
    scores = score_tosses(recorded, shifted, steps, H)
    assert float(scores["position integral [% width]"]) == pytest.approx(75.0)
    assert float(scores["end position error [% width]"]) == pytest.approx(100.0)
    assert float(scores["rotation integral [deg]"]) == pytest.approx(0.0)
    turned = recorded.clone()
    turned[..., 3:7] = torch.tensor([math.cos(math.pi / 4), math.sin(math.pi / 4), 0.0, 0.0], dtype=torch.float64)
    scores = score_tosses(recorded, -turned, steps, H)  # q and -q are one rotation
    assert float(scores["rotation integral [deg]"]) == pytest.approx(90.0)
    assert float(scores["same face down at the end [share]"]) == 0.0
    sunk = recorded.clone()
    sunk[:, 2, 2] -= 0.2 * H
    scores = score_tosses(recorded, sunk, steps, H)
    assert float(scores["penetration integral [% width]"]) == pytest.approx(10.0 / 4)
    assert float(scores["largest penetration beyond the recorded [% width]"]) == pytest.approx(10.0)
    assert float(scores["penetration integral below the board [% width]"]) == pytest.approx(50 * (0.2 - 0.035) / 4)


def test_padding_does_not_count():
    recorded, steps = resting(6), torch.tensor([3])
    predicted = recorded.clone()
    predicted[:, 1, 0] += H
    garbage = predicted.clone()
    garbage[:, 4:] = torch.nan
    expected, found = (score_tosses(recorded, p, steps, H) for p in (predicted, garbage))
    assert all(torch.equal(expected[name], found[name]) for name in expected)


def test_restarts_see_only_the_row_they_start_from():
    generator = torch.Generator().manual_seed(0)
    recorded = torch.randn(2, 9, 13, generator=generator, dtype=torch.float64)
    recorded[..., 3:7] /= recorded[..., 3:7].norm(dim=-1, keepdim=True)

    def drift(start: torch.Tensor, count: int) -> torch.Tensor:
        states = [start]
        for _ in range(count):
            position, velocity = POSE.split(states[-1])
            states.append(torch.cat((POSE.advance(position, velocity, 0.01), velocity), dim=-1))
        return torch.stack(states, dim=1)

    scores = score_restarts(drift, recorded, torch.tensor([8, 5]), H)
    found = scores["position error after 4 steps [% width]"]  # from rows 0 and 4 of the first toss, 0 of the second
    starts = [(0, 0), (0, 4), (1, 0)]
    moved = [recorded[k, i, :3] + 0.04 * recorded[k, i, 7:10] - recorded[k, i + 4, :3] for k, i in starts]
    torch.testing.assert_close(found, 50 / H * torch.stack(moved).norm(dim=-1))


def test_a_paired_difference_sees_what_two_errors_share():
    generator = torch.Generator().manual_seed(0)
    shared = 10.0 * torch.randn(300, generator=generator, dtype=torch.float64)
    better, worse = shared, shared + 1.0 + 0.1 * torch.randn(300, generator=generator, dtype=torch.float64)
    mean, low, high = paired_difference(worse, better)
    assert low < mean < high
    assert high - low < 0.05
    assert abs(mean - 1.0) < 0.03
    assert summarise(shared).standard_error > 0.5


def test_figures_of_real_tosses_are_those_of_another_implementation():
    """The prediction is the recording three rows later. Numbers: a numpy script, written apart from this package."""
    tosses = read_tosses(real_data("cube_tosses.npz"))
    predicted = tosses.states.roll(-3, dims=1)
    predicted[:, 0] = tosses.states[:, 0]
    scores = score_tosses(tosses.states, predicted, tosses.steps, tosses.half_width)
    expected = {  # mean, median, standard error
        "position integral [% width]": (11.471642698743718, 11.578741654296351, 0.05196511470087587),
        "rotation integral [deg]": (3.010577218033406, 2.8697764382095063, 0.038703181536348184),
        "penetration integral [% width]": (1.5313422081458885, 1.530507822942801, 0.01431038237042982),
        "penetration integral below the board [% width]": (0.2562816707370325, 0.21792791950094392, 0.008282508533878),
        "end position error [% width]": (0.35690708753102585, 0.0, 0.3569070875310258),
        "at rest at the end [share]": (0.9978070175438597, 1.0, 0.0021929824561403508),
    }
    for name, numbers in expected.items():
        assert summarise(scores[name]) == pytest.approx(numbers, abs=1e-8), name
