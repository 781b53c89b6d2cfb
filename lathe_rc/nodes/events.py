# SPDX-License-Identifier: Apache-2.0
"""How the nodes of a process wait for messages, requests and events, and hand them to their callbacks."""

from collections.abc import Sequence

from rclpy.executors import Executor
from rclpy.experimental import EventsExecutor

from lathe_rc.nodes.shell import CellNode


class Events:
    """Waits for events of some nodes, and hands them over.

    EventsExecutor must not lose a publisher, subscription or service while it spins: an event of one that has come,
    and that it has not handed over yet, it then drops without the interpreter's lock, which crashes the process
    (rclpy's issue 1644). So what a node discards is kept until the executor has let go of everything at once; another
    one takes its place.

    Args:
        nodes: of this process.
    """

    def __init__(self, nodes: Sequence[CellNode]) -> None:
        self._nodes = nodes
        self._executor = self._made()

    def _made(self) -> Executor:
        executor = EventsExecutor()
        for node in self._nodes:
            executor.add_node(node)
        return executor

    def spin(self, wait: float) -> None:
        """Wait for the next event, up to so many seconds, and hand it over."""
        # EventsExecutor.spin() hangs in Jazzy and Kilted; a loop of spin_once() works and sees signals.
        self._executor.spin_once(timeout_sec=wait)
        if any(node.discarded for node in self._nodes):
            self._executor.shutdown()
            for node in self._nodes:
                while node.discarded:
                    node.discarded.pop()()
            self._executor = self._made()
