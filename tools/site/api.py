# SPDX-License-Identifier: Apache-2.0
"""Pages of the Python interface, one for each package of lathe_rc, made of the docstrings by mkdocstrings."""

import ast
from pathlib import Path

from workplace import ROOT

FOLDER = "api"
ALONE = "lathe_rc"  # its page has modules that are in no package of it
# In the order in which a user meets them, with the modules of those of which only some are for users. Commands and
# nodes are called by their names, not imported.
PACKAGES: dict[str, tuple[str, ...]] = {
    "harness": (),
    "bag": (),
    "sweep": (),
    "cell": ("scenario", "recording", "batch", "parameters", "stage", "stages.law", "stages.plant"),
    "signals": (),
    "plants": (),
    "control": (),
    "analysis": (),
    "safety": (),
    ALONE: ("messages", "resources", "errors", "jit"),
}


class MissingModuleError(Exception):
    """A module that the pages shall have is not there."""


def modules(package: str) -> list[str]:
    """Return the full names of the public modules of a package, those of its sub-packages too.

    Raises:
        MissingModuleError: one that is chosen by its name is not there.
    """
    root = ROOT / "lathe_rc" / ("" if package == ALONE else package)
    if chosen := PACKAGES[package]:
        places = [root.joinpath(*name.split(".")) for name in chosen]
        for path in places:
            if not path.with_suffix(".py").is_file() and not path.joinpath("__init__.py").is_file():
                raise MissingModuleError(f"tools/site/api.py names {path.relative_to(ROOT)}, which is not there")
        return [_name(path) for path in places]
    return [_name(path) for path in sorted(root.rglob("*.py")) if not path.stem.startswith("_") and _has_content(path)]


def page(package: str, *, bare: bool) -> str:
    """Return the page of a package; ``bare``: with headings alone, for links to be checked in no time."""
    title = ALONE if package == ALONE else f"lathe_rc.{package}"
    summary = ast.get_docstring(ast.parse(_source(package).read_text(encoding="utf-8"))) or ""
    places = [f"## {module} {{ #{module} }}" if bare else f"::: {module}" for module in modules(package)]
    return "\n\n".join([f"# {title}", *filter(None, [summary]), *places]) + "\n"


def place(path: Path) -> str | None:
    """Return page and anchor of a module by its file; None: it is on no page."""
    relative = path.relative_to(ROOT)
    if relative.parts[0] != "lathe_rc" or path.suffix != ".py":
        return None
    package = relative.parts[1] if len(relative.parts) > 2 else ALONE
    name = _name(path)
    return f"{FOLDER}/{package}.md#{name}" if package in PACKAGES and name in modules(package) else None


def _name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def _source(package: str) -> Path:
    return ROOT / "lathe_rc" / ("" if package == ALONE else package) / "__init__.py"


def _has_content(path: Path) -> bool:
    """Tell whether a module defines anything that has a docstring."""
    body = ast.parse(path.read_text(encoding="utf-8")).body
    return any(isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_") for node in body)
