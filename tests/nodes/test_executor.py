# SPDX-License-Identifier: Apache-2.0
"""The executor of a process: everything that arrives is handed over once, and nothing to what has been destroyed."""

import pytest
from cells import until

pytest.importorskip("rclpy")

import rclpy
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from std_msgs.msg import Empty, String
from std_srvs.srv import Trigger

from lathe_rc.nodes.executor import Events
from lathe_rc.nodes.taking import GID


@pytest.fixture
def node():
    made = rclpy.create_node("spun", namespace="/haunted")
    yield made
    made.destroy_node()


def answered(_, response):
    response.message = "here"
    return response


@pytest.mark.parametrize("raw", [False, True])
def test_each_message_is_handed_over_once(ghost, node, raw):
    heard, writer = [], ghost.create_publisher(String, "/told", 200)
    node.create_subscription(String, "/told", lambda *message: heard.append(message), 200, raw=raw)
    until(writer.get_subscription_count)
    words = [f"{k:03}" for k in range(150)]  # more than are taken at a time
    for word in words:
        writer.publish(String(data=word))
    events = Events([node])
    until(lambda: len(heard) >= len(words), lambda: events.spin(0.1))
    events.spin(0.0)
    assert [each[0][8:11].decode() if raw else each[0].data for each in heard] == words
    (gid,) = [bytes(end.endpoint_gid)[:GID] for end in node.get_publishers_info_by_topic("/told")]
    assert not raw or {publisher for _, publisher in heard} == {gid}


def test_what_a_callback_has_destroyed_is_not_called(ghost, node):
    """A message of a subscription waits while another one's callback destroys it."""
    watched, gone = [], []

    def destroy(_):
        if not gone:
            gone.append(node.destroy_subscription(watcher))

    node.create_subscription(Empty, "/go", destroy, 1)
    watcher = node.create_subscription(Empty, "/watched", watched.append, 1)
    publisher, go = ghost.create_publisher(Empty, "/watched", 1), ghost.create_publisher(Empty, "/go", 1)
    until(lambda: publisher.get_subscription_count() and go.get_subscription_count())
    for each in (publisher, go):
        each.publish(Empty())
        assert each.wait_for_all_acked(Duration(seconds=60.0))  # from then on it is there
    events = Events([node])
    events.spin(0.0)
    assert gone
    heard = []
    node.create_subscription(Empty, "/go", heard.append, 1)
    until(lambda: heard, lambda: (go.publish(Empty()), events.spin(0.1)))
    assert not watched


def test_requests_have_their_turn_while_messages_keep_coming(ghost, node):
    told = ghost.create_publisher(Empty, "/flood", 1)
    node.create_subscription(Empty, "/flood", lambda _: told.publish(Empty()), 1)  # each message begets the next
    node.create_service(Trigger, "ask", answered)
    events = Events([node])
    until(told.get_subscription_count)
    told.publish(Empty())
    client = ghost.create_client(Trigger, "ask")
    until(client.service_is_ready, lambda: events.spin(0.1))
    answer = client.call_async(Trigger.Request())

    def turn():
        events.spin(0.0)
        rclpy.spin_once(ghost, timeout_sec=0.0)

    until(answer.done, turn)
    assert answer.result().message == "here"


def test_no_event_of_dds_is_taken(ghost, node):
    """In rmw_fastrtps 8.4 the thread that takes one may stand still for ever, whatever the event."""
    told = []
    every = dict.fromkeys(("matched", "incompatible_qos", "liveliness", "message_lost"), told.append)
    node.create_subscription(Empty, "/watched", told.append, 1, event_callbacks=SubscriptionEventCallbacks(**every))
    publisher, events = ghost.create_publisher(Empty, "/watched", 1), Events([node])
    until(publisher.get_subscription_count)
    until(lambda: told, lambda: (publisher.publish(Empty()), events.spin(0.1)))
    events.spin(0.0)
    assert {type(each) for each in told} == {Empty}
