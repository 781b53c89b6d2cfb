# SPDX-License-Identifier: Apache-2.0
"""Tachograms: read from a file as speed law, and made from a recorded run."""

import json

import numpy as np
import pytest
from cells import encoder, scenario
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from lathe_rc import harness
from lathe_rc.cell.scenario import load
from lathe_rc.cli import main
from lathe_rc.errors import InputError
from lathe_rc.signals import tachogram

SWING = {"deviation_amplitude": [0.1], "deviation_frequency": [60.0], "revolutions": 4.0}
FILE = "time_s,rpm\n0.0,1000\n0.1,1100\n0.3,900\n"


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
    for start in range(0, 1_000_000, 64):
        thinner.add(np.arange(start, start + 64) * 1e-5, np.full(64, 1000.0))
    assert thinner.finish()[0].tolist() == pytest.approx([0.0, 9.99999])


def test_the_file_gives_the_law_of_both_lists(tmp_path):
    path = tmp_path / "speed.csv"
    path.write_text(FILE)
    lists = {"tachogram_time": [0.0, 0.1, 0.3], "tachogram_deviation": [0.0, 1100 / 1000 - 1, 900 / 1000 - 1]}
    of_file = harness.run(scenario(spindle_encoder={"tachogram_file": str(path), "revolutions": 4.0}))
    of_lists = harness.run(scenario(spindle_encoder={**lists, "revolutions": 4.0}))
    assert of_file.digest == of_lists.digest


def test_the_file_s_content_is_part_of_the_run_s_identity(tmp_path):
    (tmp_path / "speed.csv").write_text(FILE)
    cell = tmp_path / "cell.yaml"
    cell.write_text("/spindle_encoder: {ros__parameters: {tachogram_file: speed.csv, revolutions: 2.0}}")
    before = load(cell).shared.run_id
    (tmp_path / "speed.csv").write_text(FILE.replace("1100", "1101"))
    assert load(cell).shared.run_id != before


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time_s,rpm\n", "no row; allowed: one or more of time_s,rpm"),
        ("time,rpm\n0,1\n", "header 'time,rpm'; allowed: time_s,rpm"),
        ("time_s,rpm\n-1,1000\n", "time_s = -1 in row 1; allowed: from 0 on, each later than the last"),
        ("time_s,rpm\n0,1000\n1,1000\n1,900\n", "time_s = 1 in row 3; allowed: from 0 on, each later than the last"),
        ("time_s,rpm\n0,1000\n0.5,0\n", "rpm = 0 at 0.5 s; allowed: above 0"),
        ("time_s,rpm\n0,fast\n", "'fast' is not a number"),
        ("time_s,rpm\n0\n", "1 values; allowed: 2"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path, text, message):
    path = tmp_path / "speed.csv"
    path.write_text(text)
    with pytest.raises(InputError) as refused:
        harness.run(scenario(spindle_encoder={"tachogram_file": str(path)}))
    assert message in str(refused.value)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_file_beside_the_lists_is_refused(tmp_path):
    both = {"tachogram_file": str(tmp_path / "speed.csv"), "tachogram_time": [0.0], "tachogram_deviation": [0.1]}
    with pytest.raises(InputError, match=r"speed\.csv beside tachogram_time; allowed: one of them"):
        harness.run(scenario(spindle_encoder=both))


def test_a_recorded_speed_comes_back_within_the_tolerance(tmp_path):
    """By the command; the run that follows the file has the recorded speed at every sample."""
    first = harness.run(scenario(spindle_encoder=SWING), bag=tmp_path / "bag")
    path = tmp_path / "speed.csv"
    words = ["bag", "tachogram", str(tmp_path / "bag"), "-o", str(path), "--tolerance", "0.5", "--json"]
    said = CliRunner().invoke(main, words, catch_exceptions=False)
    told = json.loads(said.output)
    again = harness.run(scenario(spindle_encoder={"tachogram_file": str(path), "revolutions": 3.9}))
    speed, recorded = encoder(again)["speed_true"], encoder(first)["speed_true"]
    difference = np.abs(speed - recorded[: speed.size]).max() * 30 / np.pi
    assert told["samples"] == first.samples
    assert told["points"] == len(path.read_text().splitlines()) - 2 < 60
    assert difference <= told["largest"] <= 0.5


def test_a_bag_without_an_encoder_of_that_name_is_refused(tmp_path):
    harness.run(scenario(spindle_encoder={"revolutions": 0.2}), bag=tmp_path / "bag")
    said = CliRunner().invoke(main, ["bag", "tachogram", str(tmp_path / "bag"), "--topic", "/other"])
    assert (said.exit_code, said.output.strip()) == (
        2, f"lathe: --topic /other: {tmp_path / 'bag'} has no such encoder; allowed: /encoder",
    )  # fmt: skip
