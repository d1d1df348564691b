"""Tune a position controller through dry friction, by the gradient of the simulation.

A block of 1 kg is to move by 0.1 m and to stay there. Friction holds it wherever the controller pushes with less than
mu m g = 2 N: a spring-like controller alone leaves it short of its goal, and a stiff one overshoots. What the model of
friction brings: it sticks exactly, so the end position means something, and its gradient through all steps is exact
between changes of mode.

    python examples/stick_slip_controller.py
"""

import torch
from torch import Tensor

from lcplearn.scenes import Drive, SlidingBlock

GOAL, DT, STEPS = 0.1, 0.01, 150  # [m], [s]
LIMIT = 20.0  # [N]


def move(block: SlidingBlock, gains: Tensor) -> tuple[Tensor, Tensor]:
    """Run the controller: positions [T + 1, batch] and forces [T, batch] of gains [batch, 3], which are logarithms."""
    stiffness, damping, push = gains.exp().unbind(-1)
    state = torch.zeros(*gains.shape[:-1], 2, dtype=torch.float64)
    positions, forces = [state[..., 0]], []
    for _ in range(STEPS):
        error = GOAL - state[..., 0]
        # Against friction: push / (|error| + 1 mm) is smooth, and vanishes at the goal.
        force = stiffness * error - damping * state[..., 1] + push * error / (error.abs() + 1e-3)
        force = LIMIT * torch.tanh(force / LIMIT)
        state = block.advance(state, Drive(force.unsqueeze(-1))).state
        positions.append(state[..., 0])
        forces.append(force)
    return torch.stack(positions), torch.stack(forces)


def cost(positions: Tensor, forces: Tensor) -> Tensor:
    """Mean distance to the goal over the second half [m], and a little for force."""
    return (positions[STEPS // 2 :] - GOAL).abs().mean(dim=0) + 1e-5 * forces.square().mean(dim=0)


def main(iterations: int = 60) -> tuple[float, float]:
    """Tune; return the distance to the goal before and after [m], with friction that the tuning did not see."""
    torch.set_num_threads(1)
    mu = torch.tensor([0.18, 0.2, 0.22], dtype=torch.float64)  # what we are not sure of: tune for all three
    block = SlidingBlock(mass=1.0, mu=mu, dt=DT)
    gains = torch.tensor([30.0, 8.0, 1.0], dtype=torch.float64).log().requires_grad_()
    optimizer = torch.optim.Adam([gains], lr=0.1)
    before = gains.detach().clone()
    best, lowest = before, float("inf")
    for iteration in range(iterations):
        loss = cost(*move(block, gains.expand(3, 3))).mean()
        if loss < lowest:
            best, lowest = gains.detach().clone(), float(loss.detach())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if iteration % 10 == 0:
            print(f"iteration {iteration:3d}: {1e3 * loss.item():6.2f} mm from the goal, on average")
    unseen = SlidingBlock(mass=1.0, mu=0.19, dt=DT)
    ends = []
    for name, chosen in (("before", before), ("tuned", best)):
        positions, _ = move(unseen, chosen)
        ends.append(float((positions[-1] - GOAL).abs()))
        stiffness, damping, push = chosen.exp().tolist()
        moves = "at rest" if positions[-1] == positions[-2] else "moving"
        print(
            f"{name:>6}: {1e3 * ends[-1]:6.3f} mm off at the end, {moves}; stiffness {stiffness:.1f} N/m, "
            f"damping {damping:.1f} N s/m, push {push:.2f} N"
        )
    return ends[0], ends[1]


if __name__ == "__main__":
    main()
