"""Real pushes of a steel triangle, predicted by a checkpoint that learned three numbers, forces included.

Needs the recordings: python -m lcplearn.datasets.get pushes

    python examples/pushes.py
"""

import sys
from pathlib import Path

import torch

import lcplearn
from lcplearn.datasets.files import find
from lcplearn.datasets.pushes import read_all_pushes

CHECKPOINT = Path(__file__).parents[1] / "data" / "checkpoints" / "pushes_supports.ckpt"


def main(count: int = 10) -> float:
    """Predict; return the mean distance between predicted and recorded end positions of the centre of mass [m]."""
    torch.set_num_threads(1)
    model = lcplearn.load(CHECKPOINT)
    data = read_all_pushes(find("planar_pushes.npz"))
    rows = torch.linspace(0, len(data.configuration) - 1, count).long()
    pushes, recorded = data.pushes.take(rows), data.outcome.take(rows)
    with torch.no_grad():
        predicted = model.predict(pushes)
        moved, truth = model.motion(pushes, predicted.pose), model.motion(pushes, recorded.pose)
    off = (moved - truth)[:, :2].norm(dim=-1)
    for k in range(count):
        print(
            f"{data.names[data.configuration[rows[k]]]:>24}: the centre moves {1e3 * truth[k, :2].norm():4.1f} mm, "
            f"predicted {1e3 * off[k]:.1f} mm beside; force {recorded.force[k].norm():.2f} N, "
            f"predicted {predicted.force[k].norm():.2f} N"
        )
    print(f"learned: {model.physical_parameters()}")
    return float(off.mean())


if __name__ == "__main__":
    try:
        main()
    except FileNotFoundError as missing:
        sys.exit(str(missing))
