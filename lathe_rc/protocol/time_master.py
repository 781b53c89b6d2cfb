# SPDX-License-Identifier: Apache-2.0
"""Protocol of the time master: starts the run, releases blocks by window, ends it and leads the way to a safe state."""

import math
from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from lathe_rc.blocks.latency_histogram import Durations
from lathe_rc.errors import LatheError
from lathe_rc.protocol import actions as do
from lathe_rc.protocol.member import (
    GIVEN_UP,
    INACTIVE,
    LONGEST_MESSAGE,
    SILENCE,
    MemberProtocol,
    given_up,
    why_failed,
)
from lathe_rc.protocol.messages import (
    Announcement,
    BadBlock,
    CellState,
    ForeignMessage,
    MemberState,
    Phase,
    Progress,
    check_sender,
)

_REPORT_PERIOD = 0.05  # [s] between reports of progress
_ANNOUNCED = 0.05  # [s] from the announcement of an early end to the last block
_GONE = 0.2  # [s] to wait for acknowledgements after a member has died


@dataclass(frozen=True)
class Reactions:
    """Reactions of a time master to silence and death (see `lathe_rc.cell.time_master.TimeMasterParameters`)."""

    stall_reaction: str
    stall_time: float
    restart_time: float
    safe_samples: int
    block_size: int


class TimeMasterProtocol(MemberProtocol):
    """Protocol of a time master: a `MemberProtocol` that also tracks the progress of the members that it names.

    Args:
        own, window: see `MemberProtocol`.
        reactions: reactions to silence and death of members.
        first: index of the first sample of the run.

    Attributes:
        blocks, samples: number released so far, samples including those before the run.
        blocks_in_run: length of the run in blocks; None: endless, or not known yet.
        running: True from block 0 to the end of the run.
        unsafe: members that have not confirmed the safe state; no block is released until all have.
        completed: number of blocks that each member has completed.
        ends_early: the run ends with the next block, whatever its pace.
        held_at: total number of blocks after which the run is held; None: it is not held.
        starved: the time master itself lacks an input for its next block.
        latency: histogram of the time from the release of a block to its completion by every member.
    """

    def __init__(
        self,
        own: Announcement,
        window: int,
        reactions: Reactions,
        *,
        first: int = 0,
    ) -> None:
        super().__init__(own, window)
        self._reactions = reactions
        self._first = self.samples = first
        self.blocks = 0
        self.blocks_in_run: int | None = None
        self.running = False
        self.unsafe: frozenset[str] = frozenset()
        self.completed = {name: 0 for name in own.members if name != own.name}
        self.ends_early, self._asked = False, ""  # and why an operator has asked for it
        self.held_at: int | None = None
        self.starved = False
        self.latency = Durations()
        self._released: deque[float] = deque()  # monotonic times at which the blocks in flight were released
        self._checking = self._declared = self._short = False
        self._why = ""
        self._heard = self._looked = 0.0
        self._last_due = math.inf  # monotonic time at which the last block of an early end is released
        self._members_moved: dict[str, float] = {}  # monotonic time at which each has last completed a block
        self._stalled: frozenset[str] = frozenset()
        self._dead: dict[str, float] = {}  # monotonic time until which a member may be restarted
        self._report_due = 0.0

    @property
    def least(self) -> int:
        """Return the number of blocks that every member has completed."""
        return min(self.completed.values(), default=self.blocks)

    @property
    def slowest(self) -> str:
        """Return the first of the members with the least reported progress.

        Members report their progress at multiples of some blocks, and a member that computes two at once reports one
        more: a waiting member may have reported less than the member that it waits for.
        """
        return min(self.completed, key=lambda name: self.completed[name] // self.progress_step, default="")

    @property
    def credit(self) -> int:
        """Return the number of blocks that the window allows, and the hold if there is one."""
        return self._room if self.held_at is None else min(self._room, self.held_at - self.blocks)

    @property
    def _room(self) -> int:
        """Return the number of blocks that the window allows."""
        if not self.completed or not self.window:
            return 1
        return self.window - (self.blocks - self.least)

    @property
    def may_release(self) -> bool:
        """Return True if blocks can be released at all."""
        return self.running and self.active and not (self.failure or self.done or self.unsafe)

    def know_end(self, samples: int | None) -> None:
        """Set the end of the run [sample] from the stage; a safe state may already have set an earlier end."""
        if self.end is None and samples is not None:
            self._set_end(samples)

    def _set_end(self, samples: int) -> None:
        self.end = samples
        self.blocks_in_run = -(-(samples - self._first) // self._reactions.block_size)

    # ---- start --------------------------------------------------------------------------------------

    def activate(self, now: float) -> None:
        """Activate the time master, and publish the waiting phase (extends `MemberProtocol`)."""
        first = not self._started
        super().activate(now)
        if first:
            self._say(Phase.WAITING, self._first)

    def members_changed(self, now: float) -> None:
        """Request the check of the cell when every member is ready; update which members confirmed the safe state."""
        if self.unsafe:
            self.unsafe -= {name for name in self.unsafe if self.members[name].state == MemberState.SAFE}
            self.actions.append(do.Release())
        if self.running or self._checking or not self.own.members or not self.active or self.failure:
            return
        if all(name in self.members and self._is_ready(self.members[name]) for name in self.own.members):
            self._checking = True
            self.actions.append(do.CheckCell())

    def _is_ready(self, member: Announcement) -> bool:
        """Return True if a member is ready for this session, not for another start with the same run id."""
        here = member.session in (0, self.own.session) and member.name not in self.ended
        return here and member.state == MemberState.READY

    def start(self, now: float) -> None:
        """Begin the run, after the cell has passed its check."""
        self.running, self._checking = True, False
        self._log("info", f"run {self.own.run_id or '(no id)'} begins with {len(self.completed)} members")
        self._say(Phase.RUNNING, self._first)
        self._report("block0")
        self._heard = self._looked = now
        self._members_moved = dict.fromkeys(self.completed, now)
        self.actions += [do.Start(), do.Release()]

    def _say(self, phase: Phase, first: int, why: str = "") -> None:
        lost, end, session = tuple(sorted(self.without)), self.end or 0, self.own.session
        self.phase = phase
        self.actions.append(do.Say(CellState(self.own.run_id, phase, first, why[:LONGEST_MESSAGE], end, lost, session)))

    def hear_cell_state(self, state: CellState, now: float, sender: str = "") -> None:
        """Reject cell states that are not the time master's own.

        Raises:
            ForeignMessage: the cell state was published by another time master.
        """
        if (state.run_id, state.session) != (self.own.run_id, self.own.session) or sender not in ("", self.own.name):
            raise ForeignMessage("cell_state", sender, state.run_id, f"this node, {self.own.name}, is the time master")

    def deactivate(self) -> None:
        """Pause the cell (extends `MemberProtocol`)."""
        super().deactivate()
        self._report_waiting_from(self._time)

    # ---- progress -----------------------------------------------------------------------------------

    def release(self, blocks: int, now: float) -> None:
        """Record that the node releases a number of blocks."""
        if self.completed:
            self._released.extend([now] * blocks)

    def computed(self, blocks: int, samples: int, now: float, *, last: bool) -> None:
        """Record the time master's own progress (extends `MemberProtocol`)."""
        self.blocks, self.samples = blocks, samples
        super().computed(blocks, samples, now, last=last)

    def hear_progress(self, progress: Progress, now: float, sender: str = "") -> None:
        """Process the progress of a member.

        Args:
            progress: the message.
            now: monotonic time [s].
            sender: node that has published it, as DDS knows it; empty: not known.

        Raises:
            ForeignMessage: the progress belongs to another run, or is another node's.
        """
        if progress.run_id != self.own.run_id:
            raise ForeignMessage("progress", progress.name, progress.run_id, f"expected run {self.own.run_id!r}")
        name = progress.name
        check_sender("progress", name, progress.run_id, sender)
        if name == self.own.name and progress.session in (0, self.own.session):
            return  # a process publishes the progress of all its nodes, which reaches them too
        if not self.running:
            raise ForeignMessage("progress", name, progress.run_id, "the run has not begun, or it is over")
        if progress.session not in (0, self.own.session):
            raise ForeignMessage("progress", name, progress.run_id, f"expected session {self.own.session}")
        if name not in self.completed:
            return
        if progress.blocks <= self.completed[name]:
            if self.restarts(name):  # a restarted member computes blocks again: that is no silence
                self._heard = self._members_moved[name] = now
            return
        if progress.blocks > self.blocks:
            self._give_up_on(name, f"claims {progress.blocks} blocks; {self.blocks} were sent", now)
            return
        before = self.least
        self.completed[name] = progress.blocks
        self._heard = self._members_moved[name] = now
        if name in self._stalled:
            self._stalled = frozenset()
        self._after(before, now)

    def _after(self, before: int, now: float) -> None:
        """Update latency, simulated time and credit after progress beyond ``before`` blocks, or end the run."""
        least = self.least
        if least > before:
            for _ in range(least - before):
                self.latency.add(now - self._released.popleft())
            samples = min(self._first + least * self._reactions.block_size, self.samples)
            self.actions.append(do.TellTime(samples))
            if now >= self._report_due:
                self._report_due = now + _REPORT_PERIOD
                self._report("progress", samples=samples)
        if least == self.blocks_in_run:
            self.finish_run()
        else:
            self.actions.append(do.Release())

    def hold(self, blocks: int | None, now: float) -> None:
        """Hold the run after a total number of blocks, or let it go on: None; a held run changes no sample.

        A safe state ends the hold; an early end has one of its own, until the members know of it.
        """
        if not self.ends_early:
            self.held_at = None if self._declared else blocks
        self._heard = now  # nobody was silent meanwhile
        self.actions.append(do.Release())

    # ---- end ----------------------------------------------------------------------------------------

    def complete_part(self) -> None:
        """Record that the last block is released; the run ends when all members have completed it."""
        if not self.completed:
            self.finish_run()

    def end_by(self, signal: str, now: float) -> None:
        """End the run for all members with the next block (extends `MemberProtocol`)."""
        if self.running:
            self.end_run(f"{self.own.name} was ended by {signal} in the middle of a run", now)
        elif self.over:
            super().end_by(signal, now)
        else:
            self.interrupt(signal)
            self.done = True

    def end_run(self, why: str, now: float) -> None:
        """End a run with the next block, as fast as the members follow; a safe state comes to its own end.

        A run with a planned end fails after it, since it has not come to this end.
        """
        planned, self.ends_early, self.active, self.held_at, self._heard = self.end, True, True, None, now
        self._asked = why
        end = self.samples + self._reactions.block_size
        if self._declared or self.cut or (planned is not None and end >= planned):
            self.actions.append(do.Release())
            return
        self._set_end(end)
        self.cut = f"{why}; it ends at sample {end}" + (f" of {planned}" if planned is not None else "")
        self._short = planned is not None
        self._log("info", self.cut)
        self._say(Phase.RUNNING, self._first, self.cut)
        # The last block comes on another topic: readers that know of no earlier end would reject it.
        self.held_at, self._last_due = self.blocks, now + _ANNOUNCED

    def finish_run(self) -> None:
        """End the run after all members have completed the last block."""
        self.actions.append(do.TellPace())
        self._say(Phase.ENDED, self.samples, self._why)
        self._log("info", f"run ended: {self.blocks} blocks, {self.samples} samples")
        self.over, self.running = True, False
        if self._declared or self._short:
            super().fail(LatheError(self._why or self.cut))
        self.leave(self.patience)

    def fail(self, error: LatheError, *, cause: str = "error") -> None:
        """Fail, and fail the cell with the time master."""
        first = not self.failure
        if first and self._started:
            self._say(Phase.FAILED, self.samples, str(error))
        super().fail(error, cause=cause)

    # ---- silence and death --------------------------------------------------------------------------

    def look(self, now: float, silent: Mapping[str, float], ended: Collection[str]) -> None:
        """Do the periodic work; a time master without members begins the run at once (extends `MemberProtocol`)."""
        if self.active and not (self.running or self._checking or self.over or self.own.members or self.failure):
            self._checking = True
            self.actions.append(do.CheckCell())
        super().look(now, silent, ended)

    def look_after_others(self, now: float) -> None:
        """Report dead and silent members, and react as configured."""
        if not self.running or self.over or self.failure:
            return
        self._forgive(now - self._looked)
        self._looked = now
        if now >= self._last_due:
            self._last_due, self.held_at = math.inf, None
            self.actions.append(do.Release())
        if self.ends_early and now - self._heard > GIVEN_UP:
            waits = self._room <= 0 or self.blocks == self.blocks_in_run
            stuck = f"{self.slowest} has not completed its blocks" if waits else "its last block was not sent"
            self.fail(LatheError(f"{self.cut or self._why or self._asked}; {stuck} within {GIVEN_UP:g} s"))
            return
        for name in [each for each in self.completed if each in self.ended and each not in self._dead]:
            restarts, self.patience = self.restarts(name) and not self._declared, _GONE
            self._dead[name] = now + (self._reactions.restart_time if restarts else 0.0)
            self._log("error", f"{name} has died at block {self.completed[name]}")
            self._report("dead", member=name, blocks=self.completed[name], restarts=restarts)
        for name in [each for each in self._dead if self._is_back(each)]:
            del self._dead[name]
            self._heard = now
            self._report("back", member=name)
        if any(now >= until for until in self._dead.values()):
            # All dead members, restartable ones included: these could not join any more.
            self._lose(dict.fromkeys(self._dead, "died"), now)
        elif not self._dead:
            self._look_at_the_silent(now)

    def _is_back(self, name: str) -> bool:
        return self.members[name].state == MemberState.READY and name not in self.ended

    def _look_at_the_silent(self, now: float) -> None:
        silent = self.silent.keys() & self.completed.keys()
        stopped = {name for name in silent if now - self._members_moved[name] > SILENCE}
        quiet = now - max(self._heard, self._moved)
        waits = self.unsafe or self._room <= 0 or (self.starved and self.held_at is None)
        if waits and quiet > SILENCE:
            # Waiting members lag as much as the stalled one: members without DDS liveliness are named first.
            self._name_the_silent(frozenset(silent or self.unsafe or {self.slowest}), now)
        elif stopped:
            self._name_the_silent(frozenset(stopped) | self._stalled, now)
        if self._reactions.stall_reaction != "safe":
            return
        # In the safe state a drive that is only slow must not be given up: it alone can retract its tool.
        late = now - (max(self._reactions.stall_time, GIVEN_UP) if self._declared else self._reactions.stall_time)
        lost = {name for name in stopped if max(self.silent[name], self._members_moved[name]) < late}
        if waits and now - quiet < late:
            self._lose(dict.fromkeys(lost or self._stalled, "fell silent"), now)
        elif lost := {name for name in lost if self._owed_since(name) < late}:
            self._lose(dict.fromkeys(lost, "fell silent"), now)

    def _owed_since(self, name: str) -> float:
        """Return the time of release of the blocks that a member has to report next [s]; inf: not released yet."""
        done = self.completed[name]
        due = min((done // self.progress_step + 1) * self.progress_step, self.blocks_in_run or math.inf)
        return self._released[int(due) - self.least - 1] if done < due <= self.blocks else math.inf

    def _forgive(self, passed: float) -> None:
        """Extend all silence deadlines by the time ``passed`` [s] during which this node itself was stopped.

        Members that have failed meanwhile repeat their announcement: the time master waits for it before it gives up
        any member.
        """
        if passed > SILENCE:
            passed += GIVEN_UP if passed > GIVEN_UP else 0.0
            self._heard += passed
            self._members_moved = {name: moved + passed for name, moved in self._members_moved.items()}
            self.silent = {name: since + passed for name, since in self.silent.items()}

    def _name_the_silent(self, names: frozenset[str], now: float) -> None:
        new, self._stalled = names - self._stalled, names
        for name in sorted(new):
            self._tell_stall(name, self.completed[name], now)

    def pausing(self) -> list[str]:
        """Return the members that pause the run: inactive ones, and silent ones once the window is exhausted."""
        why = dict.fromkeys(self.silent.keys() & self.completed.keys() if self._room <= 0 else (), "silent")
        why |= {name: INACTIVE for name in self.own.members if self.members[name].message == INACTIVE}
        return [f"{name}, which is {how}" for name, how in sorted(why.items())]

    def member_failed(self, member: Announcement, now: float) -> None:
        """Handle the failure of a member: the others go to the safe state if there is a window, else the cell fails."""
        if member.message == given_up(self.own.name):
            why = f"{self.own.name} stood still at sample {self.samples}: the others have given it up"
            self.fail(LatheError(why))
        else:
            self._give_up_on(member.name, why_failed(member), now)

    def member_rejects(self, member: Announcement, now: float) -> None:
        """Give up members whose blocks another member rejects; a time master that sends such blocks fails."""
        for name, why in member.rejects.items():
            if name == self.own.name:
                self.fail(LatheError(f"{member.name} rejects {why}"))
            elif name in self.completed:
                self._give_up_on(name, f"is rejected by {member.name}: {why}", now)

    def reject(self, block: BadBlock, now: float) -> None:
        """Give up a member that has sent this time master a bad block (extends `MemberProtocol`)."""
        if block.source in self.completed:
            self._give_up_on(block.source, f"is rejected: {block}", now)
        else:
            super().reject(block, now)

    def member_left(self, member: Announcement, now: float) -> None:
        """Give up a member that has left when the run had begun, before it was informed of that."""
        if self.running and self.completed.get(member.name, self.blocks_in_run) != self.blocks_in_run:
            self._give_up_on(member.name, "left as the run began", now)

    def _give_up_on(self, name: str, why: str, now: float) -> None:
        if self.running and self.window:
            self._lose(dict.fromkeys(self._dead, "died") | {name: why}, now)
        else:
            self.fail(LatheError(f"{name} {why}"), cause="abandoned")

    def _lose(self, members: Mapping[str, str], now: float) -> None:
        """Remove lost members and bring the cell to its safe state from the next sample on, once all others know.

        Args:
            members: reason of the loss, by member.
            now: monotonic time [s].
        """
        who = ", ".join(f"{name} {fate}" for name, fate in sorted(members.items()))
        if not self.window:
            self.fail(LatheError(f"{who} at sample {self.samples}; a cell with window = 0 cannot go on without it"))
            return
        if self.completed.keys() <= members.keys():
            before = f"{self._why}; " if self._why else ""
            self.fail(LatheError(f"{before}{who}: nobody is left at sample {self.samples}"))
            return
        least = self.least
        for name in members:
            del self.completed[name]
            self._dead.pop(name, None)
        self.without |= members.keys()
        self.unsafe -= members.keys()
        self.patience = _GONE
        self.declare_safe(who, now)
        self._after(least, now)

    def declare_safe(self, why: str, now: float) -> None:
        """Declare the safe state from the next sample on; blocks are released again once all members know."""
        self._why = f"{self._why}; {why}" if self._why else f"{why}: safe state from sample {self.samples} on"
        again, self._declared, self.held_at = self._declared, True, None
        if not again:
            if self.end != self.samples:
                self._set_end(self.samples + self._reactions.safe_samples)
            # After the first safe state all members only need the names of further lost members.
            self.unsafe = frozenset(self.completed)
        self._say(Phase.SAFE, self.samples, self._why)
        assert self.end is not None, "a safe state has an end"
        self.actions.append(do.Lose(self.without, self.samples, self.end, again))
        self._report("safe", sample=self.samples, end=self.end, lost=sorted(self.without), why=self._why)
        self._log("error", self._why)  # last: the first log message takes some 70 ms
        self._heard = now
