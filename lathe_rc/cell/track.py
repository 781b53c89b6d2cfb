# SPDX-License-Identifier: Apache-2.0
"""The recent past of a topic, contiguous in memory, so that a delayed view costs no copy."""

from collections.abc import Iterable, Mapping
from math import ceil
from typing import Any

import numpy as np

from lathe_rc.cell import messages
from lathe_rc.cell.messages import Signals
from lathe_rc.cell.stage import Input

_MOVED = 0.25  # of the delayed samples, at most, are copied once more to keep them contiguous


def longest_delays(ports: Iterable[Input]) -> dict[str, int]:
    """Longest delay [sample] at which each field is read by some ports."""
    delays: dict[str, int] = {}
    for port in ports:
        for name in port.fields:
            delays[name] = max(delays.get(name, 0), port.delay)
    return delays


class Track:
    """Samples of some fields of a topic: the newest block and, where they are read late, those before it.

    Before sample 0 everything is zero. What `extend` and `view` hand out is good until the next block is added.

    Args:
        msgtype: message type of the topic.
        delays: longest delay at which each field is read [sample]; fields that are not named are not kept at all.
        block: longest block that is added [sample].

    Attributes:
        delay: longest of them.
    """

    def __init__(self, msgtype: str, delays: Mapping[str, int], block: int) -> None:
        self.delay = max(delays.values(), default=0)
        self._capacity = self.delay + max(block, ceil(self.delay / _MOVED))
        types = messages.sample_fields(msgtype)
        self._arrays = {name: np.zeros(self._capacity, types[name]) for name in delays}
        self._late = [self._arrays[name] for name, delay in delays.items() if delay]
        self._base = -self.delay  # sample index of element 0
        self._block, self._views = block, dict[int, Signals]()
        self._first, self._size, self._newest = 0, 0, Signals()  # what was added last
        self.end = 0  #: index after the newest sample

    def __getstate__(self) -> dict[str, Any]:
        """What is worth keeping: views of arrays would be kept as copies."""
        return {**self.__dict__, "_views": {}, "_size": 0, "_newest": {}}

    def _at(self, start: int, samples: int) -> Signals:
        """Views of ``samples`` elements from ``start`` on; those of whole blocks are made once."""
        if samples != self._block:
            return {name: array[start : start + samples] for name, array in self._arrays.items()}
        if start not in self._views:
            self._views[start] = {name: array[start : start + samples] for name, array in self._arrays.items()}
        return self._views[start]

    def extend(self, samples: int) -> Signals:
        """Views of ``samples`` new samples, for the caller to fill."""
        if self.end + samples - self._base > self._capacity:
            shift = self.end - self.delay - self._base
            for array in self._late:
                array[: self.delay] = array[shift : shift + self.delay]
            self._base += shift
        self._first, self._size, self._newest = self.end, samples, self._at(self.end - self._base, samples)
        self.end += samples
        return self._newest

    def view(self, first: int, samples: int) -> Signals:
        """Views of the samples ``first`` on, which must have been added and not be older than the longest delay."""
        if first == self._first and samples == self._size:
            return self._newest
        start = first - self._base
        assert start >= 0, "samples are too old"
        assert first + samples <= self.end, "samples are not there yet"
        return self._at(start, samples)

    def restart(self, first: int) -> None:
        """Begin at sample ``first``, with zeros before it; drops what is there."""
        for array in self._arrays.values():
            array[:] = 0
        self._base, self.end = first - self.delay, first
        self._first, self._size, self._newest = first, 0, {}
