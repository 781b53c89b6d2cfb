# SPDX-License-Identifier: Apache-2.0
"""Messages and requests that no executor knows of are handed over, and the executor does not mind."""

import pytest

pytest.importorskip("rclpy")

import rclpy
from rclpy.experimental.events_executor import EventsExecutor
from std_msgs.msg import String
from std_srvs.srv import Trigger

from lathe_rc.nodes import overlooked


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
        overlooked.take(ghost)
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
        overlooked.take(ghost)  # nobody spins the one that answers
        rclpy.spin_once(other, timeout_sec=0.01)
    assert answer.result().message == "here"
    other.destroy_node()
