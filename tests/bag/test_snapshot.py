# SPDX-License-Identifier: Apache-2.0
"""Snapshots: what a recording of the whole run has around a trigger, in every host, in memory that does not grow."""

import errno
import json
import os
import signal
from collections import Counter
from pathlib import Path

import leading
import numpy as np
import pytest
import rclpy
import yaml
from bags import QOS, lathe, storage_of
from cells import all_but, files_up_to, in_two, scenario
from hypothesis import given, settings
from hypothesis import strategies as st
from machines import assert_refused
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from std_srvs.srv import Trigger

from lathe_bagtools.resimulation.resim import resimulate
from lathe_rc import harness, messages
from lathe_rc.bag.check import check
from lathe_rc.bag.snapshot import SNAPSHOT, first_sample
from lathe_rc.bag.writing.order import Merger
from lathe_rc.bag.writing.snapshots import Snapshots
from lathe_rc.blocks.block import Framer
from lathe_rc.blocks.ports import Sparse
from lathe_rc.blocks.wire import Encoder
from lathe_rc.cell.recorder import RecorderParameters
from lathe_rc.cell.scenario import load
from lathe_rc.errors import LatheError
from lathe_rc.messages import START_NS
from lathe_rc.nodes.recorder_role import RecorderRole
from lathe_rc.view.report import losses
from lathe_rc.view.report_gather import gather

CONFIG = Path(__file__).parents[2] / "config"
STEP_NS, BLOCK, PRE, POST = 15_625, 64, 3200, 1280
TIMES = {"pre": PRE / 64_000, "post": POST / 64_000, "triggers": ["*: freeze", "learning_controller: clear"]}
EVENTS = ["sample 9000: freeze", "sample 13000: learn", "sample 20000: clear"]


def cell(events=EVENTS, revolutions=8.0, speed_factor=0.0, **recorder):
    spindle = {"revolutions": revolutions, "speed_factor": speed_factor}
    learning = {"events": list(events)}
    return scenario(spindle_encoder=spindle, learning_controller=learning, recorder={**TIMES, **recorder})


def read(path):
    """Topic, log time and bytes of every signal message, as they stand in the file."""
    with AnyReader([path]) as bags:
        found = [
            (connection.topic, connection.msgtype, stamp, bytes(data)) for connection, stamp, data in bags.messages()
        ]
    return [(topic, stamp, data) for topic, kind, stamp, data in found if kind in messages.signal_types()]


def about(path):
    metadata = yaml.safe_load((path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    return metadata["custom_data"]


def told(path):
    return json.loads(about(path)[SNAPSHOT])


def span(whole, first, last):
    """The messages of a recording of the whole run from the sample ``first`` to ``last``."""
    return [each for each in whole if START_NS + first * STEP_NS <= each[1] <= START_NS + last * STEP_NS]


def rows(first, last):
    """First sample and last of the blocks that hold the samples from ``first`` to ``last``."""
    return first // BLOCK * BLOCK, last // BLOCK * BLOCK + BLOCK - 1


@pytest.fixture(scope="module", params=["offline", "processes"])
def recorded(request, tmp_path_factory):
    bag, both = tmp_path_factory.mktemp(request.param) / "bag", cell(mode="both")
    return harness.run(both, mode=request.param, groups=in_two(both), bag=bag)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The same run in a bag of its own, without snapshots."""
    return read(harness.run(cell(), bag=tmp_path_factory.mktemp("whole") / "bag").bag)


# --- content


def test_snapshots_are_the_same_span_of_the_whole_bag_and_say_of_what_and_why(recorded, whole):
    """Each trigger has a bag, named by its sample."""
    assert read(recorded.bag) == whole
    assert [path.name for path in recorded.snapshots] == ["sample_0000009000", "sample_0000020000"]
    assert {path.parent for path in recorded.snapshots} == {recorded.bag.with_name("bag_snapshots")}
    for path, at, action in zip(recorded.snapshots, (9000, 20000), ("freeze", "clear"), strict=True):
        first, last = rows(at - PRE, at + POST)
        assert read(path) == span(whole, first, last)
        triggers = [[at, f"learning_controller: {action}"]]
        assert told(path) == {"first_sample": first, "samples": last - first + 1, "whole": True, "triggers": triggers}
        assert {key: text for key, text in about(path).items() if key != SNAPSHOT} == about(recorded.bag)
    assert {"lathe_rc.scenario", "lathe_rc.versions", "lathe_rc.run_id"} <= about(recorded.bag).keys()


def test_the_commands_read_a_snapshot_as_a_bag(recorded):
    """So do other readers; but its run cannot be computed again."""
    for path in recorded.snapshots:
        found, span = check(path), told(path)
        assert (found.exit_code, found.first, found.samples) == (0, span["first_sample"], span["samples"])
        found = gather(path)
        assert (found.complete, losses(found)) == (True, [])
        assert lathe("bag", "info", path, "--json").exit_code == 0
        with storage_of(path).open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            found = [(channel.topic, message.log_time, message.data) for _, channel, message in reader.iter_messages()]
            assert reader.get_summary().statistics.message_count == len(found)
        signals = read(path)
        assert [each for each in found if each[0] in {topic for topic, *_ in signals}] == signals
    assert_refused(lambda: resimulate(path), "the start of the run, from which controllers and drives have their state")


def test_an_alarm_is_a_trigger(tmp_path):
    broken = "electrodynamic_actuator.faults=['revolution 12: coarse/state.measured_position slow time=1e-3']"
    recorder = {"mode": "snapshot", "pre": 0.01, "post": 0.01, "triggers": ["supervisor: * tool"]}
    sets = ["spindle_encoder.revolutions=16", broken, *(f"recorder.{key}={value}" for key, value in recorder.items())]
    loaded = load(CONFIG / "supervised.yaml", sets)
    result = harness.run(loaded, bag=tmp_path / "bag")
    alarm = result.recording.sparse["/safety/status"].values
    (path,) = result.snapshots
    assert told(path)["triggers"] == [[alarm["sample_index"][0], "supervisor: error tool"]]


def test_the_first_complete_revolution_of_a_snapshot_has_the_number_that_it_has_in_the_run(tmp_path):
    result = harness.run(cell(["revolution 7: freeze"], mode="both", pre=0.15), bag=tmp_path / "bag")
    path = result.snapshots[-1]
    angle = result.recording.of_type(messages.ENCODER)["angle_true"]
    begun = int(np.ceil(angle[told(path)["first_sample"]] / (2 * np.pi)))
    shown = json.loads(lathe("bag", "info", path, "--json").stdout)
    assert shown["error_um"]["first"]["revolution"] == begun + 1 > 1


def test_state_of_the_cell_is_in_each_snapshot(recorded):
    """It is published once at the start: long before a snapshot begins."""
    if recorded.mode == "offline":
        return
    for path in recorded.snapshots:
        with AnyReader([path]) as bags:
            states = [each for each in bags.messages() if each[0].topic == "/cell_state"]
            assert bags.deserialize(states[0][2], states[0][0].msgtype).state == 1  # RUNNING
            assert [(each.depth, each.durability.name) for each in states[0][0].ext.offered_qos_profiles] == [
                (1, "TRANSIENT_LOCAL")
            ]
        assert states[0][1] >= START_NS + told(path)["first_sample"] * STEP_NS


def test_an_inspector_of_mcap_finds_no_fault(recorded):
    """Statistics name the channels that have messages, and no two metadata records have one name."""
    for path in (recorded.bag, *recorded.snapshots):
        with (path / f"{path.name}.mcap").open("rb") as stream:
            found = make_reader(stream)
            counted = Counter(message.channel_id for _, _, message in found.iter_messages())
            assert found.get_summary().statistics.channel_message_counts == counted
            names = [record.name for record in found.iter_metadata()]
            assert len(set(names)) == len(names) > 1


@settings(max_examples=20)
@given(
    st.lists(st.integers(0, 7500), min_size=1, max_size=5, unique=True),
    st.integers(0, 2000),
    st.integers(0, 1000),
    st.sampled_from([16, 64, 320]),
)
@pytest.mark.system
def test_no_sample_is_missing_or_written_twice(tmp_path_factory, samples, pre, post, block):
    """No sample is missing or in two snapshots: spans that overlap or touch, or whose blocks do, are one."""
    path = tmp_path_factory.mktemp("spans") / "bag"
    times = {"mode": "both", "pre": pre / 64_000, "post": post / 64_000, "triggers": ["*"], "chunk_size": 4096}
    events = {"events": [f"sample {at}: clear" for at in samples]}
    spindle = {"revolutions": 2.0}
    result = harness.run(
        scenario({"block_size": block}, spindle_encoder=spindle, learning_controller=events, recorder=times), bag=path
    )
    expected = []
    for at in sorted(samples):
        if at >= result.samples:
            continue
        first, last = max(at - pre, 0) // block * block, ((at + post) // block + 1) * block - 1
        if expected and first <= expected[-1][1] + 1:
            expected[-1] = expected[-1][0], last
        else:
            expected.append((first, last))
    everything = read(result.bag)
    assert [read(snapshot) for snapshot in result.snapshots] == [span(everything, *each) for each in expected]


def test_run_that_ends_before_its_time_is_up_ends_the_snapshot(tmp_path, whole):
    result = harness.run(cell(["sample 30000: clear"], mode="snapshot"), bag=tmp_path / "bag")
    (path,) = result.snapshots
    assert result.samples < 30000 + POST
    assert told(path)["whole"] is False
    assert told(path)["samples"] == result.samples - told(path)["first_sample"]
    assert result.bag is None
    assert [each.name for each in tmp_path.iterdir()] == ["bag_snapshots"]
    last = {topic: data for topic, _, data in read(path)}
    assert messages.decode(messages.TOOL, last["/tool"]).block.last


def test_no_trigger_leaves_nothing(tmp_path):
    assert harness.run(cell([], mode="snapshot"), bag=tmp_path / "bag").snapshots == ()
    assert not list(tmp_path.iterdir())


# --- processes


def ask(ghost):
    """Whether the recorder's service made a snapshot, and what it says."""
    client = ghost.create_client(Trigger, "/recorder/snapshot")
    assert client.wait_for_service(timeout_sec=20.0)
    future = client.call_async(Trigger.Request())
    rclpy.spin_until_future_complete(ghost, future, timeout_sec=20.0)
    return future.result().success, future.result().message


def test_service_makes_a_snapshot_and_an_interrupted_run_leaves_one(ghost, domain, tmp_path):
    running = cell([], 40.0, 0.2, mode="snapshot")
    expected = read(harness.run(cell([], 40.0), bag=tmp_path / "whole").bag)
    complete = harness.with_recorder(running, tmp_path / "bag", keep=True)
    with harness.Processes(complete, all_but(complete, "recorder"), domain=domain) as processes:
        processes.wait_for("cycle")
        success, answer = ask(ghost)
        assert success
        word, at, path = answer.replace(":", "").split()
        first, last = rows(int(at) - PRE, int(at) + POST)
        assert (word, Path(path)) == ("sample", tmp_path / "bag_snapshots" / f"sample_{int(at):010}")
        assert processes.wait_for("snapshot")["samples"] == 0
        closed = processes.wait_for("snapshot")
        assert closed["bag"] == path
        assert (closed["first"], closed["samples"], closed["whole"]) == (first, last - first + 1, True)
        assert read(Path(path)) == span(expected, first, last)
        # Whatever is closed is complete while the run goes on; what follows it is the next snapshot's.
        begun = processes.wait_for("cycle")["cycle"]
        processes.wait_for("cycle", cycle=begun + 3.0)
    assert not (tmp_path / "bag").exists()
    _, interrupted = sorted((tmp_path / "bag_snapshots").iterdir())
    found = told(interrupted)
    # The recorder may hear of another node's end before its own.
    assert found["triggers"][0][1].startswith("recorder: ")
    assert "was ended by SIGTERM in the middle of a run" in found["triggers"][0][1]
    assert found["whole"] is False
    left = read(interrupted)
    dense = {topic: stamp for topic, stamp, _ in left if not topic.endswith(("joint_states", "learning", "events"))}
    last = (min(dense.values()) - START_NS) // STEP_NS
    assert last >= found["first_sample"] + PRE - 1
    last -= BLOCK  # the last block differs: it ends the run
    assert span(left, 0, last) == span(expected, found["first_sample"], last)


def test_service_says_why_there_is_no_snapshot(tmp_path):
    with leading.configured("recorder", RecorderRole, bag=str(tmp_path / "bag")) as node:
        found = node.role._on_snapshot(Trigger.Request(), Trigger.Response())
        node.role.clean_up()
    assert not found.success
    assert found.message == "recorder.mode = 'continuous'; allowed for snapshots: snapshot or both"


@pytest.mark.parametrize("node", ["tool", pytest.param("recorder", marks=pytest.mark.system)])
def test_a_killed_node_leaves_the_last_seconds(node, tmp_path, whole):
    """A killed node leaves the seconds around its death, a killed recorder what had come to the disk."""
    pids = {}

    def kill(event):
        if event["event"] == "active":
            pids[event["node"]] = event["pid"]
        if event["event"] == ("snapshot" if node == "recorder" else "cycle") and node in pids:
            os.kill(pids.pop(node), signal.SIGKILL)

    # The recorder's is under way for as long as the cell runs.
    asked = {"events": ["sample 9000: freeze"], "post": 100.0} if node == "recorder" else {"events": []}
    running = cell(**asked, revolutions=2000.0, mode="snapshot", chunk_size=4096)
    with pytest.raises(LatheError, match=f"^{node} was killed by SIGKILL"):
        harness.run(running, mode="processes", groups=all_but(running, node), bag=tmp_path / "bag", watch=kill)
    (path,) = (tmp_path / "bag_snapshots").iterdir()
    found = told(path)
    assert found["whole"] is (node == "tool")
    assert not gather(path).complete  # the one ends at the loss, the other was never closed
    checked = check(path)
    assert (f"the snapshot has {checked.samples} samples, and it was never closed" in checked.lost) is (node != "tool")
    assert found["triggers"][0][1] == ("learning_controller: freeze" if node == "recorder" else "cell: lost /tool")
    read(path)


# --- memory, refusals, a full disk


class Feed:
    """A cell of one topic that never ends, straight into `Snapshots`."""

    def __init__(self, tmp_path, **recorder):
        self.table = RecorderParameters(**{"run_id": "run", **TIMES, "mode": "snapshot", "triggers": ["*"], **recorder})
        self.snapshots = Snapshots(tmp_path / "snapshots", self.table, name="recorder")
        dense = {"/a": (messages.STATE, "/one")}
        self.needed = self.snapshots.prepare(dense, ["one"])
        self.snapshots.add_topic("/a", messages.STATE, QOS)
        self._merger = Merger(self.snapshots, dense, {}, run_id="run", step_ns=STEP_NS, samples=self.table.block_size)
        self._encoder = Encoder(messages.STATE, "run", "/one", STEP_NS)
        self._signals = messages.allocate(messages.STATE, self.table.block_size)
        self.rows = 0

    def more(self, rows=1):
        for _ in range(rows):
            first = self.rows * self.table.block_size
            self._merger.add_block("/a", self._encoder.block(first, self._signals, None, last=False, companions=0))
            self._merger.release()
            self.rows += 1

    @property
    def kept(self):
        """Messages and rows in memory."""
        return len(self.snapshots._kept) + len(self.snapshots._waiting)


def test_memory_does_not_grow_with_the_run_nor_with_triggers(tmp_path):
    feed, most = Feed(tmp_path), PRE // BLOCK + 8
    full = set()
    for row in range(4000):
        feed.more()
        assert feed.kept <= most
        assert feed.snapshots.held <= feed.needed
        if row > most:
            full.add(feed.kept)
        if row % 97 == 96 or 2000 < row < 2500:
            feed.snapshots.trigger("test")
    feed.snapshots.close()
    assert min(full) >= PRE // BLOCK
    assert feed.snapshots.bags > 10


def test_snapshot_comes_to_the_disk_in_bounded_pieces(tmp_path):
    """A trigger writes nothing by itself, and each block that comes a few: the cell is not delayed."""
    feed = Feed(tmp_path, chunk_size=4096, compression="none")
    feed.more(200)
    snapshot = feed.snapshots.trigger("test")
    file = snapshot.path / f"{snapshot.path.name}.mcap"
    begun = size = file.stat().st_size
    grown = []
    writer = feed.snapshots._open[1]._file._thread  # writes one chunk after the other
    for _ in range(PRE // BLOCK):
        feed.more()
        writer.submit(lambda: None).result()
        grown.append(file.stat().st_size - size)
        size += grown[-1]
    block = feed.needed / (PRE / BLOCK + 18)
    assert max(grown) < 6 * block
    assert size - begun > PRE / BLOCK * block


def test_standing_cell_does_not_keep_the_snapshot_from_the_disk(tmp_path):
    feed = Feed(tmp_path, chunk_size=2**20, compression="none")
    feed.more(200)
    snapshot = feed.snapshots.trigger("test")
    file = snapshot.path / f"{snapshot.path.name}.mcap"
    feed.snapshots.flush()
    feed.snapshots.flush()
    assert file.stat().st_size > feed.needed * PRE / BLOCK / (PRE / BLOCK + 18)


def test_flood_of_events_is_refused_by_name(tmp_path):
    feed = Feed(tmp_path, memory=600_000, triggers=["one: never"])
    feed.snapshots.add_topic("/one/events", messages.EVENT, QOS)

    event = Framer("run", "/one", STEP_NS).sparse(Sparse("one/events", messages.EVENT, 0, {"action": "again"}))
    data = messages.encode(messages.EVENT, event)

    def flood():
        for k in range(10_000):
            feed.snapshots.write("/one/events", START_NS + k, data)

    with pytest.raises(LatheError, match=r"recorder: \d+ B are kept for pre = 0.05 s; allowed: memory = 600000 B"):
        flood()


REFUSED = {
    "too long": (
        {"pre": 60.0, "memory": 2**20},
        r"recorder.pre = 60 s takes \d+ B of memory, \d+ B for 64 samples .* allows pre = 0\.\d+ s: shorten pre or",
    ),
    "no memory": ({"pre": 0.0, "memory": 2**16}, r"memory = 65536 B allows none: raise memory to \d+ B or more"),
    "no node": ({"triggers": ["tol: *"]}, r"triggers = 'tol: \*': no node 'tol' in the cell; did you mean tool\?"),
    "no pattern": ({"triggers": ["freeze"]}, r"= 'freeze'; allowed: a pattern of NODE: ACTION, like '\*: freeze'"),
    "faults": ({"faults": ["second 1: bag off"]}, r"= .*: a recorder has none; allowed: none \(see triggers"),
    "backwards": ({"pre": -1.0}, r"recorder.pre = -1.0; allowed: a finite number from 0 up to 3600 \[s\]"),
}


@pytest.mark.parametrize(("kind", "mode"), [*((kind, "offline") for kind in REFUSED), ("too long", "composed")])
def test_what_cannot_work_is_refused(tmp_path, kind, mode):
    recorder, why = REFUSED[kind]
    assert_refused(lambda: harness.run(cell(mode="snapshot", **recorder), mode=mode, bag=tmp_path / "bag"), why)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("is_node", [False, True])
def test_existing_snapshots_are_never_overwritten(tmp_path, is_node):
    (tmp_path / "bag_snapshots").mkdir()
    (tmp_path / "bag_snapshots" / "precious").write_text("data")
    why = "bag_snapshots exists; a bag is never overwritten"
    if is_node:
        with leading.configured("recorder", RecorderRole, bag=str(tmp_path / "bag"), mode="snapshot") as node:
            assert why in str(node.protocol.failure)
    else:
        assert_refused(lambda: harness.run(cell(mode="snapshot"), bag=tmp_path / "bag"), why)
    assert [path.name for path in (tmp_path / "bag_snapshots").iterdir()] == ["precious"]


def test_full_disk_fails_by_name(tmp_path):
    """A file that may not grow any more is the same to the recorder."""
    feed = Feed(tmp_path, chunk_size=4096, compression="none", pre=1.0)
    feed.more(1000)
    snapshot = feed.snapshots.trigger("test")
    why = rf"{snapshot.path}: cannot write \({os.strerror(errno.EFBIG)}\); what was recorded before is readable"
    with files_up_to(2**19), pytest.raises(LatheError, match=why):
        feed.more(1000)
    with pytest.raises(LatheError, match=why):
        feed.snapshots.close()
    assert read(snapshot.path)


@pytest.mark.parametrize("first", ["null", "-1", "1.5", "true"])
def test_what_a_bag_says_of_its_first_sample_is_checked(first):
    for text in ("", "[]", '{"first_sample": 1}', f'{{"samples": 1, "first_sample": {first}}}'):
        assert_refused(lambda told=text: first_sample({SNAPSHOT: told}), "allowed: what a recorder writes, with first")
