# SPDX-License-Identifier: Apache-2.0
"""``lathe view`` and the scene behind it: what Rerun is given is what was recorded."""

import importlib.util
import io
from pathlib import Path

import numpy as np
import pytest
from bags import lathe
from cells import config, listening, scenario, until
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

rr = pytest.importorskip("rerun")
rrb = pytest.importorskip("rerun.blueprint")
RrdReader = pytest.importorskip("rerun.chunk").RrdReader

from lathe_live import rerun_part as parts  # noqa: E402
from lathe_live.rerun_blueprint import blueprint  # noqa: E402
from lathe_live.rerun_output import _free_port, end_viewer, viewer  # noqa: E402
from lathe_live.rerun_pieces import Pieces  # noqa: E402
from lathe_live.rerun_revolutions import ANGLES, Revolutions  # noqa: E402
from lathe_live.rerun_scene import Scene  # noqa: E402
from lathe_live.rerun_signals import extreme_samples  # noqa: E402
from lathe_rc import harness, messages, resources  # noqa: E402
from lathe_rc.analysis import metrology  # noqa: E402
from lathe_rc.bag import reader  # noqa: E402
from lathe_rc.blocks.ports import Sparse  # noqa: E402
from lathe_rc.cell.scenario import load  # noqa: E402
from lathe_rc.errors import LatheError  # noqa: E402
from lathe_rc.event_log import Conditions  # noqa: E402

STEP_NS = 15625


def refused(*arguments, code=2):
    """The one line that a command ends with."""
    result = lathe(*arguments)
    assert result.exit_code == code, result.output
    (line,) = result.stderr.splitlines()
    return line


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    """The bag and the recording of a run of twelve revolutions."""
    bag = tmp_path_factory.mktemp("turned") / "bag"
    given = {"profile": "harmonics", "harmonic_order": [1, 3], "harmonic_amplitude": [20e-6, 50e-6], "feed": 1e-4}
    learning = {"events": ["revolution 9: freeze"]}
    harness.run(scenario(spindle_encoder={"revolutions": 12.3}, tool=given, learning_controller=learning), bag=bag)
    return bag, reader.read_bag(bag)


class View:
    """The columns of a .rrd file."""

    def __init__(self, path):
        self.chunks = [chunk for chunk in RrdReader(path).stream() if not chunk.is_static]

    def column(self, entity, name):
        """The rows of a column, in the order in which they were logged."""
        found = [chunk.to_record_batch() for chunk in self.chunks if chunk.entity_path == entity]
        columns = [batch.column(name) for batch in found if name in batch.schema.names]
        return [row for column in columns for row in (column.cast("int64") if name == "time" else column).to_pylist()]

    def scalars(self, entity):
        """Time [ns], revolution and value of a curve."""
        values = [value for (value,) in self.column(entity, "Scalars:scalars")]
        # of a curve without a sample too, the times count samples
        return np.array(self.column(entity, "time"), int), np.array(self.column(entity, "revolution")), np.array(values)

    def entities(self, component):
        return {chunk.entity_path for chunk in self.chunks if component in chunk.to_record_batch().schema.names}


@pytest.fixture(scope="module")
def shown(turned, tmp_path_factory):
    """The .rrd file that the command makes of the bag."""
    path = tmp_path_factory.mktemp("shown") / "out.rrd"
    done = lathe("view", turned[0], "-o", path)
    assert done.exit_code == 0, done.output
    assert [file.name for file in path.parent.iterdir()] == ["out.rrd"]
    return View(path)


def form(recording):
    angle = recording.of_type(messages.ENCODER)["angle_true"]
    return angle, recording.of_type(messages.TOOL)["error"]


# --- what is in a view


def test_form_errors_and_spectrum_are_those_of_the_workshop(turned, shown):
    expected = metrology.measure(*form(turned[1]))
    for name in ("rms", "largest"):
        time, revolution, value = shown.scalars(f"/learning/form_error/{name}")
        assert_allclose(10**value * 1e-6, getattr(expected.form, name), rtol=1e-9)
        assert_array_equal(revolution, np.arange(1, 13))
        assert_array_equal(time, expected.form.starts[1:] * STEP_NS)
    bars = np.array([row[0]["buffer"] for row in shown.column("/form_error/spectrum", "BarChart:values")])
    assert bars.shape == (12, 50)
    assert_allclose(bars * 1e-6, expected.undulations.amplitude[:, 1:], rtol=2e-3, atol=5e-9)


def test_reports_of_controllers_and_events_are_at_their_samples(turned, shown):
    status = turned[1].sparse["/coarse/learning"]
    time, revolution, value = shown.scalars("/learning/coarse/learning")
    assert_allclose(10**value * 1e-6, status.values["rms_error"])
    assert_array_equal(revolution, status.values["cycle"])
    assert_array_equal(time, np.array(status.stamps) - messages.START_NS)
    event = turned[1].sparse["/learning_controller/events"]
    assert shown.column("/events", "TextLog:text") == [["learning_controller/events: freeze"]]
    assert_array_equal(shown.column("/events", "time"), np.array(event.stamps) - messages.START_NS)


def test_points_of_curves_are_samples_and_no_peak_is_lost(turned, shown):
    samples = turned[1].of_type(messages.TOOL)["error"] * 1e6
    time, revolution, value = shown.scalars("/signals/tool/error")
    index, rest = np.divmod(time, STEP_NS)
    assert not rest.any()
    assert_array_equal(value, samples[index])
    assert_array_equal(revolution, np.floor(form(turned[1])[0][index] / (2 * np.pi)) + 1)
    assert samples.size / 40 < index.size <= samples.size / 32 + 2  # two in 64 samples: 2 kHz
    for start in range(0, samples.size, 64):
        window = value[(index >= start) & (index < start + 64)]
        assert (window.min(), window.max()) == (samples[start : start + 64].min(), samples[start : start + 64].max())


def test_the_rate_of_points_is_what_was_asked_for(turned, tmp_path):
    path = tmp_path / "few.rrd"
    assert lathe("view", turned[0], "-o", path, "--rate", 200).exit_code == 0
    time, _, _ = View(path).scalars("/signals/tool/error")
    assert 150 * 0.72 < time.size <= 200 * 0.74


def test_the_last_map_holds_all_revolutions(turned, shown):
    angle, error = form(turned[1])
    file = shown.column("/form_error/map", "EncodedImage:blob")[-1][0]
    rows = np.asarray(Image.open(io.BytesIO(bytes(file))))[:: 140 // 12]
    assert rows.shape == (12, ANGLES, 3)
    for k in (0, 11):
        inside = (angle >= 2 * np.pi * (k + 40 / 360)) & (angle < 2 * np.pi * (k + 41 / 360))
        assert_allclose(rows[k, 40], parts.colours(-error[inside].mean(keepdims=True))[0, :3], atol=1)
    assert parts.colours(parts.SCALE)[[0, 3, 6], :3].tolist() == [[8, 48, 107], [244, 244, 244], [103, 0, 31]]


def test_the_surface_grows_by_a_strip_a_revolution(shown):
    strips = np.array(shown.column("/machine/part/surface", "Mesh3D:vertex_positions"))
    assert strips.shape == (12, parts.STRIP, 3)
    half = parts.STRIP // 2
    assert_array_equal(strips[1:, :half], strips[:-1, half:])
    z = strips[:, half, 2]
    assert_allclose(np.diff(z), parts.LENGTH / 12.3, rtol=1e-3)
    assert parts.TRIANGLES.max() == parts.STRIP - 1


def test_the_tool_touches_what_it_has_turned(turned, shown):
    """Turned by the spindle angle, the surface is where the tip is."""
    strips = np.array(shown.column("/machine/part/surface", "Mesh3D:vertex_positions"))
    tips = np.array([row[0] for row in shown.column("/machine/tool", "Transform3D:translation")])
    poses = np.array([row[0] for row in shown.column("/machine/part", "Transform3D:quaternion")])
    revolution = np.array(shown.column("/machine/tool", "revolution"))
    assert tips.shape[0] == poses.shape[0] == pytest.approx(250 * 0.74, abs=2)
    for tip, pose in zip(tips[revolution == 9], poses[revolution == 9], strict=True):
        turn = 2 * np.arctan2(pose[2], pose[3])
        ring = strips[8, parts.STRIP // 2 :]
        angle = np.arctan2(ring[:, 1], ring[:, 0]) + turn
        nearest = np.argmin(np.abs(np.angle(np.exp(1j * angle))))
        assert np.hypot(*ring[nearest, :2]) == pytest.approx(tip[0], abs=0.2)
    assert np.ptp(tips[revolution == 9, 0]) > 5.0


def test_every_curve_and_picture_has_a_view(turned, shown):
    """Everything that is logged has a place in the view."""

    def contents(part):
        if isinstance(part, rrb.View):
            given = [part.contents] if isinstance(part.contents, str) else part.contents
            return [line.replace("$origin", part.origin) for line in given]
        return [line for inner in part.contents for line in contents(inner)]

    layout = contents(blueprint(turned[1].types).root_container)
    trees = tuple(line.removesuffix("**") for line in layout if line.endswith("**"))
    for component in (
        "TextLog:text",
        "Scalars:scalars",
        "Mesh3D:vertex_positions",
        "EncodedImage:blob",
        "BarChart:values",
    ):
        entities = shown.entities(component)
        assert entities
        assert all(entity in layout or f"{entity}/".startswith(trees) for entity in entities)
    assert {line for line in layout if line.startswith("/signals")} == {
        entity for entity in shown.entities("Scalars:scalars") if entity.startswith("/signals")
    }


def beside_the_part(types, **more):
    """Views on the right, below the form error, or the tabs if there is no more."""
    return blueprint(types, **more).root_container.contents[-1].contents[-1].contents


def test_desired_and_actual_position_of_the_tool_are_in_one_view(turned):
    """And the title names the colours of its two curves, so that no legend lies on them."""
    views = beside_the_part(turned[1].types)
    (view,) = [view for view in views if isinstance(view, rrb.TimeSeriesView) and "tool position" in view.name]
    assert view.name == "tool position [µm]: desired blue, actual orange, latest 0.3 s"
    assert view.contents == ["/signals/tool/reference", "/signals/tool/displacement"]


def test_states_of_the_supervisor_and_faults_are_bands(tmp_path):
    """From nominal on; a faulty target has a band of its own from the first sample of its faults to their last."""
    overrides = ["spindle_encoder.revolutions=8"]
    overrides += ["electrodynamic_actuator.faults=['revolution 4 to 5: coarse/state.measured_position stuck']"]
    cell = load(resources.find(Path("supervised.yaml")), overrides)
    logged = harness.run(cell, bag=tmp_path / "bag").event_log
    done = lathe("view", tmp_path / "bag", "-o", tmp_path / "out.rrd")
    assert done.exit_code == 0, done.output
    view = View(tmp_path / "out.rrd")
    faulty = "/states/electrodynamic_actuator/fault/coarse/state.measured_position"
    assert view.entities("StateChange:state") == {"/states/cell/safety", faulty}
    status = [each for each in logged if each.topic == "/safety/status"]
    states = [state for (state,) in view.column("/states/cell/safety", "StateChange:state")]
    assert list(dict.fromkeys(states)) == ["nominal", "retracting", "safe"]
    samples = [0, *(each.sample for each in status)]
    assert view.column("/states/cell/safety", "time") == [sample * STEP_NS for sample in samples]
    fault = view.column(faulty, "StateChange:state")
    assert fault == [["coarse/state.measured_position stuck"], [""]]
    begun, over = (each.sample for each in logged if each.topic == "/electrodynamic_actuator/events")
    assert view.column(faulty, "time") == [begun * STEP_NS, over * STEP_NS]


def test_a_repair_ends_its_faults_and_no_others():
    """One of two faults of a target, all of a target, and none of another target of the node."""
    conditions = Conditions()
    for action, told in (
        ("fault a.x stuck", "a.x stuck"),
        ("fault a.x wrong scale=2.0", "a.x stuck, a.x wrong scale=2.0"),
        ("fault b off", "b off"),
        ("repair a.x stuck", "a.x wrong scale=2.0"),
        ("repair a.x", ""),
    ):
        changed = conditions.take(Sparse("n/events", messages.EVENT, 0, {"action": action}))
        assert changed == (f"n/fault/{action.split()[1]}", told)
    assert conditions.faults == {("n", "a.x"): [], ("n", "b"): ["b off"]}


def test_without_a_state_there_is_no_view_of_states(turned, tmp_path, monkeypatch):
    """The event of the bag is none; the supervisor of another is in a state from the beginning."""
    sent = []
    monkeypatch.setattr(rr.RecordingStream, "send_blueprint", lambda _, given: sent.append(given.root_container))
    harness.run(load("supervised", ["spindle_encoder.revolutions=1"]), bag=tmp_path / "bag")
    for bag, expected in ((turned[0], False), (tmp_path / "bag", True)):
        assert lathe("view", bag, "-o", tmp_path / f"{expected}.rrd").exit_code == 0
        rows = sent[-1].contents[-1].contents[-1].contents
        assert any(isinstance(row, rrb.StateTimelineView) for row in rows) == expected


def test_a_bag_without_a_tool_has_only_curves():
    types = {"/encoder": messages.ENCODER, "/x/state": messages.STATE, "/x/command": messages.SERVO}
    assert [view.name for view in beside_the_part(types)] == [
        "spindle speed [1/min]: measured blue, true orange",
        "slides [mm]",
        "servo [own units]: command blue, error orange",
    ]


def test_force_and_position_loops_have_errors_set_points_and_a_text(tmp_path):
    """By revolution as the run finds them, in a view without a part."""
    result = harness.run(config("approach"), bag=tmp_path / "bag")
    done = lathe("view", tmp_path / "bag", "-o", tmp_path / "out.rrd")
    assert done.exit_code == 0, done.output
    view, loop = View(tmp_path / "out.rrd"), result.loops["position_controller"]
    time, revolution, value = view.scalars("/loops/position_controller/largest")
    errors = loop.found.errors
    assert_allclose(10**value, np.maximum(errors.largest * 1e6, 1e-9), rtol=1e-9)
    assert_array_equal(revolution, np.arange(1, errors.rms.size + 1))
    assert_array_equal(time, errors.starts[1:] * STEP_NS)
    assert set(view.scalars("/signals/cross/command/set_point")[2]) == {5.0}  # mm
    texts = [chunk for chunk in RrdReader(tmp_path / "out.rrd").stream() if chunk.entity_path == "/loop_results"]
    told = texts[-1].to_record_batch().column("TextDocument:text").to_pylist()[0][0]
    assert next(loop.judged())[0] in told
    views = blueprint(result.recording.types, loops=[loop.loop]).root_container.contents[0].contents
    assert [view.origin for view in views if view.origin.startswith("/loop")] == [
        "/loops/position_controller",
        "/loop_results",
    ]


# --- revolutions


def test_revolutions_do_not_depend_on_the_pieces(turned):
    angle, error = form(turned[1])
    tool = turned[1].of_type(messages.TOOL)

    def collected(size):
        found = Revolutions()
        revolutions = []
        for a in range(0, angle.size, size):
            cut = slice(a, a + size)
            revolutions += found.add(a, angle[cut], error[cut], tool["reference"][cut], tool["height"][cut])
        return [*revolutions, *found.finish()]

    for one, other in zip(collected(angle.size), collected(997), strict=True):
        assert (one.number, one.end) == (other.number, other.end)
        for name in ("error", "radius", "height", "rms", "largest"):
            assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-12)


def test_a_revolution_with_a_gap_is_left_out():
    angle = 2 * np.pi * np.arange(4000) / 500
    zeros = np.zeros(4000)
    found = Revolutions()
    before = list(found.add(0, *(values[:1700] for values in (angle, zeros, zeros, zeros))))
    after = list(found.add(1900, *(values[1900:] for values in (angle, zeros, zeros, zeros))))
    assert [revolution.number for revolution in before] == [1, 2, 3]
    assert [revolution.number for revolution in [*after, *found.finish()]] == [5, 6, 7, 8]


def test_few_samples_a_revolution_leave_no_holes():
    angle = 2 * np.pi * np.arange(2000) / 97.3
    error = 1e-6 * np.cos(angle)
    (*_, last) = Revolutions().add(0, angle, error, 0 * angle, 0 * angle)
    assert_allclose(last.error, 1e-6 * np.cos(2 * np.pi * (np.arange(ANGLES) + 0.5) / ANGLES), atol=5e-8)
    assert_array_equal(last.radius, -last.error)


@pytest.mark.parametrize("jump", [-1e-3, 1e12, np.nan])
def test_an_angle_that_no_spindle_has_is_refused(jump):
    angle = np.arange(100) * 0.01
    angle[50:] += jump * 100
    with pytest.raises(LatheError, match="after sample 149"):
        list(Revolutions().add(100, angle, *np.zeros((3, 100))))


@pytest.mark.system
def test_a_long_run_stays_small(tmp_path):
    """Of 600 revolutions the map has at most 512 rows, rings become rarer, nothing else piles up."""
    types = {"encoder": messages.ENCODER, "tool": messages.TOOL}
    recording = rr.RecordingStream("test")
    recording.save(tmp_path / "long.rrd")
    scene = Scene(recording, types, STEP_NS, rate=50.0)
    for first in range(0, 60_000, 10_000):
        angle = 2 * np.pi * np.arange(first, first + 10_000) / 100
        encoder = dict.fromkeys(["angle_true", "speed", "speed_true"], angle)
        tool = dict.fromkeys(messages.sample_fields(messages.TOOL), np.zeros(10_000))
        scene.chunk(first, 10_000, {"encoder": encoder, "tool": tool | {"reference": 1e-5 * np.cos(angle)}}, {})
    scene.close()
    recording.disconnect()
    view = View(tmp_path / "long.rrd")
    maps = [Image.open(io.BytesIO(bytes(row[0]))) for row in view.column("/form_error/map", "EncodedImage:blob")]
    assert max(image.height for image in maps) == 512
    assert maps[-1].height == 300  # every second
    assert len(maps) < 60
    assert len(view.column("/machine/part/surface", "Mesh3D:vertex_positions")) == 512 + 44


# --- envelopes and pieces


def test_an_envelope_keeps_extremes_in_their_order():
    values = np.array([0.0, 5.0, -1.0, 2.0, 7.0, 7.0, 7.0, 7.0, 3.0, 4.0])
    assert extreme_samples(values, 4).tolist() == [1, 2, 4, 8, 9]
    assert extreme_samples(values, 2).tolist() == list(range(10))
    assert extreme_samples(values[:0], 4).size == 0


class Taken(list):
    """A sink that keeps what it is given."""

    def chunk(self, first, samples, dense, sparse):
        self.append((first, samples, dense, sparse))


TWO = {"/a": messages.COMMAND, "/b": messages.COMMAND}


def given(text, types=TWO, *, close=True):
    """The pieces of 100 samples, and what they lost, of blocks such as "a:0-64 b:0-100"; "+" stands for both topics."""
    taken = Taken()
    pieces = Pieces(types, 100, taken)
    pieces.message(Sparse("events", messages.EVENT, 150, {"action": "freeze"}))
    for step in text.split():
        if step == "+":
            pieces.learn(TWO)
        else:
            topic, first, end = step.replace("-", ":").split(":")
            pieces.block(topic, int(first), {"position": np.arange(int(first), int(end), dtype=float)})
    if close:
        pieces.close()
    return taken, pieces


@pytest.mark.parametrize(
    ("blocks", "expected", "lost"),
    [
        pytest.param("a:0-64 a:64-128 a:128-230 b:0-7 b:7-230", "0:100ab 100:100ab 200:30ab", 0, id="other lengths"),
        pytest.param(
            "a:0-50 a:60-700 b:0-700",
            "100:100a 200:100a 300:100ab 400:100ab 500:100ab 600:100ab",
            3,
            id="a gap, then three pieces ahead of the other topic",
        ),
        pytest.param(
            "a:0-100 b:0-100 a:150-200 a:530-600 a:600-800 b:150-200 b:530-600 b:600-800",
            "0:100ab 600:100ab 700:100ab",
            5,
            id="nothing came",
        ),
        pytest.param(
            "a:0-80 a:100-250 b:0-80 b:100-250", "0:80ab 100:100ab 200:50ab", 1, id="an end that is missing everywhere"
        ),
    ],
)
def test_blocks_meet_in_pieces_and_what_is_missing_stops_nobody(blocks, expected, lost):
    """A topic that is silent, has a gap or comes too late is left out of those pieces alone."""
    taken, pieces = given(blocks)
    told = [f"{first}:{samples}{''.join(sorted(dense)).replace('/', '')}" for first, samples, dense, _ in taken]
    assert told == expected.split()
    assert pieces.lost == lost
    for first, samples, dense, _ in taken:
        for signals in dense.values():
            assert_array_equal(signals["position"], np.arange(first, first + samples))
    found = [
        (m.index, first, first + samples) for first, samples, _, sparse in taken for m in sparse.get("/events", [])
    ]
    assert [index for index, *_ in found] == [150]
    assert found[0][2] > 150


@pytest.mark.parametrize(
    ("blocks", "begins", "lost"),
    [
        pytest.param("a:0-300 + b:0-100 b:100-400 a:300-400", [0, 100, 200, 300], 3, id="shown without it"),
        pytest.param("a:130-200 + a:200-400 b:210-500 a:400-500", [300, 400], 0, id="begins where all are whole"),
    ],
)
def test_a_topic_that_nobody_knew_of(blocks, begins, lost):
    taken, pieces = given(blocks, {"/a": messages.COMMAND}, close=False)
    assert ([first for first, *_ in taken], pieces.first, pieces.lost) == (begins, begins[0], lost)


def test_a_view_does_not_depend_on_the_blocks(turned, shown, tmp_path):
    """Fed live, in blocks of its own for each topic, it has the same points as the bag's."""
    recording = turned[1]
    stream = rr.RecordingStream("test")
    stream.save(tmp_path / "live.rrd")
    scene = Scene(stream, recording.types, STEP_NS, outlook=parts.Outlook(12.3, 1.23e-3))
    pieces = Pieces(recording.types, 8192, scene)
    samples = recording.of_type(messages.TOOL)["error"].size
    for start in range(0, samples, 2048):
        for size, (topic, signals) in zip((64, 128, 512, 2048), recording.dense.items(), strict=True):
            for first in range(start, min(start + 2048, samples), size):
                end = min(first + size, start + 2048)
                pieces.block(topic, first, {name: array[first:end] for name, array in signals.items()})
    pieces.close()
    scene.close()
    stream.disconnect()
    assert pieces.lost == 0
    live = View(tmp_path / "live.rrd")
    for entity in shown.entities("Scalars:scalars") - {"/learning/coarse/learning"}:
        for one, other in zip(live.scalars(entity), shown.scalars(entity), strict=True):
            assert_allclose(one, other, rtol=1e-12)
    surfaces = [view.column("/machine/part/surface", "Mesh3D:vertex_positions") for view in (live, shown)]
    assert_allclose(*surfaces, atol=1e-4)


# --- the command


def test_without_rerun_the_command_says_how_to_get_it(turned, tmp_path, monkeypatch):
    known = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if "rerun" in name else known(name, *rest)
    )
    assert "./lathe setup view" in refused("view", turned[0], "-o", tmp_path / "x.rrd", code=1)


def test_bad_input_is_refused_and_leaves_nothing(turned, tmp_path, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    (tmp_path / "empty").mkdir()
    assert "not a readable bag" in refused("view", tmp_path / "empty", "-o", tmp_path / "x.rrd")
    assert "there is no folder" in refused("view", turned[0], "-o", tmp_path / "none" / "x.rrd")
    assert "--output with --web" in refused("view", turned[0], "-o", tmp_path / "x.rrd", "--web")
    assert "-o FILE.rrd or --web" in refused("view", turned[0])
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]


@pytest.mark.parametrize(("kind", "count"), [("spawn", 1), ("serve", 2)])
def test_a_viewer_listens_on_this_computer_alone(kind, count, monkeypatch):
    """A window without a screen, and a page; their sockets by the kernel's own table."""
    monkeypatch.setenv("DISPLAY", ":0")
    shown = viewer(kind, _free_port())
    if kind == "spawn":
        shown.options.append("--headless")
    process = shown.start()
    try:
        until(lambda: len(listening(process.pid)) >= count or process.poll() is not None)
        found = listening(process.pid)
    finally:
        end_viewer(process)
    assert {place.partition(":")[0] for place in found} == {"0100007F"}  # 127.0.0.1


def test_a_bag_without_a_revolution_has_no_surface(tmp_path):
    bag = tmp_path / "bag"
    harness.run(scenario(spindle_encoder={"revolutions": 0.2}), bag=bag)
    assert lathe("view", bag, "-o", tmp_path / "short.rrd").exit_code == 0
    assert View(tmp_path / "short.rrd").entities("Mesh3D:vertex_positions") == set()
