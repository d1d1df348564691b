"""Starts without noise: the velocity of row 0 from all rows of the flight. A bound, as it looks at later rows."""

from dataclasses import replace

import torch

from lcplearn.datasets.cube_tosses import Tosses
from lcplearn.scenes.space import rotation_matrix
from lcplearn.training.toss_metrics import BOARD, CONTACT_HEIGHT, lowest_corner


def denoised(tosses: Tosses) -> Tosses:
    """The same tosses, with the mean of what each row of the flight says of the velocities at row 0.

    In flight v + k dt g stays the same in row k, and so does the angular velocity of a cube in the world's axes.
    Rows count as flight until a corner is close to the board; row 0 always does.
    """
    states, rows = tosses.states, torch.arange(tosses.states.shape[1])
    low = lowest_corner(states, tosses.half_width) < (BOARD + CONTACT_HEIGHT) * tosses.half_width
    flight = ((low.cumsum(-1) == 0) & (rows <= tosses.steps[:, None])) | (rows == 0)
    velocity = states[..., 7:10].clone()
    velocity[..., 2] += tosses.dt * tosses.gravity * rows.to(velocity)
    turn = rotation_matrix(states[..., 3:7])
    spin = (turn @ states[..., 10:, None])[..., 0]
    start = [torch.where(flight[..., None], x, 0.0).sum(1) / flight.sum(1, keepdim=True) for x in (velocity, spin)]
    found = states.clone()
    found[:, 0, 7:10] = start[0]
    found[:, 0, 10:] = (turn[:, 0].mT @ start[1][..., None])[..., 0]
    return replace(tosses, states=found)
