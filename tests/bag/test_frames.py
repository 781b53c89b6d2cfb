# SPDX-License-Identifier: Apache-2.0
"""Topics as tables: the samples to the bit, with units and the revolution they belong to, by pandas and without."""

import importlib.util

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from cells import form_error, scenario
from machines import line_of

from lathe_rc import harness
from lathe_rc.bag import reader
from lathe_rc.blocks.columns import columns

AT = 9000  # sample of the event, in the third revolution
RECORDER = {"mode": "both", "pre": 0.03, "post": 0.15, "triggers": ["*: freeze"]}


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """A run with a bag and a snapshot."""
    learning = {"events": [f"sample {AT}: freeze"]}
    cell = scenario(spindle_encoder={"revolutions": 5.0}, learning_controller=learning, recorder=RECORDER)
    return harness.run(cell, bag=tmp_path_factory.mktemp("frames") / "bag")


@pytest.fixture
def without_pandas(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *more: None if name == "pandas" else find(name, *more)
    )


def test_a_frame_has_the_samples_of_the_topic_to_the_bit_and_their_units(result):
    for topic, signals in result.recording.dense.items():
        frame = result.frame(topic)
        assert isinstance(frame, pd.DataFrame)
        assert list(frame.columns) == ["sample", "revolution", "spindle_angle", *signals]
        assert frame.index.name == "time"
        for name, samples in signals.items():
            assert frame[name].dtype == samples.dtype
            assert frame[name].to_numpy().tobytes() == samples.tobytes(), f"{topic}: {name}"
    assert frame.attrs["topic"] == topic
    assert result.frame("tool").attrs["units"]["error"] == "m"
    assert result.frame("/encoder").attrs["units"]["speed"] == "rad/s"
    assert result.frame("/encoder").attrs["units"]["time"] == "s"


def test_a_frame_is_a_copy(result):
    frame = result.frame("/tool")
    frame.loc[:, "error"] = 1.0
    assert form_error(result).max() < 1.0


def test_revolutions_are_those_of_the_form_errors(result):
    tool = result.frame("/tool")
    by_revolution = tool["error"].abs().groupby(tool["revolution"]).max()
    assert by_revolution.index.tolist() == [1, 2, 3, 4, 5]
    assert by_revolution.to_numpy().tolist() == result.errors.largest.tolist()
    turns = (tool["revolution"] - 1) * 2 * np.pi + tool["spindle_angle"]
    assert tool["spindle_angle"].between(0.0, 2 * np.pi).all()
    assert turns.to_numpy() == pytest.approx(result.frame("/encoder")["angle_true"].to_numpy(), rel=1e-12)


def test_messages_are_rows_at_their_samples(result):
    events = result.frame("/learning_controller/events")
    assert events[["sample", "revolution", "action"]].to_numpy().tolist() == [[AT, 3, "freeze"]]
    assert events.index[0] == result.frame("/tool").index[AT]
    assert result.frame("/tool/joint_states")["name"].unique().tolist() == ["tool"]


def test_without_pandas_a_frame_is_an_arrow_table_of_the_same(result, without_pandas):
    for topic in result.recording.types:
        table = result.frame(topic)
        assert isinstance(table, pa.Table)
        kinds = {column.name: column.unit for column in columns(result.recording.types[topic])}
        first = ["sample", "time", "revolution", "spindle_angle"]
        assert table.column_names == [*first, *list(kinds)[2:]]
        for name, unit in kinds.items():
            assert (table.schema.field(name).metadata or {}).get(b"unit", b"").decode() == unit
    table = result.frame("/tool")
    assert table["error"].to_numpy().tobytes() == form_error(result).tobytes()


def test_a_bag_gives_the_frames_of_its_run(result):
    recording = reader.read_bag(result.bag)
    for topic in recording.types:
        pd.testing.assert_frame_equal(recording.frame(topic), result.frame(topic), check_exact=True)


def test_a_snapshot_keeps_samples_times_and_revolutions(result):
    recording = reader.read_bag(result.snapshots[0])
    part, whole = recording.frame("/tool"), result.frame("/tool")
    assert recording.first == part["sample"].iloc[0] > 0
    pd.testing.assert_frame_equal(part, whole.loc[part.index[0] : part.index[-1]], check_exact=True)
    assert recording.frame("/learning_controller/events")["sample"].tolist() == [AT]
    before = int(part["revolution"].iloc[0])
    complete = recording.errors.rms.size
    assert complete == 2
    assert recording.errors.rms == pytest.approx(result.errors.rms[before : before + complete], rel=1e-9)


def test_a_run_without_a_spindle_has_no_revolutions(result):
    recording = reader.read_bag(result.bag)
    kinds = {topic: kind for topic, kind in recording.types.items() if topic != "/encoder"}
    rest = {topic: signals for topic, signals in recording.dense.items() if topic in kinds}
    alone = type(recording)(kinds, rest, recording.sparse, recording.step_ns)
    assert list(alone.frame("/tool"))[:2] == ["sample", "reference"]


def test_a_topic_that_is_not_there_is_named_with_those_that_are(result):
    refusal = line_of(lambda: result.frame("/tol"))
    assert refusal.startswith("no topic '/tol' in the recording; allowed: ")
    assert "/tool" in refusal
