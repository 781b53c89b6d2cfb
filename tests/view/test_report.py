# SPDX-License-Identifier: Apache-2.0
"""``lathe report``: what the page says is what was turned, and nothing from a bag can harm it."""

import base64
import re
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree as ET

import altair as alt
import numpy as np
import pytest
from cells import scenario
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from shown_page import ShownPage

from lathe_rc import __version__, harness, messages, resources
from lathe_rc.bag import provenance
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.bag.writing.writer import BagWriter, offered_qos
from lathe_rc.blocks.latency_histogram import LATENCY, LATENESS, Durations
from lathe_rc.cell.scenario import load
from lathe_rc.cell.wiring import Cell
from lathe_rc.commands.report import report
from lathe_rc.drawing import charts
from lathe_rc.judge import part
from lathe_rc.judge.causes import changing
from lathe_rc.view import report as reporting
from lathe_rc.view.form_limits import form_limits
from lathe_rc.view.report_figures import against_time, colour_range, spectrum_range, timing
from lathe_rc.view.report_form import FormByRevolution, Revolution
from lathe_rc.view.report_gather import gather
from lathe_rc.view.report_host import DIAGNOSTICS, Host
from lathe_rc.view.report_series import Envelope, MeanRows
from lathe_rc.view.report_verdict import assess

HOSTILE = "<script>alert(1)</script>$x_{$\u202e\x07"


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    """A run with an event, a tolerance and a feed: its bag, result and page, and the numbers that the page has."""
    folder = tmp_path_factory.mktemp("report")
    cell = scenario(
        spindle_encoder={"revolutions": 11.2},
        learning_controller={"events": ["revolution 9: freeze"]},
        tool={"tolerance": 2e-6, "feed": 1e-4, "nose_radius": 0.8e-3},
    )
    result = harness.run(cell, bag=folder / "bag")
    done = CliRunner().invoke(report, [str(folder / "bag"), "-o", str(folder / "page.html")])
    assert done.exit_code == 0, done.output
    page = (folder / "page.html").read_text(encoding="utf-8")
    return SimpleNamespace(bag=folder / "bag", result=result, page=page, shown=ShownPage(page))


class TestPage:
    def test_tells_the_numbers_of_the_first_best_and_last_revolution(self, turned):
        found = turned.result.part
        best = int(np.argmin(found.form.rms))
        rows = {row[0]: row[1:] for row in turned.shown.rows("Result")}
        for k, name in ((0, "first"), (best, "best"), (found.form.rms.size - 1, "last")):
            numbers = part.numbers(found, k)
            label, *values = rows[str(k + 1)][:5]
            assert name in label
            assert values == [f"{numbers[key]:.4g}" for key in ("rms", "max", "peak_to_valley", "ront")]

    def test_counts_every_topic(self, turned):
        rows = {row[0]: row[2:4] for row in turned.shown.rows("Topics")}
        recording = turned.result.recording
        for topic, signals in recording.dense.items():
            samples = next(iter(signals.values())).size
            assert rows[topic] == [str(-(-samples // 64)), str(samples)]
        assert rows["/coarse/learning"][0] == str(len(recording.sparse["/coarse/learning"].stamps))

    def test_needs_nothing_else_and_runs_its_own_two_scripts_alone(self, turned):
        page = turned.shown
        assert all(link.startswith("data:") or link.removeprefix("#") in page.ids for link in page.links)
        body = turned.page[: turned.page.index("<script")]
        assert not re.search(r"https?:|@import|url\(", re.sub(r"base64,[^\"]+", "", body))
        assert page.policy.startswith("default-src 'none'; ")
        assert "unsafe" not in page.policy.partition("script-src")[2]
        assert page.may_run() == [charts.library(), *page.scripts[2:]]
        assert len(page.scripts) == 3  # the first is data
        assert len(turned.page.encode()) < 3_000_000

    def test_figures_to_enlarge_have_the_numbers_of_the_pictures(self, turned):
        """Each follows the schema of its language; the curve of the form error is that of the recording."""
        specs = {name: spec for name, choices in turned.shown.specs.items() for spec in choices.values()}
        assert len(specs) == 9  # the polar figure and those of the surface and of the loop have two
        for spec in specs.values():
            alt.Chart.from_dict(of_two_rows(spec))
            assert spec["usermeta"]["box"]
        found = turned.result.part
        curve = next(spec for spec in specs.values() if spec["encoding"]["x"].get("title") == "revolution or cycle")
        for label, values in (("form error, RMS", found.form.rms), ("form error, largest", found.form.largest)):
            rows = [row for row in curve["data"]["values"] if row["l"] == label]
            assert_allclose([row["a"] for row in rows], values * 1e6, rtol=1e-3)
        field = specs["figure-0-0"]["data"]["values"]
        assert_allclose(field[-256:], found.profile[-1].reshape(256, 16).mean(axis=-1) * 1e6, rtol=1e-3, atol=1e-9)

    def test_pictures_are_whole_svg_without_links(self, turned):
        images = re.findall(r'src="data:image/svg\+xml;base64,([^"]+)"', turned.page)
        assert len(images) == 7  # two polar ones, spectrum, convergence, surface, two of the loop; maps are JPEG
        for image in images:
            root = ET.fromstring(base64.b64decode(image))  # noqa: S314 - made here
            assert root.tag == "{http://www.w3.org/2000/svg}svg"
            links = [v for element in root.iter() for k, v in element.attrib.items() if k.endswith("href")]
            assert all(link.startswith(("#", "data:image/png")) for link in links)

    def test_names_its_pages_at_every_figure_and_table_and_the_command_once(self, turned):
        page, command = turned.page, f"lathe report {turned.bag} -o {turned.bag.parent / 'page.html'}"
        assert page.count(command) == 1
        assert page.count("See docs/") >= page.count("<figure>") + page.count("<table>")
        assert page.count("docs/metrology.md") >= 5

    def test_the_axis_of_a_constant_signal_has_several_ticks(self):
        constant = Envelope()
        constant.add(np.full(8, 1000.0))
        spec = against_time(SimpleNamespace(at=np.asarray), {"/encoder": constant}, "speed", 1.0)
        assert spec["encoding"]["y"]["scale"]["domain"] == [500.0, 1500.0]

    def test_a_constant_signal_is_a_sentence(self, turned):
        """As a figure it was a line along an axis with a single number."""
        assert "Spindle speed. Constant: speed [1/min] 1000." in turned.shown.text
        assert 'alt="Spindle speed"' not in turned.page

    def test_tells_scenario_versions_events_and_what_was_not_recorded(self, turned):
        text = turned.shown.text
        assert "revolutions: 11.2" in text
        assert f"lathe_rc{__version__}" in text
        assert "base64" not in text  # no files here
        assert "nothing can be said of lateness and latency" in text
        index = turned.result.recording.sparse["/learning_controller/events"].values["sample_index"][0]
        event = ["/learning_controller/events", str(index), f"{index / 64000:.4g}", "freeze"]
        assert event in turned.shown.rows("Topics")

    def test_says_first_whether_the_part_is_in_tolerance(self, turned):
        text = turned.shown.text
        verdict = re.sub("^i", "I", turned.result.verdict.told()) + "."
        assert verdict.startswith("In tolerance (±2 µm)")
        assert text.index(verdict) < text.index("Nothing was lost") < text.index("Result")

    def test_has_the_surface_along_the_part_as_the_whole_run_has_it(self, turned):
        last, surface = gather(turned.bag).forms[0].surface, turned.result.surface
        assert_allclose(last.surface, surface.surface, rtol=0, atol=1e-15)
        assert_allclose(last.height, surface.height, rtol=0, atol=1e-15)
        assert "Along the part, last 8 revolutions at 100 µm/rev: Ra " in turned.shown.text

    def test_marks_the_drive_margin_of_the_run_in_both_figures_of_the_loop(self, turned):
        """The least error over the waves is the margin that the run printed; the locus is that of the formula."""
        specs = [spec for choices in turned.shown.specs.values() for spec in choices.values()]
        margin = turned.result.drive_margins["learning_controller"]
        drawn = [spec for spec in specs if f"margin {margin}" in str(spec)]
        assert len(drawn) == 2
        locus, over_waves = ([row for layer in spec["layer"] for row in layer["data"]["values"]] for spec in drawn)
        error = {row["n"]: row["v"] for row in over_waves if row.get("l") == "error that diverges (dashed)"}
        assert min(error.values()) == pytest.approx(margin.error, rel=1e-4)
        assert min(error, key=error.get) == pytest.approx(margin.waves, rel=1e-4)
        cell = Cell(turned.result.scenario.nodes)
        cell.check()
        (loop,) = cell.loops["learning_controller"]
        whole = next(row for row in locus if row.get("n") == 3.0)
        (drive,) = loop.responses
        factor = loop.stage.factors(drive, np.array([3.0]), margin.speed)[0, 0]
        assert whole["u"] + 1j * whole["v"] == pytest.approx(factor, rel=1e-3)

    def test_is_the_same_every_time(self, turned, tmp_path):
        again = tmp_path / "page.html"
        reporting.write_report(turned.bag, again)
        assert again.read_text(encoding="utf-8").replace(str(again), str(turned.bag.parent / again.name)) == turned.page


def of_two_rows(spec):
    """A figure with two rows of each data set: a schema takes long to skip the others."""
    if isinstance(spec, dict):
        return {k: v[:2] if k == "values" else of_two_rows(v) for k, v in spec.items()}
    return [of_two_rows(each) for each in spec] if isinstance(spec, list) else spec


class TestVerdict:
    """The head of the page."""

    @pytest.fixture
    def head(self, tmp_path):
        def of(cell):
            harness.run(cell, bag=tmp_path / "bag")
            gathered = gather(tmp_path / "bag")
            return assess(gathered, reporting.losses(gathered), None)

        return of

    def test_says_that_learning_is_not_over_and_when_it_would_be(self, head):
        """With a small gain, each revolution is better than the one before."""
        told = head(
            scenario(
                spindle_encoder={"revolutions": 8.2},
                learning_controller={"learning_gain": 0.2},
                tool={"tolerance": 1e-9},
            )
        )
        assert told.verdict.mood == "bad"
        assert re.search(r"falls by [\d.]+% a revolution; in tolerance after some \d+ more", told.limits[0].text)
        assert "repeats from revolution to revolution, most at 2 waves a turn" in told.limits[1].text

    @pytest.mark.parametrize(
        ("offset", "largest"),
        [(0.0, "most at 3 waves a turn (1 µm)"), (-5.0, "most in the size of the part (5 µm of the radius)")],
    )
    def test_tells_the_largest_part_of_what_repeats(self, offset, largest):
        """Learning leaves it only where the error does not grow."""
        profile = offset + np.sin(3.0 * np.linspace(0.0, 2.0 * np.pi, 360, endpoint=False))
        (settled,) = form_limits(np.tile(profile, (10, 1)), excess=0.0, learning=True, causes=[])
        assert settled.text.endswith(f"{largest}: what learning and its Q filter leave.")
        grows, repeats = form_limits(profile * 1.2 ** np.arange(10.0)[:, None], excess=0.0, learning=True, causes=[])
        assert "grows by 20.0%" in grows.text
        assert repeats.text.endswith((" µm).", " µm of the radius)."))

    def test_noise_changes_from_revolution_to_revolution(self, head):
        noise = {"noise_rms": 1e-6}
        told = head(scenario(spindle_encoder={"revolutions": 24.2}, electrodynamic_actuator=noise))
        assert re.search(r"^\d+% of .* changes from revolution to revolution: noise\.$", told.limits[0].text)

    @pytest.mark.parametrize(
        ("name", "causes"),
        [("two_channel", ["feed"]), ("vibration", ["vibration"]), ("robust", ["noise", "quantisation"])],
    )
    def test_names_no_cause_that_the_scenario_does_not_contain(self, name, causes):
        cell = load(resources.find(Path(f"{name}.yaml")))
        assert changing(provenance.values_of({provenance.SCENARIO: cell.to_yaml()})) == causes

    def test_names_the_node_at_the_limits_of_its_command(self, head):
        told = head(scenario(electrodynamic_actuator={"command_velocity": 5e-3}))
        assert re.search(r"^electrodynamic_actuator came to the limits of its command, ", told.limits[0].text)

    def test_a_fault_and_what_the_supervisor_did_come_first(self, head):
        """And no word of what learning leaves: the error is the fault's."""
        fault = "electrodynamic_actuator.faults=['revolution 6: coarse/state.measured_position stuck']"
        told = head(load(resources.find(Path("supervised.yaml")), ["spindle_encoder.revolutions=8", fault]))
        assert re.match(
            r"electrodynamic_actuator/events: fault coarse/state.measured_position stuck, at 0.34", told.wrong[0].text
        )
        assert re.match(r"safety/status: .*, limit .*: retracting, retract, at ", told.wrong[1].text)
        assert told.verdict.mood == "bad"
        assert told.limits == []


class TestForm:
    """The measurement by pieces."""

    @staticmethod
    def of(angle, error, pieces=1):
        form, first = FormByRevolution("/encoder", "/tool"), 0
        for part_, errors in zip(np.array_split(angle, pieces), np.array_split(error, pieces), strict=True):
            form.chunk(first, part_.size, {"/encoder": {"angle_true": part_}, "/tool": {"error": errors}}, {})
            first += part_.size
        form.finish()
        return form

    @pytest.mark.parametrize("pieces", [64, 1])
    def test_equals_that_of_the_whole_run(self, turned, pieces):
        recording, found = turned.result.recording, turned.result.part
        form = self.of(recording.dense["/encoder"]["angle_true"], recording.dense["/tool"]["error"], pieces)
        assert form.refused == ""
        assert_allclose(form.rms.curve()[1], found.form.rms, rtol=1e-12)
        assert_allclose(form.largest.curve()[2], found.form.largest, rtol=1e-12)
        for k, revolution in ((0, form.first), (int(np.argmin(found.form.rms)), form.best), (-1, form.last)):
            assert_allclose(revolution.profile, found.profile[k], rtol=0, atol=1e-15)
            assert_allclose(revolution.amplitude, found.undulations.amplitude[k], rtol=0, atol=1e-15)
            assert revolution.numbers["revolution"] == part.numbers(found, k)["revolution"]
        assert_allclose(form.map.rows()[-1], found.profile[-1].reshape(512, 8).mean(axis=-1), rtol=0, atol=1e-15)

    @pytest.mark.parametrize(
        ("angle", "reason"),
        [
            ([0.2, 0.1], "the angle falls"),
            ([0.0, 3.0], "more than a third of a turn"),
            ([0.0, 1e300], "has no sample"),
            ([1e9, 1e9 + 0.1], "begins at"),
            ([0.0, np.nan], "not finite"),
            (np.linspace(0.0, 5.0, 2**22 + 1), "longer than"),
        ],
    )
    def test_refuses_angles_that_would_take_memory_or_make_no_sense(self, angle, reason):
        form = self.of(np.array(angle), np.zeros(len(angle)))
        assert reason in form.refused
        assert form.first is None
        assert form._held.size == 0

    def test_measures_what_comes_before_a_sample_that_is_not_finite(self):
        """And says that it diverged until then."""
        angle = 2 * np.pi * np.arange(2100) / 200
        error = 1e-6 * 2.0 ** (angle // (2 * np.pi))
        error[2050:] = np.nan
        form = self.of(angle, error)
        assert form.refused == "samples that are not finite (after revolution 10)"
        assert (form.last.numbers["revolution"], form.growth.diverges, form.growth.since) == (10, True, 2)


def test_a_fault_leaves_the_colours_of_the_rest_of_the_map():
    rows = np.ones((40, 8))
    rows[0], rows[20:] = 150.0, 500.0
    assert colour_range(rows) == (500.0, 1.0)


def test_a_spectrum_has_room_for_the_last_revolution_however_small():
    first, last = (
        Revolution({"revolution": k}, np.zeros(8), np.full(51, size)) for k, size in ((1, 1e-4), (60, 1e-12))
    )
    low, high = spectrum_range(SimpleNamespace(first=first, best=last, last=last))
    assert low <= 1e-9  # [µm], of the last's 1e-6
    assert high >= 100.0


class TestSeries:
    def test_envelope_holds_the_extremes_of_its_groups(self):
        values = np.random.default_rng(1).normal(size=5000)
        envelope = Envelope(16)
        for piece in np.array_split(values, [3, 4, 700, 701, 4000]):
            envelope.add(piece)
        place, low, high = envelope.curve()
        groups = [values[k : k + envelope.group] for k in range(0, values.size, envelope.group)]
        assert len(groups) <= 16 < 2 * len(groups)
        assert low.tolist() == [group.min() for group in groups]
        assert high.tolist() == [group.max() for group in groups]
        assert envelope.extremes == (values.min(), values.max())
        assert np.all(np.diff(place) > 0)

    def test_envelope_leaves_out_what_is_not_finite(self):
        envelope = Envelope(4)
        envelope.add(np.array([np.nan, 1.0, np.inf, -2.0]))
        assert envelope.extremes == (-2.0, 1.0)
        assert np.isnan(Envelope(4).extremes).all()

    def test_rows_are_means_of_neighbours(self):
        rows = np.random.default_rng(2).normal(size=(37, 3))
        found = MeanRows(3, capacity=8)
        for piece in np.array_split(rows, [1, 2, 20]):
            found.add(piece)
        assert found.group == 8
        assert_allclose(found.rows(), [rows[k : k + 8].mean(axis=0) for k in range(0, 37, 8)])


def diagnostics(wall, name="/spindle", level=0, message="ready", **values):
    types = messages.store().types
    stamp = types["builtin_interfaces/msg/Time"](int(wall), int((wall % 1) * 1e9))
    pairs = [types["diagnostic_msgs/msg/KeyValue"](key, value) for key, value in values.items()]
    status = types["diagnostic_msgs/msg/DiagnosticStatus"](level, name, message, "spindle_encoder", pairs)
    array = types[DIAGNOSTICS](types["std_msgs/msg/Header"](stamp, ""), [status])
    return messages.encode(DIAGNOSTICS, array)


def master(wall, blocks, lateness="", latency=""):
    values = {"blocks": str(blocks), "samples": str(64 * blocks), LATENESS: lateness, LATENCY: latency}
    return diagnostics(wall, **values, **{"schedule slipped [s]": "0.0", "lost blocks": "2"})


@given(st.lists(st.floats(0.0, 5000.0), max_size=50))
def test_durations_are_counted_in_bins_of_a_factor_of_two(seconds):
    found = Durations()
    for value in seconds:
        found.add(value)
    edges = [0.0, *2.0 ** np.arange(31), np.inf]  # [µs]
    assert list(found.counts) == np.histogram([int(value * 1e6) for value in seconds], edges)[0].tolist()
    assert Durations.parse(str(found)).counts == found.counts
    if seconds:
        longest = int(max(seconds) * 1e6)
        assert found.within(100.0) * 1e6 == pytest.approx(next(edge for edge in edges[1:] if edge > longest))


@pytest.mark.parametrize("text", ["x", "1:", "1:2 ", "40:1", "1:-2", "1:2,3:4", "1:" + "9" * 20, "nan"])
def test_what_is_no_count_of_durations_is_refused(text):
    with pytest.raises(ValueError, match=r"no list of|allowed"):
        Durations.parse(text)


class TestHost:
    def test_pace_comes_from_consecutive_reports_and_durations_from_the_last(self):
        host = Host()
        for wall, blocks in ((10.0, 0), (11.0, 500), (12.0, 1500), (14.0, 2500)):
            host.add(DIAGNOSTICS, master(wall, blocks))
            host.add(DIAGNOSTICS, diagnostics(wall, name="/tool", blocks=str(blocks), samples=str(blocks)))
        # The first interval began before the run did.
        assert host.pace.tolist() == [64000.0, 32000.0]
        host.add(DIAGNOSTICS, master(15.0, 3000, "3:2900", "9:2900 12:100"))
        assert (str(host.lateness["/spindle"]), str(host.latency["/spindle"])) == ("3:2900", "9:2900 12:100")
        host.add(DIAGNOSTICS, master(16.0, 3500, "3:x", "9:2900"))  # broken: the one before counts
        assert str(host.latency["/spindle"]) == "9:2900 12:100"
        assert host.lost_blocks == {"/spindle": 2}

    @pytest.mark.parametrize("paces", [(), (1e12,), (1e12, 1e12 + 1e-3), (64000.0, 32000.0, 1e300)])
    def test_paces_that_are_all_but_the_same_make_a_histogram(self, paces):
        host = Host()
        host.pace.extend(paces)
        (spec,) = timing(host, 1.0)
        bars = spec["data"]["values"]
        assert sum(bar["v"] for bar in bars) == len(paces)

    def test_failures_are_told_once_and_bounded(self):
        host = Host()
        for k in range(200):
            host.add(DIAGNOSTICS, diagnostics(1.0 + k, level=2, message="broken"))
        assert host.errors == ["/spindle: broken"]
        state = messages.store().types[messages.CELL_STATE]
        for k in range(200):
            host.add(messages.CELL_STATE, messages.encode(messages.CELL_STATE, state("run", 3, k, "no tool", 0, [], 0)))
            host.add(DIAGNOSTICS, diagnostics(1.0, name=f"/n{k}"))
        assert host.errors[1] == "the cell failed at sample 0: no tool"
        assert len(host.errors) <= 50
        assert len(host.nodes) <= 128
        assert host.left_out > 0

    def test_broken_messages_are_counted(self):
        host = Host()
        whole = master(1.0, 1)
        for data in (b"", b"\0", whole[:40], bytes(64), b"\xff" * 64):
            host.add(DIAGNOSTICS, data)
        assert host.unreadable >= 4


def write_hostile_bag(path):
    """Write a bag whose every text is an attack, with samples as absurd as they come, and no end."""
    texts = {"lathe_rc.run_id": "x", "lathe_rc.scenario": HOSTILE * 20_000, HOSTILE: HOSTILE * 100}
    writer = BagWriter(path, compression="none", chunk_size=2**16, about=texts)
    types = messages.store().types
    qos = offered_qos(10, "volatile")
    block_info = types[f"{messages.PACKAGE}/msg/BlockInfo"]("<b>run</b>", HOSTILE, 0, 15625, 0, 0)
    header = messages.header(4095, 15625)
    angle = np.arange(4096) * (2 * np.pi / 1000)
    huge = np.full(4096, 1.7e308)
    blocks = {
        "/encoder": (messages.ENCODER, [angle, huge, np.zeros(4096, np.uint8), angle, huge]),
        "/tool": (messages.TOOL, [huge] * 5),
        "/a$b": (messages.CUT, [huge, -huge] + [np.full(4096, np.nan)] * 5),
    }
    for topic, (kind, arrays) in blocks.items():
        writer.add_topic(topic, kind, qos)
        writer.write(
            topic,
            messages.stamp_ns(SimpleNamespace(header=header)),
            messages.encode(kind, types[kind](header, block_info, *arrays)),
        )
    writer.add_topic("/diagnostics", DIAGNOSTICS, qos)
    for wall in (1.0, 2.0, 3.0, 1e300 % 2**31):
        values = {
            "blocks": str(wall * 1e200),
            "samples": "nan",
            "schedule slipped [s]": "1e999",
            LATENESS: "31:999999999999999 0:1",
            LATENCY: HOSTILE,
        }
        writer.write(
            "/diagnostics", 2 * 10**9, diagnostics(wall, name=HOSTILE, level=2, message=HOSTILE * 50, **values)
        )
    writer.write("/diagnostics", 2 * 10**9, b"\xff" * 64)
    writer.close()


def test_a_hostile_bag_gives_a_harmless_page(tmp_path):
    write_hostile_bag(tmp_path / "bag")
    done = CliRunner().invoke(report, [str(tmp_path / "bag"), "-o", str(tmp_path / "page.html")])
    assert done.exit_code == 3, done.output
    assert "incomplete recording" in done.stderr
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    page = ShownPage(text)
    assert page.may_run() == page.scripts[1:]
    assert len(page.scripts) == 3
    assert "b" in page.tags  # ours
    assert "<b>run" not in text
    assert "\u202e" not in text
    assert "\x07" not in text
    assert len(text.encode()) < 3_000_000
    assert page.text.index("What went wrong") < page.text.index("No tolerance to judge by") < page.text.index("Result")
    assert "characters)" in page.text
    assert "the recording was cut off" in page.text
    assert "1 messages of host topics cannot be decoded" in page.text


def test_a_bag_of_something_else_has_a_page_too(tmp_path):
    writer = BagWriter(tmp_path / "bag", compression="none", chunk_size=2**16, about={})
    writer.add_topic("/chatter", messages.JOINTS, offered_qos(10, "volatile"))
    writer.close()
    done = CliRunner().invoke(report, [str(tmp_path / "bag"), "-o", str(tmp_path / "page.html")])
    assert (done.exit_code, done.stderr) == (0, "incomplete recording: the bag has no encoder and no tool\n")
    assert "the bag has no encoder and no tool" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_a_gap_stops_the_reading_and_is_reported(turned, tmp_path):
    """The same recording without one block of the tool, in the fifth revolution."""
    writer = BagWriter(tmp_path / "bag", compression="none", chunk_size=2**16, about={})
    with BagSource(turned.bag) as source:
        for topic, found in source.topics.items():
            writer.add_topic(topic, found.type, offered_qos(10, "volatile"))
        blocks = 0
        for topic, log_ns, data in source.messages():
            blocks += topic == "/tool"
            if topic != "/tool" or blocks != 300:
                writer.write(topic, log_ns, data)
    writer.close()
    told = gather(tmp_path / "bag")
    assert "/tool goes from sample 19136 to 19200" in told.stopped
    assert not told.complete
    assert any(text.startswith("reading stopped: ") for text in reporting.losses(told))
