"""A tossed cube whose numbers are learned, and with them a small network for what they miss."""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lcplearn.formulations.identified import Identified, Number
from lcplearn.scenes.corrected_cube import SHAPES, CorrectedCube
from lcplearn.scenes.tossed_cube import IMPACT_SPEED


class CubeNetwork(Identified):
    """Learn numbers of a `CorrectedCube` and its network, which starts at 0.

    Args:
        dt: Time step [s].
        learn: Starts of the learned numbers.
        corrects: "friction", "restitution" or "force": what the network corrects.
        units: Of its hidden layer.
        seed: Of the hidden layer's start.
        given, fixed, clip: As in `Identified`.
    """

    def __init__(
        self,
        *,
        dt: float,
        learn: Mapping[str, Number],
        corrects: str = "friction",
        units: int = 8,
        seed: int = 0,
        given: Mapping[str, Any] | None = None,
        fixed: Mapping[str, Any] | None = None,
        clip: float | None = None,
    ) -> None:
        if units < 1:
            raise ValueError(f"units: expected at least 1, got {units}")
        inputs, outputs = SHAPES.get(corrects, (1, 1))  # the scene refuses what it does not know
        generator = torch.Generator().manual_seed(seed)
        hidden = torch.randn(units, inputs + 1, generator=generator, dtype=torch.float64)
        network = {"hidden": hidden.tolist(), "outer": [[0.0] * units] * outputs}
        super().__init__(
            scene=CorrectedCube,
            dt=dt,
            learn={**learn, **network},
            given=given,
            fixed={**(fixed or {}), "corrects": corrects},
            clip=clip,
        )
        self.corrects = corrects

    @torch.no_grad()
    def law(self, closing: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Friction or restitution, whichever is corrected, at closing speeds [m/s]."""
        scene: Any = self.moving()
        numbers: dict[str, Tensor] = scene.law(closing)
        if "restitution" in numbers:
            return numbers["restitution"]
        share = (closing / (IMPACT_SPEED * scene.half_width)).clamp(max=1.0)
        return torch.lerp(numbers["mu"], numbers.get("mu_impact", numbers["mu"]), share)

    def physical_parameters(self) -> dict[str, float]:
        """The numbers without the weights of the network."""
        return {
            name: value
            for name, value in super().physical_parameters().items()
            if not name.startswith(("hidden_", "outer_"))
        }
