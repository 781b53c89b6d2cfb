# SPDX-License-Identifier: Apache-2.0
"""Messages of running cells: kept until they can be shown, separated by run."""

import threading
from collections import deque
from collections.abc import Iterator
from typing import Literal

Message = tuple[str, str, bytes]  # fully qualified topic, message type, encoded message


class Backlog:
    """Messages that have not been shown yet. When it is full, all of them are left out: later pieces are whole again.

    To leave out every second message instead would leave no piece without a gap.

    Args:
        limit: its size [B].
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._size = 0
        self._messages: deque[Message | None] = deque()
        self._news = threading.Condition()
        self._closed = False

    def put(self, *heard: Message | None) -> None:
        """Add messages; None: nobody sends any more."""
        with self._news:
            for message in heard:
                self._size += len(message[2]) if message else 0
                if self._size > self._limit:
                    self._messages.clear()
                    self._size = len(message[2]) if message else 0
                self._messages.append(message)
            self._news.notify()

    def close(self) -> None:
        """Let the reader end when it has taken all pieces."""
        with self._news:
            self._closed = True
            self._news.notify()

    def __iter__(self) -> Iterator[Message | None]:
        """Take messages as they come, until it is closed and empty."""
        while True:
            with self._news:
                self._news.wait_for(lambda: self._messages or self._closed)
                if not self._messages:
                    return
                message = self._messages.popleft()
                self._size -= len(message[2]) if message else 0
            yield message


class Order:
    """Tells runs apart in what comes from many topics, each in its own order, none in step with the others.

    A run has a name, but equal scenarios have equal names: it also begins anew when a topic goes back. What a topic
    still brings of the run before goes on from where that topic was.
    """

    def __init__(self) -> None:
        self._run: str | None = None
        self._before: str | None = None
        self._ends: dict[str, int] = {}  # sample after the newest of each topic, in this run
        self._old: dict[str, int] = {}  # and in the one before

    def place(self, topic: str, run: str, first: int, end: int) -> Literal["same", "new", "old"]:
        """Where samples of a topic belong: to the run that goes on, to a new one, or to the one before."""
        newest = max(self._ends.values(), default=0)
        if run == self._run and first >= self._ends.get(topic, 0):
            again = run == self._before and topic not in self._ends
            if again and newest < first and first >= self._old.get(topic, first + 1):
                return "old"
            self._ends[topic] = end
            return "same"
        if run == self._before != self._run and first >= self._old.get(topic, 0):
            return "old"
        self._run, self._before = run, self._run
        self._ends, self._old = {topic: end}, self._ends
        return "new"
