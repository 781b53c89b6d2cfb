# SPDX-License-Identifier: Apache-2.0
# mypy: allow-untyped-calls
"""Compilation of inner loops: one decorator with common settings, and one cache.

Numba stores compiled code in two kinds of files: an index of a kernel's signatures, and the code for each signature. It
does not verify these files, so a flipped bit can change a number or crash the process. Each file of this cache
therefore has a checksum, and a damaged file is removed and written again. An unwritable cache does not stop a run.
"""

import contextlib
import hashlib
import io
import os
import pickle
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numba
import platformdirs
from numba import types
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile, _CacheLocator
from numba.core.ccallback import CFunc

from lathe_rc.errors import InputError
from lathe_rc.extensions import is_ours
from lathe_rc.files import DamagedError, contents, sealed, unsealed

P = ParamSpec("P")
R = TypeVar("R")

_MOST = 2**30  # longest file of the cache [B]
_ROOM = 2**22  # approximate size of the code of a cell [B]
_PACKAGE = Path(__file__).parent
_KERNELS = (
    "arrays.py",
    "compiled/*.py",
    "signals/*.py",
    "analysis/*.py",
    "bag/reading/chunk_messages.py",
    "safety/*.py",
    "cell/ahead.py",
    "cell/program.py",
    "../lathe_machine/**/*.py",
    "../lathe_bagtools/resimulation/bag_spindle.py",
    "../lathe_papers/adrc.py",
    "../lathe_papers/formulas/*.py",
)


def _source_hash() -> str:
    """Return one hash of all files that may contain a kernel."""
    digest = hashlib.sha256(Path(__file__).read_bytes())
    for pattern in _KERNELS:
        for path in sorted(_PACKAGE.glob(pattern)):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


SOURCES = _source_hash()


def _is_writable(folder: Path) -> bool:
    """Return whether a folder can be written, or made."""
    there = next(place for place in (folder, *folder.parents) if os.access(place, os.F_OK))
    return there.is_dir() and os.access(there, os.W_OK)


@cache
def _usual_folder() -> Path:
    """Return the folder of the user's cache, or one of the Python environment if only that can be written."""
    places = platformdirs.user_cache_path("lathe_rc"), Path(sys.prefix, "var", "cache", "lathe_rc")
    return next(filter(_is_writable, places), places[0])


def cache_folder() -> Path:
    """Return the folder for compiled code.

    Numba detects changes in a kernel's own file, but not in the kernels that it calls, so with a cache shared between
    versions of the source, outdated code would run. Each version of the source therefore has its own folder.
    """
    return Path(os.environ.get("NUMBA_CACHE_DIR") or _usual_folder()) / SOURCES


if "NUMBA_CACHE_DIR" not in os.environ:
    setattr(numba.config, "CACHE_DIR", str(cache_folder()))  # noqa: B010 - for third-party kernels; the attributes of numba.config are created at run time


# ---- the cache -----------------------------------------------------------------------------------------------------


def read_kept(path: Path) -> memoryview | None:
    """Return the content of a cache file; None if the file is missing, unreadable or damaged.

    A damaged file is reported and removed.
    """
    try:
        return unsealed(contents(path, _MOST))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        say_not_kept(str(error.strerror))
        return None
    except DamagedError as error:
        print(f"lathe: {path}: damaged ({error}): thrown away, and made anew", file=sys.stderr)
        with contextlib.suppress(OSError):
            path.unlink()
        return None


@cache
def say_not_kept(reason: str) -> None:
    """Print once per process that compiled code cannot be cached."""
    print(
        f"lathe: {cache_folder()}: compiled code cannot be kept ({reason}), so that each process compiles it for "
        "itself; NUMBA_CACHE_DIR in the environment names another folder",
        file=sys.stderr,
    )


def can_keep() -> bool:
    """Return whether compiled code can be cached: the folder is writable and has room; otherwise print a warning."""
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(_ROOM))
    except OSError as error:
        say_not_kept(str(error.strerror))
        return False
    return True


class _Place(_CacheLocator):
    """Cache location of a kernel; the folder need not exist or be writable, and the kernel needs no source file."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._py_file = file  # shown in Numba's warnings
        self._line = function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> "_Place":
        return cls(py_func, py_file)

    def get_cache_path(self) -> str:
        return str(cache_folder() / self.get_suitable_cache_subpath(self._py_file))

    def get_source_stamp(self) -> str:
        return SOURCES

    def get_disambiguator(self) -> str:
        return str(self._line)


class _Implementation(CompileResultCacheImpl):
    _locator_classes = [_Place]  # noqa: RUF012 - as in Numba


class _Files(IndexDataCacheFile):
    """Cache files of a kernel: index and code."""

    @contextlib.contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[io.BytesIO]:
        content = io.BytesIO()
        yield content
        with super()._open_for_write(filepath) as file:
            file.write(sealed(content.getvalue()))

    def _load_index(self) -> Any:
        return {} if read_kept(Path(self._index_path)) is None else super()._load_index()

    def _load_data(self, name: str) -> Any:
        content = read_kept(Path(self._data_path(name)))
        return None if content is None else pickle.loads(content)  # noqa: S301 - as Numba does


class _Cache(FunctionCache):
    """Compilation cache of a kernel."""

    _impl_class = _Implementation

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = _Files(self.cache_path, self._impl.filename_base, SOURCES)

    def save_overload(self, sig: object, data: object) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            say_not_kept(str(error.strerror))


# ---- kernels -------------------------------------------------------------------------------------------------------


def check_compiler() -> None:
    """Check that kernels are compiled.

    Raises:
        InputError: the environment switches the compiler off.
    """
    if vars(numba.config)["DISABLE_JIT"]:
        raise InputError(
            "NUMBA_DISABLE_JIT = 1; allowed: 0 or unset, as offline runs need compiled code (nodes run without it)"
        )


def _kept(compiled: Any, function: Callable[..., Any]) -> Any:
    compiled._cache = _Cache(function)  # noqa: SLF001 - Numba's own cache does not verify its files
    return compiled


def _compiled(function: Callable[..., Any], **options: Any) -> Any:
    compiled = numba.njit(error_model="numpy", **options)(function)
    return _kept(compiled, function) if is_ours(function.__module__) else compiled


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function of scalars and arrays with Numba; compiled code is cached between runs.

    Neither reassociation nor contraction is allowed (``fastmath`` is off), so the same arithmetic gives bit-identical
    results for every block length. Division by zero gives inf or NaN, as in NumPy. The kernel releases the GIL.

    Example:
        >>> import lathe_rc
        >>> @lathe_rc.kernel
        ... def clipped(value: float, limit: float) -> float:
        ...     return min(max(value, -limit), limit)
        >>> clipped(3.0, 2.0)
        2.0
    """
    return cast("Callable[P, R]", _compiled(function, nogil=True))


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a `kernel` that is inlined into the kernels that call it.

    This suits functions called once per sample, since passing an array costs as much as ten operations.
    """
    return cast("Callable[P, R]", _compiled(function, forceinline=True))


def entry(function: Callable[..., int]) -> Any:
    """Compile a function from six addresses or integers to an integer; other kernels `call` it by its ``address``."""
    signature = (types.int64,) * 6, types.int64
    compiled = _kept(CFunc(function, signature, locals={}, options={"error_model": "numpy"}), function)
    compiled.compile()
    return compiled
