# SPDX-License-Identifier: Apache-2.0
"""Event loop of a process: waits for messages, requests and events of its nodes and calls their callbacks."""

from collections.abc import Sequence
from typing import Any

from rclpy.executors import Executor
from rclpy.experimental import EventsExecutor
from rclpy.node import Node

from lathe_rc.nodes.cell_node import CellNode
from lathe_rc.nodes.ports import taken

_MOST = 64  # messages of one topic or service at a time: a flood must not starve the others


class Events:
    """Event executor of the nodes of a process.

    No publisher, subscription or service may be removed from EventsExecutor while it spins: the executor then drops
    the entity's pending events without holding the interpreter's lock, which crashes the process
    (rclpy's issue 1644). So discarded entities of a node are kept until the whole executor is replaced by a new one.

    Args:
        nodes: nodes of this process.
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
        """Wait for the next event, at most ``wait`` [s], and call its callback."""
        # EventsExecutor.spin() hangs in Jazzy and Kilted; a loop of spin_once() works and reacts to signals.
        self._executor.spin_once(timeout_sec=wait)
        if any(node.discarded for node in self._nodes):
            self._executor.shutdown()
            for node in self._nodes:
                while node.discarded:
                    node.discarded.pop()()
            self._executor = self._made()


def drain_missed_messages(node: Node) -> None:
    """Process messages and requests of a node for which no event was raised; call this periodically.

    When EventsExecutor adds a subscription or a service, rmw_fastrtps first counts the waiting messages and then sets
    the callback for new ones (since its pull request 657). A message in between raises no event, and from then on each
    event takes the previous message: the newest one waits for the next event. A cell that misses the last message
    before the start blocks forever.
    """
    for subscription in [*node.subscriptions]:
        for message, _ in taken(subscription, _MOST):
            subscription.callback(message)
    for service in [*node.services]:
        kind: Any = service.srv_type  # rclpy's type hints lack its requests and responses
        with service.handle:
            for _ in range(_MOST):
                request, header = service.handle.service_take_request(kind.Request)
                if header is None:
                    break
                service.send_response(service.callback(request, kind.Response()), header)
