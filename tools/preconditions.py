# SPDX-License-Identifier: Apache-2.0
"""Conditions of the set-up, checked before anything is made; each that is not met gets one clear line."""

import ctypes
import importlib.util
import os
import platform
import re
import shutil
import sys
import sysconfig
from collections.abc import Mapping
from pathlib import Path

from ros import SourcedRos, site_packages, split_own
from workplace import HOME, ROOT, RefusalError, is_plain, linked_home

# setup.bash and PATH-like lists cannot carry these.
UNSAFE = re.compile(r"[^\S ]|[:;\"$`\\]")
# Libraries of C++ that others bring, and the symbols that the wheels (manylinux_2_28) need of them.
_LIBRARIES = {"libgcc_s.so.1": b"GCC_4.3.0", "libstdc++.so.6": b"GLIBCXX_3.4.24"}


def check(ros: SourcedRos | None) -> None:
    """Check all of them.

    Raises:
        RefusalError: one is not met.
    """
    check_path(ROOT, HOME)
    if ros is None:
        check_wheels_fit()
    check_packages()


def check_path(root: Path, home: Path) -> None:
    """Refuse a checkout whose path, or that of its set-up, would break the scripts made there or cannot be written."""
    if unsafe := UNSAFE.search(str(root)):
        raise RefusalError(f"{str(root)!r} has a {unsafe[0]!r} in it, which ROS 2 cannot handle: move it")
    if not is_plain(home):
        raise RefusalError(
            f"{str(root)!r} needs a folder for its set-up with a path of plain ASCII, and {str(home.parents[2])!r} has "
            "none: XDG_CACHE_HOME=/path ./lathe ..., or move the checkout"
        )
    own = root / ".lathe"
    if own != home and own.exists() and linked_home(root) is None:
        raise RefusalError(f"{own} is in the way of a link to {home}, since ROS 2 cannot handle its path: remove it")
    for folder in (own, home):
        there = next(each for each in (folder, *folder.parents) if each.exists())
        if not os.access(there, os.W_OK):
            raise RefusalError(f"{there} cannot be written, and the set-up is made there: copy the checkout elsewhere")


def check_libraries(environ: Mapping[str, str]) -> None:
    """Refuse a folder of LD_LIBRARY_PATH with a library of C++ that is broken, or older than the packages need."""
    for name, symbol in _LIBRARIES.items():
        there = [Path(folder, name) for folder in split_own(environ.get("LD_LIBRARY_PATH", ""))]
        for path in [path for path in there if path.is_file()][:1]:  # the first one is loaded
            reason = "" if symbol in path.read_bytes() else f"lacks {symbol.decode()}"
            try:
                ctypes.CDLL(str(path))
            except OSError as error:
                reason = str(error).removeprefix(f"{path}: ")
            if reason:
                raise RefusalError(f"{path} {reason}: take {path.parent} out of LD_LIBRARY_PATH")


def check_python_path(environ: Mapping[str, str]) -> None:
    """Refuse a folder of PYTHONPATH with a module of the environment or of Python: it would be imported instead."""
    for folder in map(Path, split_own(environ.get("PYTHONPATH", ""))):
        if folder == ROOT or not folder.is_dir():
            continue
        own = {path.name.removesuffix(".py") for path in site_packages().iterdir()} | sys.stdlib_module_names
        for path in sorted(folder.iterdir()):
            if (name := path.name.removesuffix(".py")).isidentifier() and name in own:
                raise RefusalError(f"{path} hides the {name} that lathe_rc needs: take {folder} out of PYTHONPATH")


def check_wheels_fit() -> None:
    """Refuse a machine for which there are no wheels of ROS 2 (they are manylinux_2_28 x86-64)."""
    system = f"{platform.system()} {platform.machine()}"
    libc, version = platform.libc_ver()
    if system != "Linux x86_64" or libc != "glibc" or tuple(map(int, version.split("."))) < (2, 28):
        raise RefusalError(
            f"no ROS 2 wheels for this machine ({system}, {libc or 'no glibc'} {version}), only for "
            "Linux x86_64 with glibc 2.28 or newer: install ROS 2 (Jazzy or newer) and source it first"
        )


def check_packages() -> None:
    """Refuse to start without a compiler, the venv module or Python's headers, naming their packages."""
    python = f"python{sysconfig.get_python_version()}"
    wanted = {
        "C++ compiler": ("g++", has_compilers()),
        f"venv module for {python}": (f"{python}-venv", has_module("ensurepip")),
        f"Python.h for {python}": (f"{python}-dev", Path(sysconfig.get_path("include"), "Python.h").exists()),
    }
    missing = {name: package for name, (package, there) in wanted.items() if not there}
    if missing:
        raise RefusalError(f"no {', no '.join(missing)}: sudo apt install {' '.join(missing.values())}")


def has_module(name: str) -> bool:
    """Tell whether this interpreter has a module; a folder left behind by its package is none."""
    spec = importlib.util.find_spec(name)
    return spec is not None and spec.origin is not None


def has_compilers() -> bool:
    """Tell whether CMake will find a C and a C++ compiler."""
    return any(map(shutil.which, (os.environ.get("CC", "cc"), "gcc", "clang"))) and any(
        map(shutil.which, (os.environ.get("CXX", "c++"), "g++", "clang++"))
    )
