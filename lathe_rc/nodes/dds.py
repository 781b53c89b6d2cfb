# SPDX-License-Identifier: Apache-2.0
"""DDS settings for the nodes of a process; imports nothing of lathe_rc, since the set-up runs this module as well."""

import os
from collections.abc import Mapping
from pathlib import Path

RANGE, PROFILES = "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE"
_LOOPBACK, _NETWORK = (str(Path(__file__).with_name(name)) for name in ("fastdds.xml", "fastdds_network.xml"))
#: variables by which the user chooses the transport
_CHOICES = ("FASTDDS_BUILTIN_TRANSPORTS", "ROS_STATIC_PEERS")


def settings(environ: Mapping[str, str]) -> dict[str, str]:
    """Return the environment variables that restrict DDS to this machine over loopback UDP, unless overridden.

    With the range LOCALHOST, rmw_fastrtps adds shared memory, whatever the profile and ``FASTDDS_BUILTIN_TRANSPORTS``.
    So the profile limits the range instead, to the loopback interface.

    Fast DDS's shared memory is not used because a killed process may leave it locked: other members then block, or no
    longer receive each other's messages. ``FASTDDS_BUILTIN_TRANSPORTS=DEFAULT`` switches it on.
    """
    profiles, reach = environ.get(PROFILES, _LOOPBACK), environ.get(RANGE, "LOCALHOST")
    found = {RANGE: reach, PROFILES: profiles, "SKIP_DEFAULT_XML_FILE": "1"}  # the working directory's may be foreign
    if profiles not in (_LOOPBACK, _NETWORK):
        return found
    if reach == "LOCALHOST" and not any(name in environ for name in _CHOICES):
        return found | {RANGE: "SYSTEM_DEFAULT", PROFILES: _LOOPBACK}
    if reach == "SYSTEM_DEFAULT" and environ.get(PROFILES) == _LOOPBACK:
        return found  # as returned above
    return found | {PROFILES: _NETWORK, "FASTDDS_BUILTIN_TRANSPORTS": environ.get(_CHOICES[0], "UDPv4")}


def settle() -> None:
    """Apply the DDS settings to this process; call it before the first node is created."""
    os.environ.update(settings(os.environ))
