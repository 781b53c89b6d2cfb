# SPDX-License-Identifier: Apache-2.0
"""A node that discards a subscription while an event of it is on its way."""

from functools import partial

import pytest

pytest.importorskip("rclpy")

import rclpy
from rclpy.event_handler import SubscriptionEventCallbacks
from std_msgs.msg import Empty

from lathe_rc.nodes.events import Events


@pytest.fixture
def watcher(ghost):
    node = rclpy.create_node("watcher")
    node.discarded = []
    yield node
    node.destroy_node()


def test_an_event_of_what_has_been_discarded_is_dropped(ghost, watcher):
    """Had it been destroyed at once, EventsExecutor would raise InvalidHandle, or crash the process."""
    matched, discarded = [], []
    publisher, go = ghost.create_publisher(Empty, "/watched", 1), ghost.create_publisher(Empty, "/go", 1)
    events_of = SubscriptionEventCallbacks(matched=matched.append)
    watched = watcher.create_subscription(Empty, "/watched", lambda _: None, 1, event_callbacks=events_of)

    def discard(_):
        if discarded:
            return
        watcher.discarded.append(partial(watcher.destroy_subscription, watched))
        ghost.destroy_publisher(publisher)
        while watched.get_publisher_count():  # from then on the event is on its way
            pass
        discarded.append(True)

    watcher.create_subscription(Empty, "/go", discard, 1)
    events = Events([watcher])
    while not matched:
        events.spin(0.1)
    while not discarded:
        go.publish(Empty())
        events.spin(0.1)
    heard = []
    watcher.create_subscription(Empty, "/go", heard.append, 1)
    while not heard:  # then the event has had its turn as well
        go.publish(Empty())
        events.spin(0.1)
    assert len(matched) == 1
    assert not watcher.discarded
