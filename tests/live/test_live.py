# SPDX-License-Identifier: Apache-2.0
"""``lathe view --live``: what is heard is shown, what is left out is said, and no member waits for a viewer."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from cells import held, scenario
from numpy.testing import assert_allclose, assert_array_equal

pytest.importorskip("rerun")

from test_view import View, lathe, refused

from lathe_live import rerun_part as parts
from lathe_live.live_runs import Backlog, RunOrder
from lathe_live.rerun_live import Live
from lathe_live.rerun_output import LiveOutput
from lathe_live.rerun_signals import is_drawn
from lathe_rc import harness, messages
from lathe_rc.bag import reader
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.cell.scenario import load
from lathe_rc.errors import LatheError
from lathe_rc.nodes import dds

PISTON = Path(__file__).parents[2] / "config" / "piston.yaml"
STEP_NS = 15625
DRAWN = 6  # topics of the piston
LENGTH = 12.0  # revolutions


# --- without ROS: the backlog, the order


def test_a_full_backlog_leaves_out_all_blocks_and_no_status():
    """A message that is taken makes room."""
    backlog = Backlog(100)
    taken = iter(backlog)
    for number in range(7):
        backlog.put(("/a", messages.TOOL, bytes([number]) * 80))
        assert next(taken)[2][0] == number
    for number in range(7):
        backlog.put(("/a", messages.TOOL, bytes([number]) * 40), ("/b", messages.EVENT, bytes([10 + number])))
    backlog.put(None)
    backlog.close()
    left = [message and message[2][0] for message in taken]
    assert [number for number in left if number is None or number < 10] == [6, None]
    assert [number for number in left if number is not None and number >= 10] == list(range(10, 17))


@pytest.mark.parametrize(
    ("heard", "places"),
    [
        pytest.param("a:x0 b:x0 a:x1 b:x9", "new same same same", id="one run, with a gap"),
        pytest.param("a:x5 b:x5 a:y0 b:x6 b:y0", "new same new old same", id="the next, while one is late"),
        pytest.param("a:x5 b:x5 a:x0 b:x6 b:x0 b:x1", "new same new old same same", id="the same again"),
        pytest.param("a:x5 a:x0 b:x3 a:x1 a:x9 b:x7", "new new same same same same", id="a topic that was silent"),
        pytest.param("a:x3 b:x3 a:x0 b:x5 a:x8 b:x9", "new same new old same same", id="it lost its beginning"),
        pytest.param("a:x3 a:y0 a:x0 a:y1 a:z0", "new new new old new", id="back and forth"),
        pytest.param("a:x1 b:y1 a:x2 b:y2 a:x3 b:y3", "new new old same old same", id="two cells at once"),
    ],
)
def test_runs_are_told_apart(heard, places):
    order = RunOrder()
    steps = [(topic, text[0], int(text[1:])) for topic, _, text in (part.partition(":") for part in heard.split())]
    assert [order.place(topic, run, first, first + 1) for topic, run, first in steps] == places.split()


# --- without ROS: a bag stands for what is heard


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    """The bag of a run of twelve revolutions, and what would be heard of it."""
    bag = tmp_path_factory.mktemp("turned") / "bag"
    given = {"profile": "harmonics", "harmonic_order": [1], "harmonic_amplitude": [20e-6]}
    learning = {"events": ["revolution 9: freeze"]}
    harness.run(scenario(spindle_encoder={"revolutions": 12.3}, tool=given, learning_controller=learning), bag=bag)
    with BagSource(bag) as source:
        types = {topic: kind.type for topic, kind in source.topics.items() if is_drawn(kind.type)}
        return bag, [(topic, types[topic], data) for topic, _, data in source.messages(set(types))], types


class Watched:
    """A live view to files."""

    def __init__(self, folder, types, known=None):
        self.said = []
        output = LiveOutput("save", file=folder / "live.rrd", url="", port=0)
        self.live = Live(output.open, rate=2000.0, say=self.said.append, scenario=known)
        self.live.present = types

    def hear(self, heard):
        for message in heard:
            self.live.take(*message)

    def end(self):
        self.live.end()
        return self.live.shown


def test_a_run_and_its_repetition_are_a_recording_each(turned, tmp_path):
    bag, heard, types = turned
    watched = Watched(tmp_path, types)
    watched.hear([*heard[: len(heard) // 2], *heard])
    first, second = watched.end()
    assert (first.file.name, first.complete, first.left_out) == ("live.rrd", False, 1)  # cut amid a round of blocks
    assert (second.file.name, second.complete, second.left_out) == ("live-2.rrd", True, 0)
    assert (first.revolutions < 12, second.revolutions) == (True, 12)
    recording = reader.read_bag(bag)
    view = View(second.file)
    assert view.column("/events", "TextLog:text") == [["learning_controller/events: freeze"]]
    assert view.scalars("/learning/coarse/learning")[1].tolist() == recording.sparse["/coarse/learning"].values["cycle"]
    assert "the end of the run was not heard" in watched.said[2]


def test_length_and_feed_of_a_scenario_scale_the_part(turned, tmp_path):
    bag, heard, types = turned
    given = load("piston", ["spindle_encoder.revolutions=12.3", "tool.feed=1e-4"])
    assert parts.Outlook.of(given) == parts.Outlook(12.3, 12.3 * 1e-4)
    watched = Watched(tmp_path, types, given.varied({"tool.feed": 0.0}))
    watched.hear(heard)
    (shown,) = watched.end()
    assert lathe("view", bag, "-o", tmp_path / "bag.rrd").exit_code == 0
    live, whole = (
        View(file).column("/machine/part/surface", "Mesh3D:vertex_positions")
        for file in (shown.file, tmp_path / "bag.rrd")
    )
    assert_allclose(np.array(live), np.array(whole), rtol=1e-3, atol=1e-3)


def test_topics_that_nobody_knew_of_are_taken_in(turned, tmp_path):
    _, heard, _ = turned
    watched = Watched(tmp_path, {})
    watched.hear(heard)
    (shown,) = watched.end()
    assert (shown.revolutions, shown.left_out) == (12, 0)
    assert {entity.split("/")[2] for entity in View(shown.file).entities("Scalars:scalars")} > {"coarse", "tool"}


def test_who_is_too_slow_leaves_out_whole_pieces_and_says_so(turned, tmp_path):
    bag, heard, types = turned
    watched = Watched(tmp_path, types)
    watched.hear(heard[: len(heard) // 3])
    backlog = Backlog(2**20)  # a fraction of the rest, of which nothing is taken while the run goes on
    for message in heard[len(heard) // 3 :]:
        backlog.put(message)
    backlog.close()
    watched.hear(backlog)
    (shown,) = watched.end()
    samples = reader.read_bag(bag).of_type(messages.TOOL)["error"] * 1e6
    view = View(shown.file)
    time, _, value = view.scalars("/signals/tool/error")
    assert_array_equal(value, samples[time // STEP_NS])
    pieces = set((time // STEP_NS // 6400).tolist())
    assert 0 < shown.left_out == -(-samples.size // 6400) - len(pieces)
    assert (shown.complete, shown.end) == (True, samples.size)
    notes = [text for (text,) in view.column("/events", "TextLog:text") if text.startswith("left out")]
    assert sum(int(re.search(r"(\d+) pieces of 0.1 s", note)[1]) for note in notes) == shown.left_out
    assert all(any(note in line for line in watched.said) for note in notes)


def test_who_comes_late_shows_the_rest(turned, tmp_path):
    _, heard, types = turned
    watched = Watched(tmp_path, types)
    watched.hear(heard[len(heard) // 2 :])
    (shown,) = watched.end()
    assert (shown.complete, shown.left_out) == (True, 0)
    assert 0 < shown.first < shown.end
    _, revolution, _ = View(shown.file).scalars("/learning/form_error/rms")
    assert_array_equal(revolution, np.arange(13 - shown.revolutions, 13))
    assert "s on" in watched.said[0]


def test_broken_bytes_are_named(turned, tmp_path):
    _, heard, types = turned
    topic, msgtype, data = heard[0]
    with pytest.raises(LatheError, match=f"^{topic}: "):
        Watched(tmp_path, types).live.take(topic, msgtype, data[:100])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--live", "-o", "x.mcap"], "allowed: a name that ends in .rrd"),
        (["--live", "-o", "none/x.rrd"], "there is no folder none"),
        (["--live", "--web", "--connect", "x"], "--web with --connect; allowed: one of them"),
        (["--live", "--connect", "localhost:9876"], "url = 'localhost:9876'; allowed: rerun+http://HOST:PORT/proxy"),
        (["--live", "a_bag"], "a BAG with --live; allowed: one of them"),
        (["-o", "x.rrd"], "no BAG; name one, or --live"),
        (["a_bag", "--once"], "--connect, --scenario, --once and --json are for --live"),
    ],
)
def test_what_cannot_be_shown_is_refused(options, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with harness.free_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        assert said in refused("view", *options)
    assert list(tmp_path.iterdir()) == []


# --- a real cell


@pytest.fixture(scope="module")
def offline():
    return harness.run(load(PISTON, [f"spindle_encoder.revolutions={LENGTH}"])).digest


@contextlib.contextmanager
def watching(domain, folder, *options):
    """A bridge as a process of its own, which saves; killed at the end if it has not ended by itself."""
    environment = os.environ | {"ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(folder)}
    command = [sys.executable, "-m", "lathe_rc", "view", "--live", "--json", "-o", folder / "live.rrd", *options]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, env=environment, stdout=pipe, stderr=pipe, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


@contextlib.contextmanager
def cell(folder, domain, *overrides):
    """The processes of a cell that begins when somebody calls ``begin``."""
    piston = load(PISTON, [f"spindle_encoder.revolutions={LENGTH}", *overrides])
    with held(harness.with_recorder(piston, folder / "bag", keep=True), domain) as (processes, begin):
        yield processes, begin


def listens(bridge):
    """Wait until a bridge listens to every topic."""
    topics = 0
    while topics < DRAWN:
        line = bridge.stderr.readline()
        assert line, "the bridge has ended"
        topics += "listens to" in line


def told(bridge):
    """The output about the one run that it has shown."""
    out, errors = bridge.communicate()
    assert bridge.returncode == 0, errors
    assert "Traceback" not in errors
    (run,) = json.loads(out)["runs"]
    return run, errors


@pytest.mark.system
def test_a_running_cell_is_shown_as_its_bag(offline, tmp_path):
    with harness.free_domain() as domain, watching(domain, tmp_path, "--once") as bridge:
        # So slow that the viewer keeps up beside other tests: one that falls behind leaves messages out.
        with cell(tmp_path, domain, "spindle_encoder.speed_factor=0.1") as (processes, begin):
            listens(bridge)
            begin()
            processes.wait_for_end()
        run, _ = told(bridge)
    recording = reader.read_bag(tmp_path / "bag")
    assert recording.digests() == offline
    samples = recording.of_type(messages.TOOL)["error"] * 1e6
    expected = {"first": 0, "end": samples.size, "revolutions": int(LENGTH), "left_out": 0, "complete": True}
    assert {name: run[name] for name in expected} == expected
    view = View(tmp_path / "live.rrd")
    time, _, value = view.scalars("/signals/tool/error")
    assert_array_equal(value, samples[time // STEP_NS])
    assert time[-1] // STEP_NS >= samples.size - 64
    learned = recording.sparse["/coarse/learning"].values["rms_error"]
    assert_allclose(10 ** view.scalars("/learning/coarse/learning")[2] * 1e-6, learned)


@pytest.mark.system
def test_a_bridge_that_is_stuck_delays_no_member(offline, tmp_path):
    """Two of them: one continues before the run has ended, the other after that."""
    folders = [tmp_path / "goes_on", tmp_path / "until_the_end"]
    for folder in folders:
        folder.mkdir()
    with contextlib.ExitStack() as stack:
        domain = stack.enter_context(harness.free_domain())
        # With buffers as large as those of the members, nothing would be lost in so short a run.
        small = tmp_path / "small_buffers.xml"
        small.write_text(Path(dds.__file__).with_name("fastdds.xml").read_text("utf-8").replace("4194304", "212992"))
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv(dds.PROFILES, str(small))
            bridges = [stack.enter_context(watching(domain, folder)) for folder in folders]
        # So slow that the bridges have time to show something before they are stopped; nothing is right as well.
        with cell(tmp_path, domain, "spindle_encoder.speed_factor=0.1") as (processes, begin):
            for bridge in bridges:
                listens(bridge)
            begin()
            processes.wait_for("cycle", cycle=2.0)
            for bridge in bridges:
                bridge.send_signal(signal.SIGSTOP)
            processes.wait_for("cycle", cycle=9.0)
            bridges[0].send_signal(signal.SIGCONT)
            processes.wait_for_end()
        bridges[1].send_signal(signal.SIGCONT)
        for bridge in bridges:
            bridge.send_signal(signal.SIGINT)
        (goes_on, left_out), (until_the_end, cut) = map(told, bridges)
    recording = reader.read_bag(tmp_path / "bag")
    assert recording.digests() == offline
    samples = recording.of_type(messages.TOOL)["error"] * 1e6
    for folder, run in zip(folders, (goes_on, until_the_end), strict=True):
        time, _, value = View(folder / "live.rrd").scalars("/signals/tool/error")
        assert_array_equal(value, samples[time // STEP_NS])
        assert run["revolutions"] < LENGTH
    assert not until_the_end["complete"]
    assert "the end of the run was not heard" in cut
    assert goes_on["left_out"] > 0
    assert "left out, wholly or in part" in left_out
