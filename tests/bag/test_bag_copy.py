# SPDX-License-Identifier: Apache-2.0
"""Filtered, cut, merged and converted bags: every chosen message to the byte, read by another library."""

import json
from datetime import datetime, timezone

import numpy as np
import pytest
from bags import lathe, read_by_others, strange_bag
from cells import config
from rosbags.rosbag2 import StoragePlugin

import lathe_rc
from lathe_rc import harness
from lathe_rc.bag.check import check
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.bag.writing.writer import BagWriter


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    """Bag of two revolutions and an event."""
    path = tmp_path_factory.mktemp("bags") / "turned"
    sets = ["spindle_encoder.revolutions=2", "learning_controller.events=['sample 1280: freeze']"]
    harness.run(config("piston", *sets), bag=path)
    return path


def test_a_part_of_a_bag_holds_the_chosen_messages_to_the_byte(turned, tmp_path):
    whole = read_by_others(turned)
    first = whole[0][1]
    words = ["--topics", "/tool,/encoder", "--without", "/encoder", "--start", "0.02", "--end", "0.05"]
    done = lathe("bag", "copy", turned, "-o", tmp_path / "part", *words, "--json")
    wanted = [m for m in whole if m[0] == "/tool" and first + 20_000_000 <= m[1] < first + 50_000_000]
    assert done.exit_code == 0
    assert read_by_others(tmp_path / "part") == wanted != []
    assert json.loads(done.stdout)["bags"][0]["saved"] == len(wanted)
    found = check(tmp_path / "part")
    assert (found.wrong, found.lost[0]) == ([], "/tool: 1280 samples are missing before sample 1280")


def test_bags_are_merged_by_log_time_and_a_database_becomes_mcap(turned, tmp_path):
    sent = strange_bag(tmp_path / "strange", StoragePlugin.SQLITE3)
    done = lathe("bag", "copy", turned, tmp_path / "strange", "-o", tmp_path / "both")
    merged = read_by_others(tmp_path / "both")
    assert done.exit_code == 0
    assert sorted(merged) == sorted(read_by_others(turned) + sent)
    assert [stamp for _, stamp, _ in merged] == sorted(stamp for _, stamp, _ in merged)
    assert len(list((tmp_path / "both").glob("*.mcap"))) == 1


def test_the_scenario_does_not_scroll_the_topics_away_where_it_is_not_asked_for(turned):
    whole, short = lathe("bag", "info", turned).stdout, lathe("bag", "info", turned, "--no-scenario").stdout
    count = whole.count("\n") - short.count("\n")
    assert "ros__parameters" in whole
    assert "ros__parameters" not in short
    assert f"scenario: {count} lines; --scenario prints them" in short
    assert short.index("/tool") < short.index("scenario:")
    assert "event: sample 1280, /learning_controller: freeze\n" in short


def test_a_recording_that_joined_late_or_lacks_samples_is_described(turned, tmp_path):
    for name, words in {"first": ["--end", "0.03"], "late": ["--start", "0.06"]}.items():
        assert lathe("bag", "copy", turned, "-o", tmp_path / name, *words).exit_code == 0
    lathe("bag", "copy", tmp_path / "first", tmp_path / "late", "-o", tmp_path / "gap")
    told = lathe("bag", "info", tmp_path / "late")
    assert told.exit_code == 0
    assert "recorded from sample 3840 of the run on" in told.output
    assert f"written: {datetime.now(timezone.utc):%Y-%m-%d}" in told.output
    whole, late = lathe_rc.read_bag(turned).dense["/tool"]["error"], lathe_rc.read_bag(tmp_path / "late")
    assert np.array_equal(late.dense["/tool"]["error"], whole[3840:])
    told = lathe("bag", "info", tmp_path / "gap", "--json")
    assert told.exit_code == 3
    assert json.loads(told.stdout)["topics"]["/tool"]["messages"] > 60
    assert "goes from sample 1920 to 3840" in json.loads(told.stdout)["damage"][0]
    told = lathe("resim", tmp_path / "late")
    assert told.exit_code == 2
    assert "was recorded from sample 3840 on: the start of the run" in told.output


def test_a_cell_recorded_at_the_wall_time_is_clean(turned, tmp_path):
    """The log times of its blocks are not their stamps."""
    made = BagWriter(tmp_path / "wall", compression="none", chunk_size=2**20, about={})
    with BagSource(turned) as source:
        for topic, each in source.topics.items():
            made.add_topic(topic, each.type, each.qos[0])
        for topic, log_ns, data in source.messages():
            made.write(topic, 17 * 10**17 + log_ns, data)
    made.close()
    assert check(tmp_path / "wall").exit_code == 0
