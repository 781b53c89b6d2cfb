# SPDX-License-Identifier: Apache-2.0
"""What DDS is told before the first node of a process: unless the user says otherwise, this machine only."""

import os
from pathlib import Path


def settle() -> None:
    """Set what the environment leaves open."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(Path(__file__).with_name("fastdds.xml")))
