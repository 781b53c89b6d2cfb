# SPDX-License-Identifier: Apache-2.0
"""Python without the modules and names that Windows or macOS lack, for our packages alone, in all processes."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import mypy

_TYPESHED = Path(mypy.__file__).parent / "typeshed" / "stdlib"
_MODULES = ("fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty")  # which Windows lacks
_CUT = ("faulthandler", "mmap", "os", "select", "signal", "socket", "time")  # of which it lacks names
_SITE = """
import builtins, sys, types
modules, names, whole = {modules}, {names}, builtins.__import__

class Lacking:
    def __init__(self, module, lacks):
        self.__dict__.update(_module=module, _lacks=lacks)
    def __getattr__(self, name):
        if name in self._lacks:
            raise AttributeError(f"this system has no {{self._module.__name__}}.{{name}}")
        return getattr(self._module, name)

def imported(name, globals=None, locals=None, fromlist=(), level=0):
    ours = str((globals or {{}}).get("__name__")).startswith("lathe_")
    if ours and name in modules:
        raise ModuleNotFoundError(f"this system has no module {{name}}", name=name)
    module = whole(name, globals, locals, fromlist, level)
    return Lacking(module, names[name]) if ours and name in names else module

builtins.__import__ = imported
"""


def _defined(body: list[ast.stmt], platform: str) -> Iterator[str]:
    """Yield the names that a stub defines on a platform."""
    for node in body:
        if isinstance(node, ast.If):
            known = {"sys": SimpleNamespace(platform=platform, version_info=sys.version_info)}
            holds = eval(ast.unparse(node.test), known)  # noqa: S307 - of a stub
            yield from _defined(node.body if holds else node.orelse, platform)
        elif isinstance(node, ast.AnnAssign):
            yield ast.unparse(node.target)
        elif isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            yield node.name


def lacking(module: str) -> set[str]:
    """Return the names of a module of the standard library that Linux has, but not both Windows and macOS."""
    (stub,) = (path for path in (_TYPESHED / f"{module}.pyi", _TYPESHED / module / "__init__.pyi") if path.exists())
    body = ast.parse(stub.read_text(encoding="utf-8")).body
    linux, windows, macos = (set(_defined(body, platform)) for platform in ("linux", "win32", "darwin"))
    return linux - (windows & macos)


def write_site(folder: Path) -> None:
    """Write the module that each Python process imports first, for a folder in PYTHONPATH or of an environment."""
    names = {module: lacking(module) for module in _CUT}
    (folder / "sitecustomize.py").write_text(_SITE.format(modules=_MODULES, names=names), encoding="utf-8")
