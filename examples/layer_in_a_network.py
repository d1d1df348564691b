"""The LCP layer inside a network: learn an equilibrium problem from its solutions alone.

Somebody solves LCPs 0 <= z ⟂ M z + q(x) >= 0 and shows us inputs x and answers z, and neither M nor q. A network gives
q, and M is a parameter, positive semidefinite plus skew, so that the layer solves it whatever is learned. What an
answer has as zero is zero here too, exactly, which no regression of z on x would give.

    python examples/layer_in_a_network.py
"""

import torch
from torch import Tensor, nn

import lcplearn


class Equilibrium(nn.Module):
    """A network for q, a learned M, and the layer behind them."""

    def __init__(self, inputs: int, n: int) -> None:
        super().__init__()
        self.q = nn.Sequential(nn.Linear(inputs, 16), nn.Tanh(), nn.Linear(16, n))
        self.factor = nn.Parameter(torch.eye(n))
        self.skew = nn.Parameter(torch.zeros(n, n))
        self.layer = lcplearn.LCPLayer()

    def forward(self, x: Tensor) -> Tensor:
        M = self.factor @ self.factor.T + self.skew - self.skew.T + 0.1 * torch.eye(len(self.factor))
        return self.layer(M, self.q(x)).z  # what is not solved has a zero gradient (this M is always solved)


def main(steps: int = 600) -> float:
    """Train; return the share of exact zeros, of inputs never seen, that come out as exact zeros."""
    torch.manual_seed(0)
    torch.set_num_threads(1)
    M = torch.tensor([[1.0, 0.8, 0.0], [-0.8, 1.0, 0.5], [0.0, -0.5, 1.0]])  # not symmetric
    A = torch.randn(3, 2)

    def answers(x: Tensor) -> Tensor:
        return lcplearn.solve_lcp(M, x @ A.T, throw=True).z

    model = Equilibrium(inputs=2, n=3)
    optimizer = torch.optim.Adam(model.parameters(), lr=0.01)
    for step in range(steps):
        x = torch.randn(256, 2)
        loss = (model(x) - answers(x)).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 100 == 0 or step == steps - 1:
            print(f"step {step:4d}   loss {loss.item():.2e}")
    with torch.no_grad():
        x = torch.randn(1000, 2)
        zero = answers(x) == 0
        kept = ((model(x) == 0) & zero).sum() / zero.sum()
    print(f"{zero.float().mean():.0%} of the answers are zero; {kept:.1%} of these are exactly zero in the model")
    return float(kept)


if __name__ == "__main__":
    main()
