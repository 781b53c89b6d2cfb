# SPDX-License-Identifier: Apache-2.0
"""Events of what a node has discarded, and messages and requests that no event announces."""

from functools import partial

import pytest
from cells import until

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
        until(lambda: not watched.get_publisher_count())  # from then on the event is on its way
        discarded.append(True)

    watcher.create_subscription(Empty, "/go", discard, 1)
    events = Events([watcher])
    until(lambda: matched, lambda: events.spin(0.1))

    def call():
        go.publish(Empty())
        events.spin(0.1)

    until(lambda: discarded, call)
    heard = []
    watcher.create_subscription(Empty, "/go", heard.append, 1)
    until(lambda: heard, call)  # then the event has had its turn as well
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
    until(
        lambda: reader.get_publisher_count() and writer.get_subscription_count(),
        lambda: executor.spin_once(timeout_sec=0.01),
    )
    for word in ("one", "two"):
        writer.publish(String(data=word))
    # Before the executor has looked, though it has been told
    until(lambda: len(heard) >= 2, lambda: drain_missed_messages(ghost))
    assert [bytes(each)[8:11] if raw else each.data.encode() for each in heard] == [b"one", b"two"]
    for _ in range(10):
        executor.spin_once(timeout_sec=0.0)
    writer.publish(String(data="end"))
    until(lambda: len(heard) >= 3, lambda: executor.spin_once(timeout_sec=0.1))
    assert len(heard) == 3
    executor.shutdown()


def test_a_request_that_nobody_has_announced_is_answered(ghost):
    ghost.create_service(Trigger, "ask", answered)
    other = rclpy.create_node("asks", namespace="/haunted")
    client = other.create_client(Trigger, "ask")
    assert client.wait_for_service(60.0)
    answer = client.call_async(Trigger.Request())

    def look():
        drain_missed_messages(ghost)  # nobody spins the one that answers
        rclpy.spin_once(other, timeout_sec=0.01)

    until(answer.done, look)
    assert answer.result().message == "here"
    other.destroy_node()
