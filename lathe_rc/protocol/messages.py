# SPDX-License-Identifier: Apache-2.0
"""The three messages of the protocol, with the fields of the ROS messages of the same names.

A ``session`` tells two starts of one scenario apart, whose run ids are equal: the time master draws it, members take it
over from its announcement, and 0, of a third-party node, stands for any.
"""

from dataclasses import dataclass
from enum import IntEnum

from lathe_rc.errors import LatheError

_LONGEST = 256  # characters of a name that is quoted


class MemberState(IntEnum):
    """How far a member has come; the constants of Member.msg."""

    JOINING = 0
    WIRED = 1
    READY = 2
    FAILED = 3
    SAFE = 4


class Phase(IntEnum):
    """State of a cell; the constants of CellState.msg."""

    WAITING = 0
    RUNNING = 1
    ENDED = 2
    FAILED = 3
    SAFE = 4


@dataclass(frozen=True, slots=True)
class Announcement:
    """Member.msg: a member says its name, its topics and how far it has come."""

    run_id: str
    name: str
    stage: str
    state: int = MemberState.JOINING
    members: tuple[str, ...] = ()
    publishes: tuple[str, ...] = ()
    types: tuple[str, ...] = ()
    sparse: tuple[bool, ...] = ()
    subscribes: tuple[str, ...] = ()
    parameters: str = "{}"
    message: str = ""
    host: str = ""
    pid: int = 0
    session: int = 0

    @property
    def process(self) -> tuple[str, int]:
        """Host and process number: two announcements with the same are of the same process."""
        return self.host, self.pid


@dataclass(frozen=True, slots=True)
class CellState:
    """CellState.msg: the time master says how the run goes."""

    run_id: str
    state: int
    first_index: int
    message: str = ""
    end_index: int = 0
    lost: tuple[str, ...] = ()
    session: int = 0


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress.msg: a member says how many blocks and samples it has completed."""

    run_id: str
    name: str
    blocks: int
    samples: int
    session: int = 0


class ForeignMessage(LatheError):  # noqa: N818 - the message, not what went wrong
    """A message from outside the cell; it is refused and counted, and the cell goes on.

    Args:
        topic: fully qualified.
        source: sender that the message names; empty if it names none.
        run_id: run that it names.
        why: what was expected.
    """

    def __init__(self, topic: str, source: str, run_id: str, why: str) -> None:
        self.sender = f"{source[:_LONGEST] or 'an unknown sender'} of run {run_id[:_LONGEST]!r} on {topic}"
        super().__init__(f"{topic}: message of run {run_id[:_LONGEST]!r} from {source[:_LONGEST] or '?'}; {why}")
        self.topic = topic
        self._rest = source, run_id, why

    def on(self, topic: str) -> "ForeignMessage":
        """The same with the fully qualified name of its topic."""
        return ForeignMessage(topic, *self._rest)
