# SPDX-License-Identifier: Apache-2.0
"""Installing packages with uv, which reads settings of its own: those that the user has made for pip hold here, too."""

import ast
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path

from workplace import NODE, PYTHON, REQUIREMENTS

# Settings of pip, and the environment variables of uv that say the same.
_SETTINGS = {
    "cert": ("SSL_CERT_FILE", " "),
    "extra-index-url": ("UV_INDEX", " "),
    "find-links": ("UV_FIND_LINKS", ","),
    "index-url": ("UV_DEFAULT_INDEX", " "),
    "no-index": ("UV_NO_INDEX", " "),
    "proxy": ("ALL_PROXY", " "),
    "trusted-host": ("UV_INSECURE_HOST", " "),
}
# pip looks for a package at all indexes that it knows. What we mend must not be changed in the cache as well: no links.
_ALIKE = {"UV_INDEX_STRATEGY": "unsafe-best-match", "UV_LINK_MODE": "copy", "UV_PYTHON_DOWNLOADS": "never"}


def pip(*options: str | Path) -> list[str | Path]:
    """Return a command line of pip that installs."""
    # --no-user: a user's setting of pip would install elsewhere
    return [PYTHON, "-m", "pip", "install", "--no-input", "--no-user", "--no-warn-script-location", *options]


def uv(lists: Iterable[str], locks: Iterable[str]) -> list[str | Path]:
    """Return a command line that installs what files in requirements/ list, as lock files say: versions and hashes.

    All is compiled to byte code: where Python may not write any later, each start would compile it anew.
    """
    files = [word for name in lists for word in ("-r", REQUIREMENTS / name)]
    constraints = [word for name in locks for word in ("-c", REQUIREMENTS / name)]
    target: list[str | Path] = ["--python", PYTHON, "--overrides", REQUIREMENTS / "overrides.txt"]
    return [PYTHON.with_name("uv"), "pip", "install", "--compile-bytecode", *target, *files, *constraints]


def npm() -> list[str | Path]:
    """Return a command line that installs what requirements/package.json lists, as its lock says.

    npm wants its two files where it installs.
    """
    NODE.mkdir(exist_ok=True)
    for name in ("package.json", "package-lock.json"):
        shutil.copy(REQUIREMENTS / name, NODE)
    return [PYTHON.with_name("npm"), "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--prefix", NODE]


def uv_environment(pip_config: str, environ: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of uv.

    Args:
        pip_config: what ``pip config list`` prints.
        environ: the user's; what it says to uv itself comes first.
    """
    said: dict[str, str] = {}
    lines = [line.partition("=") for line in pip_config.splitlines() if "=" in line]
    for key, _, value in sorted(lines, key=lambda line: _rank(line[0])):
        said[key.rpartition(".")[2]] = str(ast.literal_eval(value))
    found = {}
    for name, value in said.items():
        if name in _SETTINGS:
            variable, separator = _SETTINGS[name]
            found[variable] = separator.join(value.split())
    return _ALIKE | found | dict(environ)


def _rank(key: str) -> int:
    """Return what a setting of pip overrides: the environment those of a command, these those for all commands."""
    return 2 if key.startswith(":env:") else 1 if key.startswith("install.") else 0
