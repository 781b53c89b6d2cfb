# SPDX-License-Identifier: Apache-2.0
"""Lazily imported public names of a package, listed in its stub, which type checkers read as well.

A name is imported on first use (PEP 562), so a package can export names from many modules without import costs.
"""

import ast
import importlib
import sys
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any


@cache
def homes(package: str) -> dict[str, tuple[str, str]]:
    """Return the module of each of a package's public names, and the object's name in that module."""
    stub = Path(str(sys.modules[package].__file__)).with_suffix(".pyi")
    lines = ast.parse(stub.read_text(encoding="utf-8")).body
    imports = [line for line in lines if isinstance(line, ast.ImportFrom)]
    return {each.asname or each.name: (str(line.module), each.name) for line in imports for each in line.names}


def attribute(package: str, name: str) -> Any:
    """Return a public name of a package; serves as its module-level ``__getattr__``.

    Raises:
        AttributeError: the package has no such name.
    """
    if name == "__all__":
        return sorted(homes(package))
    if name not in homes(package):
        raise AttributeError(f"module {package!r} has no attribute {name!r}")
    module, own = homes(package)[name]
    if module == package:  # the name is a module of the package
        return importlib.import_module(f"{package}.{own}")
    return getattr(importlib.import_module(module), own)


def face(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return the ``__getattr__`` and the ``__dir__`` of a package with a stub of public names."""
    return partial(attribute, package), lambda: sorted([*vars(sys.modules[package]), *homes(package)])
