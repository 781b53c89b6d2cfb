# SPDX-License-Identifier: Apache-2.0
"""The shell that all nodes share: lifecycle, membership and start handshake, progress, diagnostics, end."""

import json
import math
import os
import time
import traceback
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import chain, repeat
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lathe_rc_msgs.msg import CellState, Member, Progress
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleNode, State, TransitionCallbackReturn
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from std_msgs.msg import Empty

from lathe_rc import messages
from lathe_rc.bag.writing.record import signal_depth
from lathe_rc.cell.parameters import NodeParameters, remapped
from lathe_rc.cell.scenario import TABLES
from lathe_rc.cell.stages import MASTERS
from lathe_rc.cell.wiring import Unknown
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.nodes import declare
from lathe_rc.nodes.exchange import Exchange
from lathe_rc.nodes.liveliness import SILENCE, Watch, liveliness, this_host
from lathe_rc.nodes.ports import latched_qos, message_class, signal_qos
from lathe_rc.nodes.refused_messages import ForeignMessage, RefusedMessages
from lathe_rc.nodes.report import Reporter

_TICK = 0.02  # [s] between looks at the graph while members join
_DIAGNOSTICS_PERIOD = 1.0  # [s]
_REPEAT_PERIOD = 0.5  # [s] between announcements before the run, in the safe state, and after it has given up
_LATCHED_DEPTH = 256
_PATIENCE = 2.0  # [s] for others to acknowledge the last messages
_GIVEN_UP = 2.0  # [s] of silence after which a time master is lost in a cell that does not wait
_MOST_MEMBERS = 256  # announced names that are kept
_TOLD_AFTER = (2.0, 8.0, 30.0)  # [s] of waiting until it is told what for; the last again and again
_MOST_PUT_OFF = 8  # times the blocks in flight of each topic, while a node is deactivated


class CellNode(LifecycleNode):
    """A member of a cell, or a node alone.

    Args:
        name: default name.
        kind: what it is.
        reporter: line to the harness.
        exchange: what the nodes of this process hand over in memory.

    Attributes:
        table: its parameters, once configured.
        over: it has finished its part of the run.
        done: it may leave: in a cell, all have finished theirs, also if it has given up its own.
        failure: why it gave up.
        due: messages have come since it last worked.
        handled: messages received so far.
        watch: whether those are alive that it cannot do without; there once it is active.
        refused_messages: those that do not belong to the cell.
        outlets, inlets: publisher and subscription of each signal topic, by fully qualified name.
        patience: for messages to be acknowledged [s].
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
        self._service_change_state.callback = self._refusing(self._service_change_state.callback)
        self._forget()

    def _forget(self) -> None:
        """Be as before the first activation."""
        self.active = self.over = self.done = False
        self.members: dict[str, Member] = {}
        self.master: Member | None = None
        self._put_off: deque[tuple[Callable[[Any], object], Any]] = deque()  # signals that came while deactivated
        self._told_unknown: set[str] = set()
        self._tell_due = math.inf
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

    def on_configure(self, state: State) -> TransitionCallbackReturn:
        """Validate parameters and allocate."""
        return self._transition(state, "inactive", self._configure)

    def on_activate(self, state: State) -> TransitionCallbackReturn:
        """Announce itself and exchange data from now on; or go on, having been deactivated."""
        return self._transition(state, "active", self._activate)

    def on_deactivate(self, state: State) -> TransitionCallbackReturn:
        """Stand still: what comes is put off, and so the cell stands still as well."""
        return self._transition(state, "inactive", self._deactivate)

    def on_cleanup(self, state: State) -> TransitionCallbackReturn:
        """Leave the cell, and be as before it was configured; not in the middle of a run, which needs its blocks."""
        if self._takes_part:
            self.get_logger().warning(
                "cleanup refused in the middle of a run; activate to go on, or shutdown to give up"
            )
            return TransitionCallbackReturn.FAILURE
        return self._transition(state, "unconfigured", self._clean_up)

    def on_shutdown(self, state: State) -> TransitionCallbackReturn:
        """Leave; in the middle of a run as one that has failed."""
        return self._transition(state, "finalized", self._shut_down)

    def on_error(self, state: State) -> TransitionCallbackReturn:
        """Safe state: nothing is published any more."""
        self.active = False
        return TransitionCallbackReturn.SUCCESS

    def _transition(self, state: State, goal: str, step: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            step()
        except LatheError as error:
            self.fail(error)
            return TransitionCallbackReturn.FAILURE
        except Exception as error:  # noqa: BLE001 - rclpy would swallow it, and the cell wait for a node that is not there
            self.get_logger().error(traceback.format_exc())
            self.fail(LatheError(f"{self.get_name()}: {type(error).__name__}: {shown(error)}"))
            return TransitionCallbackReturn.FAILURE
        self.get_logger().info(f"{state.label} -> {goal}")
        return TransitionCallbackReturn.SUCCESS

    def _refusing(self, change: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """The lifecycle service, without the exception with which rclpy answers to what cannot be."""

        def call(request: Any, response: Any) -> Any:
            try:
                return change(request, response)
            except RuntimeError as error:
                self.get_logger().warning(f"transition {request.transition.id} refused: {str(error).splitlines()[0]}")
                response.success = False
                return response

        return call

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
            for endpoint in now - before:
                destroy(endpoint)
        self._forget()

    def _shut_down(self) -> None:
        if self._takes_part:
            self.fail(LatheError(f"{self.get_name()} was shut down in the middle of a run"))
        else:
            self.finish()
            self._clean_up()
            self.done = True
            self.reporter("done", self.get_name(), cpu_s=time.process_time())
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

    @abstractmethod
    def publications(self) -> list[tuple[str, str, bool]]:
        """Fully qualified signal topic, message type, sparse or not."""

    @abstractmethod
    def subscriptions_wanted(self) -> list[str]:
        """Fully qualified signal topics."""

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
        """Let go of what it has made; publishers, subscriptions and services are destroyed by who calls."""

    def begin(self, *, joins: bool) -> None:
        """Every input and output is matched; ``joins``: the cell is running already."""

    def lose(self, lost: set[str], first: int, end: int) -> None:
        """Do without lost members up to sample ``end``, the end of the run; be safe from sample ``first`` on."""

    def statistics(self) -> dict[str, object]:
        """Figures for the diagnostics."""
        return {}

    def finish(self) -> None:
        """End in order: close files, write what is left."""

    # ---- helpers ------------------------------------------------------------------------------------

    def topic(self, relative: str) -> str:
        """Fully qualified name of a relative topic after all remapping."""
        return str(self.resolve_topic_name(remapped(self.table, relative)))

    def guarded(self, callback: Callable[[Any], object], *, always: bool = False) -> Callable[[Any], None]:
        """A callback that fails the node, by name and in one line, instead of the process with a traceback.

        Args:
            callback: takes a message.
            always: whether it also hears what comes after the node has given up.
        """

        def call(message: Any) -> None:
            self.handled += 1
            self.due = True
            if not self._host or (self.failure and not always):
                return
            try:
                callback(message)
            except ForeignMessage as refused:
                self.refused_messages.refuse(refused)
            except LatheError as error:
                self.fail(error)

        return call

    def _in_turn(self, callback: Callable[[Any], object]) -> Callable[[Any], None]:
        """A callback for signals, which are put off while the node is deactivated: then nothing is lost.

        Where nothing holds the spindle back they are left out, and counted as any that are missing.
        """
        most = _MOST_PUT_OFF * signal_depth(self.table)

        def call(message: Any) -> None:
            if self.active:
                callback(message)
            elif self.table.window:
                self._put_off.append((callback, message))
                if len(self._put_off) > most * (len(self.subscriptions_wanted()) + 1):
                    raise LatheError(f"{self.full_name}: {len(self._put_off)} messages wait until it is active again")

        return call

    def _report_refused(self, message: ForeignMessage) -> None:
        publishers = self._who_publishes(message.topic)
        self.get_logger().warning(f"refused: {message}; publishers of {message.topic}: {', '.join(publishers)}")
        self.reporter("foreign_message", self.get_name(), message=str(message), publishers=publishers)
        self._diagnostics_due = time.monotonic()

    def _who_publishes(self, topic: str) -> list[str]:
        """Nodes that publish a topic, as the graph lists them."""
        return sorted(_name(end) for end in self.get_publishers_info_by_topic(topic))

    def _one_of_many(self, topic: str, callback: Callable[[bytes], object]) -> Callable[[bytes], None]:
        """A callback whose errors name all publishers of its topic, if there are several: any of them may be it."""

        def call(data: bytes) -> None:
            try:
                callback(data)
            except ForeignMessage:
                raise
            except LatheError as error:
                if len(publishers := self._who_publishes(topic)) > 1:
                    error.args = (f"{error}; publishers of {topic}: {', '.join(publishers)}",)
                raise

        return call

    def attempt(self, step: Callable[[], None]) -> None:
        """Do something that may fail the node."""
        try:
            step()
        except LatheError as error:
            self.fail(error)

    def work(self) -> None:
        """Do what the messages since the last call allow."""

    def listen(
        self,
        topic: str,
        msgtype: str,
        callback: Callable[[bytes], object],
        inside: Callable[[Any], object],
    ) -> None:
        """Read a signal topic.

        Args:
            topic: fully qualified.
            msgtype: message type.
            callback: gets the encoded message from DDS.
            inside: gets the `lathe_rc.nodes.exchange.Delivery` of a node of this process instead.
        """
        if self.exchange.has(topic):
            self.exchange.listen(topic, self.full_name, self.guarded(self._in_turn(inside)))
            return
        self.inlets[topic] = self.create_subscription(
            message_class(msgtype),
            topic,
            self.guarded(self._in_turn(self._one_of_many(topic, callback))),
            signal_qos(self.table, topic),
            raw=True,
            event_callbacks=self.subscription_events(topic),
        )

    def subscription_events(self, topic: str) -> SubscriptionEventCallbacks:
        """Publishers that do not fit become named errors.

        To hear of lost messages as well may stop a node for ever: rmw_fastrtps 8.4 takes its own lock and then
        that of DDS where DDS takes them the other way round (its pull request 890); a flood from outside is enough.
        Nothing is missed by that: every block and every message at a chosen sample is counted by who reads it.
        """

        def incompatible(status: Any) -> None:
            self.fail(
                LatheError(
                    f"{topic}: a publisher offers a quality of service that does not fit ({status.last_policy_kind}); "
                    f"if it is a device that keeps no messages, add {topic} to {self.get_name()}.volatile_inputs"
                )
            )

        return SubscriptionEventCallbacks(incompatible_qos=incompatible)

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

    # ---- membership ---------------------------------------------------------------------------------

    def announce(self) -> None:
        """Publish who this is and how far it has come."""
        published = self.publications()
        own = Member(
            run_id=self.table.run_id,
            name=self.full_name,
            stage=self.kind,
            state=self._membership(),
            members=self.member_names(),
            publishes=[topic for topic, _, _ in published],
            types=[msgtype for _, msgtype, _ in published],
            sparse=[sparse for _, _, sparse in published],
            subscribes=self.subscriptions_wanted(),
            parameters=self._effective().model_dump_json(),
            message=str(self.failure or ""),
            host=this_host(),
            pid=os.getpid(),
        )
        self._host["members"].publish(own)

    def _membership(self) -> int:
        if self.failure:
            return int(Member.FAILED)
        if self._safe:
            return int(Member.SAFE)
        if self._ready:
            return int(Member.READY)
        return int(Member.WIRED if self.wired() else Member.JOINING)

    def wired(self) -> bool:
        """Whether all its publishers and subscriptions are there."""
        return True

    def _effective(self) -> NodeParameters:
        """The table with the remapping of the command line written into ``remap``."""
        namespace = self.get_namespace().rstrip("/") + "/"
        rules = [f"{topic}:={self.topic(topic).removeprefix(namespace)}" for topic in self.relative_topics()]
        changed = sorted({rule for rule in rules if rule.split(":=")[0] != rule.split(":=")[1]})
        return self.table.model_copy(update={"remap": changed})

    def announced(self, names: Iterable[str]) -> tuple[dict[str, NodeParameters], dict[str, Unknown]]:
        """What members have announced, by their name in this node's namespace: for a `lathe_rc.cell.wiring.Cell`.

        Returns:
            The parameters of those that are known here, and the topics of those of whom nobody here knows more.

        Raises:
            InputError: a member that is known has a parameter that cannot be.
        """
        tables, unknown = dict[str, NodeParameters](), dict[str, Unknown]()
        for name in names:
            table = self._table(name)
            if table is None:
                unknown[self._relative(name)] = self._topics_of(self.members[name])
            else:
                tables[self._relative(name)] = table
        return tables, unknown

    def _topics_of(self, member: Member) -> Unknown:
        dense, sparse = dict[str, str](), dict[str, str]()
        for topic, msgtype, is_sparse in zip(member.publishes, member.types, member.sparse, strict=True):
            (sparse if is_sparse else dense)[self._relative(topic)] = msgtype
        return Unknown(dense, sparse, frozenset(self._relative(topic) for topic in member.subscribes))

    def _relative(self, name: str) -> str:
        """The name of a member or topic in this node's namespace."""
        return name.removeprefix(self.get_namespace().rstrip("/") + "/")

    def _table(self, name: str) -> NodeParameters | None:
        """What a member has announced of its parameters; None, and told once, if nobody here knows what it is."""
        member = self.members[name]
        try:
            kind = TABLES.get(member.stage)
            why = "there is no such stage here"
        except InputError as error:
            kind, why = None, str(error)
        if kind is not None:
            values = json.loads(member.parameters) | {"stage": member.stage}
            missing = [row for row in kind.rows() if row not in values]
            if not missing:
                return kind.read(name, values)
            why = f"its parameters do not say {missing[0]}" + (f" and {len(missing) - 1} others" if missing[1:] else "")
        if name not in self._told_unknown:
            self._told_unknown.add(name)
            self.get_logger().info(f"{name}, stage {shown(repr(member.stage))}, is known by its topics alone: {why}")
        return None

    def relative_topics(self) -> list[str]:
        """Signal topics of the stage that it runs, before remapping, if it runs one."""
        return []

    def member_names(self) -> list[str]:
        """Fully qualified names of all members; only the time master knows them."""
        return []

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

    def _check_member(self, member: Member) -> None:
        """Refuse who is no member of this cell."""
        why = ""
        if self.table.run_id and member.run_id != self.table.run_id:
            why = f"expected run {self.table.run_id!r}"
        elif member.members and member.stage not in MASTERS:
            why = f"a time master is a {' or '.join(MASTERS)}"
        elif member.members and self.master is not None and member.name != self.master.name:
            why = f"the time master is {self.master.name}"
        elif not len(member.publishes) == len(member.types) == len(member.sparse):
            why = "its topics, their types and what is sparse are lists of different lengths"
        elif unknown := set(member.types) - messages.signal_types():
            why = f"no signals are of type {min(unknown)}"
        else:
            try:
                why = "" if isinstance(json.loads(member.parameters), dict) else "its parameters are no map"
            except (ValueError, RecursionError):
                why = "its parameters are no JSON"
        if why:
            raise ForeignMessage(self._host["members"].topic_name, member.name, member.run_id, why)

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
            self.done = self.done or ended or silent > 2.0 * _GIVEN_UP
        elif (ended or silent > _GIVEN_UP) and self.over:
            self._leave([])
        elif ended:
            self.fail(LatheError(f"{name}, the time master, is lost: no sample follows"), cause="abandoned")
        elif silent > _GIVEN_UP:
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

    def _parameter(self, name: str, key: str) -> object:
        """What a member has announced of its parameters; None if it has no such."""
        return json.loads(self.members[name].parameters).get(key)

    def restarts(self, name: str) -> bool:
        """Whether another process may go on in place of a member."""
        return bool(self._parameter(name, "restart_file"))

    @property
    def complete(self) -> bool:
        """Whether the master and all members that it names have announced themselves."""
        return self.master is not None and all(name in self.members for name in self.master.members)

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

    def matched(self) -> bool:
        """Whether each input has met its publisher and each output the members that read it, by name and in fact.

        The graph knows names, but runs ahead of what DDS has matched; DDS counts matches, but without names.
        """
        return next(self._unmatched(), None) is None

    def _unmatched(self) -> Iterator[str]:
        """The topics that have not met, and whom they lack."""
        assert self.master is not None
        peers = [self.members[name] for name in self.master.members if name != self.full_name]
        for topic, inlet in self.inlets.items():
            expected = {peer.name for peer in peers if topic in peer.publishes}
            found = _names(self.get_publishers_info_by_topic(topic))
            if not expected:
                yield f"{topic}, which no member publishes"
            elif not expected <= found or inlet.get_publisher_count() < len(expected):
                yield f"{topic} from {', '.join(sorted(expected - found or expected))}"
        for topic, outlet in self.outlets.items():
            expected = {peer.name for peer in peers if topic in peer.subscribes} - self.exchange.readers(topic)
            found = _names(self.get_subscriptions_info_by_topic(topic))
            if not expected <= found or outlet.get_subscription_count() < len(expected):
                yield f"{topic} to {', '.join(sorted(expected - found or expected))}"

    def missing(self) -> list[str]:
        """Members and topics that it waits for until it can begin; empty if it has begun, or waits for nobody."""
        if self.done or self.failure or (self._ready and self._cell not in (None, CellState.WAITING)):
            return []
        if not self.active:
            return ["its own activation"]
        if self.master is None:
            lonely = [topic for topic, inlet in self.inlets.items() if not inlet.get_publisher_count()]
            alone = any(member.stage in MASTERS for member in self.members.values())
            master = [] if alone or not lonely else ["a time master"]
            return [*master, *(f"a publisher of {topic}" for topic in lonely)]
        others = [name for name in self.master.members if name != self.full_name]
        states = {name: self.members[name].state if name in self.members else None for name in others}
        unheard = [name for name, state in states.items() if state is None]
        joining = [f"{name} to join" for name, state in states.items() if state == Member.JOINING]
        if unheard or joining:
            return [*unheard, *joining]
        if not self._ready:
            return list(self._unmatched())
        return [f"{name} to be ready" for name, state in states.items() if state == Member.WIRED]

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

    def end(self, acknowledged: list[Publisher]) -> None:
        """The node's part is over. In a cell it stays until all have ended; else until others have its last messages.

        A process that leaves while messages are under way may take a lock of the transport with it, and those who
        send to the same reader wait for ever. So one that has given up stays as well, while the others go on.
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

    def tick(self, now: float) -> None:
        """Do what is due by the wall clock; nothing here touches a sample."""
        self.next_tick = now + _TICK if not self._ready else now + 0.1
        if self._host:
            if not self._ready:
                self.attempt(self._settle)
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

    def _level(self) -> bytes:
        if self.failure:
            return bytes(DiagnosticStatus.ERROR)
        return bytes(DiagnosticStatus.WARN if self.refused_messages.senders else DiagnosticStatus.OK)

    def _publish_diagnostics(self) -> None:
        told = self.statistics() | {"refused": self.refused_messages}
        told |= {
            f"publishers of {topic}": ", ".join(self._who_publishes(topic)) for topic in self.refused_messages.topics
        }
        status = DiagnosticStatus(
            level=self._level(),
            name=self.full_name,
            message=str(self.failure or ("ready" if self._ready else "waiting for members")),
            hardware_id=self.kind,
            values=[KeyValue(key=key, value=str(value)) for key, value in told.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._host["diagnostics"].publish(message)


def why_failed(member: Member) -> str:
    """What a member says of its failure; its name, with which that may begin, is said before."""
    own_name = member.name.rpartition("/")[2]
    return f"failed: {member.message.removeprefix(f'{own_name}: ')}"


def given_up(master: str) -> str:
    """What members say that do without a silent time master from now on."""
    return f"{master}, the time master, has been silent for {_GIVEN_UP:g} s: no sample follows"


def _names(endpoints: list[Any]) -> set[str]:
    return {_name(end) for end in endpoints}


def _name(end: Any) -> str:
    return f"{end.node_namespace.rstrip('/')}/{end.node_name}"
