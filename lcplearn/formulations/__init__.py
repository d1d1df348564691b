"""What is learned: torch modules behind one interface, `Formulation`, and the losses that train them."""

from lcplearn.formulations.baselines import MLP, Affine, ForceMLP
from lcplearn.formulations.direct import Direct
from lcplearn.formulations.formulation import Formulation
from lcplearn.formulations.losses import LOSS_TERMS, Windows, loss_terms
from lcplearn.formulations.relu import ReLU
from lcplearn.formulations.slack import Slack
from lcplearn.formulations.structured import Physical, Structured
from lcplearn.formulations.traditional import PSD, PSDSkew, Traditional

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
    "LOSS_TERMS",
    "MLP",
    "PSD",
    "Affine",
    "Direct",
    "ForceMLP",
    "Formulation",
    "PSDSkew",
    "Physical",
    "ReLU",
    "Slack",
    "Structured",
    "Traditional",
    "Windows",
    "loss_terms",
]
