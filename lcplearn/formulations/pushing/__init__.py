"""Models of pushes: (configuration, start pose, finger path) -> end pose and force."""

from lcplearn.formulations.pushing.baselines import PushMLP, Ridge
from lcplearn.formulations.pushing.push_model import PushModel, PushPrediction
from lcplearn.formulations.pushing.residual import Residual
from lcplearn.formulations.pushing.supports import Supports

__all__ = ["PushMLP", "PushModel", "PushPrediction", "Residual", "Ridge", "Supports"]
