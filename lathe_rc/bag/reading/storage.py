# SPDX-License-Identifier: Apache-2.0
"""Channels of the files of bags, and spans of messages that are read when their time comes."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from rosbags.interfaces import Qos

from lathe_rc.bag.reading.chunk_messages import Places
from lathe_rc.bag.reading.limits import MOST_TEXT, MOST_TOPICS
from lathe_rc.bag.reading.metadata import check_name, qos_of_text
from lathe_rc.bag.reading.unpacking import Budget

Message = tuple[str, int, bytes]  #: topic, log time [ns] and bytes

CDR = "cdr"  #: the serialization of ROS 2, the only one that is read


@dataclass(frozen=True)
class Batch:
    """Messages in the same bytes.

    Attributes:
        whole: the bytes.
        topics: by channel.
        places: channel, log time [ns], begin and end of each message, shape (messages, 4).
    """

    whole: bytes
    topics: Mapping[int, str]
    places: Places

    def __len__(self) -> int:
        """Number of messages."""
        return len(self.places)

    def __iter__(self) -> Iterator[Message]:
        """Topic, log time [ns] and bytes of each."""
        for channel, log_ns, begin, end in self.places.tolist():
            yield self.topics[channel], log_ns, self.whole[begin:end]

    @classmethod
    def of(cls, message: Message) -> "Batch":
        """A batch of one."""
        topic, log_ns, data = message
        return cls(data, {0: topic}, np.array([[0, log_ns, 0, len(data)]], np.uint64))


@dataclass
class Channel:
    """A topic as a file announces it.

    Attributes:
        topic: its name.
        type: message type; empty: none is told.
        encoding: serialization of its messages.
        qos: offered by the publishers, as far as it is told.
        count: messages.
    """

    topic: str
    type: str
    encoding: str
    qos: tuple[Qos, ...] = ()
    count: int = 0

    @property
    def unread(self) -> str:
        """Why its messages are not read; empty if they are."""
        if self.encoding != CDR:
            return f"serialized as {self.encoding[:64]!r}, not {CDR!r}"
        return "" if self.type else "without a message type"


@dataclass(frozen=True)
class Span:
    """Messages that are read together: a chunk, a part of a file without chunks, a database.

    Attributes:
        first_ns, last_ns: smallest and largest log time.
        size: in memory [B]; 0: its messages come one by one.
        channels: that it may have messages of; empty: any.
    """

    first_ns: int
    last_ns: int
    size: int
    channels: frozenset[int]

    def read(self, topics: Mapping[int, str], start_ns: int, stop_ns: int, budget: Budget) -> Iterator[Batch]:
        """Messages by log time.

        Args:
            topics: by the channels that are wanted.
            start_ns: log times from this on [ns].
            stop_ns: log times before this [ns].
            budget: what is read is counted by it.

        Raises:
            ValueError: it is broken; OSError and SQLite's errors alike.
        """
        raise NotImplementedError


@dataclass
class Storage:
    """Content of a file of a bag.

    Attributes:
        channels: by number.
        spans: in the order of the file.
        first_ns, last_ns: smallest and largest log time of its messages, if it has any.
        damage: what cannot be read of it, one line each; where its summary is right, damage may show up later.
        remarks: what it says wrong of itself, though all messages can be read.
    """

    channels: dict[int, Channel] = field(default_factory=dict)
    spans: list[Span] = field(default_factory=list)
    first_ns: int = 0
    last_ns: int = 0
    damage: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    _offered: int = 0  # characters of quality of service

    def announce(self, number: int, channel: Channel, offered: str) -> None:
        """Take a channel and its quality of service.

        Raises:
            ValueError: a name that cannot be shown, or there are too many.
        """
        check_name(channel.topic)
        if channel.type:
            check_name(channel.type)
        self._offered += len(offered)
        if self._offered > MOST_TEXT:
            raise ValueError(f"more than {MOST_TEXT} characters of quality of service")
        try:
            channel.qos = qos_of_text(offered)
        except ValueError as error:
            self.remarks.append(f"{channel.topic}: quality of service that cannot be read ({error})")
        self.channels[number] = channel
        if len(self.channels) > MOST_TOPICS:
            raise ValueError(f"more than {MOST_TOPICS} topics")
