# SPDX-License-Identifier: Apache-2.0
"""Time master with a real encoder: readings from a topic or a serial line release the blocks that they complete."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from sensor_msgs.msg import JointState

from lathe_machine.signals.counts import LineReader, Reading
from lathe_rc.errors import LatheError
from lathe_rc.nodes.cell_node import CellNode
from lathe_rc.nodes.publisher_info import asked
from lathe_rc.nodes.spindle_role import SpindleRole

if TYPE_CHECKING:
    from lathe_machine.stages.spindle.encoder_device import EncoderDevice, EncoderDeviceParameters

_POLL = 0.5e-3  # [s] between polls of a line


def _place(joints: Any, name: str) -> int | None:
    """Return the index of a joint in a joint state's positions, of the first joint without a name; None if it has none.

    Several nodes may publish on one topic, like the grippers of a robot, and a driver may publish velocities only.
    """
    if name and name not in joints.name:
        return None
    place = list(joints.name).index(name) if name else 0
    return place if place < len(joints.position) else None


class EncoderRole(SpindleRole):
    """Role of the time master with a real encoder; with a file as source it works like the simulated spindle.

    When the encoder is lost the members go to their safe state, and the angle is extrapolated at the last speed.

    Block k is due when the last reading that it needs would have arrived with the shortest transmission delay observed
    so far.
    """

    stage: "EncoderDevice"

    def __init__(self, node: CellNode) -> None:
        super().__init__(node)
        device = self._device = cast("EncoderDeviceParameters", node.table)
        self._scale = device.counts_per_revolution / (2.0 * np.pi) if device.position == "angle" else 1.0
        timed, is_line = device.edge_clock > 0.0, device.source == "line"
        self._line = LineReader.open(Path(device.device), device.baud_rate, timed=timed) if is_line else None
        self._came = 0.0  # arrival of the newest reading, monotonic [s]
        self._listens = self._lost = False
        self._unusable = 0  # joint states without a spindle position
        self._other = ""  # description of the last unusable one

    def finish(self) -> None:
        """Close the encoder's line (implements `Role`)."""
        if self._line is not None:
            self._line.close()
            self._line = None

    @property
    def tunable(self) -> tuple[str, ...]:
        """Return the parameters that may change in a run: not the pace of a live encoder (extends `SpindleRole`)."""
        return () if self.stage.live else super().tunable

    def statistics(self) -> dict[str, object]:
        """Return the figures of spindle and encoder for the diagnostics (implements `Role`)."""
        counted = self.stage.counted
        figures: dict[str, object] = {"newest reading [s]": round(counted.time, 6), "late readings": counted.late}
        if self._unusable:
            figures["joint states without the spindle"] = f"{self._unusable}, the last {self._other}"
        return {**super().statistics(), **figures} if self.stage.live else super().statistics()

    # ---- readings -----------------------------------------------------------------------------------

    @contextmanager
    def _losing_it(self) -> Iterator[None]:
        """Convert errors in the context into the loss of the encoder."""
        try:
            yield
        except LatheError as error:
            self._lose_encoder(str(error))

    def _lose_encoder(self, why: str) -> None:
        """Declare the encoder lost and lead the members to their safe state.

        Raises:
            LatheError: a safe state is not possible: no window, no members, or no sample released yet.
        """
        if not self.table.window or not self.leads.completed or not self.samples:
            raise LatheError(why)
        if not self._lost:
            self._lost = True
            self.stage.go_on()
            self.leads.declare_safe(why, time.monotonic())

    def _listen_to_joints(self) -> None:
        """Subscribe to the joint states as soon as a node publishes them: only then are their offered QoS known."""
        node, topic = self.node, self.node.topic(self._device.topic)
        if not self._listens and (publishers := node.get_publishers_info_by_topic(topic)):
            self._listens = True
            node.create_subscription(JointState, topic, node.guarded(self._on_joints), asked(publishers))

    def _on_joints(self, joints: Any) -> None:
        where, place = self.node.topic(self._device.topic), _place(joints, self._device.joint)
        if place is None:
            self._unusable += 1
            self._other = f"of {', '.join(joints.name) or 'no joint'} with {len(joints.position)} positions"
            return
        stamp = joints.header.stamp
        time_ns = stamp.sec * 10**9 + stamp.nanosec
        with self._losing_it():
            if not time_ns:
                raise LatheError(f"{where}: no time in a header; allowed: the time at which the position was measured")
            self._hear(iter([(time_ns, joints.position[place] * self._scale)]))

    def _hear(self, readings: Iterator[Reading]) -> None:
        """Take encoder readings; readings from before the start of the run are ignored."""
        for reading in readings:
            if not self.leads.running or self.leads.over or self._lost:
                continue
            self._came = time.monotonic()
            self.stage.hear(*reading)
            self.pace.schedule = min(self.pace.schedule, self._came - self.stage.counted.time)

    def start_run(self) -> None:
        """Begin the run; with a live encoder the schedule follows the readings (extends `SpindleRole`)."""
        super().start_run()
        if self.stage.live:
            self.pace.schedule, self._came = np.inf, time.monotonic()

    # ---- run ----------------------------------------------------------------------------------------

    def blocks_at_once(self) -> int:
        """Return the largest number of blocks to release; a late live encoder catches up (extends `SpindleRole`)."""
        catches_up = self.stage.live and not self._lost
        return min(self.leads.credit, self.together) if catches_up else super().blocks_at_once()

    def possible(self) -> int:
        """Return the number of samples to release, limited by the encoder readings (extends `SpindleRole`)."""
        samples = super().possible()
        if not self.stage.live:
            return samples
        self.leads.know_end(self.stage.samples)
        there, end = self.stage.available - self.samples, self.leads.end
        if end is None or self.stage.available < end:
            there -= there % self.table.block_size  # only the last block may be shorter
        return min(samples, there)

    def fall_behind(self, late: float) -> None:
        """Check the cell's lag behind a live encoder, which cannot wait; beyond ``max_lag`` it counts as lost."""
        if not self.stage.live:
            super().fall_behind(late)
        elif late > self._device.max_lag and not self._lost:
            self._lose_encoder(
                f"{self.node.get_name()}: the cell is {late:.3g} s behind the encoder at sample {self.samples}; "
                f"allowed: up to max_lag = {self._device.max_lag:g} s (fewer processes, a larger block_size, or less "
                "to record)"
            )

    def work(self) -> None:
        """Compute, and release the blocks that new readings allow (extends `SpindleRole`)."""
        super().work()
        self.release()

    def tick(self, now: float) -> float:
        """Poll the encoder and do the spindle's periodic work (implements `Role`)."""
        leads = self.leads
        if leads.active and self.stage.live and not leads.done and not leads.failure:
            self.node.attempt(self._look)
        due = super().tick(now)
        return due if self._line is None else min(due, now + _POLL)

    def _look(self) -> None:
        """Read the encoder's line or subscribe to its topic, and check for readings that are overdue."""
        if self._lost:
            return
        with self._losing_it():
            if self._line is None:
                self._listen_to_joints()
            else:
                self._hear(self._line.read())
                if self._line.ended and self.leads.running and not self.leads.over:
                    self.stage.end()
            self._check_silence()

    def _check_silence(self) -> None:
        leads = self.leads
        silent, needed = time.monotonic() - self._came, np.inf if leads.end is None else leads.end
        if not leads.running or self.stage.available >= needed or silent <= self._device.max_silence:
            return
        topic, why = self.node.topic(self._device.topic), ""
        if self._line is None and not self._listens:
            why = f"; nobody publishes {topic}"
        elif self._unusable:
            wanted = f"joint {self._device.joint!r}" if self._device.joint else "a first joint"
            why = f"; {self._unusable} messages on {topic} have no position of {wanted}, the last {self._other}"
        raise LatheError(
            f"{self.node.get_name()}: no counts for {silent:.3g} s, after {self.stage.counted.time:.6g} s; allowed: up "
            f"to max_silence = {self._device.max_silence:g} s{why}"
        )
