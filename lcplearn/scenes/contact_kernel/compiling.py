"""How the compiled functions of scenes are compiled and cached."""

from collections.abc import Iterable
from hashlib import sha256
from inspect import unwrap
from pathlib import Path
from typing import Any

from torch import Tensor

from lcplearn.lcp.kernel import jit
from lcplearn.lcp.torch_internals import mapped_by_autograd


def compiled(function: Any, cached: bool = False) -> Any:
    """Compiled as the layer's kernel is; with a cache on disk if asked for."""
    function = unwrap(function)  # in tests jaxtyping wraps every function
    return jit.cached(function) if cached else jit.jit(function)


def merged(function: Any) -> Any:
    """As `compiled`, but as part of its only caller: to pass many arrays takes longer than what is done to them."""
    return jit.jit_merged(unwrap(function))


def fingerprint(*files: str) -> str:
    """Of the sources of a compiled function, in this folder and elsewhere.

    numba watches one file alone, but a closure's values are part of a function's key.
    """
    here = Path(__file__).parent
    layer = (f"../lcp/kernel/{name}.py" for name in ("calling", "jit", "memory"))
    names = ("contact_gradient.py", "friction_lcp.py", *layer, *files)
    sources = [*sorted(here.glob("*.py")), *(here.parent / name for name in names)]
    return sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()


def refuse_batched(gradients: Iterable[Tensor]) -> None:
    """A compiled gradient has numbers to look at, not a tensor that stands for many.

    Raises:
        RuntimeError: `torch.autograd.grad(..., is_grads_batched=True)` or a vectorised Jacobian asks for it.
    """
    if any(mapped_by_autograd(x) for x in gradients):
        raise RuntimeError(
            "gradients of compiled scenes can't be batched (is_grads_batched or vectorize=True): ask for one after the "
            "other, or repeat the scene along a batch dimension"
        )
