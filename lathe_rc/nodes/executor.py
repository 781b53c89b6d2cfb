# SPDX-License-Identifier: Apache-2.0
"""Executor of a process: takes the messages and requests of its nodes, and calls their callbacks."""

import time
from collections.abc import Sequence
from functools import partial
from typing import Any, cast

from rclpy.executors import Executor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.subscription import Subscription

from lathe_rc.messages import ALIVE
from lathe_rc.nodes.taking import taker

_MOST = 64  # messages of one topic or service at a time: a flood must not starve the others
# [s] between looks at requests while messages keep coming, by node and at most: a look costs as much as 20 messages of
# each node.
_LOOK, _LONGEST_LOOK = 0.02, 0.1
_SERIES = 0.1  # [s] after a request in which every wait is a look, so that a series of requests is answered at once


def _take_typed(inlet: Subscription) -> tuple[Any] | None:
    found = cast("Any", inlet.handle).take_message(inlet.msg_type, False)  # noqa: FBT003 - it has no names
    return None if found is None else found[:1]


class Events:
    """Executor of the nodes of a process, in place of rclpy's, which cost more than the messages themselves.

    The messages that have arrived are taken without a wait. A process without any waits: for messages only if it has
    looked at requests just now, otherwise for these as well. QoS events are not taken, since they can deadlock a node
    (see `lathe_rc.nodes.graph.unfit`). The callback of a raw subscription gets each message with the identity of its
    publisher (see `lathe_rc.nodes.taking`).

    Args:
        nodes: nodes of this process; they have no clients, timers and guard conditions.
    """

    def __init__(self, nodes: Sequence[Node]) -> None:
        self._nodes = nodes
        self._changed = True
        self._look_period = min(_LOOK * len(nodes), _LONGEST_LOOK)
        self._look_due = self._series_end = 0.0
        for node in nodes:
            node.executor = cast("Executor", self)

    def add_node(self, node: Node) -> None:
        """Accept a node; rclpy calls it when the node's executor is set."""

    def wake(self) -> None:
        """Note that a node has created or destroyed a publisher, subscription or service; rclpy calls it."""
        self._changed = True

    def spin(self, wait: float) -> None:
        """Call the callbacks of what has arrived; if no message has, wait for the next event, at most ``wait`` [s]."""
        if self._changed:
            self._list_endpoints()
        taken, now = self._take(), time.monotonic()
        looks = now >= self._look_due or now < self._series_end
        if self._changed or (taken and not looks):
            return
        if looks:
            self._look_due = now + self._look_period
        else:
            wait = min(wait, self._look_due - now)
        self._wait(0.0 if taken else wait, looks=looks)
        self._take()

    def _list_endpoints(self) -> None:
        self._changed = False
        # Topics of liveliness carry no messages, but each change of liveliness would end a wait.
        self._inlets = [
            (inlet, taker(inlet) if inlet.raw else partial(_take_typed, inlet))
            for node in self._nodes
            for inlet in node.subscriptions
            if not inlet.topic_name.endswith(f"/{ALIVE}")
        ]
        self._services = [service for node in self._nodes for service in node.services]
        sizes = (len(self._inlets), 0, 0, 0, len(self._services), 0)
        self._set = rclpy_implementation.WaitSet(*sizes, self._nodes[0].context.handle)

    def _take(self) -> bool:
        """Take the messages that have arrived; return True if there were any."""
        any_taken = False
        for inlet, take in self._inlets:
            for _ in range(_MOST):
                if self._changed:  # the callback may have destroyed the subscription
                    return any_taken
                if (found := take()) is None:
                    break
                any_taken = True
                inlet.callback(*found)
        return any_taken

    def _wait(self, wait: float, *, looks: bool) -> None:
        """Wait for messages, and if this is a look, also for requests, which are answered."""
        ready, services = self._set, self._services if looks else ()
        ready.clear_entities()
        for inlet, _ in self._inlets:
            ready.add_subscription(inlet.handle)
        places = [ready.add_service(service.handle) for service in services]
        ready.wait(round(wait * 1e9))
        for service, place in zip(services, places, strict=True):
            if not self._changed and ready.is_ready("service", place):
                self._answer(service)

    def _answer(self, service: Any) -> None:
        kind = service.srv_type
        with service.handle:
            for _ in range(_MOST):
                request, header = service.handle.service_take_request(kind.Request)
                if header is None:
                    return
                service.send_response(service.callback(request, kind.Response()), header)
                self._series_end = time.monotonic() + _SERIES
