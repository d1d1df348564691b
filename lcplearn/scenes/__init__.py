"""Physics: (state, force) -> LCP -> next state."""

from lcplearn.scenes.falling_block import BouncingBlock, FallingBlock
from lcplearn.scenes.rollout import Mode, Trajectory, rollout
from lcplearn.scenes.sliding_block import OneWayBlock, SlidingBlock, slide

__all__ = ["BouncingBlock", "FallingBlock", "Mode", "OneWayBlock", "SlidingBlock", "Trajectory", "rollout", "slide"]
