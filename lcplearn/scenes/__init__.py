"""Physics: (state, drive) -> LCP -> next state."""

from lcplearn.scenes.falling_block import BouncingBlock, FallingBlock
from lcplearn.scenes.planar_block import PlanarBlock
from lcplearn.scenes.planar_body import PlanarBody, PlanarStack
from lcplearn.scenes.scene import Drive, Mode, Moving, Scene, Step, Trajectory, rollout
from lcplearn.scenes.sliding_block import OneWayBlock, SlidingBlock, slide
from lcplearn.scenes.space import LINE, PLANE, POSE, TABLE, Space
from lcplearn.scenes.spatial_body import SpatialBody, box_corners
from lcplearn.scenes.spring_block import SpringBlock
from lcplearn.scenes.tossed_cube import TossedCube

__all__ = [
    "LINE",
    "PLANE",
    "POSE",
    "TABLE",
    "BouncingBlock",
    "Drive",
    "FallingBlock",
    "Mode",
    "Moving",
    "OneWayBlock",
    "PlanarBlock",
    "PlanarBody",
    "PlanarStack",
    "Scene",
    "SlidingBlock",
    "Space",
    "SpatialBody",
    "SpringBlock",
    "Step",
    "TossedCube",
    "Trajectory",
    "box_corners",
    "rollout",
    "slide",
]
