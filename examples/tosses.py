"""Real tosses of a cube, predicted from their first row by a checkpoint that learned six numbers.

Needs the recordings: python -m lcplearn.datasets.get tosses

    python examples/tosses.py
"""

import sys
from pathlib import Path

import torch

import lcplearn
from lcplearn.datasets.cube_tosses import CHOOSE, read_tosses
from lcplearn.scenes import POSE

CHECKPOINT = Path(__file__).parents[1] / "data" / "checkpoints" / "cube_body.ckpt"


def main(count: int = 10) -> float:
    """Predict; return the median distance of the end positions, in widths of the cube."""
    torch.set_num_threads(1)
    model = lcplearn.load(CHECKPOINT)
    tosses = read_tosses()
    chosen = [tosses.numbers.index(number) for number in CHOOSE if number in tosses.numbers][:count]  # not learned from
    states, steps = tosses.states[chosen], tosses.steps[chosen]
    with torch.no_grad():
        path = model.rollout(states[:, 0], torch.zeros(len(chosen), int(steps.max()), 6, dtype=torch.float64))
    last = torch.arange(len(chosen)), steps
    distance = (path.positions[last][:, :3] - states[last][:, :3]).norm(dim=-1) / (2 * tosses.half_width)
    at_rest = (path.velocities[last] == 0).all(dim=-1)
    turned = POSE.difference(path.positions[last], states[last][:, :7])[:, 3:].norm(dim=-1).rad2deg()
    for row, k in enumerate(chosen):
        print(
            f"toss {tosses.numbers[k]:3d}: {int(steps[row]):3d} rows, ends {100 * float(distance[row]):5.1f} % of the "
            f"width and {float(turned[row]):5.1f} degrees off, {'exactly at rest' if at_rest[row] else 'moving'}"
        )
    print(f"learned: {model.physical_parameters()}")
    return float(distance.median())


if __name__ == "__main__":
    try:
        main()
    except FileNotFoundError as missing:
        sys.exit(str(missing))
