# SPDX-License-Identifier: Apache-2.0
"""Filtered, cut, merged and converted bags: every chosen message to the byte, read by another library."""

import json

import pytest
from bags import lathe, read_by_others, strange_bag
from cells import config
from rosbags.rosbag2 import StoragePlugin

from lathe_rc import harness
from lathe_rc.bag.check import check


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    """Bag of two revolutions."""
    path = tmp_path_factory.mktemp("bags") / "turned"
    harness.run(config("piston", "spindle_encoder.revolutions=2"), bag=path)
    return path


def test_a_part_of_a_bag_holds_the_chosen_messages_to_the_byte(turned, tmp_path):
    whole = read_by_others(turned)
    first = whole[0][1]
    words = ["--topics", "/tool", "--topics", "/encoder", "--without", "/encoder", "--start", "0.02", "--end", "0.05"]
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


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--topics", "/tol"], "no topic '/tol' in "),
        (["--start", "0.5", "--end", "0.5"], "--end 0.5 with --start 0.5; allowed: an end after the start"),
    ],
)
def test_a_choice_that_cannot_be_met_is_refused(turned, tmp_path, words, said):
    done = lathe("bag", "copy", turned, "-o", tmp_path / "part", *words)
    assert done.exit_code == 2
    assert said in done.output
    assert not (tmp_path / "part").exists()
