# SPDX-License-Identifier: Apache-2.0
"""Executable: the ``replayer``, which publishes the messages of any bag again, with /clock."""

import json
import tempfile
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import Any

from builtin_interfaces.msg import Time
from lathe_rc_msgs.msg import CellState, Member, Progress
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.task import Future
from rosgraph_msgs.msg import Clock

from lathe_bagtools.nodes import keys, replayed_qos
from lathe_bagtools.nodes.replay_services import ReplayServices
from lathe_bagtools.nodes.replayed_qos import DEPTH
from lathe_rc.bag import provenance
from lathe_rc.bag.reading.limits import MOST_BEFORE, MOST_SENT
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.bag.reading.storage import Message
from lathe_rc.cell.beside import REPLAYED_FILES, ReplayerParameters
from lathe_rc.cell.beside import REPLAYER as KIND
from lathe_rc.cell.parameters import remapped
from lathe_rc.cell.recorder import KIND as RECORDER
from lathe_rc.cell.scenario import kind_of
from lathe_rc.cell.time_master import TimeMaster
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.names import instead
from lathe_rc.nodes import standalone_node
from lathe_rc.nodes.ports import latched_qos, message_class
from lathe_rc.nodes.standalone_node import StandaloneNode

_ACKNOWLEDGED = 30.0  # [s] for a reader to acknowledge its messages
_CLOCK, _STATE = "/clock", "/cell_state"
_CLOCK_END = 2**31 * 10**9  # [ns] first time beyond the range of a ROS time
# [ns] of wall time within which a message must be acknowledged before others follow: a reader that sorts messages by
# their publication then need not wait much longer for a late one
_PROMPT = 100_000_000
_SETBACK = 1_000_000_000  # [ns] by which the system clock may be set back without harm
_LONG = 10.0  # [s] of wall time until the next message, from which on the wait is reported
_SETTLED = 0.5  # [s] of wall time without a new reader or node, after which the replay begins
_ALONE = 4.0  # [s] the same while no other node is found: participants announce themselves again every 3 s
_LOOK = 0.05  # [s] of wall time between polls of services and signals


class _Pace:
    """Wall time at which each message of a replay is due.

    Args:
        rate: pace against the bag's time; 0: every message is due at once.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._origin_ns: int | None = None  # log time of the bag that is due at `_began`
        self._began = self._delay = 0.0  # monotonic time, and wait before it [s]

    def begin(self, delay: float = 0.0) -> None:
        """Begin with the next message, after a delay [s]."""
        self._origin_ns, self._delay = None, delay

    def due(self, log_ns: int) -> float:
        """Return the monotonic time at which a message is due [s]."""
        if self._origin_ns is None:
            self._origin_ns, self._began = log_ns, time.monotonic() + self._delay
        return self._began + (log_ns - self._origin_ns) * 1e-9 / self._rate if self._rate else self._began

    def jump(self, log_ns: int) -> None:
        """Continue from a message that is sent before it is due."""
        self._origin_ns, self._began = log_ns, time.monotonic()

    def hold(self, seconds: float) -> None:
        """Postpone all messages by a pause."""
        self._began += seconds

    def change(self, rate: float, now: float, newest_ns: int) -> None:
        """Continue at another rate from the place that the replay has reached.

        Args:
            rate: new rate.
            now: monotonic time, of the begin of a pause if there is one [s].
            newest_ns: log time of the newest message: the place of a replay without a pace.
        """
        if self._origin_ns is not None:
            passed = round((now - self._began) * self._rate * 1e9)
            self._origin_ns = self._origin_ns + passed if self._rate else newest_ns
        self._rate, self._began = rate, now


@dataclass
class _Steps:
    """Messages that a client has asked for in a pause: those left, those sent, and the answer."""

    left: int
    sent: int = 0
    over: Future = field(default_factory=Future)


class Replayer:
    """Publisher of the messages of a bag, in the order of their log times.

    Args:
        node: node with the topic /clock and the services (see `replay_services`).
        parameters: topics, speed and options of the replay.
        source: the bag.
        pressed: function that returns the keys pressed since its last call.

    Attributes:
        paused: whether the replay waits.
        sent: number of messages sent.

    Raises:
        InputError: the bag lacks a topic, or a message type is not installed on this machine.
    """

    def __init__(
        self,
        node: StandaloneNode,
        parameters: ReplayerParameters,
        source: BagSource,
        pressed: Callable[[], list[str]] = list,
    ) -> None:
        self._node, self._parameters, self._source = node, parameters, source
        if parameters.as_cell and any(
            (parameters.loop, parameters.start, parameters.end, parameters.topics, parameters.remap)
        ):
            raise InputError(
                f"{KIND}.as_cell: a cell is replayed whole and once; leave out loop, start, end, topics and remap"
            )
        self._topics = set(parameters.topics) or set(self._source.topics) - {_CLOCK}
        if unknown := sorted(self._topics - set(self._source.topics)):
            known = instead(unknown[0], sorted(self._source.topics), listing=f"lathe bag info {parameters.bag}")
            raise InputError(f"{KIND}.topics: {unknown[0]} is not in the bag; {known}")
        if _CLOCK in self._topics:
            raise InputError(f"{KIND}.topics: {_CLOCK} is the replayer's own and tells the log times of the bag")
        if len(self._topics) > MOST_SENT:
            count = len(self._topics)
            raise InputError(f"{parameters.bag}: {count} topics; allowed: up to {MOST_SENT}, named by --topics")
        start, end, span_ns = parameters.start, parameters.end, source.last_ns - source.first_ns
        if _ns(start) > span_ns or 0.0 < end <= start:
            raise InputError(
                f"{KIND}.start = {start:.16g} s, end = {end:.16g} s: nothing to send; allowed: a start up to "
                f"{_seconds(span_ns)} s, where the bag's last message is, and an end after it, or 0"
            )
        self._start_ns = source.first_ns + _ns(start)
        self._stop_ns = min(source.first_ns + _ns(end) if end else source.last_ns + 1, self._loss_ns())
        for topic, log_ns, _ in source.messages(
            self._topics, start_ns=max(self._start_ns, _CLOCK_END), stop_ns=self._stop_ns
        ):
            room = _CLOCK_END - source.first_ns
            cure = f"{KIND}.end = {_seconds(room)} s leaves them out" if room > _ns(start) else "name other topics"
            raise InputError(f"{parameters.bag}: {topic}: log time {log_ns} ns; {_CLOCK} ends in 2038; {cure}")
        self._classes = {topic: self._class(topic) for topic in sorted(self._topics)}
        self._names = _remapped(parameters.remap, {*self._topics, _CLOCK})
        path = parameters.qos_overrides
        overrides = replayed_qos.overrides(Path(path), self._topics) if path else {}
        self._qos = {
            topic: replayed_qos.of(self._source.topics[topic].qos, overrides.get(topic)) for topic in self._topics
        }
        self.paused = parameters.start_paused
        self.sent = 0
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self._looked = 0.0
        self._pace, self._held_since, self._newest_ns = _Pace(parameters.rate), 0.0, self._start_ns
        self._sought: int | None = None  # log time at which to continue [ns]
        self._stopped = False
        self._steps: deque[_Steps] = deque()
        self._pressed = pressed
        node.tunes("rate", self._take_rate)
        try:
            ReplayServices(node, self)
        except ImportError:
            node.get_logger().info("no services: rosbag2_interfaces, their package, is not installed")
        self._members: dict[str, Node] = {}
        self._master, self._window = "", 0  # of a cell: topic whose blocks count, and blocks in flight
        self._blocks = self._recorded = 0
        # Reliable and with a queue, unlike other clocks: readers may need every time.
        self._publishers: dict[str, Publisher] = {
            _CLOCK: node.create_publisher(Clock, self._names.get(_CLOCK, _CLOCK), QoSProfile(depth=DEPTH))
        }
        self._waiting: Counter[str] = Counter()  # messages of a topic that may not have been acknowledged
        self._sent_ns = self._settled_ns = 0  # wall time of the newest message, and when all were acknowledged

    def _class(self, topic: str) -> Any:
        kind = self._source.topics[topic].type
        try:
            return message_class(kind)
        except (ImportError, AttributeError, ValueError):
            raise InputError(
                f"{topic}: message type {kind} is not installed; install its package, or name other topics"
            ) from None

    # ---- control ------------------------------------------------------------------------------------

    @property
    def rate(self) -> float:
        """Return the pace against the bag's time; 0: none."""
        return float(self._node.get_parameter("rate").value)

    def change_rate(self, rate: float) -> bool:
        """Continue at another rate; return False if it is refused."""
        (result,) = self._node.set_parameters([Parameter("rate", value=rate)])
        return bool(result.successful)

    def _take_rate(self, rate: float) -> None:
        """Continue at another rate; the pause of a paused replay goes on."""
        self._pace.change(rate, self._held_since if self.paused else time.monotonic(), self._newest_ns)

    def seek(self, log_ns: int) -> bool:
        """Continue at a time of the bag; return False if it is outside of what is replayed."""
        if self._parameters.as_cell or not self._source.first_ns <= log_ns < self._stop_ns:
            return False
        self._sought = log_ns
        return True

    def step(self, messages: int) -> Future:
        """Send the next messages of a paused replay at once, 0: all; the result is their number."""
        self._steps.append(_Steps(messages or 2**64))
        return self._steps[-1].over

    def _end_steps(self) -> None:
        """Answer all who wait for messages that do not come any more."""
        while self._steps:
            self._steps[0].over.set_result(self._steps.popleft().sent)
            self._look()

    def stop(self) -> None:
        """End the replay."""
        self._stopped = True

    def _press(self, key: str) -> None:
        if key == "space":
            self.paused = not self.paused
        elif key == "right" and self.paused:
            self.step(1)
        elif key in ("up", "down"):
            self.change_rate(self.rate * (1.1 if key == "up" else 1 / 1.1))

    # ---- start --------------------------------------------------------------------------------------

    def open(self) -> None:
        """Create the publishers and wait for readers; as a cell, wait until a recorder is ready."""
        if self._parameters.as_cell:
            self._join()
        else:
            for topic in sorted(self._topics):
                self._publish(self._node, topic)
        for what in (*self._source.contradictions, *(f"not sent: {each}" for each in self._source.unread)):
            self._node.get_logger().warning(what)
        if _CLOCK in self._source.topics:
            self._node.get_logger().info(f"{_CLOCK} of the bag is left out: the replayer's tells the log times")
        while lonely := [topic for topic in sorted(self._topics) if self._readers(topic) < self._parameters.wait]:
            self._node.get_logger().info(f"waiting for readers of {', '.join(lonely)}", throttle_duration_sec=5.0)
            self._look(_LOOK)
        if not self._parameters.as_cell:
            self._find_readers()

    def _find_readers(self) -> None:
        """Wait until no further reader is found: readers that are there already receive the first message."""
        before, since = [-1], time.monotonic()
        while time.monotonic() - since < (_SETTLED if before[-1] > 1 else _ALONE):
            found = [*map(self._readers, sorted(self._topics)), len(self._node.get_node_names())]
            if found != before:
                before, since = found, time.monotonic()
            self._look(_LOOK)

    def _readers(self, topic: str) -> int:
        return int(self._publishers[topic].get_subscription_count())

    def _publish(self, node: Node, topic: str) -> None:
        name = self._names.get(topic, topic)
        try:
            self._publishers[topic] = node.create_publisher(self._classes[topic], name, self._qos[topic])
        except InvalidTopicNameException as error:
            reason = shown(error).removeprefix("Invalid topic name: ").rstrip(":")
            raise InputError(f"{name}: no name in ROS ({reason}); name others with --topics or --remap") from None

    def _join(self) -> None:
        """Announce the bag's nodes with their topics, and a recorder; begin when the recorder is ready."""
        ready: list[str] = []

        def heard(member: Any) -> None:
            if member.state == Member.READY:
                ready.append(member.name)

        def progressed(progress: Any) -> None:
            if progress.name == f"/{RECORDER}":
                self._recorded = int(progress.blocks)

        self._node.create_subscription(Member, "/members", heard, latched_qos(256))
        self._node.create_subscription(Progress, "/progress", progressed, latched_qos(256))
        # The recorder copies the scenario's files into its bag as well, so they exist as long as the replayer.
        self._folder = tempfile.TemporaryDirectory(prefix=REPLAYED_FILES)
        scenario = provenance.scenario_of(self._source.about, Path(self._folder.name))
        cell = Cell(scenario.nodes)
        self._announced = []
        for name, stage in cell.stages.items():
            member = self._members[name] = Node(name, context=self._node.context)
            sparse = {remapped(stage.shared, topic): kind for topic, kind in stage.sparse_topics.items()}
            dense = {remapped(stage.shared, port.topic): port.type for port in stage.outputs}
            for topic in {**dense, **sparse}:
                self._publish(member, f"/{topic}")
            publisher = member.create_publisher(Member, "/members", latched_qos(1))
            everybody = [*(f"/{other}" for other in cell.stages), f"/{RECORDER}"]
            publisher.publish(
                Member(
                    run_id=scenario.shared.run_id,
                    name=f"/{name}",
                    stage=kind_of(stage.name, stage.shared.stage),
                    state=Member.READY,
                    members=everybody if isinstance(stage, TimeMaster) else [],
                    publishes=[f"/{topic}" for topic in (*dense, *sparse)],
                    types=[*dense.values(), *sparse.values()],
                    sparse=[*(False for _ in dense), *(True for _ in sparse)],
                    parameters=json.dumps(stage.shared.model_dump()),
                )
            )
            self._announced.append(publisher)
        self._topics &= set(self._publishers)
        self._publishers[_STATE] = self._node.create_publisher(CellState, _STATE, latched_qos(1))
        # A member becomes ready once it knows that the cell is not running yet.
        self._publishers[_STATE].publish(CellState(run_id=scenario.shared.run_id, state=CellState.WAITING))
        self._ended = CellState(run_id=scenario.shared.run_id, state=CellState.ENDED)
        self._window = scenario.shared.window
        self._master = f"/{remapped(cell.master.shared, 'encoder')}"
        self._node.get_logger().info("waiting for a recorder")
        while f"/{RECORDER}" not in ready:
            self._look(0.1)

    # ---- run ----------------------------------------------------------------------------------------

    def _look(self, wait: float = 0.0) -> None:
        """Process pending messages and service requests."""
        for key in self._pressed():
            self._press(key)
        self._executor.spin_once(timeout_sec=wait)
        self._looked = time.monotonic()

    def run(self) -> None:
        """Publish all messages of the bag, repeatedly if so configured.

        Raises:
            LatheError: a reader does not accept the messages.
        """
        self.open()
        while True:
            self._once()
            if not self._parameters.loop or self._stopped:
                break
        self._end_steps()
        for topic in self._publishers:
            self._acknowledged(topic)
        if self._parameters.as_cell:
            self._let_go()

    def _let_go(self) -> None:
        """Announce the end of the cell, once the recorder has all messages, so that it leaves."""
        self._until(lambda: self._recorded >= self._blocks)
        self._send(_STATE, self._ended)
        self._acknowledged(_STATE)

    def _chosen(self, start_ns: int) -> Iterator[Message]:
        if start_ns > self._source.first_ns:
            yield from self._latched(start_ns)
        yield from self._source.messages(self._topics, start_ns=start_ns, stop_ns=self._stop_ns)

    def _loss_ns(self) -> int:
        """Return the time at which members of the recorded cell were lost [ns], and say so.

        Raises:
            InputError: the bag is to be replayed as a cell, which would be recorded as a whole run.
        """
        if loss := self._source.loss:
            said = f"{self._parameters.bag}: {loss}"
            if self._parameters.as_cell:
                raise InputError(f"{said}; allowed as a cell: a bag of a run that nothing interrupted")
            self._node.get_logger().warning(said)
        return self._source.loss_ns

    def _latched(self, start_ns: int) -> Iterator[Message]:
        """Yield the latched messages from before the start, up to the publishers' depth, as for a late reader."""
        kept: dict[str, deque[Message]] = {}
        for topic in sorted(self._topics):
            if self._qos[topic].durability == DurabilityPolicy.TRANSIENT_LOCAL:
                kept[topic] = deque(maxlen=replayed_qos.kept(self._source.topics[topic].qos))
        size = 0
        for message in self._source.messages(set(kept), stop_ns=start_ns):
            messages = kept[message[0]]
            size += len(message[2]) - (len(messages[0][2]) if len(messages) == messages.maxlen else 0)
            if size > MOST_BEFORE:
                raise InputError(f"latched messages from before the start take more than {MOST_BEFORE} B; begin at 0")
            messages.append(message)
        for topic, _, data in sorted(chain.from_iterable(kept.values()), key=itemgetter(1)):
            yield topic, start_ns, data

    def _once(self) -> None:
        """Publish the messages from the start, or from where a client seeks, to the end."""
        start_ns = self._start_ns
        self._pace.begin(self._parameters.delay)
        while True:
            if self._sought is not None:
                start_ns, self._sought = self._sought, None
                self._pace.begin()
            self._from(start_ns)
            if self._sought is None:
                return

    def _from(self, start_ns: int) -> None:
        told: int | None = None
        for topic, log_ns, data in self._chosen(start_ns):
            if (wait := self._pace.due(log_ns) - time.monotonic()) > _LONG + self._parameters.delay:
                offset = _seconds(log_ns - self._source.first_ns)
                self._node.get_logger().warning(
                    f"{topic}: the next message comes in {_span(wait)}; start = {offset} begins with it"
                )
            if not self._wait_for(log_ns):
                return
            self._newest_ns = log_ns
            if log_ns != told:
                told = log_ns
                self._send(_CLOCK, Clock(clock=Time(sec=log_ns // 10**9, nanosec=log_ns % 10**9)))
            if topic == self._master:
                self._hold()
            self._send(topic, data)
            self.sent += 1

    def _send(self, topic: str, message: Any) -> None:
        """Publish a message with a later wall-clock stamp than all before it, since readers sort by the stamp."""
        if time.time_ns() - self._settled_ns > _PROMPT:
            for other in self._publishers:
                self._acknowledged(other)
            self._settled_ns = time.time_ns()
        while (back := self._sent_ns - time.time_ns()) >= 0:
            if back > _SETBACK:
                raise LatheError(f"the computer's clock was set back by {back * 1e-9:.1f} s")
        try:
            self._publishers[topic].publish(message)
        except RuntimeError:
            if not self._node.context.ok():
                raise ExternalShutdownException from None
            raise InputError(f"{topic}: message {self.sent + 1} that is sent is none of its type") from None
        self._sent_ns = time.time_ns()
        self._waiting[topic] += 1
        if self._waiting[topic] >= DEPTH // 2:
            self._acknowledged(topic)

    def _wait_for(self, log_ns: int) -> bool:
        """Wait until a message is due, longer while paused; return False if another is wanted instead, or none."""
        while self._sought is None and not self._stopped:
            self._held_since = now = time.monotonic()
            if self._steps and not self._steps[0].left:
                self._steps[0].over.set_result(self._steps.popleft().sent)
            elif self._steps and now - self._looked <= _LOOK:
                self._steps[0].left, self._steps[0].sent = self._steps[0].left - 1, self._steps[0].sent + 1
                self._pace.jump(log_ns)
                return True
            elif self.paused and not self._steps:
                self._look(_LOOK)
                self._pace.hold(time.monotonic() - now)
            elif (wait := self._pace.due(log_ns) - now) > 0.0 and not self._steps:
                self._look(min(wait, _LOOK))
            elif now - self._looked > _LOOK:
                self._look()
            else:
                return True
        return False

    def _hold(self) -> None:
        """Limit the blocks in flight to the recorder's queue; acknowledged by DDS does not mean read."""
        self._blocks += 1
        if self._window:
            self._until(lambda: self._blocks - self._recorded <= self._window)

    def _until(self, enough: Callable[[], bool]) -> None:
        """Wait until the recorder has reported enough progress."""
        heard = time.monotonic()
        while not enough():
            before = self._recorded
            self._look(_LOOK)
            if self._recorded != before:
                heard = time.monotonic()
            elif time.monotonic() - heard > _ACKNOWLEDGED:
                raise LatheError(f"the recorder has taken nothing for {_ACKNOWLEDGED:.0f} s")

    def _acknowledged(self, topic: str) -> None:
        """Wait until all reliable readers have acknowledged the messages."""
        if self._waiting[topic] and not self._publishers[topic].wait_for_all_acked(Duration(seconds=_ACKNOWLEDGED)):
            raise LatheError(f"{topic}: a reader has taken nothing for {_ACKNOWLEDGED:.0f} s")
        self._waiting[topic] = 0


def _remapped(rules: Sequence[str], known: Collection[str]) -> dict[str, str]:
    """Parse ``FROM:=TO`` rules into names by topic."""
    names = {}
    for rule in rules:
        topic, given, name = rule.partition(":=")
        if not given or not name:
            raise InputError(f"{KIND}.remap: {rule!r}; allowed: /topic:=/other")
        if topic not in known:
            raise InputError(f"{KIND}.remap: {topic!r} is not replayed; {instead(topic, sorted(known))}")
        names[topic] = name
    return names


def _ns(seconds: float) -> int:
    """Convert a decimal time to ns exactly; a binary number of 1.7e9 s would be 238 ns coarse."""
    return int(Decimal(repr(seconds)) * 10**9)


def _seconds(time_ns: int) -> str:
    """Format a time in s, truncated to whole µs, such that `_ns` parses it exactly."""
    seconds, rest = divmod(time_ns // 1000, 10**6)
    return f"{seconds}.{rest:06d}".rstrip("0").rstrip(".")


def _span(seconds: float) -> str:
    """Format a duration in a suitable unit."""
    units = (("years", 31_556_952.0), ("days", 86_400.0), ("h", 3600.0), ("min", 60.0))
    name, unit = next(((name, unit) for name, unit in units if seconds >= 2.0 * unit), ("s", 1.0))
    return f"{seconds / unit:.3g} {name}"


def _work(node: StandaloneNode, parameters: ReplayerParameters) -> None:
    if not parameters.bag:
        raise InputError(f"{KIND}.bag is empty; name the bag's folder")
    with BagSource(Path(parameters.bag)) as source, keys.listening() as pressed:
        replayer = Replayer(node, parameters, source, pressed)
        replayer.run()
        node.get_logger().info(f"{replayer.sent} messages sent")


run, main = standalone_node.program(KIND, ReplayerParameters, _work)

if __name__ == "__main__":
    main()
