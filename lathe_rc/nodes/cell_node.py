# SPDX-License-Identifier: Apache-2.0
"""The node of every member: it turns ROS's callbacks into events of the protocol, and does what the protocol asks for.

It has a `lathe_rc.protocol.MemberProtocol`, which decides, a `Role`, which computes or records, and a `Watch`, which
sees whether others live.
"""

import os
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from functools import partial
from typing import Any, Protocol, TypeVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lathe_rc_msgs.msg import CellState as CellStateMessage
from lathe_rc_msgs.msg import Member
from lathe_rc_msgs.msg import Progress as ProgressMessage
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleNode, State, TransitionCallbackReturn
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from std_msgs.msg import Empty

from lathe_rc import messages
from lathe_rc.cell.host_topics import signal_depth
from lathe_rc.cell.parameters import NodeParameters, remapped
from lathe_rc.cell.scenario import TABLES
from lathe_rc.cell.stages import MASTERS
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.nodes import declare, graph
from lathe_rc.nodes.exchange import Exchange
from lathe_rc.nodes.liveliness import Watch, liveliness, this_host
from lathe_rc.nodes.ports import latched_qos, message_class, signal_qos
from lathe_rc.nodes.refused_messages import RefusedMessages
from lathe_rc.nodes.report import Reporter
from lathe_rc.protocol import Announcement, CellState, ForeignMessage, MemberProtocol, Progress, actions

_TICK = 0.02  # [s] between looks at the graph while members join
_IDLE_TICK = 0.1  # [s] between looks at the others
_DIAGNOSTICS_PERIOD = 1.0  # [s]
_LATCHED_DEPTH = 256
_MOST_PUT_OFF = 8  # times the blocks in flight of each topic, while a node is deactivated
_EARLY = 4  # times the blocks in flight of each topic, before a node is ready

T = TypeVar("T")


class Role(Protocol):
    """Work of a kind of node in the cell; it is made when the node is configured, and lives until it is cleaned up."""

    def protocol(self, own: Announcement) -> MemberProtocol:
        """The protocol of this kind of member."""

    def member_names(self) -> list[str]:
        """Fully qualified names of all members; a time master alone knows them."""

    def publications(self) -> list[tuple[str, str, bool]]:
        """Fully qualified signal topic, message type, and whether its messages come at chosen samples."""

    def subscriptions(self) -> list[str]:
        """Fully qualified signal topics that it reads."""

    def relative_topics(self) -> list[str]:
        """Signal topics of its stage before remapping, if it has a stage."""

    def activate(self) -> None:
        """Make publishers, subscriptions and services."""

    def members_changed(self) -> None:
        """A member has announced something new."""

    def begin(self, *, joins: bool) -> None:
        """Prepare for block 0: every topic has met its peers; ``joins``: the cell is running already."""

    def lose(self, lost: frozenset[str], first: int, end: int, *, again: bool) -> None:
        """Do without lost members, see `actions.Lose`."""

    def perform(self, action: actions.Action) -> None:
        """Do what the protocol asks a time master for: to check the cell, to start, to release, to tell the time."""

    def work(self) -> None:
        """Compute what the messages since the last call allow."""

    def tick(self, now: float) -> float:
        """Do what is due by wall time; returns when it wants to be called again, monotonic [s]."""

    def failed(self) -> None:
        """The node has given up."""

    def finish(self) -> None:
        """Close files and write what is left."""

    def clean_up(self) -> None:
        """Let go of everything but publishers, subscriptions and services, which the node destroys."""

    def statistics(self) -> dict[str, object]:
        """Figures for the diagnostics."""


class CellNode(LifecycleNode):
    """A member of a cell, or a node alone.

    Args:
        name: default name.
        kind: of node, as `TABLES` has it.
        role: makes its role once it is configured.
        reporter: line to the harness.
        exchange: between the nodes of this process.

    Attributes:
        table: parameters, once configured.
        protocol: its part in the cell.
        role: see the arguments; None unless configured.
        outlets, inlets: publisher and subscription of each signal topic, by fully qualified name.
        due: messages have come since it last worked.
        handled: messages received so far.
        refused_messages: those from outside the cell.
        discarded: destroy the publishers, subscriptions and services that it had before it was cleaned up; for its
            process to call.
        next_tick: monotonic time [s] at which it wants `tick` to be called.
    """

    def __init__(
        self, name: str, kind: str, role: Callable[["CellNode"], Role], reporter: Reporter, exchange: Exchange
    ) -> None:
        super().__init__(
            name,
            automatically_declare_parameters_from_overrides=True,
            allow_undeclared_parameters=True,
        )
        given = declare.overrides(self)
        self.kind, self._make_role = kind, role
        self.autostart = bool(given.get("autostart", True))
        self.table: NodeParameters = TABLES[self.kind]()
        self.reporter = reporter
        self.exchange = exchange
        self.next_tick = time.monotonic()
        self.handled, self.due = 0, False
        self.full_name = self.get_fully_qualified_name()
        self.namespace = self.get_namespace().rstrip("/") + "/"
        self.refused_messages = RefusedMessages(self._report_refused)
        self._diagnostics_due = time.monotonic() + _DIAGNOSTICS_PERIOD
        self._endpoints_of_rclpy = self._endpoints()
        self.discarded: list[Callable[[], object]] = []
        self._service_change_state.callback = self._refusing(self._service_change_state.callback)
        self._forget()

    def _forget(self) -> None:
        """Be as before the first activation."""
        self.role: Role | None = None
        self.protocol = MemberProtocol(Announcement("", self.full_name, self.kind), 0)
        self._performs = False
        self._put_off: deque[tuple[Callable[[Any], object], Any]] = deque()  # signals that came while deactivated
        self._early: deque[tuple[Callable[[Any], object], Any]] = deque()  # signals that came before it was ready
        self._read_elsewhere = True  # whether other nodes than the time master read the progress
        self._host: dict[str, Publisher] = {}
        self.outlets: dict[str, Publisher] = {}
        self.inlets: dict[str, Subscription] = {}
        self._unknown: set[str] = set()  # members of unknown stages that have been reported

    # ---- lifecycle ----------------------------------------------------------------------------------

    def on_configure(self, state: State) -> TransitionCallbackReturn:
        """Validate parameters and allocate."""
        return self._transition(state, "inactive", self._configure)

    def on_activate(self, state: State) -> TransitionCallbackReturn:
        """Announce the node and exchange data from now on; or go on after a deactivation."""
        return self._transition(state, "active", self._activate)

    def on_deactivate(self, state: State) -> TransitionCallbackReturn:
        """Stand still: messages are put off, and so the cell stands still as well."""
        return self._transition(state, "inactive", self.protocol.deactivate)

    def on_cleanup(self, state: State) -> TransitionCallbackReturn:
        """Leave the cell, and be as before it was configured; not in the middle of a run, which needs its blocks."""
        if self.protocol.takes_part:
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
        self.protocol.deactivate()
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
        self._perform_actions()
        return TransitionCallbackReturn.SUCCESS

    def _refusing(self, change: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """The lifecycle service, without the exception with which rclpy answers to a transition that cannot be."""

        def call(request: Any, response: Any) -> Any:
            try:
                return change(request, response)
            except RuntimeError as error:
                self.get_logger().warning(f"transition {request.transition.id} refused: {str(error).splitlines()[0]}")
                response.success = False
                return response

        return call

    def _configure(self) -> None:
        self.table = declare.declare(self, TABLES[self.kind])
        if self.table.stage not in ("", self.kind):
            raise InputError(f"{self.get_name()}.stage = {self.table.stage!r}; this executable is a {self.kind}")
        self.role = self._make_role(self)
        topics = self.role.publications()
        own = Announcement(
            run_id=self.table.run_id,
            name=self.full_name,
            stage=self.kind,
            members=tuple(self.role.member_names()),
            publishes=tuple(topic for topic, _, _ in topics),
            types=tuple(msgtype for _, msgtype, _ in topics),
            sparse=tuple(sparse for _, _, sparse in topics),
            subscribes=tuple(self.role.subscriptions()),
            parameters=self._effective(self.role).model_dump_json(),
            host=this_host(),
            pid=os.getpid(),
            session=time.monotonic_ns() if self.role.member_names() else 0,
        )
        self.protocol = self.role.protocol(own)

    def _effective(self, role: Role) -> NodeParameters:
        """The table with the remapping of the command line written into ``remap``."""
        rules = [f"{topic}:={self.topic(topic).removeprefix(self.namespace)}" for topic in role.relative_topics()]
        changed = sorted({rule for rule in rules if rule.split(":=")[0] != rule.split(":=")[1]})
        return self.table.model_copy(update={"remap": changed})

    def _activate(self) -> None:
        assert self.role is not None, "the node is configured"
        self.due = True
        if not self._host:
            self._begin_to_exchange()
            self.role.activate()
        self.protocol.activate(time.monotonic())
        self._take_up(self._put_off)
        self._perform_actions()
        self.reporter("active", self.get_name(), pid=os.getpid())

    def _begin_to_exchange(self) -> None:
        """Make the publishers and subscriptions of the protocol."""
        add = self.create_publisher
        self._host = {
            "members": add(Member, "members", latched_qos(1)),
            "progress": add(ProgressMessage, "progress", latched_qos(1)),  # a node that was away needs the newest
            "diagnostics": add(DiagnosticArray, "/diagnostics", QoSProfile(depth=100)),
        }
        if self.protocol.own.stage in MASTERS:
            self._host["cell_state"] = add(CellStateMessage, "cell_state", latched_qos(1))
        subscribe = self.create_subscription
        subscribe(Member, "members", self.guarded(self._on_member), latched_qos(_LATCHED_DEPTH))
        subscribe(CellStateMessage, "cell_state", self.guarded(self._on_cell_state, always=True), latched_qos())
        add(Empty, f"~/{messages.ALIVE}", liveliness())
        self.watch = Watch(self, self._look)

    def _clean_up(self) -> None:
        assert self.role is not None, "the node is configured"
        self.role.clean_up()
        self.protocol.clean_up()
        if self._host:
            self._perform_actions()
            self._wait_for_acknowledgement([self._host["members"]], self.protocol.patience)
            self.watch.close()
        for before, now, destroy in zip(self._endpoints_of_rclpy, self._endpoints(), self._destroyers(), strict=True):
            self.discarded += [partial(destroy, endpoint) for endpoint in now - before]
        self._forget()

    def _shut_down(self) -> None:
        if not self.protocol.takes_part:
            self.finish()
        self.protocol.shut_down(time.monotonic())

    def interrupt(self, signal: str) -> None:
        """Tell the others that this process ends by a signal."""
        self.protocol.interrupt(signal)
        self._perform_actions()
        if self._host and self.protocol.failure:
            self._wait_for_acknowledgement([self._host["members"]], self.protocol.patience)

    def _endpoints(self) -> list[set[Any]]:
        return [set(self.publishers), set(self.subscriptions), set(self.services)]

    def _destroyers(self) -> list[Callable[[Any], object]]:
        return [self.destroy_publisher, self.destroy_subscription, self.destroy_service]

    # ---- events of the protocol ---------------------------------------------------------------------

    def _on_member(self, message: Any) -> None:
        member = from_ros(message, Announcement)
        known = self.protocol.members.get(member.name)
        if known and known.process != member.process:
            self._look()  # the process before may have ended
        self.protocol.hear_member(member, time.monotonic())

    def _on_cell_state(self, message: Any) -> None:
        self.protocol.hear_cell_state(from_ros(message, CellState), time.monotonic())

    def completed(self, blocks: int, samples: int, *, last: bool) -> None:
        """The role has completed so many blocks and samples in all."""
        self.protocol.computed(blocks, samples, time.monotonic(), last=last)
        if self.protocol.actions:
            self._perform_actions()

    def complete_part(self) -> None:
        """The role has completed its last block."""
        self.protocol.complete_part()
        self._perform_actions()

    def describe(self, **topics: tuple[object, ...]) -> None:
        """Announce other lists of topics than before; see `MemberProtocol.describe`."""
        self.protocol.describe(**topics)
        self._perform_actions()

    def fail(self, error: LatheError, *, cause: str = "error") -> None:
        """Give up, and say so to all; see `MemberProtocol.fail`."""
        first = self.protocol.failure is None
        self.protocol.fail(error, cause=cause)
        self._perform_actions()
        if first and self.role is not None:
            self.role.failed()

    def attempt(self, step: Callable[[], object]) -> None:
        """Do something that may fail the node, and what the protocol asks for then."""
        try:
            step()
        except ForeignMessage as refused:
            self._refuse(refused)
        except LatheError as error:
            self.fail(error)
        self._perform_actions()

    def _look(self) -> None:
        """Let the protocol see the time, the others and the graph."""
        protocol = self.protocol
        self.watch.look()
        protocol.look(time.monotonic(), self.watch.silent, self.watch.ended())
        if protocol.wants_match:
            protocol.matched(list(graph.unmatched(self, self.inlets, self.outlets, protocol, self.exchange)))
        elif protocol.master is None:
            protocol.unmatched = [topic for topic, inlet in self.inlets.items() if not inlet.get_publisher_count()]
        self._perform_actions()

    def tick(self, now: float) -> None:
        """Do what is due by the wall clock; nothing here touches a sample."""
        self.next_tick = now + (_IDLE_TICK if self.protocol.ready else _TICK)
        if not self._host:
            return
        self._look()
        self._read_elsewhere = self._host["progress"].get_subscription_count() > 1
        if self.role is not None:
            self.next_tick = min(self.next_tick, self.role.tick(now))
        if now >= self._diagnostics_due:
            self._diagnostics_due = now + _DIAGNOSTICS_PERIOD
            self._publish_diagnostics()

    def work(self) -> None:
        """Compute what the messages since the last call allow."""
        if self.role is not None and self.protocol.active and not self.protocol.failure:
            self.attempt(self.role.work)

    def finish(self) -> None:
        """Close files and write what is left."""
        if self.role is not None:
            self.role.finish()

    # ---- requests of the protocol -------------------------------------------------------------------

    def _perform_actions(self) -> None:
        """Do what the protocol asks for; what it asks for meanwhile, after that."""
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
        match action:
            case actions.Announce(member):
                if self._host:
                    self._host["members"].publish(Member(**asdict(member)))
            case actions.Say(state):
                self._host["cell_state"].publish(CellStateMessage(**asdict(state)))
            case actions.Tell(progress):
                self._tell(progress)
            case actions.Follow(member):
                self.watch.follow(member)
            case actions.Log(level, text):
                self._log(level, text)
            case actions.Report(event, values):
                self.reporter(event, self.get_name(), **values)
            case actions.Leave(patience):
                self._leave(patience)
            case _ if self.role is not None:
                self._perform_by_role(self.role, action)

    def _log(self, level: str, text: str) -> None:
        if level == "error":  # rclpy refuses another level from the same line
            self.get_logger().error(text)
        elif level == "warning":
            self.get_logger().warning(text)
        else:
            self.get_logger().info(text)

    def _leave(self, patience: float) -> None:
        if patience:
            publishers = [self._host[name] for name in ("progress", "cell_state") if name in self._host]
            self._wait_for_acknowledgement([*self.outlets.values(), *publishers], patience)
        self.protocol.left()
        self.reporter("done", self.get_name(), cpu_s=time.process_time())

    def _perform_by_role(self, role: Role, action: actions.Action) -> None:
        match action:
            case actions.MembersChanged():
                role.members_changed()
            case actions.Begin(joins):
                role.begin(joins=joins)
                self.protocol.begun(time.monotonic())
                self._take_up(self._early)
            case actions.Lose(lost, first, end, again):
                role.lose(lost, first, end, again=again)
            case _:
                role.perform(action)

    def _tell(self, progress: Progress) -> None:
        if self.exchange.master:
            self.exchange.master(progress)
        if not self.exchange.master or self._read_elsewhere:
            self._host["progress"].publish(ProgressMessage(**asdict(progress)))

    def _wait_for_acknowledgement(self, publishers: Sequence[Publisher], patience: float) -> None:
        for publisher in publishers:
            if not publisher.wait_for_all_acked(Duration(seconds=patience)):
                self.get_logger().warning(f"{publisher.topic}: not everybody has acknowledged the last message")

    # ---- topics -------------------------------------------------------------------------------------

    def topic(self, relative: str) -> str:
        """Fully qualified name of a relative topic after all remapping."""
        return str(self.resolve_topic_name(remapped(self.table, relative)))

    def guarded(self, callback: Callable[[Any], object], *, always: bool = False) -> Callable[[Any], None]:
        """A callback that fails the node, by name and in one line, instead of the process with a traceback.

        Args:
            callback: takes a message.
            always: whether it also gets messages after the node has given up.
        """

        def call(message: Any) -> None:
            self.handled += 1
            self.due = True
            if not self._host or (self.protocol.failure and not always):
                return
            try:
                callback(message)
            except ForeignMessage as refused:
                self._refuse(refused)
            except LatheError as error:
                self.fail(error)
            if self.protocol.actions:
                self._perform_actions()

        return call

    def _in_turn(self, callback: Callable[[Any], object]) -> Callable[[Any], None]:
        """A callback for signals, which are put off while the node is deactivated, and until it is ready.

        So nothing is lost, and no block counts as missing that a node could not hear when it joined. Where nothing
        holds the spindle back, signals are left out while it is deactivated, and counted as any that are missing.
        """
        most = _MOST_PUT_OFF * signal_depth(self.table)

        def call(message: Any) -> None:
            if not self.protocol.active:
                if self.table.window:
                    self._put_off.append((callback, message))
                if len(self._put_off) > most * (len(self.inlets) + 1):
                    raise LatheError(f"{self.full_name}: {len(self._put_off)} messages wait until it is active again")
            elif self._is_early():
                self._early.append((callback, message))
                if len(self._early) > _EARLY * signal_depth(self.table) * (len(self.inlets) + 1):
                    self._early.popleft()  # of a flood from outside
            else:
                self._take_up(self._early)
                callback(message)

        return call

    def _is_early(self) -> bool:
        """Whether signals have to wait: until the node is ready, and knows where to begin if it may go on."""
        if self.protocol.master is not None:
            return not self.protocol.ready
        return bool(getattr(self.table, "restart_file", "")) and not self.protocol.alone

    def _take_up(self, waiting: deque[tuple[Callable[[Any], object], Any]]) -> None:
        while waiting:
            callback, message = waiting.popleft()
            self.guarded(callback)(message)

    def _one_of_many(self, topic: str, callback: Callable[[bytes], object]) -> Callable[[bytes], None]:
        """A callback whose errors name all publishers of its topic, if there are several: any of them may be it."""

        def call(data: bytes) -> None:
            try:
                callback(data)
            except ForeignMessage:
                raise
            except LatheError as error:
                if len(publishers := graph.publishers(self, topic)) > 1:
                    error.args = (f"{error}; publishers of {topic}: {', '.join(publishers)}",)
                raise

        return call

    def listen(
        self, topic: str, msgtype: str, callback: Callable[[bytes], object], inside: Callable[[Any], object]
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
        """Publishers that do not fit are named.

        To hear of lost messages as well may stop a node for ever: rmw_fastrtps 8.4 takes its own lock and then
        that of DDS where DDS takes them the other way round (its pull request 890); a flood from outside is enough.
        Nothing is missed by that: every block and every message at a chosen sample is counted by its readers.
        """

        def incompatible(status: Any) -> None:
            why = (
                f"a publisher offers a quality of service that does not fit ({status.last_policy_kind}); if it is a "
                f"device that keeps no messages, add {topic} to {self.get_name()}.volatile_inputs"
            )
            self._refuse(ForeignMessage(topic, "", "", why))

        return SubscriptionEventCallbacks(incompatible_qos=incompatible)

    def announced(self, names: Sequence[str]) -> graph.Announced:
        """The members' parameters and topics; see `lathe_rc.nodes.graph.announced`."""
        return graph.announced(self.protocol.members, names, self.namespace, self._report_unknown)

    def _report_unknown(self, name: str, stage: str, why: str) -> None:
        if name not in self._unknown:
            self._unknown.add(name)
            self.get_logger().info(f"{name}, stage {shown(repr(stage))}, is known by its topics alone: {why}")

    # ---- diagnostics --------------------------------------------------------------------------------

    def _refuse(self, message: ForeignMessage) -> None:
        """Count a message from outside the cell; the protocol knows the relative names of its own topics."""
        self.refused_messages.refuse(message.on(self.resolve_topic_name(message.topic)))

    def _report_refused(self, message: ForeignMessage) -> None:
        publishers = graph.publishers(self, message.topic)
        self.get_logger().warning(f"refused: {message}; publishers of {message.topic}: {', '.join(publishers)}")
        self.reporter("foreign_message", self.get_name(), message=str(message), publishers=publishers)
        self._diagnostics_due = time.monotonic()

    def _publish_diagnostics(self) -> None:
        refused, failure = self.refused_messages, self.protocol.failure
        figures = {} if self.role is None else self.role.statistics()
        figures |= {"refused": refused}
        figures |= {f"publishers of {topic}": ", ".join(graph.publishers(self, topic)) for topic in refused.topics}
        level = DiagnosticStatus.WARN if refused.senders else DiagnosticStatus.OK
        status = DiagnosticStatus(
            level=bytes(DiagnosticStatus.ERROR if failure else level),
            name=self.full_name,
            message=str(failure or ("ready" if self.protocol.ready else "waiting for members")),
            hardware_id=self.kind,
            values=[KeyValue(key=key, value=str(value)) for key, value in figures.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._host["diagnostics"].publish(message)


def from_ros(message: Any, kind: type[T]) -> T:
    """The protocol's own message with the fields of the ROS message of the same name."""
    values = {field.name: getattr(message, field.name) for field in fields(kind)}  # type: ignore[arg-type]
    return kind(**{name: tuple(value) if isinstance(value, list) else value for name, value in values.items()})
