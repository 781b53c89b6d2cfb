# SPDX-License-Identifier: Apache-2.0
"""Pages of the Python interface, one for each package, made of the docstrings by mkdocstrings."""

import ast
from pathlib import Path

from workplace import ROOT

FOLDER = "api"
# In the order in which a user meets them, with the modules of those of which only some are for users. Commands and
# nodes are called by their names, not imported.
PACKAGES: dict[str, tuple[str, ...]] = {
    "lathe_rc.harness": (),
    "lathe_rc.bag": (),
    "lathe_rc.cell": ("scenario", "recording", "batch", "parameters", "stage"),
    "lathe_machine.stages": ("learning.law", "drive.plant"),
    "lathe_machine.signals": (),
    "lathe_machine.plants": (),
    "lathe_machine.control": (),
    "lathe_machine.analysis": (),
    "lathe_machine.safety": (),
    "lathe_rc.signals": (),
    "lathe_rc.analysis": (),
    "lathe_rc.safety": (),
    "lathe_rc": ("messages", "resources", "errors", "jit"),
    "lathe_bagtools": ("hosts", "resimulation.resim", "resimulation.identify"),
    "lathe_commission": (),
    "lathe_explore.sweep": (),
    "lathe_export": ("tables.export", "c_library.library", "c_library.fmu"),
}


class MissingModuleError(Exception):
    """A module that the pages shall have is not there."""


def modules(package: str) -> list[str]:
    """Return the full names of the public modules of a package, those of its sub-packages too.

    Raises:
        MissingModuleError: one that is chosen by its name is not there.
    """
    root = ROOT.joinpath(*package.split("."))
    if chosen := PACKAGES[package]:
        places = [root.joinpath(*name.split(".")) for name in chosen]
        for path in places:
            if not path.with_suffix(".py").is_file() and not path.joinpath("__init__.py").is_file():
                raise MissingModuleError(f"tools/site/api.py names {path.relative_to(ROOT)}, which is not there")
        return [_name(path) for path in places]
    return [
        _name(path)
        for path in sorted(root.rglob("*.py"))
        if not path.stem.startswith("_") and "commands" not in path.parts and _has_content(path)
    ]


def page(package: str, *, bare: bool) -> str:
    """Return the page of a package; ``bare``: with headings alone, for links to be checked in no time."""
    source = ROOT.joinpath(*package.split("."), "__init__.py").read_text(encoding="utf-8")
    summary = ast.get_docstring(ast.parse(source)) or ""
    places = [f"## {module} {{ #{module} }}" if bare else f"::: {module}" for module in modules(package)]
    return "\n\n".join([f"# {package}", *filter(None, [summary]), *places]) + "\n"


def place(path: Path) -> str | None:
    """Return page and anchor of a module by its file; None: it is on no page."""
    name = _name(path)
    pages = [package for package in PACKAGES if path.suffix == ".py" and name in modules(package)]
    return f"{FOLDER}/{pages[0]}.md#{name}" if pages else None


def _name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def _has_content(path: Path) -> bool:
    """Tell whether a module defines anything that has a docstring."""
    body = ast.parse(path.read_text(encoding="utf-8")).body
    return any(isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_") for node in body)
