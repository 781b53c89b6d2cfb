# SPDX-License-Identifier: Apache-2.0
"""The two sources of ROS 2: one that the user has sourced, or the wheels."""

import os
import sys
import sysconfig
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from workplace import HOME, VENV, RefusalError


class SourcedRos(NamedTuple):
    """A ROS 2 installation that was sourced before ./lathe was called."""

    distro: str
    prefixes: tuple[str, ...]

    def python_version(self) -> str:
        """Return the Python that this ROS was built for, such as ``3.12``.

        Raises:
            RefusalError: it has no rclpy.
        """
        for prefix in self.prefixes:
            for rclpy in sorted(Path(prefix).glob("lib/python3.*/site-packages/rclpy")):
                return rclpy.parts[-3].removeprefix("python")
        raise RefusalError(
            f"the sourced ROS 2 ({self.distro}) has no rclpy: source a complete one, or unset ROS_DISTRO"
        )

    def python(self) -> Path:
        """Return the interpreter of this ROS: ours, its own, or the system's.

        Raises:
            RefusalError: none of them has the version that this ROS was built for.
        """
        version = self.python_version()
        own = [Path(prefix, "bin", "python3") for prefix in self.prefixes]
        others = [] if "LATHE_PYTHON" in os.environ else [*own, Path("/usr/bin/python3")]
        for candidate in [*others, Path(sys.executable)]:
            if candidate.exists() and candidate.resolve().name == f"python{version}":
                return candidate
        raise RefusalError(
            f"the sourced ROS 2 ({self.distro}) is for Python {version}: "
            f"name that one with LATHE_PYTHON=/path/to/python{version} ./lathe ..."
        )


def sourced_ros(environ: Mapping[str, str]) -> SourcedRos | None:
    """Return the ROS 2 that the user has sourced; an environment made by ./lathe does not count as one."""
    prefixes = split_own(environ.get("AMENT_PREFIX_PATH", ""))
    distro = environ.get("ROS_DISTRO")
    return SourcedRos(distro, tuple(prefixes)) if distro and prefixes else None


def split(path_list: str) -> list[str]:
    """Split a value such as PATH's."""
    return [entry for entry in path_list.split(os.pathsep) if entry]


def split_own(path_list: str) -> list[str]:
    """Split a value such as PATH's into the user's own entries, without those of a ./lathe that called us."""
    return [entry for entry in split(path_list) if HOME.name not in Path(entry).parts]


def site_packages() -> Path:
    """Return the site-packages folder of the virtual environment."""
    return VENV / "lib" / f"python{sysconfig.get_python_version()}" / "site-packages"
