# SPDX-License-Identifier: Apache-2.0
"""examples/c_controller: an exported law in a C program commands the drive of a cell."""

import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from cells import scenario

pytest.importorskip("rclpy")

import test_foreign

from lathe_export.c_library.sources import export_nodes
from lathe_rc import harness
from lathe_rc.bag import reader

pytestmark = pytest.mark.system

FOLDER = Path(__file__).parents[2] / "examples" / "c_controller"
LAW = {"identify": False, "feedback_delay": 3200}


def test_a_c_program_gives_the_command_of_the_cell(domain, tmp_path, monkeypatch):
    """The program of examples/c_controller, over UDP: the bits of our controller; it reports how late blocks were."""
    nodes = {"learning_controller": LAW, "spindle_encoder": {"revolutions": 5.0, "speed_factor": 1.0}}
    exported = export_nodes(scenario(**nodes), ["learning_controller"], tmp_path / "law", block=3200, samples=1)
    sources = [FOLDER / "controller.c", *exported.place.glob("l*.c")]
    program = tmp_path / "controller"
    flags = ["-std=c11", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-I", exported.place]
    subprocess.run(["cc", *flags, "-o", program, *sources, "-lm"], check=True)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    member = (sys.executable, FOLDER / "udp_member.py", "--ros-args", "-p", f"port:={port}")
    monkeypatch.setitem(test_foreign.PROGRAMS, "learning_controller", member)
    with subprocess.Popen([program, str(port)], stdout=subprocess.PIPE, text=True) as controller:
        with test_foreign.cell(domain, tmp_path / "bag", ["learning_controller"], ["tool", "recorder"], **nodes) as (
            processes,
            theirs,
        ):
            processes.wait_for_end()
            assert theirs["learning_controller"].wait() == 0
        told = controller.communicate(timeout=10)[0]
    wanted = harness.run(scenario(**nodes)).recording.dense["/coarse/command"]["position"]
    found = reader.read_bag(tmp_path / "bag").dense["/coarse/command"]["position"]
    assert found.tobytes() == wanted.tobytes()
    assert re.fullmatch(
        rf"\d+ blocks, {wanted.size} samples: \d+ ns a sample, longest block \d+ us, latest block \d+\.\d\d ms late\n",
        told,
    ), told
