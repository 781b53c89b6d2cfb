# SPDX-License-Identifier: Apache-2.0
"""Compilation of inner loops: one decorator, one place for its settings, one cache."""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numba
import numpy as np
import numpy.typing as npt
import platformdirs
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numba.np.numpy_support import carray

P = ParamSpec("P")
R = TypeVar("R")

_PACKAGE = Path(__file__).parent
_KERNELS = (
    "transfer.py",
    "signals/*.py",
    "plants/*.py",
    "control/*.py",
    "analysis/*.py",
    "bag/walk.py",
    "safety/*.py",
    "cell/collect.py",
    "cell/program.py",
    "cell/stages/*.py",
)


def _source_hash() -> str:
    """Hash of every file that may hold a kernel."""
    digest = hashlib.sha256(Path(__file__).read_bytes())
    for pattern in _KERNELS:
        for path in sorted(_PACKAGE.glob(pattern)):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


if "NUMBA_CACHE_DIR" not in os.environ:
    # Numba looks for changes in the file of a kernel, not in those of the kernels that it calls: a cache
    # shared between versions of the source would go on using old arithmetic. So each version has its own.
    setattr(numba.config, "CACHE_DIR", str(platformdirs.user_cache_path("lathe_rc") / _source_hash()))  # noqa: B010 - the module makes its names at run time


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function of scalars and arrays; compiled code is kept between runs.

    Neither reassociation nor contraction is allowed (``fastmath`` off), so the same arithmetic gives the
    same bits whatever the length of the block. Division by zero gives inf or NaN as in NumPy. Other threads have the
    interpreter meanwhile.
    """
    compiled = numba.njit(cache=True, error_model="numpy", nogil=True)(function)
    return cast("Callable[P, R]", compiled)


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """A `kernel` that is copied into the kernels that call it.

    For what is called once a sample: to hand over an array costs as much as ten operations.
    """
    compiled = numba.njit(cache=True, error_model="numpy", forceinline=True)(function)
    return cast("Callable[P, R]", compiled)


# ---- addresses: for who keeps the arrays meanwhile --------------------------------------------------------------------


def _pointer_to(kind: Any) -> Any:
    """What makes a pointer of an address, as Numba wants it: signature, and what writes the code."""

    def pointer(_context: object, _address: object) -> Any:
        made = types.CPointer(kind)

        def code(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            return builder.inttoptr(arguments[0], context.get_value_type(made))

        return made(types.int64), code

    return intrinsic(pointer)


_float_at, _integer_at, _octet_at = (_pointer_to(kind) for kind in (types.float64, types.int64, types.uint8))


@inlined
def floats(address: int, shape: Any) -> npt.NDArray[np.float64]:
    """The array of float64 at an address."""
    return carray(_float_at(address), shape)


@inlined
def integers(address: int, shape: Any) -> npt.NDArray[np.int64]:
    """The array of int64 at an address."""
    return carray(_integer_at(address), shape)


@inlined
def octets(address: int, shape: Any) -> npt.NDArray[np.uint8]:
    """The array of uint8 at an address."""
    return carray(_octet_at(address), shape)


@intrinsic
def call(_context: object, _address: Any, _a: Any, _b: Any, _c: Any, _d: Any, _e: Any, _f: Any) -> Any:
    """Call an `entry` by its address."""

    def code(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        whole = ir.IntType(64)
        function = builder.inttoptr(values[0], ir.FunctionType(whole, [whole] * 6).as_pointer())
        return builder.call(function, values[1:])

    return types.int64(*[types.int64] * 7), code


entry: Any = numba.cfunc(types.int64(*[types.int64] * 6), cache=True, error_model="numpy", nopython=True)
