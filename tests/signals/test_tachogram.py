# SPDX-License-Identifier: Apache-2.0
"""Tachograms: read from a file as speed law, and made from a recorded run."""

import json
import re
from decimal import Decimal

import numpy as np
import pytest
from cells import encoder, scenario
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from machines import assert_refused

from lathe_rc import harness
from lathe_rc.cell.scenario import load
from lathe_rc.cli import main
from lathe_rc.signals import tachogram

SWING = {"deviation_amplitude": [0.1], "deviation_frequency": [60.0], "revolutions": 4.0}
FILE = "time_s,rpm\n0.0,1000\n0.1,1100\n0.3,900\n"


@pytest.fixture
def path(tmp_path):
    return tmp_path / "speed.csv"


def turned(**spindle):
    """A run of the smallest cell."""
    return harness.run(scenario(spindle_encoder=spindle))


@given(
    st.lists(st.floats(-100.0, 100.0), min_size=1, max_size=400),
    st.floats(1e-3, 50.0),
    st.lists(st.integers(1, 60), min_size=1, max_size=5),
)
def test_lines_stay_within_the_tolerance_of_every_point_however_they_come(values, tolerance, cuts):
    time, value = np.arange(len(values)) * 1e-3, np.array(values)
    thinner, place = tachogram.Thinner(tolerance), 0
    while place < value.size:
        size = cuts[place % len(cuts)]
        thinner.add(time[place : place + size], value[place : place + size])
        place += size
    picked_time, picked = thinner.finish()
    assert np.abs(np.interp(time, picked_time, picked) - value).max() <= tolerance
    whole = tachogram.Thinner(tolerance)
    whole.add(time, value)
    assert np.array_equal(whole.finish(), (picked_time, picked))


def test_a_straight_record_is_two_points_however_long():
    thinner = tachogram.Thinner(1e-3)
    for start in range(0, 320_000, 64):
        thinner.add(np.arange(start, start + 64) * 1e-5, np.full(64, 1000.0))
    assert thinner.finish()[0].tolist() == pytest.approx([0.0, 3.19999])


def test_the_file_gives_the_law_of_both_lists(path):
    path.write_text(FILE)
    lists = {"tachogram_time": [0.0, 0.1, 0.3], "tachogram_deviation": [0.0, 1100 / 1000 - 1, 900 / 1000 - 1]}
    assert turned(tachogram_file=str(path), revolutions=4.0).digest == turned(**lists, revolutions=4.0).digest


def test_the_file_s_content_is_part_of_the_run_s_identity(path, tmp_path):
    cell, ids = tmp_path / "cell.yaml", set()
    cell.write_text("/spindle_encoder: {ros__parameters: {tachogram_file: speed.csv, revolutions: 2.0}}")
    for text in (FILE, FILE.replace("1100", "1101")):
        path.write_text(text)
        ids.add(load(cell).shared.run_id)
    assert len(ids) == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,n\n0,1\n", "column 'n' has no unit; allowed for speed: rpm, 1/min"),
        ("time_s,rpm\n0,1000\n1,1000\n1,900\n", "row 3 is 0 s after the one before; allowed: times that rise"),
        ("time_s,rpm\n0,1000\n0.5,0\n", "rpm = 0 in row 2, 0.5 s after the first; allowed: above 0"),
        ("time_s\trpm\n0\t1.00,5\n", ":2: 'rpm' is '1.00,5'; allowed"),
        ("time_s,rpm\n0,16.7\n1,16.6\n", "rpm is 16.65 in the middle, with nominal_rpm = 1000, which looks like rev"),
        ("time_s,rpm\n0,1\n1,15\n2,16\n3,17\n", "(multiply by 60, or set nominal_rpm = 15.5 if it is)"),
        ("time_s,rpm\n0,104.72\n", "rpm is 104.7 in the middle, with nominal_rpm = 1000, which looks like rad/s; al"),
        ("time_s,rpm\n0,6000\n", "looks like degrees per second; allowed: 1/min (multiply by 0.1667, or set nominal_r"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(path, text, message):
    path.write_text(text)
    assert_refused(lambda: turned(tachogram_file=str(path)), f"{re.escape(str(path))}.*{re.escape(message)}")


@pytest.mark.parametrize("start", ["1700000000.000000125", "-3.5", f"{2**52}", "1e9", "+86400.0", "1e-9", "7"])
def test_a_file_begins_at_its_first_row_whatever_its_clock_shows(path, start):
    rows = [f"{Decimal(start) + Decimal(time)},{rpm}" for time, rpm in (("0", 1000), ("0.1000000001", 1100))]
    path.write_text("\n".join(["time_s,rpm", *rows]))
    assert [column.tolist() for column in tachogram.read(path)] == [[0.0, 0.1000000001], [1000.0, 1100.0]]


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"revolutions": 4.9}, []),
        ({"revolutions": 9.0}, ["tachogram_file ends 0.3 s after its first row, the run at 0.56112 s: the spindle"]),
        (
            {"tachogram_file": "", "tachogram_time": [1.7e9, 1.7e9 + 1], "tachogram_deviation": [0.1, 0.2]},
            ["tachogram_time begins at 1700000000 s, after the end of the run at 0.10909 s: the spindle turns at 1100"],
        ),
    ],
)
def test_a_tachogram_that_does_not_meet_the_run_is_told(path, changed, said):
    """A tachogram that is too short for the run is reported before the start and in the result."""
    path.write_text(FILE.replace("\n0.", "\n7."))
    events = []
    spindle = {"tachogram_file": str(path), "revolutions": 2.0, **changed}
    result = harness.run(scenario(spindle_encoder=spindle), watch=events.append)
    assert len(result.summary()["warnings"]) == len(said)
    assert all(line.startswith(f"spindle_encoder.{start}") for line, start in zip(result.warnings, said, strict=True))
    assert [event["message"] for event in events if event["event"] == "warning"] == result.warnings


def test_a_file_beside_the_lists_is_refused(path):
    both = {"tachogram_file": str(path), "tachogram_time": [0.0], "tachogram_deviation": [0.1]}
    assert_refused(lambda: turned(**both), r"speed\.csv beside tachogram_time; allowed: one of them")


def test_a_recorded_speed_comes_back_within_the_tolerance(path, tmp_path):
    """A tachogram of a bag keeps its tolerance, and the run that follows it has the recorded speed."""
    first = harness.run(scenario(spindle_encoder=SWING), bag=tmp_path / "bag")
    words = ["bag", "tachogram", str(tmp_path / "bag"), "-o", str(path), "--tolerance", "0.5", "--json"]
    told = json.loads(CliRunner().invoke(main, words, catch_exceptions=False).output)
    again = turned(tachogram_file=str(path), revolutions=3.9)
    speed, recorded = encoder(again)["speed_true"], encoder(first)["speed_true"]
    difference = np.abs(speed - recorded[: speed.size]).max() * 30 / np.pi
    assert told["samples"] == first.samples
    assert told["points"] == len(path.read_text().splitlines()) - 2 < 60
    assert difference <= told["largest"] <= 0.5
