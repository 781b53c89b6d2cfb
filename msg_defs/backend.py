# SPDX-License-Identifier: Apache-2.0
"""The build backend of lathe_rc_msgs: scikit-build-core, in the environment that the ROS 2 wheels need."""

import importlib.util
import os
import sys
from pathlib import Path
from typing import Any

from scikit_build_core import build
from scikit_build_core.build import build_sdist, get_requires_for_build_sdist, prepare_metadata_for_build_wheel

from ros_wheels import FAST_DDS_ALONE, PYTHON_ALONE, cmake_options, environment, mend_cmake_paths

__all__ = [
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
    "prepare_metadata_for_build_wheel",
]


def get_requires_for_build_wheel(_settings: Any = None) -> list[str]:
    """Return what requirements.in lists."""
    lines = Path(__file__).with_name("requirements.in").read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line and not line.startswith("#")]


def build_wheel(directory: str, settings: Any = None, metadata: str | None = None) -> str:
    """Build the messages for this interpreter and return the name of the wheel in ``directory``."""
    spec = importlib.util.find_spec("ament_package")
    assert spec is not None, "requirements.in lists it"
    assert spec.origin is not None, "it is a package"
    site_packages = Path(spec.origin).parents[1]
    prefix = site_packages.parents[2]
    mend_cmake_paths(prefix, site_packages)
    options = [*cmake_options(sys.executable), PYTHON_ALONE]
    os.environ.update(environment(prefix, site_packages) | FAST_DDS_ALONE | {"CMAKE_ARGS": " ".join(options)})
    return build.build_wheel(directory, settings, metadata)
