# SPDX-License-Identifier: Apache-2.0
"""uv with the settings that the user has made for pip."""

import os
import subprocess
import sys
from pathlib import Path

import installer

UV = Path(sys.executable).with_name("uv")


def uv(*words: str | Path, check: bool = True) -> str:
    """Run uv; return its output, without the text that it prints about its own work."""
    listed = subprocess.run([sys.executable, "-m", "pip", "config", "list"], capture_output=True, text=True, check=True)
    settings = installer.uv_environment(installer.pip_settings(listed.stdout), os.environ)
    settings["UV_LINK_MODE"] = "hardlink"  # nothing here is changed, and copies of 500 MB take their time
    return subprocess.run([UV, *words], env=settings, stdout=subprocess.PIPE, text=True, check=check).stdout
