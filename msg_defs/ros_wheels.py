# SPDX-License-Identifier: Apache-2.0
"""Building against the ROS 2 wheels; for ./lathe and for pip (backend.py)."""

import os
import re
import sysconfig
from pathlib import Path

# What the wheels' CMake files say instead of the paths of the interpreter at hand.
BUILD_MACHINE = re.compile(r"/opt/python/[^/;\"]+/(?:(include)/python3\.\d+|lib/python3\.\d+/site-packages)")
# The wheels' middleware reads the introspection of C alone, and nodes in Python need no type support for C++.
FAST_DDS_ALONE = {"STATIC_ROSIDL_TYPESUPPORT_CPP": "rosidl_typesupport_fastrtps_cpp"}
PYTHON_ALONE = "-DLATHE_RC_MSGS_CPP=OFF"
# Fewer and larger compilations take a third of the time.
CMAKE_OPTIONS = (
    "-GNinja",
    "-DCMAKE_BUILD_TYPE=Release",
    "-DBUILD_TESTING=OFF",
    "-DCMAKE_UNITY_BUILD=ON",
    "-DCMAKE_UNITY_BUILD_BATCH_SIZE=0",
)


def cmake_options(python: str | Path) -> list[str]:
    """Return CMake's options for messages of the interpreter ``python``."""
    return [*CMAKE_OPTIONS, f"-DPython3_EXECUTABLE={python}", f"-DPYTHON_EXECUTABLE={python}"]


def mend_cmake_paths(prefix: Path, site_packages: Path) -> None:
    """Replace the build machine's paths in the wheels' CMake files by those of this interpreter.

    Args:
        prefix: the environment in which the wheels are installed.
        site_packages: its folder of Python packages.
    """
    include = sysconfig.get_path("include")
    for cmake in prefix.glob("share/**/*.cmake"):
        text = cmake.read_text(encoding="utf-8")
        mended = BUILD_MACHINE.sub(lambda path: include if path[1] else str(site_packages), text)
        if mended != text:
            draft = cmake.with_name(cmake.name + ".draft")  # uv links files from its cache, which others use
            draft.write_text(mended, encoding="utf-8")
            draft.replace(cmake)


def environment(prefix: Path, site_packages: Path) -> dict[str, str]:
    """Return what the wheels need in the environment; the arguments are those of `mend_cmake_paths`.

    Their own bootstrap restarts every Python once, to set LD_LIBRARY_PATH in random order. Doing it here, in
    a fixed order and with their guard variable set, saves the restart.
    """
    libraries = [str(prefix / "lib"), *sorted(map(str, site_packages.glob("ros_*.libs")))]
    return {
        "AMENT_PREFIX_PATH": str(prefix),
        "CMAKE_PREFIX_PATH": str(prefix),
        "LD_LIBRARY_PATH": os.pathsep.join(libraries),
        "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1",
    }
