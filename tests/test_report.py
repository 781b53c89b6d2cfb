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
from mcap.writer import Writer as McapWriter
from numpy.testing import assert_allclose
from shown_page import ShownPage

from lathe_rc import __version__, harness, messages, part, resources
from lathe_rc.bag import provenance, reader
from lathe_rc.bag.writing.writer import BagWriter, offered_qos
from lathe_rc.cell.budget import changing
from lathe_rc.cell.latency_histogram import LATENCY, LATENESS, Durations
from lathe_rc.cell.scenario import load
from lathe_rc.commands.report import report
from lathe_rc.errors import InputError
from lathe_rc.view import charts
from lathe_rc.view import report as reporting
from lathe_rc.view.report_figures import colour_range, spectrum_range, timing
from lathe_rc.view.report_form import Form, Revolution
from lathe_rc.view.report_gather import gather
from lathe_rc.view.report_host import DIAGNOSTICS, Host
from lathe_rc.view.report_series import Envelope, MeanRows
from lathe_rc.view.report_verdict import judged

HOSTILE = "<script>alert(1)</script>$x_{$\u202e\x07"


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    """A bag of six revolutions with an event, its recording, and its page."""
    folder = tmp_path_factory.mktemp("report")
    nodes = {"spindle_encoder": {"revolutions": 6.2}, "learning_controller": {"events": ["revolution 4: freeze"]}}
    harness.run(scenario(**nodes), bag=folder / "bag")
    done = CliRunner().invoke(report, [str(folder / "bag"), "-o", str(folder / "page.html")])
    assert done.exit_code == 0, done.output
    return folder / "bag", reader.read_bag(folder / "bag"), (folder / "page.html").read_text(encoding="utf-8")


class TestPage:
    def test_tells_the_numbers_of_the_first_best_and_last_revolution(self, turned):
        _, recording, page = turned
        found = part.measured(recording)
        cells = ShownPage(page).cells
        best = int(np.argmin(found.form.rms))
        for k, name in ((0, "first"), (best, "best"), (found.form.rms.size - 1, "last")):
            told = part.numbers(found, k)
            row = cells[cells.index(str(k + 1)) :][:11]
            assert row[0] == str(k + 1)
            assert name in row[1]
            assert row[2:6] == [f"{told[key]:.4g}" for key in ("rms", "max", "peak_to_valley", "ront")]
            cells = cells[cells.index(str(k + 1)) + 1 :] if k else cells

    def test_counts_every_topic(self, turned):
        _, recording, page = turned
        cells = ShownPage(page).cells
        for topic, signals in recording.dense.items():
            samples = next(iter(signals.values())).size
            row = cells[cells.index(topic) :][:4]
            assert row[2:] == [str(-(-samples // 64)), str(samples)]
        assert cells[cells.index("/coarse/learning") + 2] == str(len(recording.sparse["/coarse/learning"].stamps))

    def test_needs_nothing_else(self, turned):
        page = ShownPage(turned[2])
        assert all(link.startswith("data:") or link.removeprefix("#") in page.ids for link in page.links)
        body = turned[2][: turned[2].index("<script")]
        assert not re.search(r"https?:|@import|url\(", re.sub(r"base64,[^\"]+", "", body))
        assert page.policy.startswith("default-src 'none'; ")
        assert len(turned[2].encode()) < 3_000_000

    def test_runs_its_own_two_scripts_and_no_other(self, turned):
        page = ShownPage(turned[2])
        assert "unsafe" not in page.policy.partition("script-src")[2]
        assert page.may_run() == [charts.library(), *page.scripts[2:]]
        assert len(page.scripts) == 3  # the first is data

    def test_figures_to_enlarge_have_the_numbers_of_the_pictures(self, turned):
        """Each follows the schema of its language; the curve of the form error is that of the recording."""
        specs = {name: spec for name, choices in ShownPage(turned[2]).specs.items() for spec in choices.values()}
        assert len(specs) == 6  # the polar figure has two
        for spec in specs.values():
            alt.Chart.from_dict(spec)
            assert spec["usermeta"]["box"]
        found = part.measured(turned[1])
        curve = next(spec for spec in specs.values() if spec["encoding"]["x"].get("title") == "revolution or cycle")
        for label, values in (("form error, RMS", found.form.rms), ("form error, largest", found.form.largest)):
            rows = [row for row in curve["data"]["values"] if row["l"] == label]
            assert_allclose([row["a"] for row in rows], values * 1e6, rtol=1e-3)
        field = specs["figure-0-0"]["data"]["values"]
        assert_allclose(field[-256:], found.profile[-1].reshape(256, 16).mean(axis=-1) * 1e6, rtol=1e-3, atol=1e-9)

    def test_figures_are_whole_svg_without_links(self, turned):
        images = re.findall(r'src="data:image/svg\+xml;base64,([^"]+)"', turned[2])
        assert len(images) == 5  # two polar ones, spectrum, convergence, speed; the map is a JPEG
        for image in images:
            root = ET.fromstring(base64.b64decode(image))  # noqa: S314 - made here
            assert root.tag == "{http://www.w3.org/2000/svg}svg"
            links = [v for element in root.iter() for k, v in element.attrib.items() if k.endswith("href")]
            assert all(link.startswith(("#", "data:image/png")) for link in links)

    def test_names_its_pages_and_the_command_at_every_figure_and_table(self, turned):
        bag, _, page = turned
        assert page.count(f"lathe report {bag} -o {bag.parent / 'page.html'}") >= page.count("<figure>") + page.count(
            "<table>"
        )
        assert page.count("docs/metrology.md") >= 5

    def test_says_what_was_not_recorded(self, turned):
        assert "nothing can be said of lateness and latency" in ShownPage(turned[2]).text

    def test_tells_scenario_and_versions(self, turned):
        text = ShownPage(turned[2]).text
        assert "revolutions: 6.2" in text
        assert f"lathe_rc{__version__}" in text
        assert "base64" not in text  # no files here

    def test_lists_events(self, turned):
        cells = ShownPage(turned[2]).cells
        index = turned[1].sparse["/learning_controller/events"].values["sample_index"][0]
        place = cells.index("freeze")
        assert cells[place - 3 : place] == ["/learning_controller/events", str(index), f"{index / 64000:.4g}"]

    def test_is_the_same_every_time(self, turned):
        bag, _, page = turned
        reporting.write_report(bag, bag.parent / "page.html")
        assert (bag.parent / "page.html").read_text(encoding="utf-8") == page


class TestVerdict:
    """The head of the page."""

    def told(self, cell, place):
        harness.run(cell, bag=place / "bag")
        found = gather(place / "bag")
        return judged(found, reporting.losses(found), None)

    def test_says_first_whether_the_part_is_in_tolerance(self, tmp_path):
        cell = scenario(spindle_encoder={"revolutions": 6.2}, tool={"tolerance": 2e-6})
        told = self.told(cell, tmp_path)
        assert told.verdict.text == re.sub("^i", "I", harness.run(cell).verdict.told()) + "."
        assert (told.verdict.mood, told.wrong) == ("good", [])
        page = tmp_path / "page.html"
        reporting.write_report(tmp_path / "bag", page)
        text = ShownPage(page.read_text(encoding="utf-8")).text
        assert text.index("In tolerance (±2 µm)") < text.index("Nothing was lost") < text.index("Result")

    def test_says_that_learning_is_not_over_and_when_it_would_be(self, tmp_path):
        """With a small gain, each revolution is better than the one before."""
        slow = scenario(
            spindle_encoder={"revolutions": 12.2},
            learning_controller={"learning_gain": 0.2},
            tool={"tolerance": 1e-9},
        )
        told = self.told(slow, tmp_path)
        assert told.verdict.mood == "bad"
        assert re.search(r"falls by [\d.]+% a revolution; in tolerance after some \d+ more", told.limits[0].text)
        assert "repeats from revolution to revolution, most at 2 UPR" in told.limits[1].text

    def test_noise_changes_from_revolution_to_revolution(self, tmp_path):
        noisy = scenario(
            spindle_encoder={"revolutions": 24.2}, electrodynamic_actuator={"noise_rms": 1e-6}, tool={"tolerance": 1e-6}
        )
        told = self.told(noisy, tmp_path)
        assert re.search(r"^\d+% of .* changes from revolution to revolution: noise\.$", told.limits[0].text)

    @pytest.mark.parametrize(
        ("name", "causes"),
        [
            ("two_channel", ["feed"]),
            ("vibration", ["vibration"]),
            ("robust", ["noise", "quantisation"]),
        ],
    )
    def test_names_no_cause_that_the_scenario_does_not_contain(self, name, causes):
        cell = load(resources.find(Path(f"{name}.yaml")))
        assert changing(provenance.values_of({provenance.SCENARIO: cell.to_yaml()})) == causes

    def test_says_who_came_to_a_limit(self, tmp_path):
        limited = scenario(electrodynamic_actuator={"command_velocity": 5e-3})
        told = self.told(limited, tmp_path)
        assert re.search(r"^electrodynamic_actuator came to the limits of its command, ", told.limits[0].text)

    def test_a_fault_and_what_the_supervisor_did_come_first(self, tmp_path):
        """And no word of what learning leaves: the error is the fault's."""
        fault = "electrodynamic_actuator.faults=['revolution 6: coarse/state.measured_position stuck']"
        supervised = load(resources.find(Path("supervised.yaml")), ["spindle_encoder.revolutions=12", fault])
        told = self.told(supervised, tmp_path)
        assert re.match(
            r"electrodynamic_actuator/events: fault coarse/state.measured_position stuck, at 0.34", told.wrong[0].text
        )
        assert re.match(r"safety/status: .*, limit .*: retracting, retract, at ", told.wrong[1].text)
        assert told.verdict.mood == "bad"
        assert told.limits == []


def test_surface_along_the_part_is_that_of_the_whole_run(tmp_path):
    feeds = scenario(spindle_encoder={"revolutions": 11.2}, tool={"feed": 1e-4, "nose_radius": 0.8e-3})
    surface = harness.run(feeds, bag=tmp_path / "bag").surface
    told = gather(tmp_path / "bag").forms[0].surface
    assert_allclose(told.surface, surface.surface, rtol=0, atol=1e-15)
    assert_allclose(told.height, surface.height, rtol=0, atol=1e-15)
    done = CliRunner().invoke(report, [str(tmp_path / "bag"), "-o", str(tmp_path / "page.html")])
    assert done.exit_code == 0, done.output
    page = ShownPage((tmp_path / "page.html").read_text(encoding="utf-8"))
    assert "Along the part, last 8 revolutions at 100 µm/rev: Ra " in page.text


class TestForm:
    """The measurement by pieces against that of the whole run."""

    @pytest.mark.parametrize("piece", [700, 3840, 65536])
    def test_equals_that_of_the_whole_run(self, turned, piece):
        _, recording, _ = turned
        found = part.measured(recording)
        form = Form("/encoder", "/tool")
        samples = recording.dense["/tool"]["error"].size
        for first in range(0, samples, piece):
            dense = {
                topic: {name: array[first : first + piece] for name, array in recording.dense[topic].items()}
                for topic in ("/encoder", "/tool")
            }
            form.chunk(first, dense["/tool"]["error"].size, dense, {})
        form.finish()
        assert form.refused == ""
        assert_allclose(form.rms.curve()[1], found.form.rms, rtol=1e-12)
        assert_allclose(form.largest.curve()[2], found.form.largest, rtol=1e-12)
        for k, revolution in ((0, form.first), (int(np.argmin(found.form.rms)), form.best), (-1, form.last)):
            assert_allclose(revolution.profile, found.profile[k], rtol=0, atol=1e-15)
            assert_allclose(revolution.amplitude, found.undulations.amplitude[k], rtol=0, atol=1e-15)
            assert revolution.numbers["revolution"] == part.numbers(found, k)["revolution"]
        assert_allclose(form.map.rows()[-1], found.profile[-1].reshape(512, 8).mean(axis=-1), rtol=0, atol=1e-15)

    @pytest.mark.parametrize(
        ("angle", "said"),
        [
            (np.array([0.2, 0.1]), "the angle falls"),
            (np.array([0.0, 1e300]), "more than a third of a turn"),
            (np.array([1e9, 1e9 + 0.1]), "begins at"),
            (np.array([0.0, np.nan]), "not finite"),
        ],
    )
    def test_refuses_angles_that_would_take_memory_or_make_no_sense(self, angle, said):
        form = Form("/encoder", "/tool")
        form.chunk(0, angle.size, {"/encoder": {"angle_true": angle}, "/tool": {"error": np.zeros(angle.size)}}, {})
        form.finish()
        assert said in form.refused
        assert form.first is None

    def test_measures_what_comes_before_a_sample_that_is_not_finite(self):
        """And says that it diverged until then."""
        angle = 2 * np.pi * np.arange(2100) / 200
        error = 1e-6 * 2.0 ** (angle // (2 * np.pi))
        error[2050:] = np.nan
        form = Form("/encoder", "/tool")
        form.chunk(0, angle.size, {"/encoder": {"angle_true": angle}, "/tool": {"error": error}}, {})
        form.finish()
        assert form.refused == "samples that are not finite (after revolution 10)"
        assert (form.last.numbers["revolution"], form.growth.diverges, form.growth.since) == (10, True, 2)

    def test_gives_up_a_revolution_that_never_ends(self):
        form = Form("/encoder", "/tool")
        for k in range(70):
            angle = (k * 65536 + np.arange(65536.0)) * 1e-9
            form.chunk(0, 65536, {"/encoder": {"angle_true": angle}, "/tool": {"error": angle}}, {})
        assert "longer than" in form.refused
        assert form._held.size == 0


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
    values = {
        "blocks": blocks,
        "samples": 64 * blocks,
        "schedule slipped [s]": 0.0,
        LATENESS: lateness,
        LATENCY: latency,
    }
    return diagnostics(wall, **{key: str(value) for key, value in values.items()}, **{"lost blocks": "2"})


@given(st.lists(st.floats(0.0, 5000.0), max_size=50))
def test_durations_are_counted_in_bins_of_a_factor_of_two(seconds):
    found = Durations()
    for value in seconds:
        found.add(value)
    assert sum(found.counts) == len(seconds)
    for place, count in enumerate(found.counts):
        low, high = (0.0 if place == 0 else 2.0 ** (place - 1)), (np.inf if place == 31 else 2.0**place)
        assert count == sum(low <= int(value * 1e6) < high for value in seconds)
    assert Durations.parse(str(found)).counts == found.counts


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
            host.add(messages.CELL_STATE, messages.encode(messages.CELL_STATE, state("run", 3, k, "no tool", 0, [])))
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


@pytest.fixture(scope="module")
def hostile(tmp_path_factory):
    """A bag whose every text is an attack, with samples as absurd as they come, and no end."""
    path = tmp_path_factory.mktemp("hostile") / "bag"
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
    return path


def test_a_bag_that_is_of_no_cell_is_called_so(tmp_path):
    file = tmp_path / "foreign.mcap"
    with file.open("wb") as stream:
        foreign = McapWriter(stream)
        foreign.start()
        foreign.finish()
    done = CliRunner().invoke(report, [str(file), "-o", str(tmp_path / "page.html")])
    assert done.exit_code == 0, done.output
    assert done.stderr == "incomplete recording: the bag has no encoder and no tool\n"


def test_a_hostile_bag_gives_a_harmless_page(hostile, tmp_path):
    done = CliRunner().invoke(report, [str(hostile), "-o", str(tmp_path / "page.html")])
    assert done.exit_code == 0, done.output
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
    assert "(540000 characters)" in page.text or "characters)" in page.text
    assert "the recording was cut off" in page.text
    assert "1 messages of host topics cannot be decoded" in page.text


def test_a_bag_of_something_else_has_a_page_too(tmp_path):
    writer = BagWriter(tmp_path / "bag", compression="none", chunk_size=2**16, about={})
    writer.add_topic("/chatter", messages.JOINTS, offered_qos(10, "volatile"))
    writer.close()
    reporting.write_report(tmp_path / "bag", tmp_path / "page.html")
    assert "the bag has no encoder and no tool" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_a_gap_is_told_and_what_came_before_is_shown(turned, tmp_path):
    """The same recording without one block of the tool, in the fifth revolution."""
    from lathe_rc.bag.reading.source import Source

    writer = BagWriter(tmp_path / "bag", compression="none", chunk_size=2**16, about={})
    with Source(turned[0]) as source:
        for topic, found in source.topics.items():
            writer.add_topic(topic, found.type, offered_qos(10, "volatile"))
        left_out = 300
        for topic, log_ns, data in source.messages():
            left_out -= topic == "/tool"
            if topic != "/tool" or left_out != 0:
                writer.write(topic, log_ns, data)
    writer.close()
    told = gather(tmp_path / "bag")
    assert "/tool goes from sample 19136 to 19200" in told.stopped
    assert not told.complete
    page = reporting.render(told, "bag", "lathe report")
    assert "reading stopped: " in page


@pytest.mark.parametrize(
    ("name", "said"), [("page.txt", "ends in .html"), ("no/page.html", "no such folder"), ("dir.html", "is a folder")]
)
def test_places_that_are_none_are_refused(turned, tmp_path, name, said):
    (tmp_path / "dir.html").mkdir()
    with pytest.raises(InputError, match=said):
        reporting.write_report(turned[0], tmp_path / name)


def test_what_is_no_bag_is_refused_and_leaves_no_page(tmp_path):
    (tmp_path / "x").mkdir()
    with pytest.raises(InputError):
        reporting.write_report(tmp_path / "x", tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()
