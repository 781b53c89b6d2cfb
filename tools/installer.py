# SPDX-License-Identifier: Apache-2.0
"""Installing packages with uv, which reads settings of its own: those that the user has made for pip hold here, too."""

import ast
import os
import re
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
# Settings that pip itself keeps beside those: all others, such as user, target or constraint, would turn the set-up.
_OF_PIP = {"cache-dir", "client-cert", "default-timeout", "keyring-provider", "no-cache-dir", "retries", "timeout"}
# Variables of uv that do the same.
_OF_UV = re.compile(
    r"UV_(CACHE_DIR|CONCURRENT_\w+|DEFAULT_INDEX|EXTRA_INDEX_URL|FIND_LINKS|HTTP_\w+|INDEX\w*|INSECURE_HOST"
    r"|KEYRING_PROVIDER|NATIVE_TLS|NO_CACHE|NO_INDEX|OFFLINE|REQUEST_TIMEOUT|SYSTEM_CERTS)"
)
# pip looks for a package at all indexes that it knows. What we mend must not be changed in the cache as well: no links.
_ALIKE = {"UV_INDEX_STRATEGY": "unsafe-best-match", "UV_LINK_MODE": "copy", "UV_PYTHON_DOWNLOADS": "never"}


def pip(*options: str | Path) -> list[str | Path]:
    """Return a command line of pip that installs."""
    return [PYTHON, "-m", "pip", "install", "--no-input", "--no-warn-script-location", *options]


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


def pip_settings(pip_config: str) -> dict[str, str]:
    """Return those of the user's settings of pip that hold here, by name.

    Args:
        pip_config: what ``pip config list`` prints.
    """
    lines = [line.partition("=") for line in pip_config.splitlines() if "=" in line]
    said = {}
    for key, _, value in sorted(lines, key=lambda line: _rank(line[0])):
        said[key.rpartition(".")[2]] = " ".join(str(ast.literal_eval(value)).split())
    return {name: value for name, value in said.items() if name in _SETTINGS.keys() | _OF_PIP}


def pip_environment(settings: Mapping[str, str], environ: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of pip, with these settings and no others."""
    found = {f"PIP_{name.upper().replace('-', '_')}": value for name, value in settings.items()}
    rest = {name: value for name, value in environ.items() if not name.startswith("PIP_")}
    return rest | found | {"PIP_CONFIG_FILE": os.devnull}


def uv_environment(settings: Mapping[str, str], environ: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of uv, without files of settings; what the user's environment has for uv comes first."""
    found = {}
    for name, (variable, separator) in _SETTINGS.items():
        if name in settings:
            found[variable] = separator.join(settings[name].split())
    rest = {name: value for name, value in environ.items() if not name.startswith("UV_") or _OF_UV.fullmatch(name)}
    return _ALIKE | found | rest | {"UV_NO_CONFIG": "1"}


def _rank(key: str) -> int:
    """Return what a setting of pip overrides: the environment those of a command, these those for all commands."""
    return 2 if key.startswith(":env:") else 1 if key.startswith("install.") else 0
