# SPDX-License-Identifier: Apache-2.0
"""Events of what a node has discarded, and messages and requests that no event announces."""

from functools import partial

import pytest

pytest.importorskip("rclpy")

import rclpy
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.experimental.events_executor import EventsExecutor
from std_msgs.msg import Empty, String
from std_srvs.srv import Trigger

from lathe_rc.nodes.executor import Events, drain_missed_messages


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


def answered(_, response):
    response.message = "here"
    return response


@pytest.mark.parametrize("raw", [False, True])
def test_what_nobody_has_announced_is_handed_over_once(ghost, raw):
    heard = []
    reader = ghost.create_subscription(String, "told", heard.append, 10, raw=raw)
    writer = ghost.create_publisher(String, "told", 10)
    executor = EventsExecutor()
    executor.add_node(ghost)
    while not (reader.get_publisher_count() and writer.get_subscription_count()):
        executor.spin_once(timeout_sec=0.01)
    for word in ("one", "two"):
        writer.publish(String(data=word))
    while len(heard) < 2:  # before the executor has looked, though it has been told
        drain_missed_messages(ghost)
    assert [bytes(each)[8:11] if raw else each.data.encode() for each in heard] == [b"one", b"two"]
    for _ in range(10):
        executor.spin_once(timeout_sec=0.0)
    writer.publish(String(data="end"))
    while len(heard) < 3:
        executor.spin_once(timeout_sec=0.1)
    assert len(heard) == 3
    executor.shutdown()


def test_a_request_that_nobody_has_announced_is_answered(ghost):
    ghost.create_service(Trigger, "ask", answered)
    other = rclpy.create_node("asks", namespace="/haunted")
    client = other.create_client(Trigger, "ask")
    assert client.wait_for_service(60.0)
    answer = client.call_async(Trigger.Request())
    while not answer.done():
        drain_missed_messages(ghost)  # nobody spins the one that answers
        rclpy.spin_once(other, timeout_sec=0.01)
    assert answer.result().message == "here"
    other.destroy_node()
