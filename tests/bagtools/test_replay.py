# SPDX-License-Identifier: Apache-2.0
"""Replay over real DDS: what was recorded comes again, in order and complete, and can be recorded again."""

import functools
import os
import re
import shutil
import subprocess
import sys
import threading

import pytest
import rclpy
import yaml
from bags import JAZZY, mcap_writer
from builtin_interfaces.msg import Time
from cells import refusals, scenario, started
from geometry_msgs.msg import Point
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagWriter
from rosgraph_msgs.msg import Clock

from lathe_bagtools.nodes import replayed_qos, replayer
from lathe_rc import harness
from lathe_rc.bag.check import check
from lathe_rc.bag.reading import metadata
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.errors import InputError

try:
    from rosbag2_interfaces import srv
except ImportError:
    srv = None

COUNT = 1500


@pytest.mark.system
def test_a_replayed_cell_is_recorded_as_the_same_bag(domain, tmp_path):
    first, again = tmp_path / "first", tmp_path / "again"
    form = tmp_path / "form.csv"
    form.write_text("angle_deg,radius_um\n0,0\n120,30\n240,-10\n")
    loaded = scenario(spindle_encoder={"revolutions": 8.0}, tool={"profile": "csv", "profile_file": str(form)})
    harness.run(loaded, mode="composed", bag=first)
    with started("node", "recorder", "--ros-args", "-p", f"bag:={again}", "-p", "run_id:=test") as recorder:
        ((code, said),) = refusals(["replay", first, "--rate", "0", "--as-cell"])
        assert code == 0, said
        assert recorder.wait() == 0, recorder.stdout.read()
    with BagSource(first) as old, BagSource(again) as new:
        signals = set(old.topics) - {"/diagnostics", "/cell_state"}
        assert len(signals) == 9
        assert list(old.messages(signals)) == list(new.messages(signals))
        assert old.about["lathe_rc.file.tool.profile_file"] == new.about["lathe_rc.file.tool.profile_file"]
    assert check(first).digests == check(again).digests
    assert check(again).compared == 9, "a recorder that is started by hand stores digests"


@pytest.fixture(scope="module")
def strange(tmp_path_factory):
    """A bag of another maker, in SQLite, whose messages are a millisecond apart."""
    point = JAZZY.types["geometry_msgs/msg/Point"]
    path = tmp_path_factory.mktemp("strange") / "bag"
    with RosbagWriter(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        topics = [writer.add_connection(name, point.__msgtype__, typestore=JAZZY) for name in ("/a", "/b")]
        for number in range(COUNT):
            data = JAZZY.serialize_cdr(point(float(number), 0.0, 0.0), point.__msgtype__)
            writer.write(topics[number % 2], 5 * 10**9 + number * 10**6, bytes(data))
    return path


class Listener:
    """Hears the topics of that bag and /clock, in a thread."""

    def __init__(self):
        rclpy.init()
        self.node = rclpy.create_node("listener")
        qos = QoSProfile(depth=4096, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE)
        self.heard, self.clock = {"/a": [], "/b": []}, []
        self.news = threading.Condition()
        # /clock first: readers are discovered in the order of their making, and the replayer waits for the others.
        self.node.create_subscription(
            Clock, "/clock", lambda told: self.clock.append(told.clock.sec * 10**9 + told.clock.nanosec), 50_000
        )
        for topic in self.heard:
            self.node.create_subscription(Point, topic, functools.partial(self._keep, topic), qos)
        self.executor, self.over = SingleThreadedExecutor(), Future()
        self.executor.add_node(self.node)
        self.thread = threading.Thread(target=self.executor.spin_until_future_complete, args=(self.over,))
        self.thread.start()

    def _keep(self, topic, message):
        with self.news:
            self.heard[topic].append(message.x)
            self.news.notify_all()

    def wait_for(self, what):
        with self.news:
            assert self.news.wait_for(what, timeout=60.0)

    def call(self, service, **request):
        kind = getattr(srv, "".join(part.title() for part in service.split("_")))
        client = self.node.create_client(kind, f"/replayer/{service}")
        assert client.wait_for_service(timeout_sec=60.0)
        future, done = client.call_async(kind.Request(**request)), threading.Event()
        future.add_done_callback(lambda _: done.set())
        assert done.wait(60.0)
        return future.result()


@pytest.fixture
def listener(domain):
    made = Listener()
    yield made
    # An executor that is shut down while another thread spins it may crash that.
    made.over.set_result(None)
    made.thread.join()
    made.executor.shutdown()
    made.node.destroy_node()
    rclpy.shutdown()


@pytest.mark.skipif(srv is None, reason="no rosbag2_interfaces")
def test_the_services_of_rosbag2_control_a_replay(strange, listener):
    """Pause, steps, bursts, seek, rate, resume and stop, under other names and from the first message on."""
    options = ["--start-paused", "--remap", "/b:=/a", "--rate", "0.01"]
    with started("replay", strange, *options) as process:
        assert listener.call("is_paused").paused
        assert not listener.call("seek", time=Time(sec=6, nanosec=500_000_000)).success
        assert listener.call("play_next").success
        assert listener.call("burst", num_messages=3).actually_burst == 3
        listener.wait_for(lambda: listener.heard["/a"] == [0.0, 1.0, 2.0, 3.0])
        assert listener.call("seek", time=Time(sec=6)).success
        assert listener.call("burst", num_messages=2).actually_burst == 2
        listener.wait_for(lambda: listener.heard["/a"][4:] == [1000.0, 1001.0])
        assert not listener.call("set_rate", rate=0.0).success
        assert listener.call("set_rate", rate=0.5).success
        assert listener.call("get_rate").rate == 0.5
        listener.call("resume")
        listener.wait_for(lambda: len(listener.heard["/a"]) > 20)
        listener.call("toggle_paused")
        assert listener.call("is_paused").paused
        listener.call("stop")
        assert process.wait(60.0) == 0
    assert listener.heard["/a"][4:] == [float(n) for n in range(1000, 996 + len(listener.heard["/a"]))]
    assert listener.heard["/b"] == []


def test_every_message_comes_in_order_with_the_clock(strange, listener):
    """Every message comes in order with the clock, in each round, the first one too."""
    with started("replay", strange, "--rate", "0", "--loop"):
        whole = {"/a": [float(n) for n in range(0, COUNT, 2)], "/b": [float(n) for n in range(1, COUNT, 2)]}
        listener.wait_for(lambda: all(len(heard) >= 3 * len(whole[topic]) for topic, heard in listener.heard.items()))
    for topic, heard in listener.heard.items():
        assert heard[: len(whole[topic])] == whole[topic]
        start = heard.index(whole[topic][0], 1)
        assert heard[start : start + len(whole[topic])] == whole[topic]
    assert sorted(set(listener.clock)) == [5 * 10**9 + number * 10**6 for number in range(COUNT)]


def test_what_comes_before_the_start_that_the_metadata_give_is_sent_too(strange, listener, tmp_path):
    """Messages before the start that the metadata give are sent too, and the disagreement is reported."""
    shutil.copytree(strange, tmp_path / "bag")
    metadata = yaml.safe_load((strange / "metadata.yaml").read_text())
    metadata["rosbag2_bagfile_information"]["starting_time"]["nanoseconds_since_epoch"] += 5 * 10**8
    (tmp_path / "bag" / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    ((code, said),) = refusals(["replay", tmp_path / "bag", "--rate", "0", "--wait", "1"])
    assert code == 0
    assert "metadata.yaml says first message at 5500000000 ns; the files: 5000000000" in said
    assert f"{COUNT} messages sent" in said
    listener.wait_for(lambda: sum(map(len, listener.heard.values())) >= COUNT)
    assert listener.clock[0] == 5 * 10**9


def test_a_part_of_some_topics(strange, listener):
    """A part of some topics is sent, if that is what is asked for."""
    options = ["--topics", "/b", "--start", "0.5", "--end", "0.6", "--rate", "0", "--loop"]
    with started("replay", strange, *options):
        listener.wait_for(lambda: len(listener.heard["/b"]) > 200)
    assert listener.heard["/a"] == []
    assert set(listener.heard["/b"]) == {float(n) for n in range(501, 600, 2)}


def odd_bag(path):
    """A latched topic, one of different publishers, a name that is none, JSON, and a message after 2038."""
    with mcap_writer(path, "") as writer:
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        latched, best = "- {reliability: reliable, durability: transient_local, depth: 1}\n", "- {reliability: 2}\n"
        offers = {"/latched": latched, "/mixed": best + latched, "/tool/": "", "/late": "", "/json": ""}
        numbers = {
            topic: writer.register_channel(
                topic, "json" if topic == "/json" else "cdr", schema, {"offered_qos_profiles": text}
            )
            for topic, text in offers.items()
        }
        times = {"/latched": (0, 1), "/mixed": (10**9, 10**18), "/tool/": (2,), "/late": (2**62,)}
        for topic, log_ns in ((topic, each) for topic, several in times.items() for each in several):
            writer.add_message(numbers[topic], log_ns, b"\0\1\0\0\2\0\0\0x\0", log_ns)
    return path


def clocks(path, log_ns, data):
    """A bag with a message on /clock and another topic."""
    with RosbagWriter(path, version=9) as writer:
        for topic in ("/clock", "/other"):
            writer.write(writer.add_connection(topic, "rosgraph_msgs/msg/Clock", typestore=JAZZY), log_ns, data)
    return path


def test_what_cannot_be_replayed_is_refused(domain, strange, tmp_path):
    late = clocks(tmp_path / "late", 2**31 * 10**9, bytes(12))
    early, junk = clocks(tmp_path / "early", 1, bytes(12)), clocks(tmp_path / "junk", 1, b"junk" * 1000)
    odd = odd_bag(tmp_path / "odd.mcap")
    cases = [
        (strange, "--topics /c", "replayer.topics: /c is not in the bag; allowed: /a, /b"),
        (strange, "--topics /clock", "replayer.topics: /clock is not in the bag; allowed: /a, /b"),
        (strange, "--start 2", "replayer.start = 2 s, end = 0 s: nothing to send; allowed: a start up to 1.499 s"),
        (strange, "--start 1 --end 1", "replayer.start = 1 s, end = 1 s: nothing to send"),
        (strange, "--remap /c:=/d", "replayer.remap: '/c' is not replayed; did you mean /clock?"),
        (strange, "--remap /a=/d", "replayer.remap: '/a=/d'; allowed: /topic:=/other"),
        (strange, "--as-cell", "the bag holds no scenario"),
        (strange, "--as-cell --loop", "a cell is replayed whole and once"),
        (strange, "--rate -1", "-1"),
        (odd, "--end 5 --rate 0", "/tool/: no name in ROS (topic name must not end with a forward slash)"),
        (odd, "--topics /late", "/late: log time 4611686018427387904 ns; /clock ends in 2038; replayer.end = 21474836"),
        (late, "--rate 0", "log time 2147483648000000000 ns; /clock ends in 2038; name other topics"),
        (early, "--topics /clock", "/clock is the replayer's own and tells the log times of the bag"),
        (junk, "--rate 0", "/other: message 1 that is sent is none of its type"),
    ]
    ended = refusals(*(["replay", bag, *words.split()] for bag, words, _ in cases))
    for (code, told), (_, words, said) in zip(ended, cases, strict=True):
        assert code == 2, words
        assert said in told
        assert "Traceback" not in told


@pytest.mark.system
def test_a_bag_of_odd_topics_is_replayed_as_far_as_it_goes(domain, tmp_path):
    """Times and topics that are asked for count; a latched message from before the start comes; waits are announced."""
    odd = odd_bag(tmp_path / "odd.mcap")
    cases = [
        ("", "4 messages sent"),
        ("--start 0.5 --end 5", "2 messages sent"),
        ("--end 5", "not sent: /json std_msgs/msg/String, 0 messages serialized as 'json', not 'cdr'"),
    ]
    fast = ["--rate", "0", "--topics", "/latched", "--topics", "/mixed"]
    ended = refusals(*(["replay", odd, *fast, *words.split()] for words, _ in cases))
    for (code, told), (_, said) in zip(ended, cases, strict=True):
        assert code == 0, told
        assert said in told
    with started("replay", odd, "--topics", "/mixed", "--start", "1", "--end", "2e9") as process:
        waits = "the next message comes in 31.7 years; start = 1000000000 begins with it"
        assert any(waits in line for line in process.stdout)


@pytest.mark.parametrize("time_ns", [0, 999, 1_499_000_000, 1_700_000_000_123_456_789, 1_700_000_128_700_000_000])
def test_the_start_that_is_told_is_no_later_than_its_message(time_ns):
    """As a number it was up to 5 s later: of nine digits, and in binary."""
    assert 0 <= time_ns - replayer._ns(float(replayer._seconds(time_ns))) < 1000


LATCHED = "- {durability: transient_local, depth: 2"
OFFERS = {
    "infinite or not told": (f"{LATCHED}}}\n{LATCHED}, deadline: {{sec: 9223372036, nsec: 854775807}}}}", True, 4),
    "other deadlines": (f"{LATCHED}, deadline: {{sec: 1, nsec: 0}}}}\n{LATCHED}}}", True, 4),
    "other lifespans": (f"{LATCHED}, lifespan: {{sec: 1, nsec: 0}}}}\n{LATCHED}}}", True, 4),
    "other liveliness": (f"{LATCHED}, liveliness: 1}}\n{LATCHED}, liveliness: 3}}", True, 4),
    "partial": (f"{LATCHED}}}\n{LATCHED}, reliability: reliable}}", True, 4),
    "by number": ("- {durability: 1, reliability: 1, history: 1, depth: 3}", True, 3),
    "all are kept": (f"{LATCHED}, history: keep_all}}", True, 512),
    "all are kept, by number": ("- {durability: 1, history: 2, depth: 0}", True, 512),
    "latched and volatile": (f"{LATCHED}}}\n- {{durability: volatile, depth: 9}}", True, 2),
    "best effort and reliable": (f"{LATCHED}}}\n{LATCHED}, reliability: best_effort}}", True, 4),
    "volatile": ("- {durability: volatile, depth: 9}", False, 1),
}


@pytest.mark.parametrize("kind", OFFERS)
def test_the_offered_qos_serves_readers_of_every_publisher(kind):
    text, latched, kept = OFFERS[kind]
    recorded = metadata.qos_of_text(text)
    offered = replayed_qos.of(recorded)
    assert offered.reliability == ReliabilityPolicy.RELIABLE
    assert (offered.durability == DurabilityPolicy.TRANSIENT_LOCAL) is latched
    assert replayed_qos.kept(recorded) == kept


def test_qos_is_overridden_by_topic(tmp_path):
    file = tmp_path / "qos.yaml"
    file.write_text("/a: {reliability: best_effort, depth: 7}\n")
    given = replayed_qos.overrides(file, ["/a", "/b"])["/a"]
    offered = replayed_qos.of(metadata.qos_of_text(f"{LATCHED}}}"), given)
    assert (offered.reliability, offered.depth) == (ReliabilityPolicy.BEST_EFFORT, 7)
    assert offered.durability == DurabilityPolicy.TRANSIENT_LOCAL
    for text, said in {
        "/c: {depth: 1}": "topic '/c' is not replayed; allowed: /a, /b",
        "/a: {reliable: true}": "/a: policy 'reliable'; allowed: history, depth, reliability, durability",
        "/a: {durability: latched}": "/a: durability 'latched'; allowed: volatile, transient_local",
        "/a: {depth: 0}": "/a: depth '0'; allowed: a whole number from 1 on",
        "/a": "allowed",
        "/a: [": "allowed: a YAML file of topics with their policies",
    }.items():
        file.write_text(text)
        with pytest.raises(InputError, match=re.escape(said)):
            replayed_qos.overrides(file, ["/a", "/b"])


def test_keys_of_a_terminal_are_told_and_its_settings_come_back():
    master, terminal = os.openpty()
    with subprocess.Popen(
        [sys.executable, "-c", KEYS], stdin=terminal, stdout=subprocess.PIPE, start_new_session=True
    ) as process:
        assert process.stdout.readline() == b"listening\n"
        os.write(master, b" \x1b[Cx\x1b[A\x1b[B")
        assert process.stdout.read() == b"space right up down\n"
    assert process.returncode == 0
    os.close(master)
    os.close(terminal)


KEYS = """
import fcntl, termios, time
from lathe_bagtools.nodes import keys
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
before = termios.tcgetattr(0)
with keys.listening() as pressed:
    print("listening", flush=True)
    told = []
    while len(told) < 4:
        told += pressed()
        time.sleep(0.01)
    print(*told)
assert termios.tcgetattr(0) == before
"""
