# SPDX-License-Identifier: Apache-2.0
"""Protocol of a cell, without I/O: joining, progress and credit, silence and death of members, safe state and end.

A node passes events with their time to its `MemberProtocol`, and performs the requests of the protocol (`actions`).
Nothing here publishes, waits, reads a clock or starts a thread: so thousands of cells can be simulated in a second.
"""

from lathe_rc.protocol.block_order import BlockOrder
from lathe_rc.protocol.member import GIVEN_UP, SILENCE, MemberProtocol
from lathe_rc.protocol.messages import Announcement, BadBlock, CellState, ForeignMessage, MemberState, Phase, Progress
from lathe_rc.protocol.pace import Pace
from lathe_rc.protocol.time_master import Reactions, TimeMasterProtocol

__all__ = [
    "GIVEN_UP",
    "SILENCE",
    "Announcement",
    "BadBlock",
    "BlockOrder",
    "CellState",
    "ForeignMessage",
    "MemberProtocol",
    "MemberState",
    "Pace",
    "Phase",
    "Progress",
    "Reactions",
    "TimeMasterProtocol",
]
