# SPDX-License-Identifier: Apache-2.0
"""A bag in several files: each is whole by itself, and together they are the recording."""

import shutil
from itertools import pairwise

import pytest
from cells import assert_resimulated, scenario
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from lathe_rc import harness
from lathe_rc.bag import reader
from lathe_rc.bag.check import check
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.bag.repairing import recover


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """The digests of a run of 0.48 s, its bag in files of 0.2 s, and its bag in one file."""
    folder = tmp_path_factory.mktemp("bags")
    digests = []
    for name, duration in (("split", 0.2), ("whole", 0.0)):
        nodes = scenario(spindle_encoder={"revolutions": 8.0}, recorder={"split_duration": duration})
        digests.append(harness.run(nodes, bag=folder / name).digest)
    assert digests[0] == digests[1]
    return digests[0], folder / "split", folder / "whole"


def test_a_split_bag_holds_the_recording(bags):
    """Readers of all kinds find every message once, in the same order as in one file."""
    digest, split, whole = bags
    assert sorted(file.name for file in split.glob("*.mcap")) == ["split.mcap", "split_1.mcap", "split_2.mcap"]
    assert reader.read_bag(split).digests() == digest
    assert check(split).exit_code == 0
    with AnyReader([split]) as ours, AnyReader([whole]) as theirs:
        assert [(c.topic, *rest) for c, *rest in ours.messages()] == [
            (c.topic, *rest) for c, *rest in theirs.messages()
        ]
    assert_resimulated(split)


def test_each_file_of_a_split_bag_is_whole_and_follows_the_one_before(bags):
    _, split, _ = bags
    ends = []
    for name in ("split", "split_1", "split_2"):
        with (split / f"{name}.mcap").open("rb") as stream:
            found = make_reader(stream)
            statistics = found.get_summary().statistics
            assert any(each.name == "lathe_rc" for each in found.iter_metadata())
            ends.append((statistics.message_start_time, statistics.message_end_time))
    assert all(before < first < last for (_, before), (first, last) in pairwise(ends))
    assert all(last - first < 0.2e9 for first, last in ends)


def test_a_split_bag_of_a_killed_recorder_is_completed(bags, tmp_path):
    """Completed files stay as they are, and of the last one what has reached the disk is saved."""
    _, split, _ = bags
    cut = tmp_path / "split"
    shutil.copytree(split, cut)
    (cut / "metadata.yaml").unlink()
    with (cut / "split_2.mcap").open("r+b") as stream:
        stream.truncate(stream.seek(0, 2) - 3000)
    found = recover.mend(cut)
    with BagSource(cut) as source, BagSource(split) as before:
        assert source.damage == []
        assert found.saved == sum(topic.count for topic in source.topics.values())
        assert source.first_ns == before.first_ns
        assert source.last_ns > before.first_ns + 0.4e9 - 2e6
