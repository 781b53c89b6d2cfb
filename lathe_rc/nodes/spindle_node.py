# SPDX-License-Identifier: Apache-2.0
"""The spindle as time master: it starts the run, lets blocks go by window and pace, and ends it."""

import time
from collections import deque
from collections.abc import Mapping
from typing import cast

from lathe_rc_msgs.msg import CellState, Member, Progress
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from lathe_rc import messages
from lathe_rc.cell.durations import LATENCY, LATENESS, PERCENT, Durations, Percentiles
from lathe_rc.cell.stages.time_master import TimeMaster, TimeMasterParameters
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError
from lathe_rc.nodes.liveliness import SILENCE
from lathe_rc.nodes.ports import latched_qos
from lathe_rc.nodes.refused_messages import ForeignMessage
from lathe_rc.nodes.shell import given_up, why_failed
from lathe_rc.nodes.stage_node import StageNode

_GONE = 0.2  # [s] for messages to be acknowledged, if who has died never will
_LOOK = 0.02  # [s] between looks at the members
_REPORT_PERIOD = 0.05  # [s] between reports of progress
_BURST = 64  # blocks let go before other work gets its turn


class SpindleNode(StageNode):
    """See the module; its stage is the spindle and its encoder.

    Attributes:
        slipped: seconds that the schedule has slipped because members were slow.
    """

    stage: TimeMaster

    def configure_part(self) -> None:
        """See `StageNode`."""
        super().configure_part()
        assert isinstance(self.table, TimeMasterParameters)
        self._pace = self.table
        if self.table.members and not self.table.window and not self.table.speed_factor:
            raise InputError(
                f"{self.get_name()}.speed_factor = 0 with window = 0: nothing would hold the spindle back; "
                "allowed: a speed_factor above 0, or a window"
            )
        namespace = self.get_namespace().rstrip("/")
        self._member_names = [name if name.startswith("/") else f"{namespace}/{name}" for name in self.table.members]
        self._completed = dict.fromkeys(self._member_names, 0)
        self._blocks_in_run: int | None = None
        self._told: deque[Progress] = deque()
        self._running = False
        self._schedule = 0.0  # monotonic time at which sample 0 would have been, were there no slips
        self._heard = self._looked = time.monotonic()
        self._members_moved: dict[str, float] = {}  # monotonic time at which each has last completed a block
        self._stalled: frozenset[str] = frozenset()
        self._dead: dict[str, float] = {}  # monotonic time until which a member may be restarted
        self._declared = False  # the safe state
        self._unsafe: set[str] = set()  # members that have not yet heard of it
        self._end: int | None = None
        self._know_end()
        self._why = ""
        self._report_due = 0.0
        self.slipped = 0.0
        self._released: deque[float] = deque()  # monotonic times at which the blocks in flight were let go
        self._lateness, self._latency = Durations(), Durations()
        self._percentiles, self._late = Percentiles(), 0

    def _know_end(self) -> None:
        """Take the end of the run from the stage, once that knows it, unless a safe state has another."""
        if self._end is None and self.stage.samples is not None:
            self._end = self.stage.samples
            self._blocks_in_run = -(-self._end // self.table.block_size)

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

    @property
    def _slowest(self) -> str:
        return min(self._completed, key=lambda name: self._completed[name], default="")

    @property
    def _least(self) -> int:
        """Blocks that every member has completed."""
        return min(self._completed.values(), default=self.blocks)

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
        if progress.blocks <= self._completed.get(progress.name, progress.blocks):
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
                break  # DDS waits a while for a reader that has died: that shall be noticed
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
        """Take what members in this process have told: not at once, the block that they tell of may be under way."""
        while self._told:
            self._on_progress(self._told.popleft())
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

    # ---- those who stall, and those who die ---------------------------------------------------------

    def look_after_others(self) -> None:
        """Name the members that are dead or silent, and do what is to be done about them."""
        if not self._running or self.over or self.failure:
            return
        now = time.monotonic()
        self._forgive(now - self._looked)
        self._looked = now
        for name in self.watch.ended() & self._completed.keys() - self._dead.keys():
            restarts, self.patience = self.restarts(name) and not self._declared, _GONE
            self._dead[name] = now + (self._pace.restart_time if restarts else 0.0)
            self.get_logger().error(f"{name} has died at block {self._completed[name]}")
            self.reporter("dead", self.get_name(), member=name, blocks=self._completed[name], restarts=restarts)
        ready = {name for name in self._dead if self.members[name].state == Member.READY}
        for name in ready - self.watch.ended():
            del self._dead[name]
            self._heard = now
            self.reporter("back", self.get_name(), member=name)
        if any(now >= until for until in self._dead.values()):
            self._lose(dict.fromkeys(self._dead, "died"))  # who was waited for as well: it could not join any more
        elif not self._dead:
            silent = self.watch.silent.keys() & self._completed.keys()
            stopped = {name for name in silent if now - self._members_moved[name] > SILENCE}
            stands = (self._unsafe or not self._credit()) and now - self._heard > SILENCE
            if stands:
                # Who waits for a silent one is as slow as it is: first those that DDS does not hear any more.
                self._name_the_silent(frozenset(silent or self._unsafe or {self._slowest}))
            elif stopped:
                self._name_the_silent(frozenset(stopped) | self._stalled)
            if stands and self._pace.stall_reaction == "safe" and now - self._heard > self._pace.stall_time:
                lost = self._silent_for(now, self._pace.stall_time) or self._stalled
                self._lose(dict.fromkeys(lost, "fell silent"))

    def _forgive(self, passed: float) -> None:
        """While it stood still itself, for so long [s], it could not hear anybody: that is nobody else's silence."""
        if passed > SILENCE:
            self._heard += passed
            self._members_moved = {name: moved + passed for name, moved in self._members_moved.items()}
            self.watch.silent = {name: since + passed for name, since in self.watch.silent.items()}

    def failed(self, member: Member) -> None:
        """See `CellNode`: the others go on without it to their safe state, if they can wait until all know.

        Raises:
            LatheError: it has itself been silent for so long that the others have given it up.
        """
        if member.message == given_up(self.full_name):
            raise LatheError(f"{self.full_name} stood still at sample {self.samples}: the others have given it up")
        if self._running and self.table.window:
            self._lose(dict.fromkeys(self._dead, "died") | {member.name: why_failed(member)})
        else:
            self.abandon(member)

    def _silent_for(self, now: float, seconds: float) -> set[str]:
        """Members that DDS has not heard for so long."""
        return {name for name, since in self.watch.silent.items() if now - since > seconds} & self._completed.keys()

    def _go_safe(self, state: CellState) -> None:
        """It has said so itself."""

    def _name_the_silent(self, names: frozenset[str]) -> None:
        new, self._stalled = names - self._stalled, names
        for name in sorted(new):
            self.tell_stall(name, self._completed[name])

    def _lose(self, members: Mapping[str, str]) -> None:
        """Bring the cell to its safe state without some members, from the next sample on: once all others know.

        Args:
            members: what became of each.
        """
        names, who = members.keys(), ", ".join(f"{name} {what}" for name, what in sorted(members.items()))
        if not self.table.window:
            raise LatheError(f"{who} at sample {self.samples}; a cell with window = 0 cannot go on without it")
        if self._completed.keys() <= names:
            raise LatheError(f"{f'{self._why}; ' if self._why else ''}{who}: nobody is left at sample {self.samples}")
        before = self._least
        for name in names:
            del self._completed[name]
            self._dead.pop(name, None)
        self._without |= names
        self._unsafe -= names
        self.patience = _GONE
        self._declare_safe(who)
        if self._completed:
            self._after(before, self._least)
        else:
            self.release()

    def _declare_safe(self, why: str) -> None:
        """Bring the cell to its safe state from the next sample on, once all members know."""
        self._why = f"{self._why}; {why}" if self._why else f"{why}: safe state from sample {self.samples} on"
        if not self._declared:
            if self._end != self.samples:
                self._end = self.samples + max(1, round(self._pace.safe_time * self.table.sample_rate))
                self._blocks_in_run = -(-self._end // self.table.block_size)
            # After the first time all know what to do, and need only hear whom to do without.
            self._unsafe = set(self._completed)
        self._declared = True
        self._say(CellState.SAFE, self.samples, self._why)
        self.get_logger().error(self._why)
        self.reporter(
            "safe", self.get_name(), sample=self.samples, end=self._end, lost=sorted(self._without), why=self._why
        )
        self._heard = time.monotonic()
