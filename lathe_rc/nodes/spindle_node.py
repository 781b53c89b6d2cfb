# SPDX-License-Identifier: Apache-2.0
"""The spindle as time master: it starts the run, lets blocks go by window and pace, and ends it."""

import time
from collections import deque
from typing import cast

from lathe_rc_msgs.msg import CellState, Member, Progress
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from lathe_rc import messages
from lathe_rc.cell.latency_histogram import LATENCY, LATENESS, PERCENT, Durations, Percentiles
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError
from lathe_rc.nodes.losses import LossWatch
from lathe_rc.nodes.ports import latched_qos
from lathe_rc.nodes.refused_messages import ForeignMessage

_LOOK = 0.02  # [s] between looks at the members
_REPORT_PERIOD = 0.05  # [s] between reports of progress
_BURST = 64  # blocks let go before other work gets its turn


class SpindleNode(LossWatch):
    """See the module; its stage is the spindle and its encoder.

    Attributes:
        slipped: seconds that the schedule has slipped because members were slow.
    """

    def configure_part(self) -> None:
        """See `StageNode`."""
        super().configure_part()
        if self._pace.members and not self.table.window and not self._pace.speed_factor:
            raise InputError(
                f"{self.get_name()}.speed_factor = 0 with window = 0: nothing would hold the spindle back; "
                "allowed: a speed_factor above 0, or a window"
            )
        self._told: deque[Progress] = deque()
        self._schedule = 0.0  # monotonic time at which sample 0 would have been, were there no slips
        self._report_due = 0.0
        self.slipped = 0.0
        self._released: deque[float] = deque()  # monotonic times at which the blocks in flight were let go
        self._lateness, self._latency = Durations(), Durations()
        self._percentiles, self._late = Percentiles(), 0

    def activate_part(self) -> None:
        """See `StageNode`."""
        super().activate_part()
        self._state = self.create_publisher(CellState, "cell_state", latched_qos(1))
        self._clock_publisher = self.create_publisher(Clock, "/clock", QoSProfile(depth=10))
        self.create_subscription(Progress, "progress", self.guarded(self._on_progress), latched_qos())
        self.exchange.master = self.guarded(self._told.append)
        self._say(CellState.WAITING, 0)

    def member_names(self) -> list[str]:
        """All members, itself included; nobody when it runs alone."""
        return [self.full_name, *self._member_names] if self._member_names else []

    def statistics(self) -> dict[str, object]:
        """See `CellNode`."""
        return {
            **super().statistics(),
            "blocks in flight": self.blocks - self._least,
            "slowest member": self._slowest,
            "schedule slipped [s]": round(self.slipped, 3),
            LATENESS: self._lateness,
            LATENCY: self._latency,
        }

    def _say(self, state: int, first: int, why: str = "") -> None:
        said = CellState(run_id=self.table.run_id, state=state, first_index=first, message=why[:1024])
        if self._declared:
            assert self._end is not None, "the safe state has an end"
            said.end_index, said.lost = self._end, sorted(self._without)
        self._state.publish(said)

    # ---- start --------------------------------------------------------------------------------------

    def members_changed(self) -> None:
        """Begin when every member is ready and the cell passes its check."""
        super().members_changed()
        for name in self._member_names:
            if name in self.members:
                self.watch.follow(self.members[name])
        if self._unsafe:
            self._unsafe -= {name for name in self._unsafe if self.members[name].state == Member.SAFE}
            self.release()
        if self._running or not self._member_names or not self.active:
            return
        known = [self.members.get(name) for name in self.member_names()]
        if all(member is not None and member.state == member.READY for member in known):
            # The same check as before an offline run, with the parameters that the members really have.
            cell = Cell(*self.announced(self.member_names()))
            cell.check()
            for what in cell.unchecked:
                self.get_logger().warning(f"not checked: {what}")
            for what in cell.warnings:
                self.get_logger().warning(what)
            self._begin(cell)

    def _begin(self, cell: Cell | None = None) -> None:
        self._running = True
        self.get_logger().info(f"run {self.table.run_id or '(no id)'} begins with {len(self._member_names)} members")
        self._say(CellState.RUNNING, 0)
        self.reporter("block0", self.get_name())
        self._schedule = self._heard = self._looked = time.monotonic()
        self._members_moved = dict.fromkeys(self._member_names, self._heard)
        self.exchange.form(self, cell)
        if self.chain is None and self._inputs:
            self._join(0)
        self.release()

    # ---- run ----------------------------------------------------------------------------------------

    def _on_progress(self, progress: Progress) -> None:
        if progress.run_id != self.table.run_id:
            why = f"expected run {self.table.run_id!r}"
            raise ForeignMessage(self._host["progress"].topic_name, progress.name, progress.run_id, why)
        known = progress.name in self._completed
        if not known or progress.blocks <= self._completed[progress.name]:
            if known and self.restarts(progress.name):  # it computes once more: that is no silence
                self._heard = self._members_moved[progress.name] = time.monotonic()
            return
        if progress.blocks > self.blocks:
            raise LatheError(f"{progress.name} claims {progress.blocks} blocks; {self.blocks} were sent")
        before = self._least
        self._completed[progress.name] = progress.blocks
        least = self._least
        self._heard = self._members_moved[progress.name] = time.monotonic()
        if progress.name in self._stalled:
            self._stalled = frozenset()
        self._after(before, least)

    def _after(self, before: int, least: int) -> None:
        """Every member has completed some more blocks."""
        if least > before:
            for _ in range(least - before):
                self._latency.add(self._heard - self._released.popleft())
            samples = min(least * self.table.block_size, self.samples)
            stamp = messages.header(max(samples - 1, 0), self.table.step_ns).stamp
            clock = Clock()
            clock.clock.sec, clock.clock.nanosec = stamp.sec, stamp.nanosec
            self._clock_publisher.publish(clock)
            if self._heard >= self._report_due:
                self._report_due = self._heard + _REPORT_PERIOD
                self.reporter("progress", self.get_name(), samples=samples)
        if least == self._blocks_in_run:
            self._finish_run()
        else:
            self.release()

    def _credit(self) -> int:
        """Blocks that the window lets go."""
        if not self._completed or not self.table.window:
            return 1
        return self.table.window - (self.blocks - self._least)

    def _at_once(self) -> int:
        """Blocks to let go at once, at most."""
        return 1 if self._pace.speed_factor else min(self._credit(), self.together)

    def _possible(self) -> int:
        """Samples to let go at once; 0 while it, or others in its chain, wait for an input."""
        samples = self.table.block_size * self._at_once()
        if self.chain is None and not self._inputs:
            return samples
        ready = self.chain.ready() if self.chain is not None else self.next()
        return min(samples, ready[0]) if ready else 0

    def _let_go(self, samples: int, *, last: bool) -> None:
        if self.chain is not None:
            self.chain.compute(samples, last=last)
        else:
            self.compute(samples, self.read(samples), last=last)

    def release(self) -> None:
        """Let go every block that credit and pace allow."""
        if not (self._running and self.active) or self.failure or self.done or self._unsafe:
            return
        factor = self._pace.speed_factor
        size, step = self.table.block_size, self.table.step
        begun = time.monotonic()
        for _ in range(_BURST):
            if self.blocks == self._blocks_in_run or not self._credit():
                return
            if time.monotonic() - begun > _LOOK:
                break  # a window may hold many blocks: meanwhile deaths shall be noticed
            if not (samples := self._possible()):
                return
            if factor and not self._is_due(size * step / factor, -(-samples // size)):
                return
            last = self._end is not None and self._end - self.samples <= samples
            if last:
                samples = cast("int", self._end) - self.samples
            if self._completed:
                self._released.extend([time.monotonic()] * -(-samples // size))
            self._let_go(samples, last=last)
        self.next_tick = time.monotonic()

    def _is_due(self, block: float, blocks: int) -> bool:
        """Whether the next blocks may go, each taking so much wall time [s]; counts how late they are."""
        now = time.monotonic()
        due = self._schedule + (self.blocks + 1) * block
        if now < due:
            self.next_tick = min(self.next_tick, due)
            return False
        late = now - due
        for number in range(blocks):
            behind = max(late - number * block, 0.0)
            self._lateness.add(behind)
            self._percentiles.add(behind)
            self._late += behind > block
        if late > max(1, self.table.window // 2) * block:
            self._fall_behind(late)
        return True

    def _fall_behind(self, late: float) -> None:
        """Slip, for less would be made up by the next blocks: no long burst to catch up."""
        self._schedule += late
        self.slipped += late

    def lead(self) -> None:
        """See `StageNode`: as far as credit and pace allow."""
        self.attempt(self.release)

    def advance(self) -> None:
        """Take what members in this process have told: not at once, the block that they report may be under way."""
        for _ in range(len(self._told)):  # their reports on the blocks that this lets go have their turn later
            report = self._told.popleft()
            self.due = self.due or bool(self._told)  # an error leaves the rest for the next turn
            self._on_progress(report)
        if self._inputs and self.chain is None:
            self.release()  # what has come from the cut may let blocks go

    def ended(self) -> None:
        """Its last block is out; the run ends when all members have completed it."""
        if not self._completed:
            self._finish_run()

    def _report_pace(self) -> None:
        """Say how late the blocks were, if they were due at some time."""
        if self._percentiles.count:
            self.reporter(
                "pace",
                self.get_name(),
                blocks=self._percentiles.count,
                late=self._late,
                worst=self._percentiles.worst,
                within={percent: self._percentiles.within(percent) for percent in PERCENT},
                slipped=self.slipped,
            )

    def _finish_run(self) -> None:
        self._report_pace()
        self._say(CellState.ENDED, self.samples, self._why)
        self.get_logger().info(f"run ended: {self.blocks} blocks, {self.samples} samples")
        self.end([*self.outlets.values(), self._state])
        if self._declared:
            super().fail(LatheError(self._why))

    def fail(self, error: LatheError, *, cause: str = "error") -> None:
        """As the arbiter, fail the cell with it."""
        first = not self.failure
        super().fail(error, cause=cause)
        if first and hasattr(self, "_state"):
            self._say(CellState.FAILED, self.samples, str(error))

    def tick(self, now: float) -> None:
        """See `CellNode`."""
        super().tick(now)
        if not self.active or self.done:
            return
        if not self._running and not self._member_names:
            self._begin()
        self.attempt(self.release)
        self.next_tick = min(self.next_tick, now + _LOOK)
