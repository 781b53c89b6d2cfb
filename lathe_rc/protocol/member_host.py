# SPDX-License-Identifier: Apache-2.0
"""Host of a cell member, without I/O: passes events to the protocol and the role, and performs the requests."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

from lathe_rc.blocks.ports import signal_depth
from lathe_rc.errors import LatheError
from lathe_rc.protocol import actions
from lathe_rc.protocol.exchange import Exchange
from lathe_rc.protocol.member import MemberProtocol
from lathe_rc.protocol.messages import Announcement, BadBlock, CellState, ForeignMessage

if TYPE_CHECKING:
    from lathe_rc.cell.parameters import NodeParameters

MOST_DEFERRED = 8  #: times the blocks in flight of each topic, until a node is ready and active


class Work(Protocol):
    """Work of one kind of member, as its host requests it."""

    def members_changed(self) -> None:
        """Take in a new announcement of a member."""

    def begin(self, *, joins: bool) -> None:
        """Prepare the node for block 0 once every topic is matched; ``joins``: the cell is running already."""

    def lose(self, lost: frozenset[str], first: int, end: int, *, again: bool) -> None:
        """Continue without lost members (handles `actions.Lose`)."""

    def perform(self, action: actions.Action) -> None:
        """Perform a time master's action: check the cell, start, release blocks or publish the simulated time."""

    def work(self) -> None:
        """Compute as far as the messages received since the last call allow."""

    def failed(self) -> None:
        """React to the failure of the node."""


class MemberHost(ABC):
    """Base class of a node, real or simulated: a `MemberProtocol` takes the decisions, a role computes or records.

    Attributes:
        full_name: fully qualified name.
        table: parameters of the node.
        exchange: hands signals over between the nodes of this process.
        protocol: protocol object of this member.
        role: role of the node; None unless configured.
        inlets: subscription of each signal topic that comes from other processes, by fully qualified name.
        listens: the node exchanges messages; from its first activation on.
        due: messages have arrived since the last call of `work`.
        next_tick: monotonic time of the next call of `tick` [s].
    """

    full_name: str
    table: "NodeParameters"
    exchange: Exchange
    protocol: MemberProtocol
    role: Work | None
    inlets: dict[str, Any]
    due = False
    next_tick = 0.0

    def _forget(self) -> None:
        """Reset the node to its state before the first activation."""
        self.role = None
        self.inlets = {}
        self.listens = self._performs = False
        self._deferred: deque[tuple[Callable[..., object], Any]] = deque()  # signals received too early

    # ---- what a host provides -----------------------------------------------------------------------

    @abstractmethod
    def now(self) -> float:
        """Return the monotonic time [s]."""

    @abstractmethod
    def look(self) -> None:
        """Pass the time, the state of the other members and the matched topics to the protocol."""

    @abstractmethod
    def has_ended(self, member: Announcement) -> bool:
        """Return True if the process of an announcement is known to have ended."""

    @abstractmethod
    def first_sample(self) -> int:
        """Return the sample at which the run begins."""

    @abstractmethod
    def send(self, action: actions.Action) -> None:
        """Publish what the protocol requests, or perform what else it requests of the host."""

    @abstractmethod
    def refuse(self, message: ForeignMessage) -> None:
        """Count a rejected message from outside the cell."""

    # ---- events -------------------------------------------------------------------------------------

    def hear_member(self, member: Announcement, sender: str) -> None:
        """Process an announcement; ``sender`` is the node that has published it, as DDS knows it."""
        known = self.protocol.members.get(member.name)
        if known and known.process != member.process:
            self.look()  # the previous process may have ended
        if member.name == self.protocol.own.name and self.has_ended(member):
            return  # the last announcement of this member's previous process is no namesake
        self.protocol.hear_member(member, self.now(), sender)

    def hear_cell_state(self, state: CellState, sender: str) -> None:
        """Process a cell state; it may be the one for which signals have waited."""
        self.protocol.hear_cell_state(state, self.now(), sender)
        self._take_up()

    def activate(self) -> None:
        """Take part in the cell, or resume after a deactivation, and take the signals received meanwhile."""
        self.due = True
        self.protocol.activate(self.now())
        self._take_up()
        self.perform_actions()

    def completed(self, blocks: int, samples: int, *, last: bool) -> None:
        """Report the total number of blocks and samples that the role has completed."""
        self.protocol.computed(blocks, samples, self.now(), last=last)
        if self.protocol.actions:
            self.perform_actions()

    def complete_part(self) -> None:
        """Report that the role has completed its last block."""
        self.protocol.complete_part()
        self.perform_actions()

    def describe(self, **topics: tuple[object, ...]) -> None:
        """Announce changed lists of topics (see `MemberProtocol.describe`)."""
        self.protocol.describe(**topics)
        self.perform_actions()

    def fail(self, error: LatheError, *, cause: str = "error") -> None:
        """Fail the node and announce the reason to all members (see `MemberProtocol.fail`)."""
        first = self.protocol.failure is None
        self.protocol.fail(error, cause=cause)
        self.perform_actions()
        if first and self.role is not None:
            self.role.failed()

    def attempt(self, step: Callable[..., object], *arguments: object) -> None:
        """Run a step whose error fails the node, then perform the protocol's pending actions."""
        try:
            step(*arguments)
        except ForeignMessage as refused:
            self.refuse(refused)
        except BadBlock as error:
            self.protocol.reject(error, self.now())
        except LatheError as error:
            self.fail(error)
        if self.protocol.actions:
            self.perform_actions()

    def work(self) -> None:
        """Compute as far as the messages received since the last call allow."""
        if self.role is not None and self.protocol.active and not self.protocol.failure:
            self.attempt(self.role.work)

    # ---- messages -----------------------------------------------------------------------------------

    def guarded(self, callback: Callable[..., object], *, always: bool = False) -> Callable[..., None]:
        """Wrap a callback so that its error fails the node with a one-line message instead of a traceback.

        Args:
            callback: function of a message.
            always: call it also after the node has failed.
        """

        def call(*message: Any) -> None:
            self.due = True
            if self.listens and (always or not self.protocol.failure):
                self.attempt(callback, *message)

        return call

    def in_turn(self, callback: Callable[..., object]) -> Callable[..., None]:
        """Wrap a signal callback so that messages are deferred while the node is deactivated or not yet ready.

        So no message is lost, and blocks from before a node joined do not count as missing. In a free-running cell
        all signals of a deactivated node but the newest of each topic, which may be the last block, are dropped
        instead, and counted like any missing blocks.
        """

        def call(*message: Any) -> None:
            if self.protocol.active and not self._is_early():
                self._take_up()
                callback(*message)
            else:
                if not (self.protocol.active or self.table.window):
                    self._deferred = deque(each for each in self._deferred if each[0] != callback)
                self._deferred.append((callback, message))
                if len(self._deferred) > MOST_DEFERRED * signal_depth(self.table.window) * (len(self.inlets) + 1):
                    if self.protocol.ready:
                        raise LatheError(f"{self.full_name}: {len(self._deferred)} messages wait until it is active")
                    self._deferred.popleft()  # a flood of foreign messages

        return call

    def _is_early(self) -> bool:
        """Return True while signals have to be deferred: the node is not ready, or its first sample is not known."""
        if self.protocol.master is not None:
            return not self.protocol.ready
        return bool(getattr(self.table, "restart_file", "")) and not self.protocol.alone

    def _take_up(self) -> None:
        """Take the deferred signals, unless it is too early."""
        while self._deferred and self.protocol.active and not self._is_early():
            callback, message = self._deferred.popleft()
            self.guarded(callback)(*message)

    # ---- requests of the protocol -------------------------------------------------------------------

    def perform_actions(self) -> None:
        """Perform the protocol's pending actions, including actions added meanwhile."""
        if self._performs:
            return
        self._performs = True
        try:
            while self.protocol.actions:
                action = self.protocol.actions.popleft()
                try:
                    self._perform(action)
                except LatheError as error:
                    self.fail(error)
        finally:
            self._performs = False

    def _perform(self, action: actions.Action) -> None:
        role = self.role
        match action:
            case actions.Announce() | actions.Say() | actions.Follow() | actions.Log() | actions.Report():
                self.send(action)
            case actions.Leave() | actions.Tell():
                self.send(action)
            case _ if role is None:
                pass
            case actions.MembersChanged():
                role.members_changed()
            case actions.Begin(joins):
                role.begin(joins=joins)
                self.protocol.begun(self.now())
                self._take_up()
            case actions.Lose(lost, first, end, again):
                role.lose(lost, first, end, again=again)
            case _:
                role.perform(action)
