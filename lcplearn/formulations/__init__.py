"""What is learned: torch modules behind one interface, `Formulation`, and the losses that train them."""

from lcplearn.formulations.baselines import MLP, Affine
from lcplearn.formulations.formulation import Formulation, build
from lcplearn.formulations.identified import Identified, Physical
from lcplearn.formulations.line.direct import Direct
from lcplearn.formulations.line.force_mlp import ForceMLP
from lcplearn.formulations.line.formulation import LineFormulation
from lcplearn.formulations.line.relu import ReLU
from lcplearn.formulations.line.slack import Slack
from lcplearn.formulations.line.structured import Structured
from lcplearn.formulations.line.traditional import PSD, PSDSkew, Traditional
from lcplearn.formulations.losses import loss_terms

FORMULATIONS: dict[str, type[Formulation]] = {
    "affine": Affine,
    "mlp": MLP,
    "force_mlp": ForceMLP,
    "direct": Direct,
    "slack": Slack,
    "relu": ReLU,
    "traditional": Traditional,
    "psd": PSD,
    "psd_skew": PSDSkew,
    "structured": Structured,
    "physical": Physical,
}

__all__ = [
    "FORMULATIONS",
    "MLP",
    "PSD",
    "Affine",
    "Direct",
    "ForceMLP",
    "Formulation",
    "Identified",
    "LineFormulation",
    "PSDSkew",
    "Physical",
    "ReLU",
    "Slack",
    "Structured",
    "Traditional",
    "build",
    "loss_terms",
]
