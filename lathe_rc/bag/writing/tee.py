# SPDX-License-Identifier: Apache-2.0
"""Two outputs at once: the recording of a run and its snapshots."""

from collections.abc import Mapping

from rosbags.interfaces import Qos

from lathe_rc.bag.writing.rows import RowPlan
from lathe_rc.bag.writing.writer import Output


class Both:
    """Two outputs with the same topics; an `Output`.

    Args:
        first, second: the outputs.
    """

    def __init__(self, first: Output, second: Output) -> None:
        self._first, self._second = first, second

    def tell(self, about: Mapping[str, str]) -> None:
        """See `Output`."""
        self._first.tell(about)
        self._second.tell(about)

    def add_topic(self, topic: str, msgtype: str, qos: Qos) -> None:
        """See `Output`."""
        self._first.add_topic(topic, msgtype, qos)
        self._second.add_topic(topic, msgtype, qos)

    def channel(self, topic: str) -> int:
        """See `Output`; the same in both."""
        number = self._first.channel(topic)
        assert number == self._second.channel(topic), "topics are announced to both in the same order"
        return number

    def write(self, topic: str, log_ns: int, data: bytes) -> None:
        """See `Output`."""
        self._first.write(topic, log_ns, data)
        self._second.write(topic, log_ns, data)

    def write_rows(self, plan: RowPlan, first_ns: int, data: bytes | memoryview) -> None:
        """See `Output`."""
        self._first.write_rows(plan, first_ns, data)
        self._second.write_rows(plan, first_ns, data)

    def flush(self) -> None:
        """See `Output`."""
        self._first.flush()
        self._second.flush()

    def close(self) -> None:
        """See `Output`."""
        try:
            self._first.close()
        finally:
            self._second.close()
