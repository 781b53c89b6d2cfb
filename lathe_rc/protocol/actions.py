# SPDX-License-Identifier: Apache-2.0
"""Requests of the protocol to its node: each is performed once, in the order of the list."""

from collections.abc import Mapping
from typing import NamedTuple

from lathe_rc.protocol.messages import Announcement, CellState, Progress


class Announce(NamedTuple):
    """Publish an announcement on ``members``."""

    member: Announcement


class Say(NamedTuple):
    """Publish the state of the cell on ``cell_state``."""

    state: CellState


class Tell(NamedTuple):
    """Publish progress on ``progress``."""

    progress: Progress


class TellTime(NamedTuple):
    """Publish the simulated time, given by the samples that the slowest member has completed."""

    samples: int


class Follow(NamedTuple):
    """Monitor a member: its process and, between time master and members, the ``liveliness`` of its topic ``alive``."""

    member: Announcement
    liveliness: bool


class MembersChanged(NamedTuple):
    """Update the node after a new announcement: sources of blocks, and topics to subscribe to."""


class Begin(NamedTuple):
    """Prepare for block 0, or to ``join`` a running cell; answered with `MemberProtocol.begun`."""

    joins: bool


class CheckCell(NamedTuple):
    """Check the cell described by the announcements; answered with `TimeMasterProtocol.start`."""


class Start(NamedTuple):
    """Start the run at block 0: form chains, and begin the schedule."""


class TellPace(NamedTuple):
    """Report the lateness of the blocks of the run."""


class Release(NamedTuple):
    """Release the blocks that `TimeMasterProtocol.credit` and the pace allow."""


class Lose(NamedTuple):
    """Continue without lost members: safe state from sample ``first`` on, end of the run at sample ``end``.

    ``again``: members were lost before, and the node is in its safe state already.
    """

    lost: frozenset[str]
    first: int
    end: int
    again: bool


class Log(NamedTuple):
    """Write a line to the log at a ``level``: info, warning or error."""

    level: str
    text: str


class Report(NamedTuple):
    """Report an event to the harness."""

    event: str
    values: Mapping[str, object]


class Leave(NamedTuple):
    """Leave, after at most ``patience`` [s] for the acknowledgement of the last messages; answered with `left`."""

    patience: float


Action = (
    Announce | Say | Tell | TellTime | TellPace | Follow | MembersChanged | Begin | CheckCell | Start | Release | Lose
    | Log | Report | Leave
)  # fmt: skip
