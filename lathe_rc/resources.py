# SPDX-License-Identifier: Apache-2.0
"""Locations of the scenarios and profiles that are installed with lathe_rc."""

import os
import sys
from pathlib import Path

from lathe_rc.errors import InputError
from lathe_rc.names import instead


def config_folders() -> list[Path]:
    """Return the configuration folders in order of precedence: checkout, ament prefixes, Python environment."""
    prefixes = [prefix for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix]
    shared = [Path(prefix) / "share" / "lathe_rc" / "config" for prefix in [*prefixes, sys.prefix]]
    return [folder for folder in [Path(__file__).parents[1] / "config", *shared] if folder.is_dir()]


def scenario(path: Path) -> Path:
    """Return the file of a scenario: `find` applied to ``path``, or to the same name with ``.yaml``.

    Raises:
        InputError: there is no such file (the message names similar ones), or the current folder and lathe_rc both
            have a scenario of this name.
    """
    # A folder of that name, such as a package created by lathe new, is not a scenario.
    folder = path.is_dir() and bool(path.name.strip(".")) and find(path.with_suffix(".yaml")).exists()
    if not path.suffix and (folder or not path.exists()):
        path = path.with_suffix(".yaml")
        ours = next((folder / path for folder in config_folders() if (folder / path).exists()), None)
        if path.exists() and ours and not path.samefile(ours):
            raise InputError(f"{path.stem}: {path} here, or {ours}; name the file, with its ending")
    found, folders = find(path), config_folders()
    if found.exists() or path.name != str(path) or not folders:
        return found  # the error is reported when the file is read
    known = sorted(file.stem for file in folders[0].glob("*.yaml"))
    raise InputError(f"{path}: no such file or scenario; {instead(path.stem, known, listing=f'ls {folders[0]}')}")


def find(path: Path) -> Path:
    """Return ``path`` if it exists or is absolute; otherwise the same name in a configuration folder, if one has it."""
    if path.exists() or path.is_absolute():
        return path
    return next((folder / path for folder in config_folders() if (folder / path).exists()), path)


def is_own(path: Path) -> bool:
    """Return whether a file is installed with lathe_rc."""
    return any(path.resolve().is_relative_to(folder.resolve()) for folder in config_folders())
