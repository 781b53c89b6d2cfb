# SPDX-License-Identifier: Apache-2.0
"""Bags: complete, in order, readable by others, and saved when the recorder dies."""

import tracemalloc
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest
import yaml
from cells import run, same, scenario
from mcap.reader import make_reader
from mcap_damage import chunk_ends
from rosbags.highlevel import AnyReader

from lathe_rc import harness, messages
from lathe_rc.bag import reader
from lathe_rc.bag.repairing import recover
from lathe_rc.bag.writing.mcap_file import McapFile, channel_content, schema_content
from lathe_rc.errors import InputError

EVENTS = {"events": ["revolution 1.5: freeze", "sample 7000: learn"]}


def record(path, **recorder):
    return harness.run(scenario(learning_controller=EVENTS, recorder={"chunk_size": 65_536, **recorder}), bag=path)


@dataclass(repr=False)
class Recorded:
    """A run and its bag."""

    result: harness.Result
    path: Path

    @cached_property
    def messages(self):
        """See `read_by_mcap`, which takes its time."""
        return read_by_mcap(self.path)

    @cached_property
    def decoded(self):
        """See `read_by_rosbags`, which takes even more."""
        return read_by_rosbags(self.path)

    @cached_property
    def chunks(self):
        """See `chunk_ends`."""
        return chunk_ends(file_of(self.path).read_bytes())


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("bags") / "whole"
    return Recorded(record(path), path)


def file_of(path: Path) -> Path:
    return path / f"{path.name}.mcap"


def read_by_mcap(path):
    """Topic, log time, publish time and bytes of every message."""
    with file_of(path).open("rb") as stream:
        found = make_reader(stream).iter_messages(log_time_order=False)
        return [(channel.topic, part.log_time, part.publish_time, part.data) for _, channel, part in found]


def read_by_rosbags(path):
    """Topic, log time and message of every message, by the definitions in the bag."""
    with AnyReader([path]) as bags:
        return [(c.topic, stamp, bags.deserialize(data, c.msgtype)) for c, stamp, data in bags.messages()]


def summary_of(path):
    with file_of(path).open("rb") as stream:
        return make_reader(stream).get_summary()


# --- content


def test_mcap_rosbags_and_our_reader_read_every_sample(recorded):
    recording, types = recorded.result.recording, recorded.result.recording.types
    by_mcap = [(topic, messages.decode(types[topic], data)) for topic, _, _, data in recorded.messages]
    for told in (by_mcap, [(topic, message) for topic, _, message in recorded.decoded]):
        for topic, signals in recording.dense.items():
            blocks = [message for name, message in told if name == topic]
            found = {name: np.concatenate([getattr(block, name) for block in blocks]) for name in signals}
            assert same(found, signals)
    assert reader.read_bag(recorded.path).digests() == recorded.result.digest


def test_sparse_messages_are_all_there(recorded):
    for topic, part in recorded.result.recording.sparse.items():
        assert [stamp for name, stamp, _ in recorded.decoded if name == topic] == part.stamps
    actions = [message.action for name, _, message in recorded.decoded if name == "/learning_controller/events"]
    assert actions == ["freeze", "learn"]


def test_messages_stand_in_the_order_of_log_time_which_is_that_of_the_last_sample_and_topic(recorded):
    order = [(log_time, topic) for topic, log_time, _, _ in recorded.messages]
    assert order == sorted(order)
    assert all(log_time == publish_time for _, log_time, publish_time, _ in recorded.messages)
    for _, log_time, message in recorded.decoded:
        assert log_time == messages.stamp_ns(message)
        if hasattr(message, "block"):
            samples = next(array.size for array in vars(message).values() if isinstance(array, np.ndarray))
            assert log_time == 1_000_000_000 + (message.block.first_index + samples - 1) * 15_625
        elif hasattr(message, "sample_index"):
            assert log_time == 1_000_000_000 + message.sample_index * 15_625


def test_blocks_follow_each_other_and_the_last_says_so(recorded):
    for topic in recorded.result.recording.dense:
        blocks = [message.block for name, _, message in recorded.decoded if name == topic]
        assert [block.first_index for block in blocks] == list(range(0, recorded.result.samples, 64))
        assert [block.last for block in blocks] == [False] * (len(blocks) - 1) + [True]
        assert {(block.run_id, block.step_ns) for block in blocks} == {("test", 15_625)}
        assert len({block.source for block in blocks}) == 1


def test_block_tells_how_many_sparse_messages_came_before_it(recorded):
    sparse = {"/coarse/learning": "/learning_controller", "/learning_controller/events": "/learning_controller"}
    heard = dict.fromkeys(["/spindle_encoder", "/electrodynamic_actuator", "/tool", "/learning_controller"], 0)
    for stamp in sorted({stamp for _, stamp, _ in recorded.decoded}):
        now = [(topic, message) for topic, at, message in recorded.decoded if at == stamp]
        for topic, _ in now:
            if topic.endswith("/joint_states") or topic in sparse:
                heard[sparse.get(topic, topic.removesuffix("/joint_states"))] += 1
        assert all(m.block.companions == heard[m.block.source] for _, m in now if hasattr(m, "block"))
    assert all(heard.values())


@pytest.mark.parametrize("recorder", [{}, {"compression": "none"}, {"chunk_size": 4096}, {"chunk_size": 2**26}])
def test_neither_another_run_nor_compression_and_chunks_change_a_message(recorded, tmp_path, recorder):
    record(tmp_path / "other", **recorder)
    assert read_by_mcap(tmp_path / "other") == recorded.messages


# --- what is told about it


def test_bag_holds_its_run_counts_schemas_and_qos(recorded):
    metadata = yaml.safe_load((recorded.path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert metadata["custom_data"]["lathe_rc.run_id"] == "test"
    assert metadata["message_count"] == len(recorded.messages)
    counts = {part["topic_metadata"]["name"]: part["message_count"] for part in metadata["topics_with_message_count"]}
    assert counts["/tool"] == recorded.result.blocks
    summary = summary_of(recorded.path)
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
        assert schema.name == recorded.result.recording.types[channel.topic]
        assert schema.data
        (offered,) = yaml.safe_load(channel.metadata["offered_qos_profiles"])
        assert (offered["reliability"], offered["durability"]) == ("reliable", "transient_local")
        assert channel.metadata["topic_type_hash"].startswith("RIHS01_")
    assert {index.compression for index in summary.chunk_indexes} == {"zstd"}
    assert len(summary.chunk_indexes) > 5


@pytest.mark.parametrize(
    ("place", "why"),
    [
        ("there", "there exists; a bag is never overwritten"),
        ("there/file/bag", r"bag: cannot be made \(Not a directory\)"),
        ("new/folder/bag", "bag: there is no folder .*/new/folder; make it"),  # a slip in a path makes no new place
    ],
)
def test_place_that_cannot_be_a_new_bag_is_refused_and_left_alone(tmp_path, place, why):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "file").write_text("data")
    with pytest.raises(InputError, match=why):
        record(tmp_path / place)
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")] == ["there", "there/file"]


# --- recovery

TAILS = {"": b"", "0": bytes(5000), "F": b"\xff" * 5000, "random": np.random.default_rng(1).bytes(5000)}


@pytest.mark.parametrize("part", [0.0, 0.5, 0.999999])  # a thousand cuts are in test_recover.py
@pytest.mark.parametrize("tail", TAILS)
def test_every_complete_chunk_of_a_cut_bag_is_saved(recorded, tmp_path, part, tail):
    """A crashed machine may leave anything where it meant to write. Schemas and quality of service are kept."""
    whole = file_of(recorded.path).read_bytes()
    length = int(part * len(whole))
    expected = max((count for end, count in recorded.chunks if end <= length), default=0)
    broken = tmp_path / "cut"
    broken.mkdir()
    file_of(broken).write_bytes(whole[:length] + TAILS[tail])
    assert recover.mend(broken).saved == expected
    assert read_by_mcap(broken) == recorded.messages[:expected]
    assert list(tmp_path.iterdir()) == [broken]
    if not tail:
        assert len(read_by_rosbags(broken)) == expected
        for topic, signals in reader.read_bag(broken).dense.items():
            samples = recorded.result.recording.dense[topic]
            assert same(signals, {name: samples[name][: signals[name].size] for name in signals})
    if expected:
        told = [{c.topic: c.metadata for c in summary_of(p).channels.values()} for p in (broken, recorded.path)]
        assert told[0] == told[1]


def test_whole_bag_is_left_alone_and_nothing_made_where_there_is_none(recorded, tmp_path):
    before = file_of(recorded.path).read_bytes()
    assert recover.mend(recorded.path) is recover.mend(tmp_path / "none") is None
    assert file_of(recorded.path).read_bytes() == before
    assert not list(tmp_path.iterdir())


def test_run_without_a_bag_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(recorder={})
    assert not list(tmp_path.iterdir())


def test_memory_of_a_long_recording_grows_by_little_more_than_its_index(tmp_path):
    """A recorder writes two chunks a second: 170 000 a day."""
    file = McapFile(tmp_path / "long.mcap", chunk_size=2**20, compress=False)
    schema = file.add_schema(schema_content("std_msgs/msg/String", "ros2msg", b"string data"))
    channels = [file.add_channel(channel_content(f"/topic_{number}", "cdr", {}), schema) for number in range(12)]

    def write(chunks: int) -> None:
        for stamp in range(chunks):
            for channel in channels:
                file.add_message(channel, stamp, b"0" * 100)
            file.flush()

    write(200)
    tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    write(200)
    after, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    file.finish()
    assert (after - before) / 200 < 500  # [B] a chunk; an index entry has 200
