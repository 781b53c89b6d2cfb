# SPDX-License-Identifier: Apache-2.0
"""Creation of user packages from the templates in lathe_rc/templates: a law, a drive, a stage or a study."""

import keyword
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from lathe_rc.cell.scenario import TABLES
from lathe_rc.errors import InputError
from lathe_rc.extensions import COMMON


@dataclass(frozen=True)
class Kind:
    """Template of a package for ``lathe new``.

    Attributes:
        summary: description of the package.
        group: entry-point group of the package.
        members: nodes of the scenario besides spindle and recorder, with ``{}`` for the new node; empty: no scenario.
    """

    summary: str
    group: str
    members: tuple[str, ...] = ()


KINDS = {
    "law": Kind(
        "A repetitive control law over the spindle angle.",
        "lathe_rc.stages",
        ("{}", "electrodynamic_actuator", "tool"),
    ),
    "plant": Kind("A drive of second order with a delay.", "lathe_rc.stages", ("learning_controller", "{}", "tool")),
    "stage": Kind(
        "A filter of the command.", "lathe_rc.stages", ("learning_controller", "{}", "electrodynamic_actuator", "tool")
    ),
    "study": Kind("How the learning gain decides on the form error.", "lathe_rc.studies"),
}


def begin(kind: str, name: str, place: Path, *, compiled: bool) -> list[str]:
    """Create a package from a template.

    Args:
        kind: kind of package, one of `KINDS`.
        name: name of the package and its folder.
        place: parent folder of the new folder.
        compiled: whether the package has a compiled step.

    Returns:
        Names of the files written.

    Raises:
        InputError: the name is not allowed, or the folder exists or cannot be written.
    """
    _check_name(name)
    folder, chosen = place / name, KINDS[kind]
    if folder.exists():
        raise InputError(f"{folder}: exists; allowed: a name that no folder has here")
    words = {
        "kind": kind,
        "name": name,
        "target": "STUDY" if kind == "study" else "".join(part.capitalize() for part in name.split("_")),
        "summary": chosen.summary,
        "group": chosen.group,
        "members": [member.format(name) for member in chosen.members],
        "compiled": compiled,
    }
    files = {
        "pyproject.toml": "package/pyproject.toml.j2",
        "README.md": "package/README.md.j2",
        f"{name}/__init__.py": f"{kind}/__init__.py.j2",
        f"tests/test_{name}.py": "package/test.py.j2" if chosen.members else f"{kind}/test.py.j2",
    }
    if chosen.members:
        files[f"{name}.yaml"] = "package/scenario.yaml.j2"
    _write(folder, files, words)
    return list(files)


def _check_name(name: str) -> None:
    """Reject a name that is not allowed for both a package and a node."""
    if not (name.isascii() and name.isidentifier() and name == name.lower()) or name.startswith("_"):
        raise InputError(f"{name!r}; allowed: small letters, digits and _, a letter first")
    if keyword.iskeyword(name) or name in COMMON:
        raise InputError(f"{name!r} is a word or module of Python's already; allowed: another")
    if name in TABLES.own or name == "tests":
        raise InputError(f"{name!r} is a name of lathe_rc's own; allowed: another")


def _write(folder: Path, files: dict[str, str], words: dict[str, object]) -> None:
    environment = Environment(
        loader=PackageLoader("lathe_rc", "templates"),
        undefined=StrictUndefined,
        trim_blocks=False,
        keep_trailing_newline=True,
        autoescape=False,  # noqa: S701 - the files are not web pages
    )
    try:
        for file, template in files.items():
            path = folder / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(environment.get_template(template).render(words), encoding="utf-8")
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from None
