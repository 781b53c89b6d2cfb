# SPDX-License-Identifier: Apache-2.0
"""Bags: complete, in order, readable by others, and saved when the recorder dies."""

import shutil
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
from lathe_rc.bag.writing.mcap_file import McapFile
from lathe_rc.errors import InputError

EVENTS = {"events": ["revolution 1.5: freeze", "sample 7000: learn"]}
SMALL_CHUNKS = {"chunk_size": 65_536}


def record(path, **recorder):
    cell = scenario(learning_controller=EVENTS, recorder={**SMALL_CHUNKS, **recorder})
    return harness.run(cell, bag=path)


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


def dense_of(result, told):
    """The signals of all blocks, put together again by topic."""
    found = {}
    for topic, signals in result.recording.dense.items():
        blocks = [message for name, message in told if name == topic]
        found[topic] = {name: np.concatenate([getattr(block, name) for block in blocks]) for name in signals}
    return found


# --- content


def test_mcap_and_rosbags_read_every_sample(recorded):
    recording, types = recorded.result.recording, recorded.result.recording.types
    by_mcap = [(topic, messages.decode(types[topic], data)) for topic, _, _, data in recorded.messages]
    by_rosbags = [(topic, message) for topic, _, message in read_by_rosbags(recorded.path)]
    for told in (by_mcap, by_rosbags):
        found = dense_of(recorded.result, told)
        assert all(same(found[topic], signals) for topic, signals in recording.dense.items())


def test_our_reader_finds_the_same_digests(recorded):
    result, path = recorded.result, recorded.path
    assert reader.read_bag(path).digests() == result.digest


def test_sparse_messages_are_all_there(recorded):
    result, path = recorded.result, recorded.path
    told = read_by_rosbags(path)
    for topic, part in result.recording.sparse.items():
        assert [stamp for name, stamp, _ in told if name == topic] == part.stamps
    assert [m.action for name, _, m in told if name == "/learning_controller/events"] == ["freeze", "learn"]


def test_messages_stand_in_the_order_of_log_time_and_topic(recorded):
    order = [(log_time, topic) for topic, log_time, _, _ in recorded.messages]
    assert order == sorted(order)


def test_log_time_is_the_simulated_time_of_the_last_sample(recorded):
    for _, log_time, message in read_by_rosbags(recorded.path):
        assert log_time == messages.stamp_ns(message)
        if hasattr(message, "block"):
            samples = next(array.size for array in vars(message).values() if isinstance(array, np.ndarray))
            assert log_time == 1_000_000_000 + (message.block.first_index + samples - 1) * 15_625
        elif hasattr(message, "sample_index"):
            assert log_time == 1_000_000_000 + message.sample_index * 15_625
    assert all(log_time == publish_time for _, log_time, publish_time, _ in recorded.messages)


def test_blocks_follow_each_other_and_the_last_says_so(recorded):
    result, path = recorded.result, recorded.path
    for topic in result.recording.dense:
        blocks = [message.block for name, _, message in read_by_rosbags(path) if name == topic]
        assert [block.first_index for block in blocks] == list(range(0, result.samples, 64))
        assert [block.last for block in blocks] == [False] * (len(blocks) - 1) + [True]
        assert {(block.run_id, block.step_ns) for block in blocks} == {("test", 15_625)}
        assert len({block.source for block in blocks}) == 1


def test_block_tells_how_many_sparse_messages_came_before_it(recorded):
    told = read_by_rosbags(recorded.path)
    sparse = {"/coarse/learning": "/learning_controller", "/learning_controller/events": "/learning_controller"}
    heard = dict.fromkeys(["/spindle_encoder", "/electrodynamic_actuator", "/tool", "/learning_controller"], 0)
    for stamp in sorted({stamp for _, stamp, _ in told}):
        now = [(topic, message) for topic, at, message in told if at == stamp]
        for topic, _ in now:
            if topic.endswith("/joint_states") or topic in sparse:
                heard[sparse.get(topic, topic.removesuffix("/joint_states"))] += 1
        for _, message in now:
            if hasattr(message, "block"):
                assert message.block.companions == heard[message.block.source]
    assert all(heard.values())


@pytest.mark.parametrize("recorder", [{}, {"compression": "none"}, {"chunk_size": 4096}, {"chunk_size": 2**26}])
def test_neither_another_run_nor_compression_and_chunks_change_a_message(recorded, tmp_path, recorder):
    record(tmp_path / "other", **recorder)
    assert read_by_mcap(tmp_path / "other") == recorded.messages


# --- what is told about it


def test_bag_says_what_it_is(recorded):
    metadata = yaml.safe_load((recorded.path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert metadata["storage_identifier"] == "mcap"
    assert metadata["custom_data"]["lathe_rc.run_id"] == "test"
    assert metadata["message_count"] == len(recorded.messages)
    counts = {part["topic_metadata"]["name"]: part["message_count"] for part in metadata["topics_with_message_count"]}
    assert counts["/tool"] == recorded.result.blocks


def test_bag_holds_schemas_and_qos(recorded):
    with file_of(recorded.path).open("rb") as stream:
        summary = make_reader(stream).get_summary()
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


def test_existing_folder_is_never_overwritten(tmp_path):
    keep = tmp_path / "bag"
    keep.mkdir()
    (keep / "precious").write_text("data")
    with pytest.raises(InputError, match=r"bag exists; a bag is never overwritten"):
        record(keep)
    assert [path.name for path in keep.iterdir()] == ["precious"]


def test_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"bag: cannot be made \(Not a directory\)"):
        record(tmp_path / "file" / "bag")


def test_folders_above_are_not_made(tmp_path):
    """A slip in a path makes no new place."""
    with pytest.raises(InputError, match=rf"bag: there is no folder {tmp_path}/new/folder; make it"):
        record(tmp_path / "new" / "folder" / "bag")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("make", ["nothing", "file", "folder", "empty file", "junk"])
def test_what_is_no_bag_is_refused(tmp_path, make):
    bag = tmp_path / "bag"
    if make == "file":
        bag.touch()
    elif make != "nothing":
        bag.mkdir()
    if make in ("empty file", "junk"):
        file_of(bag).write_bytes(b"junk" * 100 if make == "junk" else b"")
    with pytest.raises(InputError, match="bag: not a readable bag"):
        reader.read_bag(bag)


# --- recovery


def cut(path, folder, length):
    """A bag as a recorder that was killed after ``length`` bytes leaves it."""
    broken = folder / "cut"
    shutil.rmtree(broken, ignore_errors=True)
    broken.mkdir()
    file_of(broken).write_bytes(file_of(path).read_bytes()[:length])
    return broken


TAILS = {"": b"", "0": bytes(5000), "F": b"\xff" * 5000, "random": np.random.default_rng(1).bytes(5000)}


@pytest.mark.parametrize("part", [0.0, 1e-5, 0.3, 0.5, 0.7, 0.999999, 1.0])  # a thousand cuts are in test_recover.py
@pytest.mark.parametrize("tail", TAILS)
def test_every_complete_chunk_of_a_cut_bag_is_saved(recorded, tmp_path, part, tail):
    """A crashed machine may leave anything where it meant to write."""
    length = int(part * file_of(recorded.path).stat().st_size)
    expected = max((count for end, count in recorded.chunks if end <= length), default=0)
    broken = cut(recorded.path, tmp_path, length)
    with file_of(broken).open("ab") as stream:
        stream.write(TAILS[tail])
    assert recover.mend(broken).saved == expected
    assert read_by_mcap(broken) == recorded.messages[:expected]
    assert [path.name for path in tmp_path.iterdir()] == [broken.name]
    if not tail:
        assert len(read_by_rosbags(broken)) == expected
        for topic, signals in reader.read_bag(broken).dense.items():
            whole = recorded.result.recording.dense[topic]
            assert same(signals, {name: whole[name][: signals[name].size] for name in signals})


def test_saved_bag_keeps_schemas_and_qos(recorded, tmp_path):
    broken = cut(recorded.path, tmp_path, file_of(recorded.path).stat().st_size // 2)
    recover.mend(broken)

    def told(path):
        with file_of(path).open("rb") as stream:
            channels = make_reader(stream).get_summary().channels.values()
            return {channel.topic: channel.metadata for channel in channels}

    assert told(broken) == told(recorded.path)


def test_whole_bag_is_left_alone(recorded):
    before = file_of(recorded.path).read_bytes()
    assert recover.mend(recorded.path) is None
    assert file_of(recorded.path).read_bytes() == before


def test_nothing_is_made_where_there_is_no_bag(tmp_path):
    assert recover.mend(tmp_path / "none") is None
    assert not list(tmp_path.iterdir())


def test_run_without_a_bag_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(recorder={})
    assert not list(tmp_path.iterdir())


def test_memory_of_a_long_recording_grows_by_little_more_than_its_index(tmp_path):
    """A recorder writes two chunks a second: 170 000 a day."""
    file = McapFile(tmp_path / "long.mcap", chunk_size=2**20, compress=False)
    schema = file.add_schema("std_msgs/msg/String", "string data")
    channels = [file.add_channel(f"/topic_{number}", schema, "cdr", {}) for number in range(12)]

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
