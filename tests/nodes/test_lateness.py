# SPDX-License-Identifier: Apache-2.0
"""How late the blocks of a paced run were let go, as it is told at its end."""

import json

import numpy as np
import pytest
from cells import scenario
from hypothesis import given
from hypothesis import strategies as st

from lathe_rc import harness
from lathe_rc.blocks.latency_histogram import Lateness, Percentiles
from lathe_rc.commands import outcome
from lathe_rc.errors import InputError, PaceError


@given(st.lists(st.floats(0.0, 1e4), min_size=1, max_size=300), st.sampled_from([1, 50, 95, 99, 100]))
def test_percentiles_are_never_too_small_and_too_large_by_3_percent_or_a_microsecond(seconds, percent):
    kept = Percentiles()
    for each in seconds:
        kept.add(each)
    exact = np.percentile(seconds, percent, method="inverted_cdf")
    assert exact <= kept.within(percent) * (1 + 1e-12)
    assert kept.within(percent) <= exact * 1.032 + 1e-6
    assert kept.worst == max(seconds)
    assert kept.count == len(seconds)


def test_no_duration_at_all_has_no_percentiles():
    assert Percentiles().within(99) == 0.0


@pytest.fixture(scope="module")
def paced():
    """A revolution at real time."""
    return harness.run(scenario(spindle_encoder={"revolutions": 1.0, "speed_factor": 1.0}), mode="composed")


def test_a_paced_run_tells_its_lateness_at_its_end(paced):
    """A run with a pace prints at its end how late its blocks were.

    The numbers are whole and in order; their values depend on the machine.
    """
    told = paced.lateness
    assert told.blocks == paced.blocks
    assert 0 <= told.late <= told.blocks
    within = list(told.within.values())
    assert list(told.within) == [50, 95, 99]
    assert 0.0 <= within[0] <= within[1] <= within[2] <= told.worst
    assert told.slipped >= 0.0


def test_a_strict_pace_that_is_not_held_ends_the_run_with_its_own_exit_code():
    hasty = {"revolutions": 1.0, "speed_factor": 1e6, "strict_pace": True}
    late = r"strict_pace: block \d+ is .* ms late; allowed: half a window, .* is the slowest member; try a smaller"
    with pytest.raises(PaceError, match=late) as failed:
        harness.run(scenario(spindle_encoder=hasty), mode="composed")
    assert failed.value.exit_code == 4
    with pytest.raises(InputError, match="strict_pace with speed_factor = 0: there is no pace"):
        harness.run(scenario(spindle_encoder={**hasty, "speed_factor": 0.0}), mode="composed")


def test_without_a_pace_nothing_is_late():
    assert harness.run(scenario(spindle_encoder={"revolutions": 0.5})).summary()["lateness_s"] is None


def test_lateness_is_told_in_words_and_as_json(paced):
    late = Lateness(60, 2, 0.0123, {50: 61e-6, 95: 0.5e-3, 99: 2e-3}, 0.004)
    whole = harness.Result(**{**vars(paced), "lateness": late})
    said = outcome.facts(whole)
    assert "2 of 60 blocks late; the schedule slipped by 0.004 s" in said
    assert "lateness: 50 % within 0.061 ms, 95 % within 0.5 ms, 99 % within 2 ms, worst 12.3 ms" in said
    told = json.loads(json.dumps(paced.summary()))["lateness_s"]
    assert told.keys() == {"blocks", "late", "worst", "within", "slipped"}
    assert told["within"].keys() == {"50", "95", "99"}
    assert told["blocks"] == paced.blocks
