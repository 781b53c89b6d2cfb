# SPDX-License-Identifier: Apache-2.0
"""Channels of bag files, and spans of messages that are read on demand."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from rosbags.interfaces import Qos

from lathe_rc.bag.reading.chunk_messages import Places
from lathe_rc.bag.reading.limits import MOST_TEXT, MOST_TOPICS
from lathe_rc.bag.reading.metadata import check_name, qos_of_text
from lathe_rc.bag.reading.seal import FileSeal
from lathe_rc.bag.reading.unpacking import ReadingBudget

Message = tuple[str, int, bytes]  #: topic, log time [ns] and bytes

CDR = "cdr"  #: serialization used by ROS 2, the only one supported


@dataclass(frozen=True)
class Batch:
    """Messages located in a common byte string.

    Attributes:
        whole: the byte string.
        topics: topic name by channel.
        places: channel, log time [ns], start and end of each message, shape (messages, 4).
    """

    whole: bytes
    topics: Mapping[int, str]
    places: Places

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.places)

    def __iter__(self) -> Iterator[Message]:
        """Yield the topic, log time [ns] and bytes of each message."""
        for channel, log_ns, begin, end in self.places.tolist():
            yield self.topics[channel], log_ns, self.whole[begin:end]

    def only(self, topics: Collection[str]) -> "Batch":
        """Return the messages of some topics."""
        found = np.zeros(len(self.places), dtype=bool)
        for channel, topic in self.topics.items():
            if topic in topics:
                found |= self.places[:, 0] == channel
        return Batch(self.whole, self.topics, self.places[found])

    @classmethod
    def of(cls, message: Message) -> "Batch":
        """Return a batch of one message."""
        topic, log_ns, data = message
        return cls(data, {0: topic}, np.array([[0, log_ns, 0, len(data)]], np.uint64))

    @classmethod
    def joined(cls, batches: Sequence["Batch"]) -> "Batch":
        """Return the messages of consecutive batches, at least one, as one batch."""
        if len(batches) == 1:
            return batches[0]
        topics = batches[0].topics
        places = np.concatenate([batch.places for batch in batches])
        if any(batch.topics is not topics for batch in batches):
            numbers: dict[str, int] = {}
            for batch in batches:
                for name in batch.topics.values():
                    numbers.setdefault(name, len(numbers))
            names = (batch.topics[channel] for batch in batches for channel in batch.places[:, 0].tolist())
            places[:, 0] = [numbers[name] for name in names]
            topics = {number: name for name, number in numbers.items()}
        starts = np.cumsum([0] + [len(batch.whole) for batch in batches[:-1]]).astype(np.uint64)
        places[:, 2:] += np.repeat(starts, [len(batch) for batch in batches])[:, np.newaxis]
        return cls(b"".join(batch.whole for batch in batches), topics, places)


@dataclass
class Channel:
    """Topic as declared in a file.

    Attributes:
        topic: name of the topic.
        type: message type; empty if the file states none.
        encoding: serialization of the messages.
        qos: profiles offered by the publishers, as far as the file states them.
        count: number of messages.
    """

    topic: str
    type: str
    encoding: str
    qos: tuple[Qos, ...] = ()
    count: int = 0

    @property
    def unread(self) -> str:
        """Reason why the messages are not read; empty if they are read."""
        if self.encoding != CDR:
            return f"serialized as {self.encoding[:64]!r}, not {CDR!r}"
        return "" if self.type else "without a message type"


@dataclass(frozen=True)
class Span:
    """Messages that are read together: a chunk, a section of a file without chunks, or a database.

    Attributes:
        first_ns, last_ns: smallest and largest log time [ns].
        size: size in memory [B]; 0 if the messages are read one by one.
        channels: channels that may have messages in the span; empty for any channel.
    """

    first_ns: int
    last_ns: int
    size: int
    channels: frozenset[int]

    def read(self, topics: Mapping[int, str], start_ns: int, stop_ns: int, budget: ReadingBudget) -> Iterator[Batch]:
        """Yield the messages in order of log time.

        Args:
            topics: topic name by requested channel.
            start_ns: smallest log time to read [ns].
            stop_ns: log time at which reading stops, exclusive [ns].
            budget: budget to which the bytes and messages read are charged.

        Raises:
            ValueError, OSError, sqlite3.Error: the span is damaged.
        """
        raise NotImplementedError


@dataclass
class Storage:
    """Content of one file of a bag.

    Attributes:
        channels: channels by number.
        spans: spans in the order of the file.
        first_ns, last_ns: smallest and largest log time of the messages, if there are any [ns].
        damage: unreadable parts, one line each; with a valid summary, damage may be detected later.
        remarks: incorrect statements in the file about itself that do not make any message unreadable.
        sealed: the file's seal.
    """

    channels: dict[int, Channel] = field(default_factory=dict)
    spans: list[Span] = field(default_factory=list)
    first_ns: int = 0
    last_ns: int = 0
    damage: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    sealed: FileSeal = field(default_factory=FileSeal)
    _offered: int = 0  # total length of the QoS profiles [characters]

    def announce(self, number: int, channel: Channel, offered: str) -> None:
        """Add a channel with its QoS profiles.

        Raises:
            ValueError: a name is not printable, there are too many channels, or their QoS profiles are too long.
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
