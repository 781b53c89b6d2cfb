# SPDX-License-Identifier: Apache-2.0
"""ROS topics of a cell other than signals."""

from typing import NamedTuple

from lathe_rc.cell.recorder import KIND as RECORDER
from lathe_rc.messages import PACKAGE


class HostTopic(NamedTuple):
    """Topic other than a signal: it carries wall time, or the progress of the run, and is not part of a digest.

    Attributes:
        name: name of the topic: relative, or absolute if the whole ROS domain shares the topic.
        type: message type.
        depth: queue length that publishers offer.
        durability: ``transient local`` (late readers receive the newest messages), or ``volatile``.
        publisher: role of the nodes that publish it.
        subscriber: role of the nodes that read it; empty: none in the cell.
        doc: purpose of the topic.
    """

    name: str
    type: str
    depth: int
    durability: str
    publisher: str
    subscriber: str
    doc: str


MEMBER, MASTER = "member", "time master"  #: roles of nodes, beside that of the recorder: every one is a member
_MEMBER, _STATE, _PROGRESS = (f"{PACKAGE}/msg/{name}" for name in ("Member", "CellState", "Progress"))
_DIAGNOSTICS, _CLOCK = "diagnostic_msgs/msg/DiagnosticArray", "rosgraph_msgs/msg/Clock"
_LATCHED = "transient local"
HOST_TOPICS = (
    HostTopic("members", _MEMBER, 1, _LATCHED, MEMBER, MEMBER, "who takes part, and who is ready"),
    HostTopic("cell_state", _STATE, 1, _LATCHED, MASTER, MEMBER, "start, end, safe state and failure of the run"),
    HostTopic(
        *("progress", _PROGRESS, 1, _LATCHED, MEMBER, MASTER),
        "how far each member has come: the credit of the window",
    ),
    HostTopic(
        *("/diagnostics", _DIAGNOSTICS, 100, "volatile", MEMBER, RECORDER),
        "state and counters of each node, once a second",
    ),
    HostTopic("/clock", _CLOCK, 10, "volatile", MASTER, "", "simulated time of the slowest member"),
)
