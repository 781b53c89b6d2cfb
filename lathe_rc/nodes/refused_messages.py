# SPDX-License-Identifier: Apache-2.0
"""Counter of rejected messages from outside the cell; the cell goes on."""

from collections.abc import Callable

from lathe_rc.protocol import ForeignMessage

_MOST = 32  # senders that are counted by name


class RefusedMessages:
    """Counter of the messages that a node has rejected.

    Args:
        told: called with the first message of each sender, up to a limited number of senders.

    Attributes:
        senders: number of messages by sender; senders beyond the limit are counted together as ``others``.
        topics: topics with rejected messages.
    """

    def __init__(self, told: Callable[[ForeignMessage], None]) -> None:
        self._told = told
        self.senders: dict[str, int] = {}
        self.topics: set[str] = set()

    def refuse(self, message: ForeignMessage) -> None:
        """Count a rejected message."""
        self.topics.add(message.topic)
        new = message.sender not in self.senders
        sender = "others" if new and len(self.senders) >= _MOST else message.sender
        self.senders[sender] = self.senders.get(sender, 0) + 1
        if new and sender != "others":
            self._told(message)

    def __str__(self) -> str:
        """Return the number of rejected messages of each sender."""
        return ", ".join(f"{count} from {sender}" for sender, count in self.senders.items()) or "none"
