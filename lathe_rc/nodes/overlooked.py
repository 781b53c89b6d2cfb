# SPDX-License-Identifier: Apache-2.0
"""Messages that have come and that nobody has announced to the executor.

When EventsExecutor takes up a subscription or a service, rmw_fastrtps first counts what has come and then sets the
callback that announces what comes (since its pull request 657). What comes in between is never announced, and from then
on each announcement takes the message before: the newest one waits for the next. A cell whose last word before the
start is overlooked stands still for ever. So a node looks itself from time to time.
"""

from typing import Any

from rclpy.node import Node

_MOST = 64  # of one topic or service at a time: a flood keeps nobody from its neighbours


def take(node: Node) -> None:
    """Hand over what waits at a node's subscriptions and services to their callbacks, as the executor does."""
    for subscription in [*node.subscriptions]:
        with subscription.handle:
            for _ in range(_MOST):
                if (found := subscription.handle.take_message(subscription.msg_type, subscription.raw)) is None:
                    break
                subscription.callback(found[0])
    for service in [*node.services]:
        kind: Any = service.srv_type  # rclpy does not say that it has requests and responses
        with service.handle:
            for _ in range(_MOST):
                request, header = service.handle.service_take_request(kind.Request)
                if header is None:
                    break
                service.send_response(service.callback(request, kind.Response()), header)
