# SPDX-License-Identifier: Apache-2.0
"""Listener to running cells that takes no part in them, for views.

It is not a member, so no sample waits for it: it gives no credit, and its subscriptions to blocks are best effort and
volatile. Status and events must not be lost, and reach a listener that comes late: these few messages are reliable and
latched, so that the nodes of a process wait at most 2 s for a stuck listener when they leave at the end of a run.
It polls its subscriptions 50 times a second: a wake-up for every message would cost the cell more than the whole
display.
"""

import os
import threading
import time
from collections.abc import Callable

from rclpy.node import Node
from rclpy.subscription import Subscription

from lathe_live.live_runs import Backlog, LiveRuns, ShownRun
from lathe_live.rerun_signals import is_drawn
from lathe_rc import messages
from lathe_rc.errors import LatheError
from lathe_rc.event_log import LOGGED
from lathe_rc.nodes.ports import message_class, overhear, taken
from lathe_rc.nodes.publisher_info import asked

_DEPTH = 4096  # messages
_BACKLOG = 2**25  # [B]: some seconds of a cell
_BURST = 16  # messages
_NICE = 10  # the view is less urgent than the cell
_PERIOD = 0.02  # [s] between polls of messages; also of the graph, like members that wait for peers
_BUSY = 0.5  # [s] between polls of the graph while messages of a run arrive


class Listener:
    """Listener that reads a cell's signal topics in one thread and shows them in another.

    Args:
        node: node in the namespace of the cell.
        live: view of the runs.
        over: returns True when nothing more is to be shown.

    Attributes:
        stopped: set from outside to end the work, after all received messages are shown.
    """

    def __init__(self, node: Node, live: LiveRuns, over: Callable[[], bool] = lambda: False) -> None:
        self._node, self._live, self._over = node, live, over
        self._backlog = Backlog(_BACKLOG)
        # Heard first: the blocks that rest on samples of lost members come after the message about the loss.
        cell_state = f"{node.get_namespace().rstrip('/')}/cell_state"
        inlet = overhear(node, cell_state, messages.CELL_STATE, _DEPTH)
        self._subscriptions: dict[str, tuple[Subscription, str]] = {cell_state: (inlet, messages.CELL_STATE)}
        self._heard = self._heard_before = 0
        self._failure: LatheError | None = None
        self.stopped = threading.Event()

    def run(self) -> list[ShownRun]:
        """Show one run after the other until stopped.

        Returns:
            The runs shown.

        Raises:
            LatheError: a malformed message, or the view cannot be written.
        """
        shower = threading.Thread(target=self._show)
        shower.start()
        os.nice(_NICE)  # only this thread; the DDS threads keep their priority, and so lose fewer messages
        due = 0.0
        try:
            while not (self.stopped.is_set() or self._over()):
                if not shower.is_alive():
                    break
                if (now := time.monotonic()) >= due:
                    due = now + (_BUSY if self._look() else _PERIOD)
                self._hear()
                time.sleep(_PERIOD)
            self._hear()
        finally:
            self._backlog.close()
            shower.join()
        if self._failure:
            raise self._failure
        return self._live.shown

    def _look(self) -> bool:
        """Subscribe to new topics and detect the end of all publishers; return True if messages have arrived."""
        namespace = self._node.get_namespace().rstrip("/") + "/"
        present = {
            topic: kind
            for topic, kinds in self._node.get_topic_names_and_types()
            for kind in kinds
            if (is_drawn(kind) or kind in self._live.urgent)
            and topic.startswith(namespace)
            and self._node.count_publishers(topic)
        }
        for topic in sorted(present.keys() - self._subscriptions.keys()):
            self._subscriptions[topic] = self._subscribe(topic, present[topic]), present[topic]
            self._node.get_logger().info(f"listens to {topic}")
        # The supervisor's blocks first: their samples tell a repetition of a run, whose id is the same.
        self._subscriptions = dict(sorted(self._subscriptions.items(), key=lambda each: each[1][1] != messages.SAFETY))
        quiet = self._heard == self._heard_before
        if quiet and self._live.present and not present:
            self._backlog.put(None)
        if present or quiet:
            self._live.present = present
        self._heard_before = self._heard
        return not quiet

    def _subscribe(self, topic: str, msgtype: str) -> Subscription:
        """Subscribe to a topic; of the supervisor's blocks, the newest one is enough."""
        if msgtype in (*LOGGED, messages.CELL_STATE):
            qos = asked(self._node.get_publishers_info_by_topic(topic))
            return self._node.create_subscription(message_class(msgtype), topic, lambda _: None, qos, raw=True)
        return overhear(self._node, topic, msgtype, 1 if msgtype == messages.SAFETY else _DEPTH)

    def _hear(self) -> None:
        """Take the received messages in turns, a few per topic, since chunks wait only briefly for late topics."""
        count = -1
        while count < (count := self._heard):
            for topic, (subscription, msgtype) in self._subscriptions.items():
                heard = [(topic, msgtype, data) for data, _ in taken(subscription, _BURST)]
                self._heard += len(heard)
                if msgtype in self._live.urgent:
                    for message in heard:
                        self._tell(*message)
                if is_drawn(msgtype):
                    self._backlog.put(*heard)

    def _tell(self, topic: str, msgtype: str, data: bytes) -> None:
        try:
            self._live.hear(topic, msgtype, data)
        except ValueError as error:
            raise LatheError(f"{topic}: {error}") from None

    def _show(self) -> None:
        """Show the received messages; main function of the second thread."""
        os.nice(_NICE)  # also for the threads that Rerun starts from this one
        try:
            for message in self._backlog:
                if message:
                    self._live.take(*message)
                else:
                    self._live.end()
            self._live.end()
        except LatheError as error:
            self._failure = error
