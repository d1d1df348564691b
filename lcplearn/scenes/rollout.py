"""Trajectories of a scene: one step after another."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.scenes.scene import Mode, Trajectory

__all__ = ["Block", "Mode", "Trajectory", "rollout"]


Step = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


def rollout(
    step: Step, state: Float[Tensor, "*#batch nq_plus_nv"], forces: Float[Tensor, "*#batch T nv"]
) -> Trajectory:
    """Apply a step T times.

    state_{k+1}, mode_{k+1} = step(state_k, force_{k+1}).

    Batch dimensions of state, forces and of the scene's own parameters broadcast. Gradients flow through all steps.

    Args:
        step: Maps (state, force) to (next state, mode of each contact).
        state: Positions [m], then velocities [m/s], at the start.
        forces: External force of each step [N]; T >= 1. The force of step k acts from instant k to k + 1.

    Returns:
        The trajectory, with the start as its first instant.

    Raises:
        ValueError: forces has fewer than two dimensions or no step, or state has no room for positions.
    """
    if forces.ndim < 2 or forces.shape[-2] == 0:
        raise ValueError(f"forces: expected shape [*batch, T, nv] with T >= 1, got {list(forces.shape)}")
    nv = forces.shape[-1]
    if state.ndim < 1 or state.shape[-1] <= nv:
        raise ValueError(f"state: expected shape [*batch, nq + nv] with nv = {nv}, got {list(state.shape)}")
    batch = torch.broadcast_shapes(state.shape[:-1], forces.shape[:-2])
    state = state.expand(*batch, state.shape[-1])
    states, modes = [state], []
    for force in forces.unbind(-2):
        state, mode = step(state, force)
        states.append(state)
        modes.append(mode)
    # The first state lacks the dimensions that the scene's own batched parameters add.
    path = torch.stack(torch.broadcast_tensors(*states), dim=-2)
    return Trajectory(path[..., :-nv], path[..., -nv:], torch.stack(torch.broadcast_tensors(*modes), dim=-2))


class Block:
    """A block with one position and one velocity, and a method `advance`: what its step and rollout are."""

    def advance(self, state: Float[Tensor, "*#batch 2"], force: Float[Tensor, "*#batch 1"]) -> tuple[Tensor, Tensor]:
        """Next state [*batch, 2] and contact mode [*batch, 1]."""
        raise NotImplementedError

    def step(self, state: Float[Tensor, "*#batch 2"], force: Float[Tensor, "*#batch 1"]) -> Float[Tensor, "... 2"]:
        """Next state: position or gap [m], and velocity [m/s], under a force [N]."""
        return self.advance(state, force)[0]

    def rollout(self, state: Float[Tensor, "*#batch 2"], forces: Float[Tensor, "*#batch T 1"]) -> Trajectory:
        """Trajectory over T forces [N] from a state."""
        return rollout(self.advance, state, forces)
