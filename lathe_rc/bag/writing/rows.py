# SPDX-License-Identifier: Apache-2.0
"""Rows of a bag: the blocks of all dense topics for the same samples, one after another.

All rows have the same bytes except for a few numbers and the samples. The layout is therefore computed only once, and
writing a block only copies its samples into place.
"""

from typing import Any, NamedTuple

import numpy as np

from lathe_rc.bag.writing.mcap_file import TIMES, message_head
from lathe_rc.blocks.block import Block
from lathe_rc.blocks.wire import NUMBERS, Layout
from lathe_rc.messages import START_NS, Samples, Signals

_BILLION = 1_000_000_000


class RowPlan(NamedTuple):
    """Size and period of rows, in which the same messages recur in the same order and with the same lengths.

    Attributes:
        size: size of a row [B].
        period_ns: log time between rows [ns].
    """

    size: int
    period_ns: int


class Dense(NamedTuple):
    """Dense topic of a row.

    Attributes:
        topic: fully qualified topic.
        type: message type.
        source: fully qualified name of the publishing node.
        channel: channel number in the file.
    """

    topic: str
    type: str
    source: str
    channel: int


class Plan:
    """Byte layout of rows with one block length.

    Args:
        topics: the dense topics, in the order of the row.
        run_id: ID of the run.
        step_ns: sampling step [ns].
        samples: samples per block.

    Attributes:
        step_ns, samples: as passed in.
        layouts: layouts of the messages.
        places: byte offsets of the messages in a row.
        template: row in which all numbers and samples are 0, shape (bytes,).
        rows: size and period of the rows for a `MessageSink`.
    """

    def __init__(self, topics: list[Dense], run_id: str, step_ns: int, samples: int) -> None:
        self.step_ns, self.samples = step_ns, samples
        self.layouts = [Layout(dense.type, run_id, dense.source, samples) for dense in topics]
        self.places: list[int] = []
        template = b""
        for dense, layout in zip(topics, self.layouts, strict=True):
            template += message_head(dense.channel, 0, len(layout.template))
            self.places.append(len(template))
            template += layout.template
        self.template = np.frombuffer(template, np.uint8)
        self.rows = RowPlan(len(template), samples * step_ns)


class RowBuffer:
    """Buffer of consecutive rows in memory.

    Args:
        plan: byte layout of a row.
        rows: number of rows.

    Attributes:
        plan: as passed in.
        bytes: bytes of the rows, shape (rows, bytes).
    """

    def __init__(self, plan: Plan, rows: int) -> None:
        self.plan = plan
        self.bytes = np.empty((rows, plan.template.size), np.uint8)
        self.bytes[:] = plan.template
        layouts = list(zip(plan.layouts, plan.places, strict=True))
        messages = [self._view(layout.dtype, place) for layout, place in layouts]
        # A record array creates a new view for each field access, and these fields are accessed constantly.
        self._numbers = [{name: message[name] for name in NUMBERS} for message in messages]
        self._samples = [
            {name: message[name] for name in layout.fields}
            for message, layout in zip(messages, plan.layouts, strict=True)
        ]
        self._wholes = [self._whole(layout, place) for layout, place in layouts]
        self._times = [self._view(np.dtype("<u8"), place - back) for _, place in layouts for back in TIMES]
        for numbers in self._numbers:
            numbers["step_ns"][:] = plan.step_ns

    def _view(self, dtype: np.dtype[Any], place: int) -> Samples:
        view: Samples = np.ndarray(len(self.bytes), dtype, self.bytes.data, place, self.bytes.strides[0])
        return view

    def _whole(self, layout: Layout, place: int) -> Samples | None:
        """Return a view of all samples of a message, shape (rows, fields, samples); None unless all are float64."""
        places = [start for dtype, start in layout.fields.values() if dtype == np.float64]
        # The message has array lengths between its arrays; a view with strides skips them.
        gaps = set(np.diff(places).tolist()) or {0}
        if len(places) != len(layout.fields) or len(gaps) > 1:
            return None
        shape, strides = (len(self.bytes), len(places), layout.samples), (self.bytes.strides[0], gaps.pop(), 8)
        whole: Samples = np.ndarray(shape, np.float64, self.bytes.data, place + places[0], strides)
        return whole

    def begin(self, first: int) -> None:
        """Set the times and sample indices of all rows; the first row begins at sample ``first``."""
        firsts = first + np.arange(len(self.bytes)) * self.plan.samples
        times = START_NS + (firsts + self.plan.samples - 1) * self.plan.step_ns
        for place in self._times:
            place[:] = times
        seconds, nanoseconds = np.divmod(times, _BILLION)
        for numbers in self._numbers:
            numbers["sec"][:], numbers["nanosec"][:], numbers["first_index"][:] = seconds, nanoseconds, firsts
            numbers["last"][:] = False

    def put(self, place: int, row: int, block: Block, data: bytes | None) -> None:
        """Set the block of topic number ``place`` in one row; copy the block's serialized message if there is one."""
        if data is not None:
            start = self.plan.places[place]
            self.bytes[row, start : start + len(data)] = np.frombuffer(data, np.uint8)
            return
        whole = self._wholes[place]
        if whole is not None and block.whole is not None:
            whole[row] = block.whole
        else:
            for name, samples in self._samples[place].items():
                samples[row] = block.signals[name]
        numbers = self._numbers[place]
        numbers["companions"][row] = block.companions
        if block.last:
            numbers["last"][row] = True

    def put_many(self, place: int, row: int, signals: Signals, companions: Samples, *, last: bool) -> None:
        """Set a topic's consecutive blocks from a row on; ``signals`` has arrays of shape (blocks * samples,)."""
        stop = row + companions.size
        for name, samples in self._samples[place].items():
            samples[row:stop] = signals[name].reshape(companions.size, self.plan.samples)
        numbers = self._numbers[place]
        numbers["companions"][row:stop] = companions
        numbers["last"][stop - 1] = last

    def message(self, place: int, row: int) -> bytes:
        """Return the serialized message of a topic in one row."""
        start = self.plan.places[place]
        return self.bytes[row, start : start + len(self.plan.layouts[place].template)].tobytes()
