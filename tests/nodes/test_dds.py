# SPDX-License-Identifier: Apache-2.0
"""How the nodes of one machine talk to each other, and where DDS complains."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from cells import in_two, scenario

from lathe_rc import harness
from lathe_rc.nodes import dds

TRANSPORTS = "FASTDDS_BUILTIN_TRANSPORTS"
FOLDER = Path(dds.__file__).parent


@pytest.mark.parametrize(
    ("environ", "reach", "profile"),
    [
        ({}, "SYSTEM_DEFAULT", "fastdds.xml"),
        ({dds.RANGE: "LOCALHOST"}, "SYSTEM_DEFAULT", "fastdds.xml"),
        ({dds.RANGE: "SUBNET"}, "SUBNET", "fastdds_network.xml"),
        ({dds.RANGE: "OFF"}, "OFF", "fastdds_network.xml"),
        ({TRANSPORTS: "DEFAULT"}, "LOCALHOST", "fastdds_network.xml"),
        ({"ROS_STATIC_PEERS": "10.0.0.2"}, "LOCALHOST", "fastdds_network.xml"),
        ({dds.PROFILES: "/mine.xml"}, "LOCALHOST", "/mine.xml"),
    ],
)
def test_what_the_user_chooses_stays(environ, reach, profile):
    """So it does in a process that another one started, which has settled the rest."""
    found = dds.settings(environ)
    assert (found[dds.RANGE], Path(found[dds.PROFILES])) == (reach, FOLDER / profile)
    assert dds.settings(environ | found) == found
    if not environ:
        network = dds.settings(found | {dds.RANGE: "SUBNET"})
        assert (Path(network[dds.PROFILES]).name, network[TRANSPORTS]) == ("fastdds_network.xml", "UDPv4")


@pytest.mark.parametrize(("wanted", "shared"), [(None, False), ("DEFAULT", True)])
def test_shared_memory_is_the_users_choice(wanted, shared, monkeypatch):
    """Nodes exchange messages over UDP unless DDS's own variable says otherwise, with the same bits either way."""
    for name in (dds.RANGE, dds.PROFILES, TRANSPORTS):
        monkeypatch.delenv(name, raising=False)
    if wanted:
        monkeypatch.setenv(TRANSPORTS, wanted)
    cell, pids, segments = scenario(spindle_encoder={"revolutions": 3.0}), {}, set()

    def look(event):
        if event["event"] == "active":
            pids[event["node"]] = event["pid"]
        elif event["event"] == "ready":
            maps = Path(f"/proc/{pids[event['node']]}/maps").read_text(encoding="utf-8")
            segments.add("/fastrtps_" in maps)

    assert harness.run(cell, mode="processes", groups=in_two(cell), watch=look).digest == harness.run(cell).digest
    assert segments == {shared}


def test_an_error_of_dds_goes_to_the_error_stream(domain):
    """Programs read what a command prints."""
    node = "import rclpy, signal; rclpy.init(); rclpy.create_node('x'); print('made', flush=True); signal.pause()"
    environment = os.environ | dds.settings({dds.RANGE: "SUBNET", TRANSPORTS: "pigeons"})
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", node], text=True, env=environment, **pipes) as process:
        assert process.stdout.readline() == "made\n"
        assert any("Wrong value 'pigeons'" in line for line in process.stderr)
        process.kill()
        assert process.stdout.read() == ""
