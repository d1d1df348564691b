"""Recordings of what moves, simulated and real, and batches of them."""

from lcplearn.datasets.cube_slides import read_all_cube_slides, read_cube_slides
from lcplearn.datasets.files import find
from lcplearn.datasets.loader import WindowLoader
from lcplearn.datasets.recordings import Recordings, Windows, windows
from lcplearn.datasets.simulate import simulate_falling_block, simulate_sliding_block
from lcplearn.datasets.task import Task, read_recordings

__all__ = [
    "Recordings",
    "Task",
    "WindowLoader",
    "Windows",
    "find",
    "read_all_cube_slides",
    "read_cube_slides",
    "read_recordings",
    "simulate_falling_block",
    "simulate_sliding_block",
    "windows",
]
