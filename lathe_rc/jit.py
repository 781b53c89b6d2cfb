# SPDX-License-Identifier: Apache-2.0
"""Compilation of inner loops: one decorator, one place for its settings, one cache."""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar, cast

import numba
import platformdirs

from lathe_rc.extensions import is_ours

P = ParamSpec("P")
R = TypeVar("R")

_PACKAGE = Path(__file__).parent
_KERNELS = (
    "arrays.py",
    "placed.py",
    "transfer.py",
    "signals/*.py",
    "plants/*.py",
    "control/*.py",
    "analysis/*.py",
    "bag/resimulation/bag_spindle.py",
    "bag/reading/chunk_messages.py",
    "safety/*.py",
    "cell/native.py",
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


def cache_folder() -> Path:
    """Where compiled code is kept."""
    return Path(os.environ.get("NUMBA_CACHE_DIR") or getattr(numba.config, "CACHE_DIR"))  # noqa: B009 - see above


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function of scalars and arrays; compiled code is kept between runs.

    Neither reassociation nor contraction is allowed (``fastmath`` off), so the same arithmetic gives the
    same bits whatever the length of the block. Division by zero gives inf or NaN as in NumPy. Other threads have the
    interpreter meanwhile.
    """
    compiled = numba.njit(cache=is_ours(function.__module__), error_model="numpy", nogil=True)(function)
    return cast("Callable[P, R]", compiled)


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """A `kernel` that is copied into the kernels that call it.

    For what is called once a sample: to hand over an array costs as much as ten operations.
    """
    compiled = numba.njit(cache=is_ours(function.__module__), error_model="numpy", forceinline=True)(function)
    return cast("Callable[P, R]", compiled)
