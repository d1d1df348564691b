"""Questions about torch's state that it answers only under private names; every such name of `lcplearn.lcp` is here.

Where a name is gone the answer is "yes", after which the general code runs: slower, never wrong. (A solve that takes
itself to be traced has no forward mode and no second derivative: both raise.)
tests/lcp/test_torch_internals.py says which names a version of torch lacks.
"""

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

_C = torch._C


def traced() -> bool:
    """Whether a tracer records what is done (compile, export, make_fx) or makes fake tensors: numba can't be traced.

    Other modes of torch's dispatcher only watch.
    """
    if torch.compiler.is_compiling():
        return True
    try:
        if _C._dispatch_tls_is_dispatch_key_included(_C.DispatchKey.PreDispatch):
            return True  # make_fx(pre_dispatch=True) and export
        if _C._len_torch_dispatch_stack() == 0:
            return False
        keys = _C._TorchDispatchModeKey
        return _C._get_dispatch_mode(keys.PROXY) is not None or _C._get_dispatch_mode(keys.FAKE) is not None
    except AttributeError:
        return True


def transformed() -> bool:
    """Whether a transform of torch.func is active."""
    try:
        return _C._are_functorch_transforms_active()
    except AttributeError:
        return True


def forward_mode() -> bool:
    """Whether a level of forward-mode differentiation is open, so that tensors may carry tangents."""
    try:
        return forward_ad._current_level >= 0
    except AttributeError:
        return True


def mapped_by_autograd(x: Tensor) -> bool:
    """Whether x stands for many: `torch.autograd.grad(..., is_grads_batched=True)` maps the backward."""
    try:
        return _C._functorch.is_legacy_batchedtensor(x)
    except AttributeError:
        return True
