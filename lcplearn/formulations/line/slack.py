"""Velocity affine in slack friction (the notes' 3.1.2), deployed as its own LCP."""

import torch

from lcplearn.formulations.line.direct import KnownFriction
from lcplearn.formulations.line.formulation import Numbers, Pairs, Prediction
from lcplearn.lcp.solve import solve_lcp


class Slack(KnownFriction):
    """Learn the velocity from measured slack friction; predict by solving for the slack.

    training:    (v+, v-) = f(v, u) + G s dt          with the measured slack s = (lambda'-, lambda'+)
    prediction:  0 <= s dt  ⊥  f(v, u) + G s dt >= 0,   v_{k+1} = v+ - v- = w_0 - w_1

    Velocity and slack are complementary, so what was learned is an LCP and a prediction needs no friction. Where both
    slacks are positive both velocities are exactly zero, with any f and G: the block sticks. Where G is not a P-matrix
    the LCP may have no solution; the status of a step's solution says so.

    Source: Pfrommer's "LCP Notes" (2019), section 3.1.2; NOTES 6.2.
    """

    def __init__(self, *, dt: float, gravity: float = 9.81) -> None:
        super().__init__(dt=dt, gravity=gravity)
        with torch.no_grad():
            self.G.copy_(torch.eye(2))  # unit mass: the first predictions are solvable LCPs

    def predict(self, velocity: Numbers, force: Numbers, friction: Pairs | None = None) -> Prediction:
        solution = solve_lcp(self.G, self.free_parts(velocity, force))
        return solution.w[..., 0] - solution.w[..., 1], solution
