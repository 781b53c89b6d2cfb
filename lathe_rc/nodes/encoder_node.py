# SPDX-License-Identifier: Apache-2.0
"""A real encoder as time master: readings from a topic or a line let blocks go as soon as they reach so far."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np
from sensor_msgs.msg import JointState

from lathe_rc.cell.stages.encoder_device import EncoderDevice, EncoderDeviceParameters
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import LatheError
from lathe_rc.nodes.publisher_info import asked
from lathe_rc.nodes.spindle_node import SpindleNode
from lathe_rc.signals.counts import LineReader, Reading

_POLL = 0.5e-3  # [s] between looks at a line


class _EncoderLostError(LatheError):
    """Nobody knows any more how the spindle turns."""


@contextmanager
def _losing_it() -> Iterator[None]:
    """Turn errors inside into the loss of the encoder."""
    try:
        yield
    except LatheError as error:
        raise _EncoderLostError(*error.args) from None


def _place(joints: Any, name: str) -> int | None:
    """Place of a joint, without a name the first, in the positions of a joint state; None: it has none.

    Several nodes may publish on one topic, as the grippers of a robot do, and a driver may publish velocities alone.
    """
    if name and name not in joints.name:
        return None
    place = list(joints.name).index(name) if name else 0
    return place if place < len(joints.position) else None


class EncoderNode(SpindleNode):
    """See the module; with a file it is a spindle like any other.

    When the encoder is lost the others come to their safe state, while the spindle seems to go on at its last speed.

    Block k is due when the last reading that it needs would have been here, had it taken as long on its way as the
    quickest one so far.
    """

    stage: EncoderDevice
    _line: LineReader | None = None
    _listens = _lost = False
    _unusable = 0  # joint states that say nothing of the spindle
    _other = ""  # the last of them

    def configure_part(self) -> None:
        """See `StageNode`."""
        super().configure_part()
        self._device = cast("EncoderDeviceParameters", self.table)
        self._scale = self._device.counts_per_revolution / (2.0 * np.pi) if self._device.position == "angle" else 1.0
        if self._device.source == "line":
            self._line = LineReader.open(Path(self._device.device), self._device.baud_rate)
        self._came = 0.0  # when the newest reading has come, monotonic [s]

    def finish(self) -> None:
        """See `CellNode`."""
        super().finish()
        if self._line is not None:
            self._line.close()
            self._line = None

    def statistics(self) -> dict[str, object]:
        """See `CellNode`."""
        counted = self.stage.counted
        told: dict[str, object] = {"newest reading [s]": round(counted.time, 6), "late readings": counted.late}
        if self._unusable:
            told["joint states without the spindle"] = f"{self._unusable}, the last {self._other}"
        return {**super().statistics(), **told} if self.stage.live else super().statistics()

    # ---- readings -----------------------------------------------------------------------------------

    def _listen_to_joints(self) -> None:
        """As soon as somebody publishes them: only then is it known what quality of service can be asked for."""
        topic = self.topic(self._device.topic)
        if not self._listens and (publishers := self.get_publishers_info_by_topic(topic)):
            self._listens = True
            self.create_subscription(JointState, topic, self.guarded(self._on_joints), asked(publishers))

    @_losing_it()
    def _on_joints(self, joints: Any) -> None:
        where, place = self.topic(self._device.topic), _place(joints, self._device.joint)
        if place is None:
            self._unusable += 1
            self._other = f"of {', '.join(joints.name) or 'no joint'} with {len(joints.position)} positions"
            return
        stamp = joints.header.stamp
        time_ns = stamp.sec * 10**9 + stamp.nanosec
        if not time_ns:
            raise LatheError(f"{where}: no time in a header; allowed: the time at which the position was measured")
        self._hear(iter([(time_ns, joints.position[place] * self._scale)]))

    def _hear(self, readings: Iterator[Reading]) -> None:
        """Take readings; those before the run are over."""
        for time_ns, count in readings:
            if not self._running or self.over or self._lost:
                continue
            self._came = time.monotonic()
            self.stage.hear(time_ns, count)
            self._schedule = min(self._schedule, self._came - self.stage.counted.time)

    def _begin(self, cell: Cell | None = None) -> None:
        if self._line is not None:
            self._hear(self._line.read())  # what has waited there is over
        super()._begin(cell)
        if self.stage.live:
            self._schedule, self._came = np.inf, time.monotonic()

    # ---- run ----------------------------------------------------------------------------------------

    def _at_once(self) -> int:
        """See `SpindleNode`; all that is there, for an encoder that has fallen behind has to catch up."""
        catches_up = self.stage.live and not self._lost
        return min(self._credit(), self.together) if catches_up else super()._at_once()

    def _possible(self) -> int:
        """See `SpindleNode`: no more than the readings reach to."""
        samples = super()._possible()
        if not self.stage.live:
            return samples
        self._know_end()
        there = self.stage.available - self.samples
        if self._end is None or self.stage.available < self._end:
            there -= there % self.table.block_size  # the last block alone may be shorter
        return min(samples, there)

    def _fall_behind(self, late: float) -> None:
        """See `SpindleNode`; a real spindle does not wait."""
        if not self.stage.live:
            super()._fall_behind(late)
        elif late > self._device.max_lag and not self._lost:
            raise _EncoderLostError(
                f"{self.get_name()}: the cell is {late:.3g} s behind the encoder at sample {self.samples}; allowed: up "
                f"to max_lag = {self._device.max_lag:g} s (fewer processes, a larger block_size, or less to record)"
            )

    def advance(self) -> None:
        """See `StageNode`: what has been heard may let blocks go."""
        super().advance()
        self.release()

    def tick(self, now: float) -> None:
        """See `CellNode`."""
        if self.active and self.stage.live and not self.done and not self.failure:
            self.attempt(self._look)
        super().tick(now)
        if self._line is not None:
            self.next_tick = min(self.next_tick, now + _POLL)

    @_losing_it()
    def _look(self) -> None:
        """Take what has come on a line; has a topic its publisher; has nothing come for too long?"""
        if self._lost:
            return
        if self._line is None:
            self._listen_to_joints()
        else:
            self._hear(self._line.read())
            if self._line.ended and self._running and not self.over:
                self.stage.end()
        silent, needed = time.monotonic() - self._came, np.inf if self._end is None else self._end
        if self._running and self.stage.available < needed and silent > self._device.max_silence:
            topic, why = self.topic(self._device.topic), ""
            if self._line is None and not self._listens:
                why = f"; nobody publishes {topic}"
            elif self._unusable:
                wanted = f"joint {self._device.joint!r}" if self._device.joint else "a first joint"
                why = f"; {self._unusable} messages on {topic} have no position of {wanted}, the last {self._other}"
            raise LatheError(
                f"{self.get_name()}: no counts for {silent:.3g} s, after {self.stage.counted.time:.6g} s; allowed: up "
                f"to max_silence = {self._device.max_silence:g} s{why}"
            )

    def fail(self, error: LatheError, *, cause: str = "error") -> None:
        """See `SpindleNode`; without its encoder it leads the others to their safe state, if they can wait for it."""
        if not isinstance(error, _EncoderLostError):
            super().fail(error, cause=cause)
        elif not self.table.window or not self._completed or not self.samples:
            super().fail(LatheError(*error.args), cause=cause)
        elif not self._lost:
            self._lost = True
            self.stage.go_on()
            self._declare_safe(str(error))
