# SPDX-License-Identifier: Apache-2.0
"""The recent past of a topic, contiguous in memory, so that a delayed view costs no copy."""

from collections.abc import Iterable

import numpy as np

from lathe_rc.cell import messages
from lathe_rc.cell.messages import Signals

_BLOCKS_BETWEEN_MOVES = 16


class Track:
    """Samples of some fields of a topic, from ``delay`` samples before the newest block on.

    Before sample 0 everything is zero.

    Args:
        msgtype: message type of the topic.
        fields: those to keep.
        delay: longest delay at which they are read [sample].
        block: longest block that is added [sample].

    Attributes:
        delay: see above.
    """

    def __init__(self, msgtype: str, fields: Iterable[str], delay: int, block: int) -> None:
        self.delay = delay
        self._past = delay + block
        self._capacity = self._past + _BLOCKS_BETWEEN_MOVES * max(block, delay)
        types = messages.sample_fields(msgtype)
        self._arrays = {name: np.zeros(self._capacity, types[name]) for name in fields}
        self._base = -self._past  # sample index of element 0
        self.end = 0  #: index after the newest sample

    def extend(self, samples: int) -> Signals:
        """Views of ``samples`` new samples, for the caller to fill."""
        if self.end + samples - self._base > self._capacity:
            shift = self.end - self._past - self._base
            for array in self._arrays.values():
                array[: self._past] = array[shift : shift + self._past]
            self._base += shift
        start = self.end - self._base
        self.end += samples
        return {name: array[start : start + samples] for name, array in self._arrays.items()}

    def view(self, first: int, samples: int) -> Signals:
        """Views of the samples ``first`` on, which must have been added and not be older than the longest delay."""
        start = first - self._base
        assert start >= 0, "samples are too old"
        assert first + samples <= self.end, "samples are not there yet"
        return {name: array[start : start + samples] for name, array in self._arrays.items()}

    def restart(self, first: int) -> None:
        """Begin at sample ``first``, with zeros before it; drops what is there."""
        for array in self._arrays.values():
            array[:] = 0
        self._base, self.end = first - self._past, first
