# SPDX-License-Identifier: Apache-2.0
"""Calls of C functions by their addresses, for kernels."""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

_STATUS = ir.IntType(32)
_unpack: Any = cgutils.unpack_tuple  # Numba has few types


def _call(_context: object, address: Any, arguments: Any) -> Any:
    def code(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        given = _unpack(builder, values[1], len(arguments))
        function = builder.inttoptr(values[0], ir.FunctionType(_STATUS, [each.type for each in given]).as_pointer())
        return builder.sext(builder.call(function, given), ir.IntType(64))

    return types.int64(address, arguments), code


#: (address, tuple of integers and floats): the C int that the function returns; an integer argument may also be an
#: address, or stand for a shorter C integer
c_status: Any = intrinsic(_call)
