# SPDX-License-Identifier: Apache-2.0
"""Messages that do not belong to the cell: refused, counted and named, while the cell goes on."""

from collections.abc import Callable

from lathe_rc.protocol import ForeignMessage

_MOST = 32  # senders that are counted by name


class RefusedMessages:
    """Counts what a node has refused.

    Args:
        told: called with the first message of each sender, up to a number of senders.

    Attributes:
        senders: messages by sender; those of too many senders together.
        topics: on which any have come.
    """

    def __init__(self, told: Callable[[ForeignMessage], None]) -> None:
        self._told = told
        self.senders: dict[str, int] = {}
        self.topics: set[str] = set()

    def refuse(self, message: ForeignMessage) -> None:
        """Count a message."""
        self.topics.add(message.topic)
        new = message.sender not in self.senders
        sender = "others" if new and len(self.senders) >= _MOST else message.sender
        self.senders[sender] = self.senders.get(sender, 0) + 1
        if new and sender != "others":
            self._told(message)

    def __str__(self) -> str:
        """How many of whom."""
        return ", ".join(f"{count} from {sender}" for sender, count in self.senders.items()) or "none"
