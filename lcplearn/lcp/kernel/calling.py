"""Compiled functions that call others by their address: inlined, a large one would be compiled anew in each."""

from typing import Any

from llvmlite import ir
from numba import typeof
from numba.core import cgutils, types
from numba.extending import intrinsic


def address_of(function: Any, *arguments: Any) -> int:
    """Where the code of a compiled function is, for arguments of the types of these."""
    signature = tuple(typeof(x) for x in arguments)
    function.compile(signature)  # does nothing where it is compiled
    code = function.overloads[signature]
    return int(code.library.get_pointer_to_function(code.fndesc.llvm_cfunc_wrapper_name))


def _call_code(_: Any, address: Any, arguments: Any) -> Any:
    """Call compiled code at an address with a tuple of arguments of the types that it was compiled for."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        values = cgutils.unpack_tuple(builder, args[1])
        kind = ir.FunctionType(ir.VoidType(), [x.type for x in values])
        builder.call(builder.inttoptr(args[0], kind.as_pointer()), values)
        return context.get_dummy_value()

    return types.void(address, arguments), codegen


call: Any = intrinsic(_call_code)
