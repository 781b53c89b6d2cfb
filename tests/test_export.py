# SPDX-License-Identifier: Apache-2.0
"""``lathe export``: every format gives back the bits of the bag, says the units, and overwrites nothing."""

import csv
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
from cells import scenario
from click.testing import CliRunner
from pyarrow import parquet

from lathe_rc import harness, messages
from lathe_rc.bag import reader
from lathe_rc.bag.exporting import export as exporting
from lathe_rc.bag.exporting.formats import FORMATS
from lathe_rc.cell.columns import columns, dense_rows, units
from lathe_rc.cell.stage import Sparse
from lathe_rc.commands.export import export
from lathe_rc.errors import InputError, LatheError

EVENT = {"learning_controller": {"events": ["revolution 2: freeze"]}}
STEP_NS = 15625


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A bag and what is in it."""
    bag = tmp_path_factory.mktemp("export") / "bag"
    harness.run(scenario(**EVENT), bag=bag)
    return bag, reader.read_bag(bag)


def lathe(*arguments):
    """The command, with the project's errors as the command line tells them."""
    return CliRunner().invoke(export, [str(argument) for argument in arguments])


def from_csv(place, topic):
    """Columns by label, texts."""
    with (place / f"{topic.strip('/').replace('/', '.')}.csv").open(encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    return dict(zip(head, map(list, zip(*rows, strict=True)), strict=True)) if rows else {name: [] for name in head}


def from_parquet(place, topic):
    table = parquet.read_table(place / f"{topic.strip('/').replace('/', '.')}.parquet")
    return {name: table[name].to_numpy() for name in table.column_names}


def from_npz(place, topic):
    with np.load(place) as archive:
        names = [key for key in archive if key.rpartition("/")[0] == topic.strip("/")]
        return {key.rpartition("/")[2]: archive[key] for key in names}


def same_bits(found, expected):
    expected = np.asarray(expected)
    found = np.asarray(found, dtype=expected.dtype)
    return found.shape == expected.shape and found.tobytes() == expected.tobytes()


def parsed(texts, dtype):
    return np.array([text == "true" for text in texts] if dtype.kind == "b" else texts).astype(dtype)


@pytest.fixture(scope="module")
def exported(recorded, tmp_path_factory):
    """By format, where it was written and a function that reads a topic's columns back, in their own types."""
    bag, recording = recorded
    folder = tmp_path_factory.mktemp("exported")
    for kind in FORMATS:
        done = lathe(bag, f"--{kind}", "-o", folder / kind)
        assert done.exit_code == 0, done.output

    def read_csv(topic):
        found = from_csv(folder / "csv", topic)
        known = {column.label: column for column in columns(recording.types[topic])}
        assert list(found) == list(known)
        return {known[label].name: parsed(texts, known[label].dtype) for label, texts in found.items()}

    return {
        "csv": read_csv,
        "parquet": lambda topic: from_parquet(folder / "parquet", topic),
        "npz": lambda topic: from_npz(folder / "npz", topic),
        "folder": folder,
    }


@pytest.mark.parametrize("kind", FORMATS)
class TestEveryFormat:
    def test_gives_the_samples_to_the_bit(self, recorded, exported, kind):
        for topic, signals in recorded[1].dense.items():
            found = exported[kind](topic)
            assert list(found) == ["sample", "time", *signals]
            for name, samples in signals.items():
                assert found[name].dtype == samples.dtype
                assert same_bits(found[name], samples), f"{topic}: {name}"
            assert same_bits(found["sample"], np.arange(samples.size))
            assert found["time"] == pytest.approx(1.0 + np.arange(samples.size) * STEP_NS * 1e-9, rel=1e-15)

    def test_gives_messages_at_their_samples(self, recorded, exported, kind):
        status = recorded[1].sparse["/coarse/learning"]
        found = exported[kind]("/coarse/learning")
        assert len(status.stamps) == 2
        assert found["sample"].tolist() == status.values["sample_index"]
        assert (found["time"] * 1e9).round().tolist() == status.stamps
        for name in set(status.values) - {"sample_index"}:
            expected = np.array(status.values[name])
            assert same_bits(found[name], expected.astype(found[name].dtype)), name
        assert found["learning"].dtype == bool

    def test_gives_events_and_joints(self, recorded, exported, kind):
        assert list(exported[kind]("/learning_controller/events")["action"]) == ["freeze"]
        joints = exported[kind]("/tool/joint_states")
        states = recorded[1].sparse["/tool/joint_states"].values
        assert list(joints["name"]) == ["tool"] * len(states["name"])
        assert same_bits(joints["position"], np.concatenate(states["position"]))
        assert np.isnan(joints["effort"]).all()

    def test_refuses_what_exists_and_leaves_it_alone(self, recorded, tmp_path, kind):
        place = tmp_path / "there"
        place.write_text("mine")
        refused = lathe(recorded[0], f"--{kind}", "-o", place)
        assert isinstance(refused.exception, InputError)
        assert "exists; an export never overwrites" in str(refused.exception)
        assert place.read_text() == "mine"

    def test_writes_only_the_topics_asked_for(self, recorded, tmp_path, kind):
        place = tmp_path / "out"
        assert lathe(recorded[0], f"--{kind}", "-o", place, "--topics", "tool,/encoder").exit_code == 0
        if kind == "npz":
            with np.load(place) as archive:
                assert {key.split("/")[0] for key in archive} == {"units", "tool", "encoder"}
        else:
            assert {path.name for path in place.iterdir()} == {f"tool.{kind}", f"encoder.{kind}"}

    def test_leaves_nothing_of_a_bag_that_breaks_off(self, recorded, tmp_path, kind, monkeypatch):
        def broken(bag, sinks):
            next(iter(sinks)).chunk(0, 8, {"/tool": messages.allocate(messages.TOOL, 8)}, {})
            raise LatheError("interrupted")

        monkeypatch.setattr(exporting, "feed", broken)
        assert "interrupted" in str(lathe(recorded[0], f"--{kind}", "-o", tmp_path / "out").exception)
        assert list(tmp_path.iterdir()) == []


def test_units_are_those_of_the_message_files(exported):
    assert units(messages.ENCODER)["angle"] == "rad"
    assert units(messages.STATE)["effort"] == "A or V or 1"
    assert units(messages.SERVO)["error"] == "m or N"
    folder = exported["folder"]
    assert list(from_csv(folder / "csv", "/encoder"))[:4] == ["sample", "time [s]", "angle [rad]", "speed [rad/s]"]
    schema = parquet.read_schema(folder / "parquet" / "encoder.parquet")
    assert schema.field("speed").metadata == {b"unit": b"rad/s"}
    with np.load(folder / "npz") as archive:
        assert dict(archive["units"])["tool/error"] == "m"
        assert dict(archive["units"])["learning_controller/events/action"] == ""


def test_every_field_of_a_block_has_a_unit():
    for kind in messages.block_types():
        assert [column.name for column in columns(kind)[1:] if not column.unit] == [], kind


@pytest.mark.parametrize("kind", FORMATS)
def test_numbers_at_the_edge_keep_their_bits(tmp_path, kind):
    awkward = np.array([0.1 + 0.2, -0.0, 5e-324, 1.7976931348623157e308, np.pi * 1e-9, 1.0, np.nextafter(1.0, 2.0)])
    signals = {name: np.roll(awkward, k) for k, name in enumerate(messages.sample_fields(messages.TOOL))}
    place = tmp_path / "out"
    if kind != "npz":
        place.mkdir()
    exporter = exporting.Exporter({"/tool": messages.TOOL}, STEP_NS, FORMATS[kind](place))
    for start, stop in ((0, 3), (3, 7)):
        exporter.chunk(start, stop - start, {"tool": {n: s[start:stop] for n, s in signals.items()}}, {})
    assert exporter.close() == {"/tool": 7}
    if kind == "csv":
        found = {label.split(" [")[0]: np.array(texts, float) for label, texts in from_csv(place, "/tool").items()}
    else:
        found = {"parquet": from_parquet, "npz": from_npz}[kind](place, "/tool")
    assert all(same_bits(found[name], samples) for name, samples in signals.items())


def test_pieces_are_copied_before_their_sender_uses_them_again(tmp_path):
    place = tmp_path / "out.npz"
    exporter = exporting.Exporter({"/tool": messages.TOOL}, STEP_NS, FORMATS["npz"](place))
    piece = messages.allocate(messages.TOOL, 4)
    for value in (1.0, 2.0):
        piece["error"][:] = value
        exporter.chunk(int(4 * (value - 1)), 4, {"/tool": piece}, {})
    exporter.close()
    assert from_npz(place, "/tool")["error"].tolist() == [1.0] * 4 + [2.0] * 4


@pytest.mark.parametrize("kind", FORMATS)
def test_a_joint_a_row(tmp_path, kind):
    state = {"name": ["a", 'b, "c"'], "position": np.array([1.0, 2.0]), "velocity": np.array([3.0]), "effort": []}
    found = [Sparse("/joint_states", messages.JOINTS, 7, state)]
    place = tmp_path / "out"
    if kind != "npz":
        place.mkdir()
    exporter = exporting.Exporter({"/joint_states": messages.JOINTS}, STEP_NS, FORMATS[kind](place))
    exporter.chunk(0, 8, {}, {"/joint_states": found})
    assert exporter.close() == {"/joint_states": 2}
    read = {"csv": from_csv, "parquet": from_parquet, "npz": from_npz}[kind](place, "/joint_states")
    assert list(read["name"]) == state["name"]
    assert np.array(read["position"], float).tolist() == [1.0, 2.0]
    assert np.array_equal(np.array(read["velocity"], float), [3.0, np.nan], equal_nan=True)


@pytest.mark.parametrize("kind", FORMATS)
def test_memory_does_not_grow_with_the_bag(tmp_path, kind):
    """The peak of four times as many samples is that of the first ones: one piece waits at most."""
    peaks = []
    for pieces in (4, 16):
        place = tmp_path / f"{kind}-{pieces}"
        if kind != "npz":
            place.mkdir()
        exporter = exporting.Exporter({"/tool": messages.TOOL}, STEP_NS, FORMATS[kind](place))
        signals = messages.allocate(messages.TOOL, 32768)
        tracemalloc.start()
        for k in range(pieces):
            exporter.chunk(k * 32768, 32768, {"/tool": signals}, {})
        exporter.close()
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]
    assert peaks[1] < 20e6  # 16 pieces have 22 MB


def test_time_is_that_of_the_message_headers():
    rows = dense_rows(10**12, {"x": np.zeros(1)}, STEP_NS)
    header = messages.header(10**12, STEP_NS).stamp
    assert rows["time"][0] == header.sec + header.nanosec * 1e-9


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "0 formats; allowed: one of --csv, --parquet and --npz"),
        (["--csv", "--npz"], "2 formats"),
        (["--csv", "--topics", "/nothing"], "--topics /nothing: not in the bag; allowed: /coarse/command"),
        (["--csv", "-o", "no/such/folder"], "make it first"),
    ],
)
def test_what_cannot_be_used_is_refused(recorded, arguments, said):
    refused = lathe(recorded[0], *arguments)
    assert isinstance(refused.exception, InputError)
    assert said in str(refused.exception)


@pytest.mark.parametrize("topic", ["/../../etc/x", "/a.b", "/a b", "/" + "a" * 300, "/ä"])
def test_topics_that_would_leave_the_folder_are_refused(topic):
    source = SimpleNamespace(path="bag", topics={topic: SimpleNamespace(type=messages.TOOL)})
    with pytest.raises(InputError, match="no name of ROS"):
        exporting._selected(source, [])


def test_a_bag_without_signals_is_refused():
    source = SimpleNamespace(path="bag", topics={"/chatter": SimpleNamespace(type="std_msgs/msg/String")})
    with pytest.raises(InputError, match="nothing to export"):
        exporting._selected(source, [])
