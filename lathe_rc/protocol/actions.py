# SPDX-License-Identifier: Apache-2.0
"""Requests of the protocol to its node: each is done once, in the order in which they stand."""

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
    """Publish the simulated time: the slowest member has completed so many samples."""

    samples: int


class Follow(NamedTuple):
    """Watch a member: the liveliness of its topic ``alive``, and its process."""

    member: Announcement


class MembersChanged(NamedTuple):
    """Take in a new announcement: of whom to accept blocks, to which topics to subscribe."""


class Begin(NamedTuple):
    """Prepare for block 0, or to ``join`` a run that is under way; answer with `MemberProtocol.begun`."""

    joins: bool


class CheckCell(NamedTuple):
    """Check the cell that the announcements describe; answer with `TimeMasterProtocol.start`."""


class Start(NamedTuple):
    """Block 0 may go: form chains, and begin the schedule."""


class TellPace(NamedTuple):
    """Report how late the blocks of the run were."""


class Release(NamedTuple):
    """Release the blocks that `TimeMasterProtocol.credit` and the pace allow."""


class Lose(NamedTuple):
    """Do without lost members: the run ends with sample ``end``; be safe from sample ``first`` on.

    ``again``: others were lost before, and the node is safe already.
    """

    lost: frozenset[str]
    first: int
    end: int
    again: bool


class Log(NamedTuple):
    """Write a line to the log; ``level``: info, warning or error."""

    level: str
    text: str


class Report(NamedTuple):
    """Report an event to the harness."""

    event: str
    values: Mapping[str, object]


class Leave(NamedTuple):
    """Wait up to ``patience`` [s] until other nodes have the last messages, and leave; answer with `left`."""

    patience: float


Action = (
    Announce
    | Say
    | Tell
    | TellTime
    | TellPace
    | Follow
    | MembersChanged
    | Begin
    | CheckCell
    | Start
    | Release
    | Lose
    | Log
    | Report
    | Leave
)
