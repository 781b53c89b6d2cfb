# SPDX-License-Identifier: Apache-2.0
"""Messages of a cell's members: blocks of samples, and messages at individual samples."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lathe_rc import messages
from lathe_rc.blocks.ports import Sparse
from lathe_rc.messages import MAX_BLOCK, START_NS, Samples, Signals

_MOST_FIELDS = 16
_ZEROS = np.zeros(_MOST_FIELDS * (MAX_BLOCK + 1))
_AT_ONCE = 8192  # numbers allocated at once, unless a single block is larger


@dataclass(slots=True)
class Block:
    """Block of samples, either received (signals are views of its bytes) or computed in this process.

    Attributes:
        run_id, source, first_index, step_ns, last, companions: see BlockInfo.msg.
        samples: number of samples.
        log_ns: time stamp [ns].
        signals: arrays of shape (samples,) by field.
        whole: all signals as one array of shape (fields, samples), if computed in this process.
    """

    run_id: str
    source: str
    first_index: int
    step_ns: int
    last: bool
    companions: int
    samples: int
    log_ns: int
    signals: Signals
    whole: Samples | None = None

    def part(self, start: int, stop: int) -> "Block":
        """Return samples ``start`` to ``stop`` of the block, as views."""
        first, last = self.first_index + start, self.last and stop == self.samples
        log_ns = START_NS + (first + stop - start - 1) * self.step_ns
        signals = {name: array[start:stop] for name, array in self.signals.items()}
        samples = stop - start
        return Block(self.run_id, self.source, first, self.step_ns, last, self.companions, samples, log_ns, signals)

    def check(self) -> None:
        """Check that no sample is NaN or infinite.

        Raises:
            ValueError: a sample is NaN or infinite.
        """
        if self.whole is None or not is_finite(self.whole.ravel()):
            for name, array in self.signals.items():
                check_finite(self.source, name, array, self.first_index)


class NotFiniteError(ValueError):
    """Error for a NaN or infinite sample.

    Attributes:
        index: index of the sample.
    """

    def __init__(self, message: str, index: int) -> None:
        super().__init__(message)
        self.index = index


def is_finite(array: Samples) -> bool:
    """Return whether no float64 of an array of shape (n,) is NaN or infinite."""
    # 0 times a finite number is 0, and NaN otherwise, so one product checks all.
    return bool(array.dot(_ZEROS[: array.size]) == 0.0)


def check_finite(source: str, name: str, array: Samples, first: int) -> None:
    """Check that no sample of a field is NaN or infinite.

    Args:
        source: name of the publisher.
        name: name of the field.
        array: shape (n,), any type; n up to `lathe_rc.messages.MAX_BLOCK`.
        first: index of the first sample.

    Raises:
        NotFiniteError: a sample is NaN or infinite; the error describes the first one.
    """
    if array.dtype == np.float64 and not is_finite(array):
        bad = int(np.flatnonzero(~np.isfinite(array))[0])
        index = first + bad
        raise NotFiniteError(f"{source} sends {name} = {array[bad]} at sample {index}; allowed: finite numbers", index)


class Pool:
    """Memory pool for the samples of blocks of one message type.

    Readers in the same process may keep the arrays as long as needed, so each block needs its own memory; allocating
    memory for several blocks at once takes 25 % of the time.

    Args:
        msgtype: message type.
        blank: all numbers are NaN at first, so that a field that the stage does not fill is found out.
    """

    def __init__(self, msgtype: str, *, blank: bool = False) -> None:
        self._blank = blank
        self._fields = messages.sample_fields(msgtype)
        self._uniform = set(self._fields.values()) == {np.dtype(np.float64)}
        self._samples = 0
        self._free: list[Samples] = []

    def take(self, samples: int) -> tuple[Signals, Samples | None]:
        """Return uninitialised arrays of shape (samples,) by field, and one array of all if they have the same type."""
        if self._blank:
            blank = {np.dtype(np.float64): np.nan}
            return {name: np.full(samples, blank.get(dtype, 0), dtype) for name, dtype in self._fields.items()}, None
        if not self._uniform:
            return {name: np.empty(samples, dtype) for name, dtype in self._fields.items()}, None
        if not self._free or samples != self._samples:
            self._samples, size = samples, samples * len(self._fields)
            # Views of one allocation, which lives as long as a reader holds any of them.
            self._free = list(np.empty((max(_AT_ONCE // size, 1), len(self._fields), samples)))
        whole = self._free.pop()
        return dict(zip(self._fields, whole, strict=True)), whole


class Framer:
    """Factory of the sparse messages of one node.

    Args:
        run_id: ID of the run.
        source: fully qualified name of the node.
        step_ns: sampling step [ns].

    Attributes:
        companions: number of messages created so far, which the node's next block reports.
    """

    def __init__(self, run_id: str, source: str, step_ns: int) -> None:
        self._run_id, self._source, self._step_ns = run_id, source, step_ns
        self.companions = 0

    def sparse(self, message: Sparse) -> Any:
        """Return a message at an individual sample and count it, since a block reports how many messages precede it."""
        self.companions += 1
        head = messages.header(message.index, self._step_ns)
        kind = messages.store().types[message.type]
        # ROS types, such as JointState, have no fields for run and source.
        if message.type.startswith(messages.PACKAGE):
            return kind(
                header=head,
                run_id=self._run_id,
                source=self._source,
                sample_index=message.index,
                **message.values,
            )
        return kind(header=head, **message.values)
