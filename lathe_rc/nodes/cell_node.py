# SPDX-License-Identifier: Apache-2.0
"""ROS node of every cell member: passes ROS callbacks to the protocol as events and performs the requested actions.

A node consists of a `lathe_rc.protocol.MemberProtocol`, which takes the decisions, a `Role`, which computes or records,
and a `Watch`, which monitors the liveliness of other members.
"""

import os
import time
import traceback
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any, Protocol, TypeVar, cast

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lathe_rc_msgs.msg import CellState as CellStateMessage
from lathe_rc_msgs.msg import Member
from lathe_rc_msgs.msg import Progress as ProgressMessage
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNode, State, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from std_msgs.msg import Empty

from lathe_rc import messages
from lathe_rc.blocks.ports import signal_depth
from lathe_rc.cell.checkpoint import Checkpoint, begun_of
from lathe_rc.cell.parameters import NodeParameters, SharedParameters, Value, remapped
from lathe_rc.cell.recorder import KIND as RECORDER
from lathe_rc.cell.scenario import TABLES
from lathe_rc.cell.time_master import START_FROM, TimeMasterParameters
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.nodes import declare, graph
from lathe_rc.nodes.liveliness import Watch, has_ended, liveliness, this_host
from lathe_rc.nodes.ports import latched_qos, message_class, signal_qos
from lathe_rc.nodes.publisher_info import asked
from lathe_rc.nodes.refused_messages import RefusedMessages
from lathe_rc.nodes.report import Reporter
from lathe_rc.protocol import (
    Announcement,
    CellState,
    ForeignMessage,
    MemberProtocol,
    Progress,
    TimeMasterProtocol,
    actions,
)
from lathe_rc.protocol.exchange import Exchange
from lathe_rc.protocol.member_host import MOST_DEFERRED, MemberHost, Work

_TICK = 0.02  # [s] between polls of the graph while members join
_BRIEF = 0.05  # [s] for an acknowledgement, after another reader of the process's messages has used up the patience
_IDLE_TICK = 0.1  # [s] between checks of the other members
_DIAGNOSTICS_PERIOD = 1.0  # [s]
_LATCHED_DEPTH = 256
_PROGRESS = f"{messages.PACKAGE}/msg/Progress"
_NAMELESS = 10.0  # [s] for the ROS graph to name the node of a publisher
_MOST_SENDERS = 4096  # publishers that are remembered by name

T = TypeVar("T")


class Role(Work, Protocol):
    """Work of one kind of cell node; created when the node is configured, destroyed when it is cleaned up.

    Roles derive from it, and leave out what they do not do.
    """

    @property
    def tunable(self) -> tuple[str, ...]:
        """Return the names of the parameters that may change in a run."""

    def tune(self, values: Mapping[str, Value]) -> str:
        """Change tunable parameters; return from when on they hold, in words.

        Raises:
            InputError: the values cannot be used now; the message says why.
        """

    def protocol(self, own: Announcement) -> MemberProtocol:
        """Return the protocol object of this kind of member."""

    def member_names(self) -> list[str]:
        """Return the fully qualified names of all members; only a time master knows them."""
        return []

    def publications(self) -> list[tuple[str, str, bool]]:
        """Return topic, message type and sparse flag (messages at chosen samples) of each published signal."""
        return []

    def subscriptions(self) -> list[str]:
        """Return the fully qualified names of the signal topics that the node reads."""

    def relative_topics(self) -> list[str]:
        """Return the signal topics of the node's stage before remapping; empty without a stage."""
        return []

    def activate(self) -> None:
        """Create the publishers, subscriptions and services of the node."""

    def tick(self, now: float) -> float:
        """Do the work that is due by wall time; return the monotonic time of the next call [s]."""

    def finish(self) -> None:
        """Write the remaining data and close the files."""

    def clean_up(self) -> None:
        """Release all resources except publishers, subscriptions and services, which the node destroys."""

    def statistics(self) -> dict[str, object]:
        """Return the figures of the role for the diagnostics."""


class CellNode(LifecycleNode, MemberHost):
    """ROS 2 lifecycle node of a cell member, or of a node that runs without a cell.

    Args:
        name: default name of the node.
        kind: kind of node, a key of `TABLES`.
        role: creates the role when the node is configured.
        reporter: sends reports to the harness.
        exchange: hands signals over between the nodes of this process.

    Attributes:
        table: parameters; set when the node is configured.
        protocol: protocol object of this member.
        role: role of the node; None unless configured.
        outlets: publisher of each signal topic, by fully qualified name.
        refused_messages: counter of rejected messages from outside the cell.
    """

    role: Role | None

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
        self._starts = self.autostart  # the first configuration is its own: if that fails, the process ends
        self.table: NodeParameters = TABLES[self.kind]()
        self.reporter = reporter
        self.exchange = exchange
        self.next_tick = time.monotonic()
        self.full_name = self.get_fully_qualified_name()
        self.namespace = self.get_namespace().rstrip("/") + "/"
        self.refused_messages = RefusedMessages(self._report_refused)
        self._unfit: set[tuple[str, str, str]] = set()  # topic, node and reason, as reported
        self._diagnostics_due = time.monotonic() + _DIAGNOSTICS_PERIOD
        self._endpoints_of_rclpy = self._endpoints()
        self._service_change_state.callback = self._refusing(self._service_change_state.callback)
        self._forget()

    def _forget(self) -> None:
        """Reset the node to its state before the first activation (extends `MemberHost`)."""
        super()._forget()
        self.protocol = MemberProtocol(Announcement("", self.full_name, self.kind), 0)
        self._senders: dict[bytes, str] = {}  # names of nodes by the identity of their publishers
        self._nameless: dict[tuple[str, bytes], deque[tuple[Callable[..., None], bytes, float]]] = {}
        self._read_elsewhere = True  # whether other nodes than the time master read the progress
        self._host: dict[str, Publisher] = {}
        self.outlets: dict[str, Publisher] = {}
        self._unknown: set[str] = set()  # members of unknown stages that have been reported

    # ---- lifecycle ----------------------------------------------------------------------------------

    def on_configure(self, state: State) -> TransitionCallbackReturn:
        """Validate the parameters and allocate the role; a client whose parameters are refused may set others."""
        refuse = self.fail if self._starts else self._withdraw
        self._starts = False
        return self._transition(state, "inactive", self._configure, refuse)

    def on_activate(self, state: State) -> TransitionCallbackReturn:
        """Announce the node and start to exchange data, or resume after a deactivation."""
        return self._transition(state, "active", self._activate)

    def on_deactivate(self, state: State) -> TransitionCallbackReturn:
        """Pause the node, and with it the cell: incoming messages are deferred."""
        return self._transition(state, "inactive", self.protocol.deactivate)

    def on_cleanup(self, state: State) -> TransitionCallbackReturn:
        """Leave the cell and reset to unconfigured; rejected in mid-run, since the run needs the node's blocks."""
        if self.protocol.takes_part:
            self.get_logger().warning(
                "cleanup refused in the middle of a run; activate to go on, or shutdown to give up"
            )
            return TransitionCallbackReturn.FAILURE
        return self._transition(state, "unconfigured", self._clean_up)

    def on_shutdown(self, state: State) -> TransitionCallbackReturn:
        """Leave the cell; in mid-run the node counts as failed."""
        return self._transition(state, "finalized", self._shut_down)

    def on_error(self, state: State) -> TransitionCallbackReturn:
        """Enter the safe state: nothing is published any more."""
        self.protocol.deactivate()
        return TransitionCallbackReturn.SUCCESS

    def _transition(
        self, state: State, goal: str, step: Callable[[], None], refuse: Callable[[LatheError], None] | None = None
    ) -> TransitionCallbackReturn:
        refuse = refuse or self.fail
        try:
            step()
        except LatheError as error:
            refuse(error)
            return TransitionCallbackReturn.FAILURE
        except Exception as error:  # noqa: BLE001 - rclpy would swallow it, and the cell wait for a node that is not there
            self.get_logger().error(traceback.format_exc())
            refuse(LatheError(f"{self.get_name()}: {type(error).__name__}: {shown(error)}"))
            return TransitionCallbackReturn.FAILURE
        self.get_logger().info(f"{state.label} -> {goal}")
        self.perform_actions()
        return TransitionCallbackReturn.SUCCESS

    def _refusing(self, change: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Wrap a lifecycle service so that an invalid transition is rejected without rclpy's exception."""

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
        declare.release(self, self.role.tunable)
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

    def _withdraw(self, error: LatheError) -> None:
        """Remain unconfigured, with parameters that can be set."""
        self.get_logger().error(f"remains unconfigured: {error}")
        if self.role is not None:
            self.role.clean_up()
        declare.release(self, self.table.rows())
        self._forget()

    def _effective(self, role: Role) -> NodeParameters:
        """Return the parameters with the command line's remapping rules written into ``remap``."""
        rules = [f"{topic}:={self.topic(topic).removeprefix(self.namespace)}" for topic in role.relative_topics()]
        changed = sorted({rule for rule in rules if rule.split(":=")[0] != rule.split(":=")[1]})
        return self.table.model_copy(update={"remap": changed})

    def _activate(self) -> None:
        assert self.role is not None, "the node is configured"
        if not self._host:
            self._begin_to_exchange()
            self.role.activate()
        self.activate()
        self.reporter("active", self.get_name(), pid=os.getpid())

    def _begin_to_exchange(self) -> None:
        """Create the publishers and subscriptions of the protocol."""
        add = self.create_publisher
        messages.encode(_PROGRESS, Progress("", "", 0, 0, 0))  # the first time takes 2 ms, too long for a running cell
        self._host = {
            "members": add(Member, "members", latched_qos(1)),
            "progress": add(ProgressMessage, "progress", latched_qos(1)),  # a late reader needs the newest one
            "diagnostics": add(DiagnosticArray, "/diagnostics", QoSProfile(depth=100)),
        }
        if isinstance(self.protocol, TimeMasterProtocol):
            self._host["cell_state"] = add(CellStateMessage, "cell_state", latched_qos(1))
        self.subscribe(Member, "members", self._on_member, latched_qos(_LATCHED_DEPTH))
        self.subscribe(CellStateMessage, "cell_state", self._on_cell_state, latched_qos(), always=True)
        add(Empty, f"~/{messages.ALIVE}", liveliness())
        self.watch, self.listens = Watch(self), True

    def _clean_up(self) -> None:
        assert self.role is not None, "the node is configured"
        self.role.clean_up()
        self.protocol.clean_up()
        if self._host:
            self.perform_actions()
            self._wait_for_acknowledgement([self._host["members"]], self.protocol.patience)
            self.watch.close()
        destroyers: list[Any] = [self.destroy_publisher, self.destroy_subscription, self.destroy_service]
        for before, now, destroy in zip(self._endpoints_of_rclpy, self._endpoints(), destroyers, strict=True):
            for endpoint in now - before:
                destroy(endpoint)
        declare.release(self, self.table.rows())
        self._forget()

    def _shut_down(self) -> None:
        if not self.protocol.takes_part:
            self.finish()
        self.protocol.shut_down(time.monotonic())

    def end_by(self, signal: str) -> None:
        """End the node because of a signal: in a run together with the cell (see `MemberProtocol.end_by`)."""
        self.attempt(self.protocol.end_by, signal, time.monotonic())

    def interrupt(self, signal: str) -> None:
        """Announce to the other members that this process ends at once, by a signal."""
        self.protocol.interrupt(signal)
        self.perform_actions()
        if self._host and self.protocol.failure:
            self._wait_for_acknowledgement([self._host["members"]], self.protocol.patience)

    def _endpoints(self) -> list[set[Any]]:
        return [set(self.publishers), set(self.subscriptions), set(self.services)]

    # ---- parameters ---------------------------------------------------------------------------------

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set parameters of an unconfigured node, or tune those of a configured one (extends `rclpy.node.Node`)."""
        try:
            parameters = [each if self._passes(each) else self._checked(each) for each in parameter_list]
            own = {each.name: each.value for each in parameters if not self._passes(each)}
            how = self.role.tune(own) if self.role is not None and own else ""
        except LatheError as error:
            return SetParametersResult(successful=False, reason=str(error))
        result = super().set_parameters_atomically(parameters)
        result.reason = result.reason or how
        return result

    def _passes(self, parameter: Parameter) -> bool:
        """Return True if rclpy alone handles a change: of its own parameter, or the deletion of an unknown one."""
        name = parameter.name
        deleted = (
            parameter.type_ == Parameter.Type.NOT_SET and name not in self.table.rows() and self.has_parameter(name)
        )
        return declare.is_of_rclpy(name) or deleted

    def _checked(self, parameter: Parameter) -> Parameter:
        checked = declare.checked(self.get_name(), type(self.table), parameter)
        if self.role is not None and checked.name not in self.role.tunable:
            raise InputError(f"{self.get_name()}.{checked.name} is read-only: {self._cure(checked.name)}")
        return checked

    def _cure(self, name: str) -> str:
        """Return why a parameter is read-only, and what takes its place."""
        assert self.role is not None, "the node is configured"
        if name in ("events", "faults") and self.role.relative_topics():
            return f"the service {self.full_name}/schedule schedules an event in a run"
        before = f"before a run, 'ros2 lifecycle set {self.full_name} cleanup' lets it be set"
        if name in SharedParameters.model_fields:
            return f"it is the same in all nodes of the cell; {before} in each"
        tunable = f"; allowed now: {', '.join(self.role.tunable)}" if self.role.tunable else ""
        alike = self.kind != RECORDER and not isinstance(self.table, TimeMasterParameters)
        bag = f", 'lathe resim BAG --set {self.get_name()}.{name}=VALUE' shows its effect on a recorded run" * alike
        return f"the node is configured with it{tunable}; {before}{bag}"

    def show_parameters(self, table: NodeParameters, names: Sequence[str]) -> None:
        """Let clients read the values that events have given to parameters."""
        values = {name: getattr(table, name) for name in names}
        changed = [Parameter(name, value=value) for name, value in values.items() if value != self._value(name)]
        if changed:
            super().set_parameters_atomically(changed)

    def _value(self, name: str) -> Any:
        return self.get_parameter(name).value

    # ---- events of the protocol ---------------------------------------------------------------------

    def now(self) -> float:
        """Return the monotonic time [s] (implements `MemberHost`)."""
        return time.monotonic()

    def has_ended(self, member: Announcement) -> bool:
        """Return True if the process of an announcement is known to have ended (implements `MemberHost`)."""
        return has_ended(member)

    def first_sample(self) -> int:
        """Return the sample at which the run begins (implements `MemberHost`)."""
        begun = self.begun()
        return begun.sample if begun else 0

    def _on_member(self, data: bytes, sender: str) -> None:
        self.hear_member(from_ros("members", data, Member, Announcement), sender)

    def _on_cell_state(self, data: bytes, sender: str) -> None:
        self.hear_cell_state(from_ros("cell_state", data, CellStateMessage, CellState), sender)

    def look(self) -> None:
        """Pass the time, the state of the other members and the ROS graph to the protocol (implements `MemberHost`)."""
        protocol = self.protocol
        self.watch.look()
        protocol.look(time.monotonic(), self.watch.silent, self.watch.ended())
        self.next_tick = min(self.next_tick, protocol.look_due)
        if protocol.wants_match:
            protocol.matched(list(graph.unmatched(self, self.inlets, self.outlets, protocol, self.exchange)))
        elif protocol.master is None:
            protocol.unmatched = [topic for topic, inlet in self.inlets.items() if not inlet.get_publisher_count()]
        self.perform_actions()

    def tick(self, now: float) -> None:
        """Do the periodic work that is due by wall time; it touches no sample."""
        self.next_tick = now + (_IDLE_TICK if self.protocol.ready else _TICK)
        if not self._host:
            return
        for topic, publisher in list(self._nameless):
            self._name(topic, publisher)
        self.look()
        self._read_elsewhere = self._host["progress"].get_subscription_count() > 1
        if self.role is not None:
            self.next_tick = min(self.next_tick, self.role.tick(now))
        if now >= self._diagnostics_due:
            self._diagnostics_due = now + _DIAGNOSTICS_PERIOD
            self._report_unfit()
            self._publish_diagnostics()

    def finish(self) -> None:
        """Write the remaining data and close the files."""
        if self.role is not None:
            self.role.finish()

    # ---- requests of the protocol -------------------------------------------------------------------

    def send(self, action: actions.Action) -> None:
        """Publish a message of the protocol, or perform another of its requests (implements `MemberHost`)."""
        match action:
            case actions.Announce(member):
                if self._host:
                    self._host["members"].publish(Member(**asdict(member)))
            case actions.Say(state):
                self._host["cell_state"].publish(CellStateMessage(**asdict(state)))
            case actions.Tell(progress):
                self._tell(progress)
            case actions.Follow(member, by_liveliness):
                self.watch.follow(member, by_liveliness=by_liveliness)
            case actions.Log(level, text):
                self._log(level, text)
            case actions.Report(event, values):
                self.reporter(event, self.get_name(), **values)
            case actions.Leave(patience):
                self._leave(patience)

    def _log(self, level: str, text: str) -> None:
        if level == "error":  # rclpy rejects different levels from one line
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

    def _tell(self, progress: Progress) -> None:
        if self.exchange.master:
            self.exchange.master(progress)
        if not self.exchange.master or self._read_elsewhere:
            self._host["progress"].publish(messages.encode(_PROGRESS, progress))

    def _wait_for_acknowledgement(self, publishers: Sequence[Publisher], patience: float) -> None:
        """Wait until all readers have acknowledged; a stuck one uses up the patience of a process only once."""
        for publisher in publishers:
            began = time.monotonic()
            left = max(patience - self.exchange.waited, min(patience, _BRIEF))
            if not publisher.wait_for_all_acked(Duration(seconds=left)):
                self.exchange.waited += time.monotonic() - began
                self.get_logger().warning(f"{publisher.topic}: not everybody has acknowledged the last message")

    # ---- topics -------------------------------------------------------------------------------------

    def topic(self, relative: str) -> str:
        """Return the fully qualified name of a relative topic after all remapping."""
        return str(self.resolve_topic_name(remapped(self.table, relative)))

    def subscribe(
        self,
        kind: type,
        topic: str,
        callback: Callable[[bytes, str], object],
        qos: QoSProfile,
        *,
        always: bool = False,
    ) -> Subscription:
        """Subscribe to encoded messages; the callback gets each with the name of the node that has published it.

        Args:
            kind: class of the messages.
            topic: name of the topic.
            callback: function of the message and the fully qualified name of its publisher, as DDS knows it.
            qos: quality of service.
            always: call it also after the node has failed.
        """
        full = self.resolve_topic_name(topic)
        named = self.guarded(callback, always=always)

        def call(data: bytes, publisher: bytes) -> None:
            if (sender := self._senders.get(publisher)) is not None:
                named(data, sender)
                return
            most = MOST_DEFERRED * signal_depth(self.table.window)
            waiting = self._nameless.setdefault((full, publisher), deque(maxlen=most))
            waiting.append((named, data, time.monotonic()))
            self._name(full, publisher)

        # `lathe_rc.nodes.executor` hands the publisher over as well.
        return self.create_subscription(kind, topic, cast("Callable[[bytes], None]", call), qos, raw=True)

    def _name(self, topic: str, publisher: bytes) -> None:
        """Hand over the messages of a publisher once the ROS graph names its node."""
        self._senders = graph.senders(self, topic) | self._senders if len(self._senders) < _MOST_SENDERS else {}
        sender, waiting = self._senders.get(publisher), self._nameless[topic, publisher]
        while sender is not None and waiting:
            named, data, _ = waiting.popleft()
            named(data, sender)
        if waiting and time.monotonic() > waiting[0][2] + _NAMELESS:
            waiting.clear()
            self.refuse(ForeignMessage(topic, "", "", "the ROS graph names no node for its publisher"))
        if not waiting:
            self._nameless.pop((topic, publisher), None)

    def listen(
        self, topic: str, msgtype: str, callback: Callable[[bytes, str], object], inside: Callable[[Any], object]
    ) -> None:
        """Subscribe to a signal topic, over DDS or inside this process.

        Args:
            topic: fully qualified name.
            msgtype: message type.
            callback: called with the encoded message from DDS, and the name of the node that has published it.
            inside: called instead with the `lathe_rc.protocol.exchange.Delivery` of a node of this process.
        """
        if self.exchange.has(topic):
            self.exchange.listen(topic, self.full_name, self.guarded(self.in_turn(inside)))
            return
        qos = signal_qos(self.table, topic)
        self.inlets[topic] = self.subscribe(message_class(msgtype), topic, self.in_turn(callback), qos)

    def begun(self) -> Checkpoint | None:
        """Return the checkpoint that the time master announces; None: the run begins at sample 0.

        Raises:
            InputError: the file is no checkpoint, or was made by another version of this node's code.
        """
        tables = {self.get_name(): self.table.model_copy(update={"stage": self.kind})}
        master = self.protocol.master
        if master is not None and self.protocol.parameter(master.name, START_FROM):
            tables |= self.announced([master.name])[0]
        return begun_of(tables)

    def announced(self, names: Sequence[str]) -> graph.Announced:
        """Return the parameters and topics announced by the members (see `lathe_rc.nodes.graph.announced`)."""
        return graph.announced(self.protocol.members, names, self.namespace, self._report_unknown)

    def _report_unknown(self, name: str, stage: str, why: str) -> None:
        if name not in self._unknown:
            self._unknown.add(name)
            self.get_logger().info(f"{name}, stage {shown(repr(stage))}, is known by its topics alone: {why}")

    # ---- diagnostics --------------------------------------------------------------------------------

    def refuse(self, message: ForeignMessage) -> None:
        """Count a rejected message under the protocol's relative topic name if it has one (implements `MemberHost`)."""
        self.refused_messages.refuse(message.on(self.resolve_topic_name(message.topic)))

    def _report_unfit(self) -> None:
        """Report each publisher once whose quality of service does not fit."""
        for topic, name, why in set(graph.unfit(self, self.inlets)) - self._unfit:
            self._unfit.add((topic, name, why))
            if topic in self.table.volatile_inputs and not self.table.window:
                self._subscribe_anew(topic)
                continue
            told = (
                f"a publisher offers a quality of service that does not fit ({why}); if it is a device that keeps no "
                f"messages, add {topic} to {self.get_name()}.volatile_inputs; if it is best effort, with window: 0"
            )
            self.refuse(ForeignMessage(topic, name, "", told))

    def _subscribe_anew(self, topic: str) -> None:
        """Replace the subscription to a device by one with the quality of service that its publishers offer."""
        before, offers = self.inlets[topic], self.get_publishers_info_by_topic(topic)
        kind, callback = before.msg_type, before.callback
        self.inlets[topic] = self.create_subscription(kind, topic, callback, asked(offers), raw=True)
        self.destroy_subscription(before)
        self.get_logger().info(f"{topic} is read as its device sends it: lost blocks are held and counted")

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
        # Wall time, also with use_sim_time: reports derive the pace from it.
        message.header.stamp = Clock().now().to_msg()
        self._host["diagnostics"].publish(message)


def from_ros(topic: str, data: bytes, ros: type, kind: type[T]) -> T:
    """Decode a ROS message to the protocol's message class of the same name.

    Raises:
        ForeignMessage: the bytes are no such message.
    """
    try:
        message: Any = deserialize_message(data, ros)
    except RuntimeError as error:
        raise ForeignMessage(topic, "", "", str(error).splitlines()[0]) from None
    values = {field.name: getattr(message, field.name) for field in fields(kind)}  # type: ignore[arg-type]
    return kind(**{name: tuple(value) if isinstance(value, list) else value for name, value in values.items()})
