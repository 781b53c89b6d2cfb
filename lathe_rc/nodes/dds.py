# SPDX-License-Identifier: Apache-2.0
"""Settings of DDS for the nodes of a process; this module imports nothing of lathe_rc, for the set-up runs it, too."""

import os
from collections.abc import Mapping
from pathlib import Path

RANGE, PROFILES = "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE"
_LOOPBACK, _NETWORK = (str(Path(__file__).with_name(name)) for name in ("fastdds.xml", "fastdds_network.xml"))
#: with one of them the user chooses the transport
_CHOICES = ("FASTDDS_BUILTIN_TRANSPORTS", "ROS_STATIC_PEERS")


def settings(environ: Mapping[str, str]) -> dict[str, str]:
    """Return the variables that keep DDS on this machine, over loopback UDP, unless an environment says otherwise.

    With the range LOCALHOST, rmw_fastrtps adds shared memory whatever the profile and ``FASTDDS_BUILTIN_TRANSPORTS``
    say. So the profile limits the range instead, to the loopback interface.

    Fast DDS's shared memory is not used because a killed process may leave it locked: other members then wait, or no
    longer hear each other. ``FASTDDS_BUILTIN_TRANSPORTS=DEFAULT`` switches it on.
    """
    profiles, reach = environ.get(PROFILES, _LOOPBACK), environ.get(RANGE, "LOCALHOST")
    found = {RANGE: reach, PROFILES: profiles, "SKIP_DEFAULT_XML_FILE": "1"}  # one in the folder may be anybody's
    if profiles not in (_LOOPBACK, _NETWORK):
        return found
    if reach == "LOCALHOST" and not any(name in environ for name in _CHOICES):
        return found | {RANGE: "SYSTEM_DEFAULT", PROFILES: _LOOPBACK}
    if reach == "SYSTEM_DEFAULT" and environ.get(PROFILES) == _LOOPBACK:
        return found  # as returned above
    return found | {PROFILES: _NETWORK, "FASTDDS_BUILTIN_TRANSPORTS": environ.get(_CHOICES[0], "UDPv4")}


def settle() -> None:
    """Give this process the settings, before its first node."""
    os.environ.update(settings(os.environ))
