# SPDX-License-Identifier: Apache-2.0
"""A flood of messages that belong to nobody, for half a minute: it takes no memory and no block."""

import json
from pathlib import Path

import pytest
from cells import block, scenario
from lathe_rc_msgs.msg import EncoderBlock, Member

from lathe_rc import harness, messages
from lathe_rc.bag import reader
from lathe_rc.nodes.ports import latched_qos

pytestmark = pytest.mark.system


def resident(pid):
    """Memory of a process [B]."""
    line = next(line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1]) * 1024


def test_a_flood_takes_no_memory(ghost, domain, tmp_path):
    """While the cell goes slowly; the flood is nearly all that the nodes have to work on."""
    plain = scenario(spindle_encoder={"revolutions": 30.0, "speed_factor": 0.05})
    cell = harness.with_recorder(plain, tmp_path / "bag", keep=True)
    encoder = ghost.create_publisher(EncoderBlock, "/encoder", latched_qos(500))
    members = ghost.create_publisher(Member, "/members", latched_qos(500))

    def flood(publisher, make, end):
        """Half as many at a time as the publisher keeps; ``end`` makes a message of /end that the tool reports."""
        for part in range(7):
            for count in range(250 * part, 250 * (part + 1)):
                publisher.publish(make(count))
            publisher.publish(end(f"end of part {part}"))
            told = f"{publisher.topic_name}: message of run 'end of part {part}' from /end; expected run 'test'"
            processes.wait_for("foreign_message", "tool", message=told)

    with harness.Processes(cell, [[name] for name in cell.nodes], domain=domain) as processes:
        processes.wait_for("cycle")
        before = resident(processes.pids["tool"])
        flood(
            encoder,
            lambda count: block(messages.ENCODER, count, f"/ghost_{count % 8}", "test", size=2048),
            lambda run: block(messages.ENCODER, 0, "/end", run),
        )
        text = json.dumps({"filler": "x" * 40_000})
        flood(
            members,
            lambda count: Member(run_id="test", name=f"/made_up_{count}", parameters=text),
            lambda run: Member(run_id=run, name="/end"),
        )
        grown = resident(processes.pids["tool"]) - before
        processes.wait_for_end()
    assert grown < 64e6
    assert sum(processes.refused.values()) > 1000
    assert reader.read_bag(tmp_path / "bag").digests() == harness.run(plain).digest
