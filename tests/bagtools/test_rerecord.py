# SPDX-License-Identifier: Apache-2.0
"""Recording what is replayed over real DDS gives the same bag again: messages, order and log times."""

import itertools
import signal

import numpy as np
import pytest
import rclpy
from bags import JAZZY
from cells import block, refusals, scenario, started, until
from lathe_rc_msgs.msg import ToolBlock
from rclpy.duration import Infinite
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagWriter
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Empty, String

from lathe_bagtools.nodes.topic_recorder import TopicRecorder, TopicRecorderParameters
from lathe_rc import harness
from lathe_rc.bag.check import check
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.bag.writing.writer import offered_qos
from lathe_rc.errors import InputError
from lathe_rc.nodes import publisher_info
from lathe_rc.nodes.ports import latched_qos

LATCHED = "transient_local"
TOPICS = {
    "/note": ("std_msgs/msg/String", "volatile"),
    "/robot/point": ("geometry_msgs/msg/Point", "volatile"),
    "/robot/joints": ("sensor_msgs/msg/JointState", "volatile"),
    "/description": ("std_msgs/msg/String", LATCHED),
    "/silent": ("geometry_msgs/msg/Point", "volatile"),
}


def filled(data):
    """As DDS hands messages over: filled up to a multiple of four."""
    return bytes(data) + bytes(-len(data) % 4)


def message(topic, number, chance):
    kind = TOPICS[topic][0]
    made = JAZZY.types[kind]
    if kind == "std_msgs/msg/String":
        size = 1_500_000 if number % 400 == 399 else int(chance.integers(40))
        return JAZZY.serialize_cdr(made("x" * size + str(number)), kind)
    if kind == "geometry_msgs/msg/Point":
        return JAZZY.serialize_cdr(made(float(number), 0.5, -1.0), kind)
    stamp = JAZZY.types["builtin_interfaces/msg/Time"](number, 17)  # not the log time
    header = JAZZY.types["std_msgs/msg/Header"](stamp, "base")
    values = np.arange(number % 3, dtype=np.float64)
    return JAZZY.serialize_cdr(made(header, ["axis"] * values.size, values, values, values), kind)


@pytest.fixture
def foreign(tmp_path):
    """A bag of another maker: equal log times on several topics, irregular intervals, small and large messages."""
    chance = np.random.default_rng(5)
    path, log_ns, sent = tmp_path / "foreign", 0, []
    with RosbagWriter(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections = {
            topic: writer.add_connection(
                topic, kind, typestore=JAZZY, offered_qos_profiles=[offered_qos(10, durability)]
            )
            for topic, (kind, durability) in TOPICS.items()
        }
        for number in range(1200):
            log_ns += int(chance.choice([0, 0, 1, 1000, 1_000_000, 30_000_000]))
            topic = "/description" if number == 0 else str(chance.choice(["/note", "/robot/point", "/robot/joints"]))
            data = bytes(message(topic, number, chance))
            writer.write(connections[topic], log_ns, data)
            sent.append((topic, log_ns, filled(data)))
    return path, sent


def recorded_again(bag, again, *recorder, topics=()):
    """The messages of a bag that a recorder makes of the replay of another one."""
    named = [word for topic in topics for word in ("--topics", topic)]
    with started("record", again, *recorder, "--once", *named) as recording:
        ((code, said),) = refusals(["replay", bag, "--rate", "0", "--wait", "1", *named])
        assert code == 0, said
        said, _ = recording.communicate()
        assert recording.returncode == 0, said
    return messages(again)


def messages(path):
    with BagSource(path) as source:
        return list(source.messages())


def described(path):
    """Type, definition's hash, reliability and durability of each topic."""
    with Reader(path) as reader:
        return {
            c.topic: (c.msgtype, c.digest, [(q.reliability, q.durability) for q in c.ext.offered_qos_profiles])
            for c in reader.connections
        }


@pytest.mark.system
def test_a_bag_of_others_is_recorded_again_as_it_was(foreign, domain, tmp_path):
    path, sent = foreign
    again = tmp_path / "again"
    assert recorded_again(path, again, "--sim-time") == sent
    assert described(again) == described(path)
    with AnyReader([again]) as reader:  # with the definitions in the bag alone
        known = {c.topic: c for c in reader.connections}
        ((_, log_ns, data),) = reader.messages([known["/description"]])
        assert log_ns == sent[0][1]
        assert reader.deserialize(data, "std_msgs/msg/String").data.endswith("x0")


@pytest.mark.system
def test_a_bag_of_the_cell_is_recorded_again_as_it_was(domain, tmp_path):
    first, again = tmp_path / "first", tmp_path / "again"
    harness.run(scenario(spindle_encoder={"revolutions": 6.0}), mode="composed", bag=first)
    found = recorded_again(first, again, "--sim-time")
    assert found == [(topic, log_ns, filled(data)) for topic, log_ns, data in messages(first)]
    assert described(again) == described(first)
    assert check(again).digests == check(first).digests


@pytest.mark.system
def test_without_simulated_time_the_order_is_that_of_publication(foreign, domain, tmp_path):
    (path, sent), topics = foreign, ("/note", "/robot/point")
    found = recorded_again(path, tmp_path / "again", topics=topics)
    wanted = [(topic, data) for topic, _, data in sent if topic in topics]
    assert [(topic, data) for topic, _, data in found] == wanted
    assert all(a[1] < b[1] for a, b in itertools.pairwise(found))


def matched(node, publisher):
    until(publisher.get_subscription_count, lambda: rclpy.spin_once(node, timeout_sec=0.02))


def last_word(ghost, talker, word, recording):
    """Let the talker say a word that is heard, and go; what the recorder told until it ended."""
    matched(ghost, talker)
    talker.publish(String(data=word))
    assert talker.wait_for_all_acked()
    ghost.destroy_node()
    return recording.communicate()[0]


#: how often a recorder looks for those who were there before it
LOOKS = "from lathe_bagtools.nodes import topic_recorder; topic_recorder._LOOKS = {}"


def test_what_was_missed_is_told(ghost, tmp_path):
    """A recorder that was there first reports the messages that it missed of a publisher that did not wait for it."""
    # Nobody is in this domain yet: to look for them for 3 s would find nobody.
    with started("record", tmp_path / "bag", "--once", first=LOOKS.format(4)) as recording:
        assert any("what begins from now on is heard from its first message on" in line for line in recording.stdout)
        recording.send_signal(signal.SIGSTOP)
        talker = ghost.create_publisher(String, "/talk", 10)
        for _ in range(3):
            talker.publish(String(data="nobody hears"))
        recording.send_signal(signal.SIGCONT)
        said = last_word(ghost, talker, "heard", recording)
    assert recording.returncode == 3
    assert f"lathe: {tmp_path / 'bag'}: 3 messages of /talk are missing" in said
    assert len(messages(tmp_path / "bag")) == 1


def test_missing_samples_of_a_cell_are_told(ghost, tmp_path):
    """Nodes in one process neither send nor number blocks that no other process reads."""
    with started("record", tmp_path / "bag", "--once", first=LOOKS.format(4)) as recording:
        talker = ghost.create_publisher(ToolBlock, "/tool", QoSProfile(depth=10))
        matched(ghost, talker)
        talker.publish(block("lathe_rc_msgs/msg/ToolBlock", 128, "/tool", "test"))
        assert talker.wait_for_all_acked()
        ghost.destroy_node()
        said = recording.communicate()[0]
    assert recording.returncode == 3
    assert "samples 0 to 127 of /tool are missing; /tool ends at sample 191 without its last block" in said


def test_what_was_before_it_is_told_and_no_loss(ghost, tmp_path):
    """Messages from before the start of a recorder are reported, and are no loss."""
    talker = ghost.create_publisher(String, "/talk", 10)
    for _ in range(3):
        talker.publish(String(data="nobody hears"))
    # It looks until it has found them, however long DDS takes for that.
    with started("record", tmp_path / "bag", "--once", first=LOOKS.format(10**6)) as recording:
        said = last_word(ghost, talker, "heard", recording)
    assert recording.returncode == 0
    assert "/talk is heard from its message 4 on" in said


def test_it_ends_with_a_whole_bag_when_told_to(ghost, tmp_path):
    """A recorder that is told to end closes a bag with all that it heard."""
    talker = ghost.create_publisher(String, "/talk", QoSProfile(depth=10))
    with started("record", tmp_path / "bag") as recording:
        matched(ghost, talker)
        for number in range(5):
            talker.publish(String(data=f"{number:03d}"))
        assert talker.wait_for_all_acked()
        recording.send_signal(signal.SIGTERM)
        said, _ = recording.communicate()
    assert recording.returncode == 0, said
    assert [data[8:11] for _, _, data in messages(tmp_path / "bag")] == [b"000", b"001", b"002", b"003", b"004"]
    assert check(tmp_path / "bag").exit_code == 0


def test_simulated_time_that_nobody_tells_is_no_success(ghost, tmp_path):
    """A recording by simulated time fails if nobody tells the time."""
    talker, _clock = ghost.create_publisher(String, "/talk", 10), ghost.create_publisher(Clock, "/clock", 10)
    with started("record", tmp_path / "bag", "--sim-time", "--once") as recording:
        said = last_word(ghost, talker, "when?", recording)
    assert recording.returncode == 1
    assert "/clock told no time: 1 messages are not recorded" in said


def test_what_cannot_be_recorded_is_refused(domain, tmp_path):
    (tmp_path / "here").mkdir()
    cases = [
        (["here"], "here exists; a bag is never overwritten"),
        (["new", "--topics", "/a", "--all"], "topic_recorder.all: /a are named; give one or the other"),
        (["new", "--sim-time", "--topics", "/clock"], "/clock tells the log times"),
        (["new", "--hold", "0"], "0"),
    ]
    told = refusals(*(["record", *arguments] for arguments, _ in cases), cwd=tmp_path)
    for (code, words), (arguments, said) in zip(told, cases, strict=True):
        assert code == 2, arguments
        assert said in words
        assert "Traceback" not in words
    assert not (tmp_path / "new").exists()


def test_a_later_publisher_that_offers_less_is_told(ghost, tmp_path):
    """The first is latched, the second not; its messages do not reach the recorder, which polls the graph for it."""
    recorder = TopicRecorder(ghost, TopicRecorderParameters(bag=str(tmp_path / "bag"), sim_time=False))
    ghost.create_publisher(Empty, "/told", latched_qos(1))
    until(lambda: "/told" in recorder._inlets, recorder._discover)
    ghost.create_publisher(Empty, "/told", 1)
    until(lambda: recorder._refused, recorder._discover)
    assert recorder._refused == {"/told": "/told: a later publisher offers less than the first; it is not recorded"}
    recorder._executor.shutdown()
    recorder._writer.close()


def test_a_type_that_is_not_installed_is_refused():
    with pytest.raises(InputError, match="message type nowhere_msgs/msg/Thing is not installed"):
        publisher_info.installed("nowhere_msgs/msg/Thing")
    store = publisher_info.installed("sensor_msgs/msg/JointState")
    assert store.hash_rihs01("sensor_msgs/msg/JointState") == JAZZY.hash_rihs01("sensor_msgs/msg/JointState")


def test_a_recorder_tells_the_qos_of_a_publisher_that_differs_from_our_nodes():
    from rclpy.topic_endpoint_info import TopicEndpointInfo

    ours = offered_qos(224, LATCHED)
    for_ever = dict.fromkeys(("deadline", "lifespan", "liveliness_lease_duration"), Infinite)
    alike, other = (
        TopicEndpointInfo(
            qos_profile=QoSProfile(depth=1, durability=each, liveliness=LivelinessPolicy.AUTOMATIC, **for_ever)
        )
        for each in (DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE)
    )
    assert publisher_info.offered_or(ours, []) == publisher_info.offered_or(ours, [alike]) == ours
    assert publisher_info.offered_or(ours, [alike, other]).durability.name == "VOLATILE"
