# SPDX-License-Identifier: Apache-2.0
"""What DDS is told before the first node of a process: unless the user says otherwise, this machine only."""

import os
from pathlib import Path

_RANGE, _PEERS = "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS"


def settle() -> None:
    """Set what the environment leaves open.

    The range alone would not keep others out: who names this machine's address as a static peer is let in. So with it
    goes a profile of Fast DDS that listens on the loopback interface alone.
    """
    reach = os.environ.setdefault(_RANGE, "LOCALHOST")
    alone = reach == "LOCALHOST" and not os.environ.get(_PEERS)
    profile = Path(__file__).with_name("fastdds_localhost.xml" if alone else "fastdds.xml")
    os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(profile))
