# SPDX-License-Identifier: Apache-2.0
"""Way of the time master's stage through a run, without I/O: releases blocks as window and pace allow."""

from abc import abstractmethod
from collections import deque
from typing import Any, cast

from lathe_rc.protocol import actions
from lathe_rc.protocol.messages import Progress
from lathe_rc.protocol.pace import Pace
from lathe_rc.protocol.stage_run import StageRun
from lathe_rc.protocol.time_master import TimeMasterProtocol

_LOOK = 0.02  # [s] between checks of the members
_BURST = 64  # blocks released before other work gets its turn
_MOST_LAG = 0.05  # largest loss of pace in the simulated time after which the pace is evaluated


class LeadingRun(StageRun):
    """Base class of the roles of time masters, real or simulated.

    Attributes:
        pace: schedule of the run.
    """

    pace: Pace
    _cell: Any = None

    # ---- what a time master provides ----------------------------------------------------------------

    @abstractmethod
    def check_cell(self) -> Any:
        """Check the cell with the announced parameters of the members; return it, wired, to form chains."""

    def lags(self, lag: float) -> None:
        """Warn that the members cannot hold the pace; ``lag`` is the lost fraction of it."""

    @property
    def leads(self) -> TimeMasterProtocol:
        """Return the node's protocol object as a time master's."""
        return cast("TimeMasterProtocol", self.node.protocol)

    def listen_to_inputs(self) -> None:
        """Subscribe the queues of the inputs, and take the progress of members in this process (see `StageRun`)."""
        super().listen_to_inputs()
        self._reported: deque[Progress] = deque()  # of members in this process
        self.node.exchange.master = self.node.guarded(self._reported.append)

    # ---- requests of the protocol -------------------------------------------------------------------

    def perform(self, action: actions.Action) -> None:
        """Check the cell, start the run or release blocks (implements `Work`)."""
        match action:
            case actions.CheckCell():
                self._cell = self.check_cell() if self.leads.own.members else None
                self.leads.start(self.node.now())
            case actions.Start():
                self.start_run()
            case actions.Release():
                self.release()

    def start_run(self) -> None:
        """Start the run: begin the schedule and form chains."""
        self.pace.schedule = self.node.now()
        self.node.exchange.form(self, self._cell)
        if self.chain is None and self.inputs.ports:
            self.start(self.samples)

    def become_safe(self, first: int) -> None:
        """Keep the spindle turning in the safe state; the newest samples of lost members are held (see `StageRun`)."""

    # ---- blocks -------------------------------------------------------------------------------------

    def blocks_at_once(self) -> int:
        """Return the largest number of blocks to release in one step."""
        return 1 if self.pace.block else min(self.leads.credit, self.together)

    def possible(self) -> int:
        """Return the number of samples to release in one step; 0 while the spindle or its chain waits for an input."""
        samples = self.node.table.block_size * self.blocks_at_once()
        if self.chain is None and not self.inputs.ports:
            return samples
        ready = self.chain.ready() if self.chain is not None else self.ready()
        self.leads.starved = not ready
        return min(samples, ready[0]) if ready else 0

    def release(self) -> None:
        """Release every block that credit and pace allow."""
        leads, size = self.leads, self.node.table.block_size
        begun = self.node.now()
        for _ in range(_BURST):
            if not leads.may_release or self.blocks == leads.blocks_in_run or leads.credit <= 0:
                return
            if self.node.now() - begun > _LOOK:
                break  # a window may hold many blocks: deaths must be noticed meanwhile
            if not (samples := self.possible()):
                return
            if self.pace.block and not leads.ends_early and not self._is_due(-(-samples // size)):
                return
            last = leads.end is not None and leads.end - self.samples <= samples
            if last:
                samples = cast("int", leads.end) - self.samples
            leads.release(-(-samples // size), self.node.now())
            if self.chain is not None:
                self.chain.compute(samples, last=last)
            else:
                self.compute(samples, last=last)
        self.node.next_tick = self.node.now()

    def _is_due(self, blocks: int) -> bool:
        """Return True if the next blocks are due; count their lateness."""
        now, due = self.node.now(), self.pace.due(self.blocks)
        if now < due:
            self.node.next_tick = min(self.node.next_tick, due)
            return False
        self.pace.count(now - due, blocks)
        if now - due > self.pace.most_late:
            self.fall_behind(now - due)
        if (lag := self.pace.lag()) > _MOST_LAG:
            self.lags(lag)
        return self.leads.may_release

    def fall_behind(self, late: float) -> None:
        """Postpone the schedule by ``late`` [s]: the members are too slow for the pace."""
        self.pace.slip(late)

    def lead(self) -> None:
        """Release blocks as far as credit and pace allow (extends `StageRun`)."""
        self.node.attempt(self.release)

    def work(self) -> None:
        """Process the progress of members in this process, deferred because the reported block may be in progress."""
        for _ in range(len(self._reported)):  # reports on blocks released here are processed later
            report = self._reported.popleft()
            self.node.due = self.node.due or bool(self._reported)  # after an error the rest follows in the next turn
            self.node.attempt(self.leads.hear_progress, report, self.node.now())
        if self.inputs.ports and self.chain is None:
            self.release()  # feedback blocks may allow further releases

    def release_due(self, now: float) -> float:
        """Release blocks that are due by wall time; return the time of the next call [s]."""
        if self.leads.running:
            self.node.attempt(self.release)
        return min(now + _LOOK, self.node.next_tick)
