# SPDX-License-Identifier: Apache-2.0
"""The common part of all nodes: how they begin, watch one another, make progress, fail and end."""

import math
import os
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain, repeat
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lathe_rc_msgs.msg import CellState, Member, Progress
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from std_msgs.msg import Empty

from lathe_rc import messages
from lathe_rc.cell.parameters import NodeParameters
from lathe_rc.cell.scenario import TABLES
from lathe_rc.errors import InputError, LatheError
from lathe_rc.nodes import declare
from lathe_rc.nodes.exchange import Exchange
from lathe_rc.nodes.listening import Listening
from lathe_rc.nodes.liveliness import SILENCE, Watch, liveliness
from lathe_rc.nodes.ports import latched_qos
from lathe_rc.nodes.refused_messages import ForeignMessage, RefusedMessages
from lathe_rc.nodes.report import Reporter

_TICK = 0.02  # [s] between looks at the graph while members join
_DIAGNOSTICS_PERIOD = 1.0  # [s]
_REPEAT_PERIOD = 0.5  # [s] between announcements before the run, in the safe state, and after it has given up
_LATCHED_DEPTH = 256
_PATIENCE = 2.0  # [s] for others to acknowledge the last messages
GIVEN_UP = 2.0  #: [s] of silence after which a time master is lost in a cell that does not wait
_LAST_ANSWER = 1.0  # [s] until who has asked for its shutdown has the answer: DDS does not say when
_MOST_MEMBERS = 256  # announced names that are kept
_TOLD_AFTER = (2.0, 8.0, 30.0)  # [s] of waiting until it is told what for; the last again and again


class CellNode(Listening):
    """A member of a cell, or a node alone.

    Args:
        name: default name.
        kind: what it is.
        reporter: line to the harness.
        exchange: what the nodes of this process hand over in memory.

    Attributes:
        over: it has finished its part of the run.
        watch: whether those are alive that it cannot do without; there once it is active.
        patience: for messages to be acknowledged [s].
        discarded: destroy the publishers, subscriptions and services that it had before it was cleaned up; for its
            process to call.
        next_tick: monotonic time [s] at which it wants `tick` to be called.
    """

    def __init__(self, name: str, kind: str, reporter: Reporter, exchange: Exchange) -> None:
        super().__init__(
            name,
            automatically_declare_parameters_from_overrides=True,
            allow_undeclared_parameters=True,
        )
        given = declare.overrides(self)
        self.kind = kind
        self.autostart = bool(given.get("autostart", True))
        self.table: NodeParameters = TABLES[self.kind]()
        self.reporter = reporter
        self.exchange = exchange
        self.failure: LatheError | None = None
        self.next_tick, self.patience = time.monotonic(), _PATIENCE
        self.handled, self.due = 0, False
        self.full_name = self.get_fully_qualified_name()
        self.refused_messages = RefusedMessages(self._report_refused)
        self._diagnostics_due = time.monotonic() + _DIAGNOSTICS_PERIOD
        self._without_endpoints = self._endpoints()
        self.discarded: list[Callable[[], object]] = []
        self._service_change_state.callback = self._refusing(self._service_change_state.callback)
        self._forget()

    def _forget(self) -> None:
        """Be as before the first activation."""
        self.active = self.over = self.done = False
        self.members: dict[str, Member] = {}
        self.master: Member | None = None
        self._put_off: deque[tuple[Callable[[Any], object], Any]] = deque()  # signals that came while deactivated
        self._told_unknown: set[str] = set()
        self._tell_due = self._leave_due = math.inf
        self._tell_after: Iterator[float] = iter(())
        self._ready = self._safe = False
        self._without: set[str] = set()  # members that are lost
        self._cell: int | None = None  # what the time master has said
        self._progress_step = 1
        self._reported_blocks = 0
        self._moved = 0.0  # when it has last completed a block, monotonic [s]
        self._master_stalls = False
        self._heard_elsewhere = True  # whether anybody beside the time master reads the progress
        self._repeat_due = 0.0
        self._host: dict[str, Publisher] = {}
        self.outlets: dict[str, Publisher] = {}
        self.inlets: dict[str, Subscription] = {}

    # ---- lifecycle ----------------------------------------------------------------------------------

    @property
    def _takes_part(self) -> bool:
        """Whether the others of a cell that runs need it."""
        runs = self._cell in (CellState.RUNNING, CellState.SAFE)
        return runs and self.master is not None and not (self.over or self.failure)

    def _configure(self) -> None:
        self.table = declare.declare(self, TABLES[self.kind])
        if self.table.stage not in ("", self.kind):
            raise InputError(f"{self.get_name()}.stage = {self.table.stage!r}; this executable is a {self.kind}")
        self._progress_step = max(1, self.table.window // 4)
        self.configure_part()

    def _activate(self) -> None:
        self.active = self.due = True
        if not self._host:
            self._begin_to_exchange()
        while self._put_off:
            callback, message = self._put_off.popleft()
            self.guarded(callback)(message)
        self.announce()
        self.reporter("active", self.get_name(), pid=os.getpid())

    def _begin_to_exchange(self) -> None:
        """Make what it exchanges data by."""
        add = self.create_publisher
        self._host = {
            "members": add(Member, "members", latched_qos(1)),
            "progress": add(Progress, "progress", latched_qos(1)),  # who was away for a while needs the newest
            "diagnostics": add(DiagnosticArray, "/diagnostics", QoSProfile(depth=100)),
        }
        self.create_subscription(Member, "members", self.guarded(self._on_member), latched_qos(_LATCHED_DEPTH))
        self.create_subscription(CellState, "cell_state", self.guarded(self._on_cell_state, always=True), latched_qos())
        self.create_publisher(Empty, f"~/{messages.ALIVE}", liveliness())
        self.watch = Watch(self, lambda: self.attempt(self.look_after_others))
        self._tell_after = chain(_TOLD_AFTER, repeat(_TOLD_AFTER[-1]))
        self._tell_due = time.monotonic() + next(self._tell_after)
        self.activate_part()

    def _deactivate(self) -> None:
        self.active = False

    def _clean_up(self) -> None:
        self.clean_up_part()
        self.active = self._ready = False
        if self._host:
            self.announce()  # it joins anew: the time master shall not begin without it
            self._wait_for_acknowledgement([self._host["members"]])
            self.watch.close()
        for before, now, destroy in zip(self._without_endpoints, self._endpoints(), self._destroyers(), strict=True):
            self.discarded += [partial(destroy, endpoint) for endpoint in now - before]
        self._forget()

    def _shut_down(self) -> None:
        if self._takes_part:
            self.fail(LatheError(f"{self.get_name()} was shut down in the middle of a run"))
        else:
            self.finish()
            self._clean_up()
            self._leave_due = time.monotonic() + _LAST_ANSWER
        self.active = False

    def _endpoints(self) -> list[set[Any]]:
        return [set(self.publishers), set(self.subscriptions), set(self.services)]

    def _destroyers(self) -> list[Callable[[Any], object]]:
        return [self.destroy_publisher, self.destroy_subscription, self.destroy_service]

    # ---- what a kind of node adds -------------------------------------------------------------------

    @abstractmethod
    def configure_part(self) -> None:
        """Build what the node runs from its table."""

    @abstractmethod
    def activate_part(self) -> None:
        """Make its publishers and subscriptions."""

    def members_changed(self) -> None:
        """A member announced something new."""

    def failed(self, member: Member) -> None:
        """A member has given up; once the cell may be running, the time master says what is to be done."""
        if not self._ready:
            self.abandon(member)

    def abandon(self, member: Member) -> None:
        """Give up because a member has."""
        self.fail(LatheError(f"{member.name} {why_failed(member)}"), cause="abandoned")

    def clean_up_part(self) -> None:
        """Let go of what it has made; publishers, subscriptions and services are destroyed by the caller."""

    def begin(self, *, joins: bool) -> None:
        """Every input and output is matched; ``joins``: the cell is running already."""

    def lose(self, lost: set[str], first: int, end: int) -> None:
        """Do without lost members up to sample ``end``, the end of the run; be safe from sample ``first`` on."""

    def statistics(self) -> dict[str, object]:
        """Figures for the diagnostics."""
        return {}

    def finish(self) -> None:
        """End in order: close files, write what is left."""

    def work(self) -> None:
        """Do what the messages since the last call allow."""

    # ---- failure and end ----------------------------------------------------------------------------

    def fail(self, error: LatheError, *, cause: str = "error") -> None:
        """Give up, and say so to everyone; ``cause`` is ``abandoned`` if another node is to blame."""
        if self.failure:
            return
        self.failure = error
        self.get_logger().error(str(error))
        self.reporter(cause, self.get_name(), message=str(error), exit_code=error.exit_code)
        if self._host:
            self.announce()
        self._leave_with_the_cell()

    @property
    def exit_code(self) -> int:
        """Of its process: 0 if it has done its part of a run that came to its end."""
        return self.failure.exit_code if self.failure else int(self._safe) * LatheError.exit_code

    def _leave_with_the_cell(self) -> None:
        """Leave, having given up, if nobody goes on any more."""
        self.done = self.done or self._cell in (CellState.ENDED, CellState.FAILED)

    @property
    def others_go_on(self) -> bool:
        """Whether it has given up where the others, of its process too, may have to go on to the cell's safe state."""
        return bool(self.failure) and self._ready and self.master is not None and self.master.name != self.full_name

    def end(self, acknowledged: list[Publisher]) -> None:
        """The node's part is over. In a cell it stays until all have ended; else until others have its last messages.

        DDS sends a lost message again only as long as its process lives. A node that has given up stays as well, while
        the others go on: its announcement says why, also to members that look later.
        """
        self.over = True
        if self.master is None or self.master.name == self.full_name:
            self._leave([*acknowledged, self._host["progress"]])

    def _leave(self, acknowledged: list[Publisher]) -> None:
        self._wait_for_acknowledgement(acknowledged)
        self.done = True
        self.reporter("done", self.get_name(), cpu_s=time.process_time())

    def _wait_for_acknowledgement(self, publishers: list[Publisher]) -> None:
        from rclpy.duration import Duration

        for publisher in publishers:
            if not publisher.wait_for_all_acked(Duration(seconds=self.patience)):
                self.get_logger().warning(f"{publisher.topic}: not everybody has acknowledged the last message")

    # ---- the others ---------------------------------------------------------------------------------

    def _on_member(self, member: Member) -> None:
        self._check_member(member)
        self.members[member.name] = member
        if member.members:
            self.master = member
            self.watch.follow(member)
        peers = self.master.members if self.master else ()
        if len(self.members) > _MOST_MEMBERS:
            del self.members[next(n for n in reversed(self.members) if n not in peers and n != self.full_name)]
        others = member.name in peers and member.name != self.full_name and member.name not in self._without
        if member.state == Member.FAILED and others and not self.over:
            self.failed(member)
        self.members_changed()
        self._settle()

    def _settle(self) -> None:
        """Become ready once every input and output is matched with its peers by name."""
        if not self.active or self._ready or self.failure or self.master is None or not self.complete:
            return
        if any(self.members[name].state == Member.JOINING for name in self.master.members) or not self.matched():
            return
        self._ready = True
        self.begin(joins=self._cell not in (None, CellState.WAITING))
        self.announce()
        self.reporter("ready", self.get_name())

    def _on_cell_state(self, state: CellState) -> None:
        if state.run_id != self.table.run_id:
            if self.table.run_id:
                raise ForeignMessage(self.topic("cell_state"), "", state.run_id, f"expected run {self.table.run_id!r}")
            return
        self._cell = state.state
        if self.failure:
            self._leave_with_the_cell()
        elif state.state == CellState.ENDED and self.over and not self.done:
            self._leave([])
        elif state.state == CellState.FAILED:
            self.fail(LatheError(f"the cell failed: {state.message}"), cause="abandoned")
        elif state.state == CellState.SAFE:
            self._go_safe(state)

    def _go_safe(self, state: CellState) -> None:
        if self.full_name in state.lost or not self._ready:
            self.fail(LatheError(f"{self.full_name}: the cell went to its safe state without it"), cause="abandoned")
            return
        self._without = set(state.lost)
        self.get_logger().error(f"safe state from sample {state.first_index} on: {state.message}")
        if not self.over:
            self.lose(set(state.lost), state.first_index, state.end_index)
        self._safe = True
        self.announce()

    def look_after_others(self) -> None:
        """Name a time master that is silent, and leave if it is gone: without it no sample follows."""
        if self.master is None or self.done or not self.master.members:
            return
        name, now = self.master.name, time.monotonic()
        self._name_a_silent_master(name, now)
        waits = self._parameter(name, "stall_reaction") != "safe"
        silent = 0.0 if waits else now - self.watch.silent.get(name, math.inf)
        ended = name in self.watch.ended()
        if self.failure:
            # A master that comes back in between shall hear why there is nobody any more.
            self.done = self.done or ended or silent > 2.0 * GIVEN_UP
        elif (ended or silent > GIVEN_UP) and self.over:
            self._leave([])
        elif ended:
            self.fail(LatheError(f"{name}, the time master, is lost: no sample follows"), cause="abandoned")
        elif silent > GIVEN_UP:
            self.fail(LatheError(given_up(name)), cause="masterless")

    def _name_a_silent_master(self, name: str, now: float) -> None:
        """Say once that it stalls: who stands still cannot say so itself."""
        silent = self._cell == CellState.RUNNING and name in self.watch.silent
        if silent and not self._master_stalls:
            if now - self._moved < SILENCE:  # what was on its way is still being computed
                self.next_tick = min(self.next_tick, self._moved + SILENCE)
                return
            self.tell_stall(name, self._reported_blocks)
        self._master_stalls = silent

    def tell_stall(self, name: str, blocks: int) -> None:
        """Say that a member is silent since it has completed so many blocks."""
        # In this order: to log for the first time takes some 70 ms.
        self.reporter("stall", self.get_name(), member=name, blocks=blocks)
        self.get_logger().warning(f"{name} has been silent for {SILENCE * 1e3:.0f} ms at block {blocks}")

    def _tell_what_is_missing(self, now: float) -> None:
        """Say now and then what it waits for: nobody else knows."""
        self._tell_due = now + next(self._tell_after)
        if missing := self.missing():
            self.get_logger().warning(f"waits for {'; '.join(missing)}")
            self.reporter("waits", self.get_name(), missing=missing)

    # ---- progress and time --------------------------------------------------------------------------

    def progressed(self, blocks: int, samples: int, *, last: bool) -> None:
        """Tell the time master, now and then and at the end."""
        self._moved = time.monotonic()
        # At the same blocks whoever tells: the time master waits for the slowest.
        if last or blocks // self._progress_step > self._reported_blocks // self._progress_step:
            self._reported_blocks = blocks
            progress = Progress(run_id=self.table.run_id, name=self.full_name, blocks=blocks, samples=samples)
            if self.exchange.master:
                self.exchange.master(progress)
            if not self.exchange.master or self._heard_elsewhere:
                self._host["progress"].publish(progress)

    def tick(self, now: float) -> None:
        """Do what is due by the wall clock; nothing here touches a sample."""
        self.next_tick = now + _TICK if not self._ready else now + 0.1
        if now >= self._leave_due:
            self._leave([])
        if self._host:
            if not self._ready:
                self.attempt(self._settle)
            self.watch.look()
            self.attempt(self.look_after_others)
            self._repeat(now)
            if now >= self._tell_due:
                self._tell_what_is_missing(now)
        if "progress" in self._host:
            self._heard_elsewhere = self._host["progress"].get_subscription_count() > 1
        if self._host and now >= self._diagnostics_due:
            self._diagnostics_due = now + _DIAGNOSTICS_PERIOD
            self._publish_diagnostics()

    def _repeat(self, now: float) -> None:
        """Announce itself again while others may wait for that: a flood of messages may have pushed it out."""
        of_a_cell = self.master is not None or self.member_names()
        if of_a_cell and (self._cell != CellState.RUNNING or self.failure) and now >= self._repeat_due:
            self._repeat_due = now + _REPEAT_PERIOD
            self.announce()

    def _publish_diagnostics(self) -> None:
        refused = self.refused_messages
        told = self.statistics() | {"refused": refused}
        told |= {f"publishers of {topic}": ", ".join(self._who_publishes(topic)) for topic in refused.topics}
        level = DiagnosticStatus.WARN if refused.senders else DiagnosticStatus.OK
        status = DiagnosticStatus(
            level=bytes(DiagnosticStatus.ERROR if self.failure else level),
            name=self.full_name,
            message=str(self.failure or ("ready" if self._ready else "waiting for members")),
            hardware_id=self.kind,
            values=[KeyValue(key=key, value=str(value)) for key, value in told.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._host["diagnostics"].publish(message)


def why_failed(member: Member) -> str:
    """The member's message about its failure, without its name at the beginning."""
    own_name = member.name.rpartition("/")[2]
    return f"failed: {member.message.removeprefix(f'{own_name}: ')}"


def given_up(master: str) -> str:
    """The announcement of members that go on without a silent time master."""
    return f"{master}, the time master, has been silent for {GIVEN_UP:g} s: no sample follows"
