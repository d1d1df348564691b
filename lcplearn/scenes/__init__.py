"""Physics: (state, drive) -> LCP -> next state."""

from lcplearn.scenes.falling_block import BouncingBlock, FallingBlock
from lcplearn.scenes.scene import Drive, Mode, Moving, Scene, Step, Trajectory, rollout
from lcplearn.scenes.sliding_block import OneWayBlock, SlidingBlock, slide
from lcplearn.scenes.space import LINE, PLANE, POSE, Space

__all__ = [
    "LINE",
    "PLANE",
    "POSE",
    "BouncingBlock",
    "Drive",
    "FallingBlock",
    "Mode",
    "Moving",
    "OneWayBlock",
    "Scene",
    "SlidingBlock",
    "Space",
    "Step",
    "Trajectory",
    "rollout",
    "slide",
]
