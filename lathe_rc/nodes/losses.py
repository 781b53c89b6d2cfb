# SPDX-License-Identifier: Apache-2.0
"""Members that stall or die, and what the time master does: it waits, or brings the cell to its safe state."""

import time
from abc import abstractmethod
from collections.abc import Mapping

from lathe_rc_msgs.msg import CellState, Member

from lathe_rc.cell.stages.time_master import TimeMaster, TimeMasterParameters
from lathe_rc.errors import LatheError
from lathe_rc.nodes.cell_node import GIVEN_UP, given_up, why_failed
from lathe_rc.nodes.liveliness import SILENCE
from lathe_rc.nodes.stage_node import StageNode

_GONE = 0.2  # [s] for messages to be acknowledged, if who has died never will


class LossWatch(StageNode):
    """A time master, as far as it knows how far its members have come and which of them are lost."""

    stage: TimeMaster

    def configure_part(self) -> None:
        """See `StageNode`."""
        super().configure_part()
        assert isinstance(self.table, TimeMasterParameters)
        self._pace = self.table
        namespace = self.get_namespace().rstrip("/")
        self._member_names = [name if name.startswith("/") else f"{namespace}/{name}" for name in self.table.members]
        self._completed = dict.fromkeys(self._member_names, 0)
        self._blocks_in_run: int | None = None
        self._running = False
        self._heard = self._looked = time.monotonic()
        self._members_moved: dict[str, float] = {}  # monotonic time at which each has last completed a block
        self._stalled: frozenset[str] = frozenset()
        self._dead: dict[str, float] = {}  # monotonic time until which a member may be restarted
        self._declared = False  # the safe state
        self._unsafe: set[str] = set()  # members that have not yet heard of it
        self._end: int | None = None
        self._know_end()
        self._why = ""

    def _know_end(self) -> None:
        """Take the end of the run from the stage, once that knows it, unless a safe state has another."""
        if self._end is None and self.stage.samples is not None:
            self._end = self.stage.samples
            self._blocks_in_run = -(-self._end // self.table.block_size)

    @property
    def _slowest(self) -> str:
        """The first of the members that are least far, as far as that is known.

        They report blocks when they pass a multiple of some, and one that computes two at once reports one more: who
        waits for another member may have reported less.
        """
        return min(self._completed, key=lambda name: self._completed[name] // self._progress_step, default="")

    @property
    def _least(self) -> int:
        """Blocks that every member has completed."""
        return min(self._completed.values(), default=self.blocks)

    # ---- what the time master adds ------------------------------------------------------------------

    @abstractmethod
    def release(self) -> None:
        """Let go every block that credit and pace allow."""

    @abstractmethod
    def _credit(self) -> int:
        """Blocks that the window lets go."""

    @abstractmethod
    def _after(self, before: int, least: int) -> None:
        """Every member has completed some more blocks."""

    @abstractmethod
    def _say(self, state: int, first: int, why: str = "") -> None:
        """Tell all of the state of the cell, from sample ``first`` on."""

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
        """While it stood still itself, for so long [s], it could not hear anybody: that is nobody else's silence.

        Those that have given it up meanwhile say so again and again: it waits for that before it does without anybody.
        """
        if passed > SILENCE:
            passed += GIVEN_UP if passed > GIVEN_UP else 0.0
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
