# SPDX-License-Identifier: Apache-2.0
"""Executable: the ``rerun_bridge``, which shows the cell in Rerun while it runs and takes no part in it.

It is no member, so nobody waits for it: it gives no credit, and what it reads it asks for as best effort and
volatile. A reliable reader would be served again what it has missed, and at the end of a run the publishers would
wait 2 s for one that is stuck. It takes what has come 50 times a second: to be woken for every message would take
more from the cell than all the showing.
"""

import os
import signal
import threading
import time
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from typing import NoReturn

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription

from lathe_rc.cell.beside import RERUN_BRIDGE as KIND
from lathe_rc.cell.beside import RerunBridgeParameters
from lathe_rc.errors import LatheError
from lathe_rc.nodes import arguments
from lathe_rc.nodes.ports import message_class
from lathe_rc.nodes.standalone_node import standalone_node
from lathe_rc.view.rerun_live import Backlog, Live, ShownRun
from lathe_rc.view.rerun_output import Output, require
from lathe_rc.view.rerun_signals import is_drawn

_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=4096,
    reliability=ReliabilityPolicy.BEST_EFFORT,
    durability=DurabilityPolicy.VOLATILE,
)
_BACKLOG = 2**25  # [B]: some seconds of a cell
_BURST = 16  # messages
_NICE = 10  # showing is less urgent than the cell
_PERIOD = 0.02  # [s] between looks at what has come; of the graph as well, as members of a cell do that wait for peers
_BUSY = 0.5  # [s] between looks at the graph while a run is heard


class RerunBridge:
    """Hears the signal topics of a cell in the main thread, and shows them in another.

    Args:
        node: in the namespace of the cell.
        parameters: what to show, and where.
        output: that it goes to.
    """

    def __init__(self, node: Node, parameters: RerunBridgeParameters, output: Output) -> None:
        self._node, self._parameters, self._output = node, parameters, output
        self._backlog = Backlog(_BACKLOG)
        self._live = Live(output.open, rate=parameters.rate, say=node.get_logger().info)
        self._subscriptions: dict[str, tuple[Subscription, str]] = {}
        self._heard = self._heard_before = 0
        self._failure: LatheError | None = None
        self._stop = False

    def stop(self, *_: object) -> None:
        """End after what has been heard is shown; a signal handler."""
        self._stop = True

    def run(self) -> list[ShownRun]:
        """Show one run after the other until it is told to stop.

        Returns:
            The runs that were shown.

        Raises:
            LatheError: a broken message, or the view cannot be written.
        """
        shower = threading.Thread(target=self._show)
        shower.start()
        os.nice(_NICE)  # of this thread alone; those of DDS keep theirs, and so lose less
        due = 0.0
        try:
            while not (self._stop or self._output.ended or (self._parameters.once and self._live.shown)):
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
        """Subscribe to what has come, and notice when everybody has gone; tells whether something is heard."""
        namespace = self._node.get_namespace().rstrip("/") + "/"
        present = {
            topic: kind
            for topic, kinds in self._node.get_topic_names_and_types()
            for kind in kinds
            if is_drawn(kind) and topic.startswith(namespace) and self._node.count_publishers(topic)
        }
        for topic in sorted(present.keys() - self._subscriptions.keys()):
            self._subscribe(topic, present[topic])
        quiet = self._heard == self._heard_before
        if quiet and self._live.present and not present:
            self._backlog.put(None)
        if present or quiet:
            self._live.present = present
        self._heard_before = self._heard
        return not quiet

    def _subscribe(self, topic: str, msgtype: str) -> None:
        subscription = self._node.create_subscription(message_class(msgtype), topic, _nothing, _QOS, raw=True)
        self._subscriptions[topic] = subscription, msgtype
        self._node.get_logger().info(f"listens to {topic}")

    def _hear(self) -> None:
        """Take what has come, some of each topic in turn: pieces wait for topics that are behind, but not for long."""
        count = -1
        while count < (count := self._heard):
            for topic, (subscription, msgtype) in self._subscriptions.items():
                take = partial(subscription.handle.take_message, subscription.msg_type, subscription.raw)
                heard = [(topic, msgtype, data) for data, _ in islice(iter(take, None), _BURST)]
                self._heard += len(heard)
                self._backlog.put(*heard)

    def _show(self) -> None:
        """Show what has been heard; the body of the other thread."""
        os.nice(_NICE)  # and of those that Rerun starts from this one
        try:
            for message in self._backlog:
                if message:
                    self._live.take(*message)
                else:
                    self._live.end()
            self._live.end()
        except LatheError as error:
            self._failure = error


def _nothing(_: bytes) -> None:
    """No executor calls back."""


def run(values: Mapping[str, object], args: Sequence[str]) -> list[ShownRun]:
    """Show what runs until Ctrl-C, the end of the viewer, or of the first run if so asked.

    Args:
        values: parameters; those of the command line of ROS come from ``args``.
        args: command line of ROS, from ``--ros-args`` on.

    Returns:
        The runs that were shown.

    Raises:
        LatheError: a parameter, Rerun, or a broken message.
    """
    require()
    signals = SignalHandlerOptions.NO
    with standalone_node(KIND, RerunBridgeParameters, values, args, signals=signals) as (node, parameters):
        output = Output(parameters.output, file=Path(parameters.file), url=parameters.url, port=parameters.port)
        with output:
            bridge = RerunBridge(node, parameters, output)
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, bridge.stop)
            return bridge.run()


def main() -> NoReturn:
    """Run the node, and exit."""

    def bridge(words: Sequence[str]) -> int:
        run({}, words)
        return 0

    arguments.executable(KIND, RerunBridgeParameters, bridge)


if __name__ == "__main__":
    main()
