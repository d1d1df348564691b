"""How the compiled functions of scenes are compiled, cached, and called from each other.

A big function that others need is compiled once and called by its address: inlined it would be compiled in each.
"""

from collections.abc import Iterable
from functools import cache
from hashlib import sha256
from inspect import unwrap
from pathlib import Path
from typing import Any

import numpy as np
import torch
from llvmlite import ir
from numba import typeof
from numba.core import cgutils, types
from numba.extending import intrinsic
from torch import Tensor

from lcplearn.lcp import pivoting
from lcplearn.lcp.kernel import jit
from lcplearn.lcp.torch_internals import mapped_by_autograd


def compiled(function: Any, cached: bool = False) -> Any:
    """Compiled as the layer's kernel is; with a cache on disk if asked for."""
    function = unwrap(function)  # in tests jaxtyping wraps every function
    return jit.cached(function) if cached else jit.jit(function)


def fingerprint(*files: str) -> str:
    """Of the sources of a compiled function, in this folder and elsewhere.

    numba watches one file alone, but a closure's values are part of a function's key.
    """
    here = Path(__file__).parent
    names = ("friction_lcp.py", "../lcp/kernel/memory.py", *files)
    sources = [*sorted(here.glob("*.py")), *(here.parent / name for name in names)]
    return sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()


def address_of(function: Any, *arguments: Any) -> int:
    """Where the code of a compiled function is, for arguments of the types of these."""
    signature = tuple(typeof(x) for x in arguments)
    function.compile(signature)  # does nothing where it is compiled
    code = function.overloads[signature]
    return int(code.library.get_pointer_to_function(code.fndesc.llvm_cfunc_wrapper_name))


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


def _call_code(_: Any, address: Any, arguments: Any) -> Any:
    """Call compiled code at an address with a tuple of arguments of the types that it was compiled for."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        values = cgutils.unpack_tuple(builder, args[1])
        kind = ir.FunctionType(ir.VoidType(), [x.type for x in values])
        builder.call(builder.inttoptr(args[0], kind.as_pointer()), values)
        return context.get_dummy_value()

    return types.void(address, arguments), codegen


call: Any = intrinsic(_call_code)


@cache
def solver_address() -> int:
    """Where the layer's compiled solver is."""
    M, q = torch.eye(2, dtype=torch.float64), -torch.ones(2, dtype=torch.float64)
    pivoting.solve_batch(M, q, single_precision=False, max_iter=None)
    places = (0,) * 7
    return address_of(pivoting.solve_range, 1, 2, False, 0, 0, 1e-10, False, -1, False, np.empty(1), *places)
