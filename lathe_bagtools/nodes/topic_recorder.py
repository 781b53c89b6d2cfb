# SPDX-License-Identifier: Apache-2.0
"""Executable: the ``topic_recorder``, which records arbitrary topics in the order of publication."""

import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.subscription import Subscription

from lathe_bagtools.publication_order import Continuity, PublicationOrder, Recorded
from lathe_rc import messages
from lathe_rc.bag.writing.writer import FLUSH_PERIOD, BagWriter
from lathe_rc.blocks.wire import Decoder
from lathe_rc.cell.beside import TOPIC_RECORDER as KIND
from lathe_rc.cell.beside import TopicRecorderParameters
from lathe_rc.cell.recorder import RecorderParameters
from lathe_rc.errors import InputError, LossyRunError, shown
from lathe_rc.nodes import publisher_info, standalone_node
from lathe_rc.nodes.graph import unfit
from lathe_rc.nodes.ports import message_class, taken

_CLOCK = "/clock"
_OWN = {"/rosout", "/parameter_events"}  # topics of ROS itself, also published by this node
_LOOK = 0.05  # [s] of wall time between polls of the graph and of signals
_LOOKS = 60  # polls until earlier publishers have been discovered: 3 s, unless polling is delayed
_SILENCE = 10.0  # [s] without a message after which no earlier message is in transit any more
_AT_ONCE = 10_000  # messages taken from a topic before the next topic


class TopicRecorder:
    """Recorder of arbitrary topics into a bag.

    Args:
        node: node that subscribes.
        parameters: topics to record, and the path of the bag.

    Raises:
        InputError: no path of a bag, or the bag cannot be created there.
    """

    def __init__(self, node: Node, parameters: TopicRecorderParameters) -> None:
        self._node, self._parameters = node, parameters
        if not parameters.bag:
            raise InputError(f"{KIND}.bag is empty; name the bag's folder")
        if parameters.topics and parameters.all:
            raise InputError(f"{KIND}.all: {', '.join(parameters.topics)} are named; give one or the other")
        if parameters.sim_time and _CLOCK in parameters.topics:
            raise InputError(f"{KIND}.topics: {_CLOCK} tells the log times; record it with the wall time")
        chunks = RecorderParameters()  # as in the cell's recorder
        self._writer = BagWriter(
            Path(parameters.bag), compression=chunks.compression, chunk_size=chunks.chunk_size, about={}
        )
        self._order = PublicationOrder(
            hold_ns=round(parameters.hold * 1e9), sim_time=parameters.sim_time, began_ns=time.time_ns()
        )
        self._inlets: dict[str, Subscription] = {}
        self._publishers: dict[str, int] = {}  # number by topic, at the last look
        self._blocks = {message_class(kind): kind for kind in messages.block_types()}
        self._continuity: dict[str, Continuity] = {}
        self._ends: dict[str, tuple[bytes, bytes]] = {}  # first and newest message of the topics of blocks
        self._refused: dict[str, str] = {}  # topic -> reason why it is not recorded
        self._present: set[str] = set()  # topics that may have begun before the recording
        self._looks = 0
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self._newest = self._flushed = time.monotonic()
        self._taken = 0
        self.written = 0
        self.stopped = threading.Event()  #: set from outside to end the recording

    # ---- topics -------------------------------------------------------------------------------------

    def _wanted(self, topic: str) -> bool:
        if self._parameters.topics:
            return topic in self._parameters.topics
        if self._parameters.sim_time and topic == _CLOCK:
            return False
        return self._parameters.all or not (topic in _OWN or any(part[:1] == "_" for part in topic.split("/")))

    def _discover(self) -> None:
        """Subscribe to new topics; with simulated time, subscribe to /clock first."""
        found, count = self._node.get_topic_names_and_types(), self._node.count_publishers
        publishers = {topic: count(topic) for topic, _ in found}
        graph = {topic: types for topic, types in found if publishers[topic]}
        if self._looks <= _LOOKS:
            self._present |= graph.keys()
            self._looks += 1
            if self._looks > _LOOKS:
                self._node.get_logger().info(
                    f"{standalone_node.LISTENS}; what begins from now on is heard from its first message on"
                )
        if self._parameters.sim_time and _CLOCK not in self._inlets:
            if _CLOCK in graph:
                self._subscribe(_CLOCK, graph[_CLOCK])
            return
        if publishers != self._publishers:
            self._publishers = publishers
            for topic, _, _ in unfit(self._node, self._inlets):
                self._refused[topic] = f"{topic}: a later publisher offers less than the first; it is not recorded"
        for topic in sorted(graph):
            if self._wanted(topic) and topic not in self._inlets and topic not in self._refused:
                try:
                    self._subscribe(topic, graph[topic])
                except InputError as error:
                    if topic in self._parameters.topics:
                        raise
                    self._refused[topic] = str(error)
                    self._node.get_logger().error(str(error))

    def _subscribe(self, topic: str, types: Sequence[str]) -> None:
        publishers = self._node.get_publishers_info_by_topic(topic)
        if not publishers:
            return  # the topic has gone again
        if len(types) != 1:
            raise InputError(f"{topic} has several types: {', '.join(sorted(types))}")
        (msgtype,) = types
        try:
            kind, store = message_class(msgtype), publisher_info.installed(msgtype)
            definition, _ = store.generate_msgdef(msgtype, ros_version=2)
        except (InputError, ImportError, AttributeError, ValueError):
            raise InputError(f"{topic}: message type {msgtype} is not installed; install its package") from None
        digest = store.hash_rihs01(msgtype)
        if any(str(publisher.topic_type_hash) != digest for publisher in publishers):
            raise InputError(f"{topic}: {msgtype} is defined otherwise by the publisher than it is installed here")
        if topic != _CLOCK or not self._parameters.sim_time:
            self._writer.copy_topic(
                topic, msgtype, [*map(publisher_info.offered, publishers)], definition=definition, digest=digest
            )
        self._continuity[topic] = Continuity(whole=topic not in self._present)
        self._inlets[topic] = self._node.create_subscription(
            kind,
            topic,
            cast("Any", partial(self._take, topic)),  # rclpy's type hints lack callbacks with message info
            publisher_info.asked(publishers),
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),  # see `lathe_rc.nodes.graph.unfit`
        )
        self._node.get_logger().info(f"{topic}: {msgtype}")

    # ---- messages -----------------------------------------------------------------------------------

    def _take(self, topic: str, data: bytes, info: Mapping[str, Any]) -> None:
        sequence, source_ns = info["publication_sequence_number"], info["source_timestamp"]
        if not sequence or not source_ns:
            raise InputError("this ROS middleware does not number and stamp messages; use rmw_fastrtps_cpp")
        self._taken += 1
        self._continuity[topic].take(sequence, self._inlets[topic].get_publisher_count)
        if topic == _CLOCK and self._parameters.sim_time:
            try:
                clock = messages.decode("rosgraph_msgs/msg/Clock", data).clock
            except ValueError as error:
                raise InputError(f"{topic}: {error}") from None
            self._order.add_clock(source_ns, sequence, clock.sec * 10**9 + clock.nanosec)
        else:
            if self._inlets[topic].msg_type in self._blocks:
                self._ends[topic] = self._ends.get(topic, (data, data))[0], data
            # DDS pads messages sent in one fragment to a multiple of 4 bytes; large messages arrive unpadded.
            self._order.add(topic, source_ns, sequence, data + bytes(-len(data) % 4))

    def _take_all(self) -> bool:
        """Take the messages that have arrived; return True if none are left."""
        emptied = True
        for topic, inlet in self._inlets.items():
            before = self._taken
            for message in taken(inlet, _AT_ONCE):
                self._take(topic, *message)
            emptied = emptied and self._taken - before < _AT_ONCE
        return emptied

    def _write(self, ready: Iterable[Recorded]) -> None:
        for topic, log_ns, data in ready:
            self._writer.write(topic, log_ns, data)
            self.written += 1

    def _step(self) -> int:
        """Wait briefly for messages, take and write them; return their number."""
        before = self._taken
        # The executor wakes up for one message; the rest of a burst is taken without the executor, ten times as fast.
        self._executor.spin_once(timeout_sec=_LOOK)
        seen_ns = self._order.newest_ns
        emptied = self._take_all()
        now = time.monotonic()
        if self._taken > before:
            self._newest = now
            if emptied:
                self._write(self._order.release(seen_ns))
        elif now - self._newest > _SILENCE:
            self._write(self._order.rest())
        if now - self._flushed > FLUSH_PERIOD:
            self._flushed = now
            self._writer.flush()
        return self._taken - before

    # ---- run ----------------------------------------------------------------------------------------

    def run(self) -> None:
        """Record until stopped or until all publishers have gone; then close the bag.

        Raises:
            InputError: a named topic cannot be recorded.
            LatheError: the bag cannot be written, or /clock is not usable.
            LossyRunError: messages are missing or out of order.
        """
        looked = 0.0
        try:
            while not self.stopped.is_set():
                if time.monotonic() - looked > _LOOK:
                    self._discover()
                    looked = time.monotonic()
                if not self._step() and self._parameters.once and self._left():
                    break
            while self._step():
                pass
            self._write(self._order.rest())
            self._order.finish()
        finally:
            self._writer.close()
        self._tell()

    def _left(self) -> bool:
        """Return True if there were publishers and all of them have gone."""
        return bool(self._taken) and not any(inlet.get_publisher_count() for inlet in self._inlets.values())

    def _tell(self) -> None:
        say = self._node.get_logger().info
        if self._order.left_out:
            say(f"{self._order.left_out} messages from before the first time on {_CLOCK} are left out")
        for topic, heard in self._continuity.items():
            if topic in self._present and heard.first > 1:
                say(f"{topic} is heard from its message {heard.first} on")
        say(f"bag {self._parameters.bag} closed: {self.written} messages")
        wrong = [f"{c.missing} messages of {topic} are missing" for topic, c in self._continuity.items() if c.missing]
        if self._order.late:
            wrong.append(f"{self._order.late} messages came too late for their place, hold = {self._parameters.hold} s")
        wrong += [what for topic in sorted(self._ends) for what in self._lacking(topic)]
        wrong += self._refused.values()
        if wrong:
            raise LossyRunError(f"{self._parameters.bag}: {'; '.join(wrong)}")

    def _lacking(self, topic: str) -> Iterator[str]:
        """Yield what a topic of blocks lacks: nodes in one process do not number blocks that nobody else reads."""
        decoder = Decoder(self._blocks[self._inlets[topic].msg_type])
        try:
            first, newest = map(decoder.decode, self._ends[topic])
        except ValueError as error:
            yield f"{topic}: {shown(error)}"
            return
        if first.first_index:
            yield f"samples 0 to {first.first_index - 1} of {topic} are missing"
        if not newest.last and self._parameters.once and not self.stopped.is_set():
            yield f"{topic} ends at sample {newest.first_index + newest.samples - 1} without its last block"


def _work(node: Node, parameters: TopicRecorderParameters) -> None:
    recorder = TopicRecorder(node, parameters)
    standalone_node.set_by_signal(recorder.stopped)
    recorder.run()


run, main = standalone_node.program(KIND, TopicRecorderParameters, _work)

if __name__ == "__main__":
    main()
