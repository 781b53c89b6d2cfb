# SPDX-License-Identifier: Apache-2.0
"""Settings before the first node of a process: DDS is to stay on this machine, unless the user says otherwise."""

import os
from pathlib import Path

from lathe_rc.nodes import stale_shared_memory
from lathe_rc.nodes.report import VARIABLE


def settle() -> None:
    """Set what the environment leaves open, and remove what killed processes have left in the way."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("SKIP_DEFAULT_XML_FILE", "1")  # a profile in the current folder may be anybody's
    os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(Path(__file__).with_name("fastdds.xml")))
    if VARIABLE not in os.environ:  # else the harness has done it, before the first of its processes
        stale_shared_memory.sweep()
