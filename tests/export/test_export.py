# SPDX-License-Identifier: Apache-2.0
"""``lathe export``: every format gives back the bits of the bag, says the units, and overwrites nothing."""

import csv
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
from bags import lathe
from cells import scenario
from pyarrow import parquet
from rosbags.rosbag2 import StoragePlugin, Writer

from lathe_export.tables import export as exporting
from lathe_export.tables.formats import FORMATS
from lathe_rc import harness, messages
from lathe_rc.bag import reader
from lathe_rc.blocks.columns import columns, dense_rows, units
from lathe_rc.blocks.ports import Sparse
from lathe_rc.errors import InputError, LatheError

EVENT = {"learning_controller": {"events": ["revolution 2: freeze"]}}
STEP_NS = 15625


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A bag and what is in it."""
    bag = tmp_path_factory.mktemp("export") / "bag"
    harness.run(scenario(**EVENT), bag=bag)
    return bag, reader.read_bag(bag)


def from_csv(place, topic):
    """Columns by label, texts."""
    with (place / f"{topic.strip('/').replace('/', '.')}.csv").open(encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    return dict(zip(head, map(list, zip(*rows, strict=True)), strict=True)) if rows else {name: [] for name in head}


def read(kind, place, topic, msgtype):
    """The columns of a topic, in their own types."""
    if kind == "parquet":
        table = parquet.read_table(place / f"{topic.strip('/').replace('/', '.')}.parquet")
        return {name: table[name].to_numpy() for name in table.column_names}
    if kind == "npz":
        with np.load(place) as archive:
            names = [key for key in archive if key.rpartition("/")[0] == topic.strip("/")]
            return {key.rpartition("/")[2]: archive[key] for key in names}
    found, known = from_csv(place, topic), {column.label: column for column in columns(msgtype)}
    assert list(found) == list(known)
    return {known[label].name: parsed(texts, known[label].dtype) for label, texts in found.items()}


def exporter(kind, place, topic, msgtype):
    """A writer of one topic."""
    if FORMATS[kind].folder:
        place.mkdir()
    return exporting.Exporter({topic: msgtype}, STEP_NS, FORMATS[kind](place))


def same_bits(found, expected):
    expected = np.asarray(expected)
    found = np.asarray(found, dtype=expected.dtype)
    return found.shape == expected.shape and found.tobytes() == expected.tobytes()


def parsed(texts, dtype):
    return np.array([text == "true" for text in texts] if dtype.kind == "b" else texts).astype(dtype)


@pytest.fixture(scope="module")
def exported(recorded, tmp_path_factory):
    """Where each format was written."""
    folder = tmp_path_factory.mktemp("exported")
    for kind in FORMATS:
        done = lathe("export", recorded[0], f"--{kind}", "-o", folder / kind)
        assert done.exit_code == 0, done.output
    return folder


@pytest.mark.parametrize("kind", FORMATS)
class TestEveryFormat:
    def test_gives_the_samples_to_the_bit(self, recorded, exported, kind):
        for topic, signals in recorded[1].dense.items():
            found = read(kind, exported / kind, topic, recorded[1].types[topic])
            assert list(found) == ["sample", "time", *signals]
            for name, samples in signals.items():
                assert found[name].dtype == samples.dtype
                assert same_bits(found[name], samples), f"{topic}: {name}"
            assert same_bits(found["sample"], np.arange(samples.size))
            assert found["time"] == pytest.approx(1.0 + np.arange(samples.size) * STEP_NS * 1e-9, rel=1e-15)

    def test_gives_messages_events_and_joints_at_their_samples(self, recorded, exported, kind):
        sparse, found = recorded[1].sparse, {}
        for topic in ("/coarse/learning", "/learning_controller/events", "/tool/joint_states"):
            found[topic] = read(kind, exported / kind, topic, recorded[1].types[topic])
        learning, joints = found["/coarse/learning"], found["/tool/joint_states"]
        status = sparse["/coarse/learning"]
        assert len(status.stamps) == 2
        assert learning["sample"].tolist() == status.values["sample_index"]
        assert (learning["time"] * 1e9).round().tolist() == status.stamps
        for name in set(status.values) - {"sample_index"}:
            expected = np.array(status.values[name])
            assert same_bits(learning[name], expected.astype(learning[name].dtype)), name
        assert learning["learning"].dtype == bool
        assert list(found["/learning_controller/events"]["action"]) == ["freeze"]
        states = sparse["/tool/joint_states"].values
        assert list(joints["name"]) == ["tool"] * len(states["name"])
        assert same_bits(joints["position"], np.concatenate(states["position"]))
        assert np.isnan(joints["effort"]).all()

    def test_refuses_what_exists_and_leaves_it_alone(self, recorded, tmp_path, kind):
        place = tmp_path / "there"
        place.write_text("mine")
        refused = lathe("export", recorded[0], f"--{kind}", "-o", place)
        assert (refused.exit_code, "exists; an export never overwrites" in refused.stderr) == (2, True)
        assert place.read_text() == "mine"

    def test_writes_only_the_topics_asked_for(self, recorded, tmp_path, kind):
        place = tmp_path / "out"
        assert lathe("export", recorded[0], f"--{kind}", "-o", place, "--topics", "tool,/encoder").exit_code == 0
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
        assert "interrupted" in lathe("export", recorded[0], f"--{kind}", "-o", tmp_path / "out").stderr
        assert list(tmp_path.iterdir()) == []


def test_units_are_those_of_the_message_files(exported):
    assert units(messages.ENCODER)["angle"] == "rad"
    assert units(messages.STATE)["effort"] == "A or V or 1"
    assert units(messages.SERVO)["error"] == "m or N"
    assert list(from_csv(exported / "csv", "/encoder"))[:4] == ["sample", "time [s]", "angle [rad]", "speed [rad/s]"]
    schema = parquet.read_schema(exported / "parquet" / "encoder.parquet")
    assert schema.field("speed").metadata == {b"unit": b"rad/s"}
    with np.load(exported / "npz") as archive:
        assert dict(archive["units"])["tool/error"] == "m"
        assert dict(archive["units"])["learning_controller/events/action"] == ""


def test_every_field_of_a_block_has_a_unit():
    for kind in messages.block_types():
        assert [column.name for column in columns(kind)[1:] if not column.unit] == [], kind


@pytest.mark.parametrize("kind", FORMATS)
def test_numbers_at_the_edge_keep_their_bits(tmp_path, kind):
    """Pieces are copied before their sender uses them again."""
    awkward = np.array([0.1 + 0.2, -0.0, 5e-324, 1.7976931348623157e308, np.pi * 1e-9, 1.0, np.nextafter(1.0, 2.0)])
    signals = {name: np.roll(awkward, k) for k, name in enumerate(messages.sample_fields(messages.TOOL))}
    writer = exporter(kind, tmp_path / "out", "/tool", messages.TOOL)
    for start, stop in ((0, 3), (3, 7)):
        piece = {name: samples[start:stop].copy() for name, samples in signals.items()}
        writer.chunk(start, stop - start, {"tool": piece}, {})
        for samples in piece.values():
            samples[:] = np.nan
    assert writer.close() == {"/tool": 7}
    found = read(kind, tmp_path / "out", "/tool", messages.TOOL)
    assert all(same_bits(found[name], samples) for name, samples in signals.items())


@pytest.mark.parametrize("kind", FORMATS)
def test_a_joint_a_row(tmp_path, kind):
    state = {"name": ["a", 'b, "c"'], "position": np.array([1.0, 2.0]), "velocity": np.array([3.0]), "effort": []}
    writer = exporter(kind, tmp_path / "out", "/joint_states", messages.JOINTS)
    writer.chunk(0, 8, {}, {"/joint_states": [Sparse("/joint_states", messages.JOINTS, 7, state)]})
    assert writer.close() == {"/joint_states": 2}
    found = read(kind, tmp_path / "out", "/joint_states", messages.JOINTS)
    assert list(found["name"]) == state["name"]
    assert found["position"].tolist() == [1.0, 2.0]
    assert np.array_equal(found["velocity"], [3.0, np.nan], equal_nan=True)


@pytest.mark.parametrize("kind", FORMATS)
def test_memory_does_not_grow_with_the_bag(tmp_path, kind):
    """The peak of four times as many samples is that of the first ones: one piece waits at most."""
    peaks, signals = [], messages.allocate(messages.TOOL, 32768)
    for pieces in (4, 16):
        writer = exporter(kind, tmp_path / str(pieces), "/tool", messages.TOOL)
        tracemalloc.start()
        for k in range(pieces):
            writer.chunk(k * 32768, 32768, {"/tool": signals}, {})
        writer.close()
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]
    assert peaks[1] < 20e6  # 16 pieces have 22 MB


def test_time_is_that_of_the_message_headers():
    rows = dense_rows(10**12, {"x": np.zeros(1)}, STEP_NS)
    header = messages.header(10**12, STEP_NS).stamp
    assert rows["time"][0] == header.sec + header.nanosec * 1e-9


@pytest.mark.parametrize("topic", ["/../../etc/x", "/a.b", "/a b", "/" + "a" * 300, "/ä"])
def test_topics_that_would_leave_the_folder_or_are_no_signals_are_refused(topic):
    for kind, said in ((messages.TOOL, "no name of ROS"), ("own_msgs/msg/Unknown", "nothing to export")):
        about = SimpleNamespace(type=kind, count=1)
        source = SimpleNamespace(path="bag", topics={topic: about}, step_ns=lambda _: STEP_NS)
        with pytest.raises(InputError, match=said):
            exporting._selected(source, [])


# --- messages without blocks


def recorded_messages(path, topics, count=19, first=1_700_000_000_123_456_789):
    """A bag of another recorder: messages of each topic 10 ms apart, as ``topics`` makes them from their number."""
    types = messages.store().types
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, (kind, make) in topics.items():
            channel = writer.add_connection(topic, kind, typestore=messages.store())
            for k in range(count):
                stamp = first + k * 10_000_000
                data = messages.store().serialize_cdr(make(types, k), kind)
                writer.write(channel, stamp, data)
    return path


def header(types, k):
    return types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](5, k), "base")


def joints(types, k):
    names = ["a", "b"][: 1 + k % 2]
    return types[messages.JOINTS](header(types, k), names, np.arange(len(names)) + float(k), np.empty(0), np.empty(0))


def pose(types, k):
    of = {name: types[f"geometry_msgs/msg/{name}"] for name in ("PoseStamped", "Pose", "Point", "Quaternion")}
    return of["PoseStamped"](
        header(types, k), of["Pose"](of["Point"](1.0 * k, 0.0, 0.0), of["Quaternion"](0, 0, 0, 1.0))
    )


def diagnostics(types, k):
    of = {name: types[f"diagnostic_msgs/msg/{name}"] for name in ("DiagnosticArray", "DiagnosticStatus", "KeyValue")}
    value = of["KeyValue"]("number", str(k))
    return of["DiagnosticArray"](header(types, k), [of["DiagnosticStatus"](1, "n", 'm, "x"', "h", [value])])


FOREIGN = {
    "/joint_states": (
        messages.JOINTS,
        joints,
        {"name[0]": "a", "position[0]": 3.0, "position[1]": 4.0, "stamp_ns": 5_000_000_003},
    ),
    "/pose": ("geometry_msgs/msg/PoseStamped", pose, {"pose.position.x": 3.0, "pose.orientation.w": 1.0}),
    "/speed": ("std_msgs/msg/Float64", lambda types, k: types["std_msgs/msg/Float64"](k / 3.0), {"data": 1.0}),
    "/on": ("std_msgs/msg/Bool", lambda types, k: types["std_msgs/msg/Bool"](k == 3), {"data": True}),
    "/text": ("std_msgs/msg/String", lambda types, k: types["std_msgs/msg/String"](f"k={k}"), {"data": "k=3"}),
    "/diagnostics": (
        "diagnostic_msgs/msg/DiagnosticArray",
        diagnostics,
        {"status[0].values[0].value": "3", "status[0].message": 'm, "x"'},
    ),
}


@pytest.mark.parametrize("kind", FORMATS)
def test_messages_without_blocks_have_a_row_each(tmp_path, kind):
    """Of standard types, flattened, with the times of the log; ``read_bag`` has them as well."""
    bag = recorded_messages(tmp_path / "bag", {topic: made[:2] for topic, made in FOREIGN.items()})
    done = lathe("export", bag, f"--{kind}", "-o", tmp_path / "out")
    assert (done.exit_code, done.stdout) == (0, f"6 topics, {6 * 19} rows: {tmp_path / 'out'}\n")
    for topic, (_, _, wanted) in FOREIGN.items():
        if kind == "csv":
            rows = {name.partition(" [")[0]: values for name, values in from_csv(tmp_path / "out", topic).items()}
        else:
            rows = read(kind, tmp_path / "out", topic, "")
        assert {len(values) for values in rows.values()} == {19}
        assert [int(stamp) for stamp in rows["log_ns"]] == [1_700_000_000_123_456_789 + k * 10**7 for k in range(19)]
        for name, value in wanted.items():
            found = str(rows[name][3])
            assert found == value if isinstance(value, str) else float(found.lower() == "true" or found) == value, name
    stamps = reader.read_bag(bag).sparse["/joint_states"].stamps
    assert stamps == [1_700_000_000_123_456_789 + k * 10**7 for k in range(19)]


def test_what_has_no_table_is_refused_by_name(tmp_path):
    """Too many columns; no messages at all; a copy of no message."""
    wide = "sensor_msgs/msg/LaserScan"

    def scan(types, k):
        return types[wide](header(types, k), *[0.0] * 7, np.zeros(2000, np.float32), np.zeros(0, np.float32))

    bag = recorded_messages(tmp_path / "bag", {"/scan": (wide, scan)}, 2)
    done = lathe("export", bag, "--csv", "-o", tmp_path / "out")
    assert done.exit_code == 2
    assert "/scan at " in done.stderr
    assert "ranges has 2000 elements; allowed in a table: 1024 columns" in done.stderr
    empty = recorded_messages(tmp_path / "empty", {topic: made[:2] for topic, made in FOREIGN.items()}, 0)
    done = lathe("export", empty, "--csv", "-o", tmp_path / "out")
    assert done.exit_code == 2
    assert "no messages of known types" in done.stderr
    for chosen in (["--start", "1000"], ["--without", "/scan"], ["--end", "1e-12", "--without", "/scan"]):
        done = lathe("bag", "copy", bag, "-o", tmp_path / "copy", *chosen)
        assert done.exit_code == 2
        assert "no message of" in done.stderr
        assert not (tmp_path / "copy").exists()


def test_messages_of_a_cell_without_its_blocks_have_a_row_each(recorded, tmp_path):
    assert lathe("bag", "copy", recorded[0], "-o", tmp_path / "only", "--topics", "/coarse/learning").exit_code == 0
    done = lathe("export", tmp_path / "only", "--csv", "-o", tmp_path / "out")
    assert done.exit_code == 0
    stamps = recorded[1].sparse["/coarse/learning"].stamps
    assert from_csv(tmp_path / "out", "/coarse/learning")["log_ns [ns]"] == list(map(str, stamps))


def test_samples_that_only_some_topics_have_are_told(recorded, tmp_path):
    """A topic that ends, or begins, where others do not: its further samples are in no table, with exit code 3."""
    for name, window in (("end", ["--end", "0.05"]), ("start", ["--start", "0.05"])):
        part, rest = tmp_path / f"{name}-part", tmp_path / f"{name}-rest"
        assert lathe("bag", "copy", recorded[0], "-o", part, "--topics", "/tool", *window).exit_code == 0
        assert lathe("bag", "copy", recorded[0], "-o", rest, "--topics", "/encoder").exit_code == 0
        assert lathe("bag", "copy", part, rest, "-o", tmp_path / name).exit_code == 0
        done = lathe("export", tmp_path / name, "--csv", "-o", tmp_path / f"{name}-csv")
        assert done.exit_code == 3
        assert "left out: " in done.stderr
