# SPDX-License-Identifier: Apache-2.0
"""Messages of the protocol, with the fields of the ROS messages of the same names.

A ``session`` distinguishes two starts of one scenario, whose run ids are equal: the time master draws it, members copy
it from its announcement, and 0, used by third-party nodes, matches any session.
"""

from dataclasses import dataclass
from enum import IntEnum

from lathe_rc.errors import LatheError

LONGEST = 256  #: characters of a quoted name


class MemberState(IntEnum):
    """State of a member; the constants of Member.msg."""

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
    """Announcement of a member: name, topics and state (Member.msg)."""

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
    def rejects(self) -> dict[str, str]:
        """Return the members whose blocks this member rejects, with the reasons."""
        lines = self.message.splitlines() if self.state != MemberState.FAILED else ()
        return {name: why for name, _, why in (line.partition(": ") for line in lines)}

    @property
    def process(self) -> tuple[str, int]:
        """Return host and process number, which identify the process of the announcement."""
        return self.host, self.pid


@dataclass(frozen=True, slots=True)
class CellState:
    """State of the run, published by the time master (CellState.msg)."""

    run_id: str
    state: int
    first_index: int
    message: str = ""
    end_index: int = 0
    lost: tuple[str, ...] = ()
    session: int = 0


@dataclass(frozen=True, slots=True)
class Progress:
    """Number of blocks and samples that a member has completed (Progress.msg)."""

    run_id: str
    name: str
    blocks: int
    samples: int
    session: int = 0


class BadBlock(LatheError):  # noqa: N818 - the block, not what went wrong
    """Error for a block that its source must not send: the source is lost, and its readers go on.

    Args:
        topic: fully qualified name.
        source: the member that has sent the block.
        why: description of the block.
    """

    def __init__(self, topic: str, source: str, why: str) -> None:
        super().__init__(f"{topic}: {why}")
        self.source = source


class ForeignMessage(LatheError):  # noqa: N818 - the message, not what went wrong
    """Error for a message from outside the cell; the message is rejected and counted, and the cell goes on.

    Args:
        topic: fully qualified name.
        source: sender named by the message; empty if none is named.
        run_id: run id in the message.
        why: expected content.
    """

    def __init__(self, topic: str, source: str, run_id: str, why: str) -> None:
        self.sender = f"{source[:LONGEST] or 'an unknown sender'} of run {run_id[:LONGEST]!r} on {topic}"
        super().__init__(f"{topic}: message of run {run_id[:LONGEST]!r} from {source[:LONGEST] or '?'}; {why}")
        self.topic = topic
        self._rest = source, run_id, why

    def on(self, topic: str) -> "ForeignMessage":
        """Return a copy of the error with another topic name."""
        return ForeignMessage(topic, *self._rest)


def check_sender(topic: str, source: str, run_id: str, sender: str) -> None:
    """Reject a message that names another node than its sender, as DDS knows it; empty: the sender is not known.

    Raises:
        ForeignMessage: the sender is another node.
    """
    if sender not in ("", source):
        raise ForeignMessage(topic, source, run_id, f"it is from {sender}")
