# SPDX-License-Identifier: Apache-2.0
"""Delay buffer: recent past of a topic in contiguous memory, for views of several or delayed blocks without copying."""

from collections.abc import Iterable, Mapping
from math import ceil
from types import MappingProxyType

import numpy as np

from lathe_rc import messages
from lathe_rc.blocks.ports import Input
from lathe_rc.errors import InputError
from lathe_rc.messages import Samples, Signals

_MOVED = 0.25  # largest share of samples copied again to keep them contiguous
_VIEWS = 256  # largest number of cached views
_NONE = np.empty(0)


def longest_delays(ports: Iterable[Input]) -> dict[str, int]:
    """Return the longest delay [sample] with which the given ports read each field."""
    delays: dict[str, int] = {}
    for port in ports:
        for name in port.fields:
            delays[name] = max(delays.get(name, 0), port.delay)
    return delays


def past_of(past: Mapping[str, Samples], topic: str, name: str, delay: int, first: int) -> Samples:
    """Return the samples of a field that a delayed reader needs before sample ``first``, at most ``delay``.

    Args:
        past: the newest samples before it, by field.
        topic: name of the topic.
        name: name of the field.
        delay: delay of the reader [sample].
        first: sample index.

    Raises:
        InputError: there are not as many; samples before sample 0 are zero, and need not be given.
    """
    kept = past.get(name, _NONE)
    if kept.size < min(delay, first):
        raise InputError(
            f"{topic}.{name} is read {delay} samples late, and the checkpoint holds {kept.size} past samples; "
            "allowed: no longer delay"
        )
    return kept[max(kept.size - delay, 0) :]


class DelayBuffer:
    """Buffer of the newest samples of some fields of a topic, and of earlier samples for delayed readers.

    Before sample 0 everything is zero. Views from `extend` and `view` are valid until the next block is added.

    Args:
        msgtype: message type of the topic.
        delays: longest delay with which each field is read [sample]; other fields are not kept.
        longest: largest number of samples added or viewed at once.

    Attributes:
        delay: longest of the delays [sample].
    """

    def __init__(self, msgtype: str, delays: Mapping[str, int], longest: int) -> None:
        self.delay = max(delays.values(), default=0)
        self._kept = self.delay + longest
        self._capacity = self._kept + max(longest, ceil(self._kept / _MOVED))
        types = messages.sample_fields(msgtype)
        self._arrays = {name: np.zeros(self._capacity, types[name]) for name in delays}
        self._base = -self._kept  # sample index of element 0
        self._views = dict[tuple[int, int], Signals]()
        self._first, self._size, self._newest = 0, 0, Signals()  # the newest samples
        self.end = 0  #: index after the newest sample

    def _at(self, start: int, samples: int) -> Signals:
        """Return views of ``samples`` elements starting at ``start``, cached for repeated use."""
        views = self._views.get((start, samples))
        if views is None:
            views = {name: array[start : start + samples] for name, array in self._arrays.items()}
            # With blocks of varying lengths, views are rarely reused.
            if len(self._views) < _VIEWS:
                self._views[start, samples] = views
        return views

    def extend(self, samples: int) -> Signals:
        """Return views of ``samples`` new samples, for the caller to fill."""
        if self.end + samples - self._base > self._capacity:
            # The kept samples are moved to the start, but only after several times as many new samples.
            shift = self.end - self._kept - self._base
            for array in self._arrays.values():
                array[: self._kept] = array[shift : shift + self._kept]
            self._base += shift
        self._first, self._size, self._newest = self.end, samples, self._at(self.end - self._base, samples)
        self.end += samples
        return self._newest

    def view(self, first: int, samples: int) -> Signals:
        """Return views of samples starting at ``first``, which must be in the buffer."""
        # Most readers need the complete newest block.
        if first == self._first and samples == self._size:
            return self._newest
        start = first - self._base
        assert start >= 0, "samples are too old"
        assert first + samples <= self.end, "samples are not there yet"
        return self._at(start, samples)

    def past(self) -> Signals:
        """Return copies of the samples before `end` that may still be viewed, by field."""
        start = self.end - self._kept - self._base
        return {name: array[start : start + self._kept].copy() for name, array in self._arrays.items()}

    def restart(self, first: int, past: Mapping[str, Samples] = MappingProxyType({})) -> None:
        """Restart at sample ``first``.

        Args:
            first: sample index.
            past: the newest samples before it, as returned by `past`; all others are zero.
        """
        for name, array in self._arrays.items():
            array[:] = 0
            if name in past and (size := min(past[name].size, self._kept)):
                array[self._kept - size : self._kept] = past[name][-size:]
        self._base, self.end = first - self._kept, first
        self._first, self._size, self._newest = first, 0, {}
