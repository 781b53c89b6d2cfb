# SPDX-License-Identifier: Apache-2.0
"""The panel: commands, snapshots, and a run that is that of `lathe run`."""

import contextlib
import json
import re
import socket
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import urlsplit

import cells
import numpy as np
import pytest
from bags import lathe
from cells import until
from machines import assert_refused

import lathe_rc
from lathe_live import page_server, panel, panel_age, panel_lamp, panel_view
from lathe_live.live_runs import Backlog
from lathe_live.page_server import Site
from lathe_live.panel_advice import Situation
from lathe_live.panel_live import LivePanel
from lathe_live.panel_player import Player
from lathe_live.panel_run import Driver, LiveCell
from lathe_live.panel_verdict import Evaluation
from lathe_live.panel_view import Have, news
from lathe_live.rerun_signals import is_drawn
from lathe_machine.safety import next_step
from lathe_rc import event_log, harness, messages
from lathe_rc.analysis.tolerance import growth, judge
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.cell.parameters import form_doubt, judged
from lathe_rc.cell.running_form import RunningForm
from lathe_rc.cell.scenario import load
from lathe_rc.errors import DivergedError, InputError, LatheError
from lathe_rc.judge import part
from lathe_rc.safety.state_machine import Reaction, State

ROOT = Path(__file__).parents[2]


def scenario(name="supervised", revolutions=20, *overrides):
    return load(ROOT / "config" / f"{name}.yaml", [f"spindle_encoder.revolutions={revolutions}", *overrides])


def joined(one, other):
    """Two rows of the map as one, as in panel.js."""
    if one["out"] != other["out"]:
        cells = (other if one["out"] else one)["cells"]
    else:
        cells = [max(pair, key=abs) for pair in zip(one["cells"], other["cells"], strict=True)]
    return {**other, "since": one["since"], "cells": cells, "out": one["out"] and other["out"]}


class Panel:
    """A page without a browser: the answers of the server, and all that they told."""

    def __init__(self, driver, cell, site=None):
        self.cell, self.answers = cell, (site or panel.site(driver, cell)).answers
        self.have, self.rows, self.open, self.log, self.now = Have(), [], None, [], {}

    def ask(self, name, **question):
        return json.loads(json.dumps(self.answers[name](question)))

    def take(self):
        """Take what the page lacks, as panel.js does."""
        told = self.ask("frame", **vars(self.have))
        if told["run"] != self.have.run:
            self.rows, self.log, epoch = [], [], told["epoch"]
        else:
            epoch = self.have.epoch
        for _ in range(told["epoch"] - epoch):
            self.rows = [joined(*pair) for pair in zip(self.rows[::2], self.rows[1::2])]  # noqa: B905 - one may be left
        self.rows += told["rows"]
        self.open = told["open"]
        self.log += told["log"]
        assert told["logged"] == len(self.log)  # nothing is dropped in short runs
        self.now = told["now"]
        lengths = (len(self.rows), len(self.log))
        latest = max([row["revolution"] for row in told["latest"]], default=self.have.latest)
        self.have = Have(told["number"], told["run"], told["epoch"], *lengths, latest)
        return told

    def largest(self):
        """Largest form error of each revolution, from the timeline [µm]."""
        low, high = self.ask("timeline", cells=4096)["bands"]["error"]
        return [max(-a, b) for a, b in zip(low, high, strict=True)]

    def step(self):
        """Turn the cell for a revolution."""
        before = self.now.get("sample", 0)
        self.ask("step")
        return self.until(lambda now: now["state"] == "paused" and now["sample"] > before)

    def run(self):
        """Turn the cell to the end of its run."""
        self.ask("start")
        return self.until(lambda now: now["state"] == "ended")

    def until(self, condition):
        deadline = time.monotonic() + 60.0
        while time.monotonic() < deadline:
            told = self.take()
            if condition(self.now) and not told["more"]:
                return self.now
        raise AssertionError(self.now)


@pytest.fixture
def opened():
    """Opens the panel of a scenario, as fast as possible."""
    threads = []

    def opening(loaded, pace=0.0):
        cell = LiveCell(loaded)
        driver = Driver(cell, pace)
        driver.__enter__()
        threads.append(driver)
        return Panel(driver, cell)

    yield opening
    for driver in threads:
        driver.__exit__()


def test_a_run_with_the_panel_has_the_digests_of_one_without(opened, tmp_path):
    """Also with steps, pauses, another pace and a page that asks all the time."""
    shown = opened(scenario("supervised", 12))
    shown.ask("record", bag=str(tmp_path / "bag"))
    shown.ask("step")
    assert shown.until(lambda now: now["state"] == "paused" and now["sample"])["sample"] in range(3700, 4000)
    shown.ask("pace", factor=1.0)
    shown.ask("start")
    shown.until(lambda now: now["sample"] > 10_000)
    shown.ask("pause")
    shown.ask("pace", factor=0.0)
    shown.run()
    result = harness.run(scenario("supervised", 12))
    assert lathe_rc.read_bag(tmp_path / "bag").digests() == result.digest
    assert shown.largest()[:12] == pytest.approx((result.errors.largest * 1e6).tolist())


@pytest.mark.parametrize(
    ("law", "drive", "limit"),
    [
        ({"learning_gain": 0.2}, {}, r"falls by [\d.]+% a revolution; in tolerance after some \d+ more"),
        ({"learning_gain": 0.9}, {}, r"^\d+% .* repeats from revolution to revolution, most at 2 waves"),
        ({}, {"noise_rms": 1e-6}, r"^\d+% .* changes from revolution to revolution: noise\.$"),
        ({}, {"command_velocity": 5e-3}, r"^electrodynamic_actuator is at the limits of its command"),
    ],
)
def test_the_panel_says_what_limits_the_form_error(opened, law, drive, limit):
    """Learning, Q, noise and the limits of a command, in four variants of one cell."""
    nodes = {"learning_controller": law, "electrodynamic_actuator": drive, "tool": {"tolerance": 1e-9}}
    shown = opened(cells.scenario(spindle_encoder={"revolutions": 30.2}, **nodes))
    assert re.search(limit, shown.run()["limits"][0])


def test_the_panel_tells_the_results_of_loops_in_the_words_of_a_run(opened, tmp_path):
    """Also of a bag, and after a jump back in it."""
    result = harness.run(scenario("force_turning", 40), bag=tmp_path / "bag")
    loop = result.loops["force_controller"]
    words = [f"force_controller: {text}." for text in (*(text for text, _ in loop.judged()), *loop.behaviour())]
    assert len(words) == 3
    shown = opened(scenario("force_turning", 40))
    assert shown.run()["loops"] == words
    player = Player(tmp_path / "bag")
    for sample in (player.samples, 3 * 3840, player.samples):
        player.seek(sample)
    player.view.publish({})
    assert player.view.latest.now["loops"] == words


def test_events_of_the_panel_repeat_its_run(opened, tmp_path):
    """Fault, alarm, retraction, reset, another gain: each at a sample that the panel names."""
    shown = opened(scenario())
    shown.ask("record", bag=str(tmp_path / "bag"))
    for _ in range(6):
        shown.step()
    shown.ask("act", node="learning_controller", action="set learning_gain 0.5")
    shown.ask("act", node="learning_controller", action="freeze")
    told = shown.ask("act", node="spindle_encoder", action="fault encoder missed_index")["text"]
    assert told == f"sample {shown.now['sample']}: fault encoder missed_index"
    shown.ask("start")
    shown.until(lambda now: now["safety"]["state"] == "safe" or now["state"] == "ended")
    alarm = next(line for line in shown.log if "index_pulses" in line["text"] and "rad" in line["text"])
    shown.ask("start") if shown.now["state"] == "paused" else None
    shown.until(lambda now: now["state"] == "ended")
    # The first alarm stays beside the state, and rows from the retraction on are marked.
    assert alarm["text"].startswith(f"{shown.now['safety']['cause']}: ")
    out = [row["out"] for row in shown.rows]
    assert out == sorted(out)
    assert (out[5], out[-1]) == (False, True)
    assert not any(shown.now["learning"].values())  # frozen
    assert_refused(lambda: shown.ask("causes"), "the tool was out of the part")
    again = scenario("supervised", 20, *[f"{n}.events={json.dumps(e)}" for n, e in shown.cell.events.items()])
    assert set(shown.cell.events) == {"learning_controller", "spindle_encoder"}
    assert lathe_rc.read_bag(tmp_path / "bag").digests() == harness.run(again).digest


def test_the_lamp_is_unknown_until_the_supervisor_was_heard(opened):
    shown = opened(scenario("supervised", 3))
    assert shown.take()["now"]["safety"]["state"] == "unknown"
    safety = shown.run()["safety"]
    assert (safety["state"], safety["cause"], safety["late"]) == ("nominal", "", False)
    assert opened(scenario("piston", 3)).take()["now"]["safety"] is None


def test_a_diverging_run_is_named_as_lathe_run_names_it(opened):
    """By the same evaluation, although neither a supervisor nor the guard of the law ends the run."""
    wrong = {"lead_time": 1e-4, "learning_gain": 0.5, "stop_ratio": 0.0, "allow_unstable": True}
    cell = cells.scenario(spindle_encoder={"revolutions": 40.2}, learning_controller=wrong)
    result = harness.run(cell)
    assert result.growth.diverges
    shown = opened(cell)
    part = shown.run()["part"]
    assert (part["mood"], part["text"].startswith(f"{result.growth.told()}; no tolerance")) == ("bad", True)


def test_the_causes_are_those_of_lathe_budget_for_the_run_up_to_here(opened):
    """With its commands and changed parameters; refused where the run cannot be repeated, or does not cut."""
    shown = opened(scenario("supervised", 30, "learning_controller.events=['revolution 2: set learning_gain 0.8']"))
    assert_refused(lambda: shown.ask("causes"), "no complete revolution yet")
    for _ in range(8):
        shown.step()
    shown.ask("act", node="learning_controller", action="set learning_gain 0.5")
    at = shown.now["sample"]
    for _ in range(6):
        shown.step()
    found = shown.ask("causes")
    events = ["revolution 2: set learning_gain 0.8", f"sample {at}: set learning_gain 0.5"]
    assert shown.now["events"] == f"--set 'learning_controller.events={json.dumps(events)}'"
    again = scenario("supervised", found["last"], f"learning_controller.events={json.dumps(events)}")
    assert found == {**lathe_rc.budget(again).summary(), "last": int(shown.cell.view.turns)}
    assert found["largest"] == pytest.approx(max(shown.largest()[found["last"] - 10 : found["last"]]), rel=0.02)
    shown.ask("change", values={}, here=True)
    assert_refused(lambda: shown.ask("causes"), "began at a checkpoint")


def test_other_parameters_hold_from_a_checkpoint_or_from_the_start(opened, tmp_path):
    shown = opened(scenario("piston", 12))
    for _ in range(4):
        shown.step()
    at, learned = shown.now["sample"], shown.largest()[3]
    shown.ask("change", values={"learning_controller.learning_gain": "0.5"}, here=True)
    shown.step()
    assert shown.now["begun"] == at
    assert shown.largest()[4] < 2 * learned  # goes on with what it has learned
    assert shown.cell.scenario.value("learning_controller.learning_gain") == 0.5
    with pytest.raises(InputError, match="goes on only with the parameters of the checkpoint"):
        shown.ask("change", values={"seed": "7"}, here=True)
    assert shown.take()["now"]["sample"] == shown.cell.reached  # as before
    run = shown.have.run
    shown.ask("change", values={"seed": "7"}, here=False)
    shown.take()
    assert (shown.have.run, shown.rows, shown.largest(), shown.cell.reached) == (run + 1, [], [], 0)
    shown.run()
    assert len(shown.rows) == 12


def test_parameters_add_up_and_are_listed_with_waiting_events(opened):
    """The second checkpoint at the same sample goes on like the first; a fault before it stays."""
    shown = opened(scenario("supervised", 12, "allow_faults=true"))
    for _ in range(3):
        shown.step()
    shown.ask("act", node="electrodynamic_actuator", action="fault coarse/command.position wrong scale=0.99")
    shown.ask("step")
    now = shown.until(lambda now: now["state"] == "paused" and len(shown.rows) == 4)
    assert now["faults"] == ["electrodynamic_actuator: coarse/command.position wrong scale=0.99"]
    at = now["sample"]
    shown.ask("act", node="learning_controller", action="freeze")
    for name, value in (("learning_gain", "0.5"), ("lead_time", "1.3e-3")):
        shown.ask("change", values={f"learning_controller.{name}": value}, here=True)
    listed = "--set learning_controller.learning_gain=0.5 --set learning_controller.lead_time=0.0013"
    now = shown.until(lambda now: "lead_time" in now["events"])
    assert (now["begun"], shown.cell.reached) == (at, at)
    assert now["events"] == f"{listed} --set 'learning_controller.events=[\"sample {at}: freeze\"]'"
    shown.ask("step")
    shown.until(lambda _: len(shown.rows) == 5)
    assert any(line["sample"] == at and line["text"] == "freeze" for line in shown.log)
    shown.ask("act", node="electrodynamic_actuator", action="repair coarse/command.position")
    shown.ask("step")
    shown.until(lambda now: len(shown.rows) == 6 and not now["faults"])
    assert shown.rows[-1]["revolution"] > shown.rows[-2]["revolution"]
    shown.ask("change", values={}, here=False)
    assert shown.until(lambda now: not now["begun"])["events"] == listed


def test_a_restart_begins_at_the_checkpoint_that_was_given(opened, tmp_path):
    lathe_rc.run(scenario("piston", 6), checkpoints={"revolution:3": tmp_path / "learned"})
    shown = opened(scenario("piston", 6, f"spindle_encoder.start_from={tmp_path / 'learned'}"))
    begun = shown.cell.reached
    shown.ask("step")
    shown.until(lambda now: now["state"] == "paused" and now.get("sample", 0) > begun)
    shown.ask("change", values={"learning_controller.learning_gain": "0.5"}, here=True)
    shown.ask("change", values={}, here=False)
    assert shown.cell.reached == begun > 0


def test_mistakes_are_refused_and_the_run_goes_on(opened, tmp_path):
    shown = opened(scenario("piston", 8))
    for name, question, message in (
        ("act", {"node": "tol", "action": "freeze"}, "did you mean tool"),
        ("act", {"node": "learning_controller", "action": "frieze"}, "freeze"),
        ("act", {"node": "tool", "action": "fault tool.error off"}, "allow_faults"),
        ("act", {"node": "learning_controller", "action": "set learning_gain 99"}, "learning_gain"),
        ("act", {"node": "learning_controller"}, "action = null; allowed: a text"),
        ("change", {"values": {"learning_controller.lead": "1"}, "here": True}, "lead_time"),
        ("change", {"values": [], "here": True}, "allowed: an object"),
        ("pace", {"factor": -1}, "pace = -1"),
        ("record", {"bag": str(tmp_path)}, "exists"),
        ("record", {"bag": " "}, "allowed: a name"),
        ("frame", {"number": -1}, "number = -1"),
    ):
        assert_refused(partial(shown.ask, name, **question), message)
    shown.run()
    assert_refused(lambda: shown.ask("step"), "ended; allowed: restart")


def test_a_run_that_fails_says_so_and_can_be_restarted(opened, monkeypatch):
    shown = opened(scenario("piston", 4))

    def diverge(*_):
        raise DivergedError("/tool: error is nan at sample 7")

    monkeypatch.setattr(shown.cell._engine, "advance", diverge)
    shown.ask("start")
    shown.until(lambda now: now["state"] == "failed")
    assert shown.now["failure"] == "/tool: error is nan at sample 7"
    shown.ask("change", values={}, here=False)
    shown.run()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_panel_whose_thread_has_ended_answers(opened, monkeypatch):
    shown = opened(scenario("piston", 4))
    monkeypatch.setattr(shown.cell, "advance", lambda _: 1 / 0)
    shown.ask("start")
    assert "ZeroDivisionError" in shown.until(lambda now: now["state"] == "failed")["failure"]
    with pytest.raises(LatheError, match="start lathe panel again"):
        shown.ask("pause")


def unread(address):
    """A page that asks many times and reads no answer; returns its connection, whose buffers are full."""
    parts = urlsplit(address)
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    connection.connect((parts.hostname, parts.port))
    body, token = json.dumps(vars(Have())), parts.query.partition("=")[2]
    head = f"POST /ask/frame HTTP/1.1\r\nHost: {parts.netloc}\r\n{page_server.TOKEN}: {token}\r\n"
    connection.settimeout(0.0)
    connection.send(1000 * f"{head}Content-Length: {len(body)}\r\n\r\n{body}".encode())
    return connection


def test_pages_that_read_no_answer_delay_no_sample(opened, monkeypatch, tmp_path):
    """A page beside them misses snapshots, and gets the newest one and the rows that it lacks, a few at a time."""
    monkeypatch.setattr(panel_view, "MOST_ROWS", 16)
    shown = opened(scenario("piston", 24))
    shown.ask("record", bag=str(tmp_path / "bag"))
    shown.step()
    before = shown.have.number
    with page_server.serving(Site({}, shown.answers)) as address, contextlib.ExitStack() as stuck:
        for _ in range(4):
            stuck.enter_context(unread(address))
        shown.ask("start")
        until(lambda: shown.cell.view.latest.now["state"] == "ended")
        assert shown.take()["number"] > before + 1  # that of the start was missed
        shown.until(lambda now: now["state"] == "ended")
    assert lathe_rc.read_bag(tmp_path / "bag").digests() == harness.run(scenario("piston", 24)).digest
    assert shown.have.epoch == 1
    assert [(row["since"], row["revolution"]) for row in shown.rows] == [(n, n + 1) for n in range(1, 24, 2)]
    assert all(len(row["cells"]) == 180 for row in shown.rows)


def test_a_snapshot_before_the_first_is_an_error():
    with pytest.raises(LatheError, match="not begun"):
        LiveCell(scenario("piston", 3)).view.wait(0, 0.0)


def test_what_a_page_can_ask_for_is_told(opened):
    about = opened(scenario()).ask("about")
    nodes = {node["name"]: node for node in about["nodes"]}
    assert nodes["learning_controller"]["actions"] == ["freeze", "learn", "clear"]
    assert [knob["name"] for knob in nodes["learning_controller"]["knobs"]][:1] == ["learning_gain"]
    assert "coarse/state.measured_position" in nodes["electrodynamic_actuator"]["targets"]["stuck"]
    assert about["faults"]["wrong"]["values"] == {"scale": 0.9, "offset": 0.0}  # breaks something as it is
    assert "electrodynamic_actuator.delay" in about["parameters"]


def test_only_news_are_told():
    cell = LiveCell(scenario("piston", 3))
    cell.view.publish({"state": "paused"})
    told = news(cell.view, Have(epoch=9, run=1), 1.0)
    assert (told["rows"], told["shape"], told["more"]) == ([], None, False)


def test_the_log_of_a_long_run_takes_bounded_memory_and_a_page_gets_the_newest_lines(opened, monkeypatch):
    """Each line once, in order; a page that asks seldom misses the oldest ones."""
    monkeypatch.setattr(panel_view, "MOST_LOG", 16)
    view = opened(scenario("supervised", 3)).cell.view
    seldom, often, kept = 0, 0, []
    for k in range(100):
        view.say(k, "panel", str(k))
        view.publish({"state": "running"}, at_once=True)
        assert len(view.latest.log) < 16
        told = news(view, Have(run=view.run, log=often), 0.0)
        kept += [line["sample"] for line in told["log"]]
        often = told["logged"]
        if k in (9, 70, 99):
            told = news(view, Have(run=view.run, log=seldom), 0.0)
            assert [line["sample"] for line in told["log"]][-1] == k
            seldom = told["logged"]
    assert kept == list(range(100))
    assert seldom == often == 100


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bag") / "turned"
    harness.run(scenario("supervised", 8, "spindle_encoder.faults=['revolution 5: encoder missed_index']"), bag=folder)
    return folder


def test_a_bag_is_played_with_pause_steps_and_jumps(bag):
    """Forwards and backwards, it shows at each sample what the whole run showed there."""
    player = Player(bag)
    with Driver(player, 0.0) as driver:
        shown = Panel(driver, None, panel.player_site(driver, player))
        assert shown.ask("about")["tolerance"] == 2.0
        shown.step()
        assert [row["revolution"] for row in shown.rows] == [1]
        shown.run()
        rows, log, state = shown.rows, shown.log, shown.now["safety"]
        assert (len(rows), state["state"]) == (8, "safe")
        assert any("missed_index" in line["text"] for line in log)
        now = shown.now
        assert now["reference"] - now["error"] == pytest.approx(now["displacement"])  # where the tool is drawn
        shown.ask("seek", sample=rows[3]["revolution"] * 3900)
        shown.until(lambda now: now["sample"] == rows[3]["revolution"] * 3900)
        assert shown.rows == rows[: len(shown.rows)]
        assert shown.now["safety"]["state"] == "nominal"
        shown.ask("seek", sample=player.samples)
        shown.until(lambda now: now["sample"] == player.samples)
        assert (shown.rows, shown.log, shown.now["safety"]) == (rows, log, state)
        shown.run()  # from the beginning
        assert shown.rows == rows
        assert_refused(lambda: shown.ask("seek", sample=-1), "sample -1; allowed: from 0 to")


def test_a_folder_without_a_bag_is_not_played(tmp_path):
    assert lathe("panel", tmp_path).exit_code == 2


# --- a cell of nodes: a bag stands for what is heard


@pytest.fixture(scope="module")
def retracted(bag):
    """The message types of a cell that is retracted in revolution 5, and what would be heard of it."""
    with BagSource(bag) as source:
        types = {topic: kind.type for topic, kind in source.topics.items()}
        types = {topic: kind for topic, kind in types.items() if is_drawn(kind) or kind in LivePanel.urgent}
        return types, [(topic, types[topic], data) for topic, _, data in source.messages(set(types))]


def attached(types):
    live = LivePanel()
    live.present = types
    live.view.know(scenario())
    return live


def hear(live, heard, backlog=None):
    """Take messages as the listener does, whose backlog is shown at once or later."""
    for message in heard:
        if message[1] in live.urgent:
            live.hear(*message)
        if is_drawn(message[1]):
            live.take(*message) if backlog is None else backlog.put(message)


def lamp(live):
    return news(live.view, Have(), 0.0)["now"]["safety"]


@pytest.mark.parametrize("latched_first", [True, False])
def test_a_panel_that_comes_late_shows_state_alarm_and_fault_of_a_retracted_machine(retracted, latched_first):
    """Blocks from then on, and the latched messages from before, in either order."""
    types, heard = retracted
    live = attached(types)
    assert lamp(live)["state"] == "unknown"
    late = [message for message in heard[-len(heard) // 5 :] if message[1] not in event_log.LOGGED]
    latched = [message for message in heard if message[1] in event_log.LOGGED]
    hear(live, [*latched, *late] if latched_first else [*late, *latched])
    safety = lamp(live)
    assert (safety["state"], safety["late"]) == ("safe", False)
    assert safety["cause"].startswith("index_pulses encoder")
    assert 4 * 3840 < safety["since"] < 6 * 3840  # in or after revolution 5, at 1000 rpm
    assert news(live.view, Have(), 0.0)["now"]["faults"] == ["spindle_encoder: encoder missed_index"]


def test_a_panel_under_full_load_shows_a_retraction_at_once_and_keeps_its_messages(retracted):
    """Nothing of the backlog is shown yet, and all its blocks are left out."""
    types, heard = retracted
    live, backlog = attached(types), Backlog(100_000)
    hear(live, heard[: len(heard) // 3])
    hear(live, heard[len(heard) // 3 :], backlog)
    assert lamp(live)["state"] == "safe"
    backlog.close()
    for message in backlog:
        live.take(*message)
    live.end()
    log = news(live.view, Have(), 0.0)["log"]
    assert "left out" in news(live.view, Have(), 0.0)["now"]["left_out"]
    assert next(line["text"].partition(" ")[0] for line in log if line["source"] == "safety/status") == "index_pulses"


def test_the_lamp_of_a_cell_that_falls_silent_is_late(retracted, monkeypatch):
    types, heard = retracted
    clock = [100.0]
    monkeypatch.setattr(panel_lamp, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    live = attached(types)
    hear(live, heard)
    clock[0] += 2.9
    assert not lamp(live)["late"]
    clock[0] += 0.2
    assert (lamp(live)["state"], lamp(live)["age"], lamp(live)["late"]) == ("safe", 3.1, True)
    hear(live, heard[:1000])  # the same run again
    assert (lamp(live)["state"], lamp(live)["late"]) == ("nominal", False)


def test_a_cell_of_nodes_that_fails_is_told_in_its_own_words(retracted):
    types, heard = retracted
    live = attached(types)
    hear(live, heard[:1000])
    kind = messages.store().types[messages.CELL_STATE]
    for state, text in ((3, "/learning_controller: learning diverges"), (1, "")):
        told = messages.encode(messages.CELL_STATE, kind("run", state, 0, text, 0, [], 0))
        hear(live, [("/cell_state", messages.CELL_STATE, told)])
        now = news(live.view, Have(), 0.0)["now"]
        assert (now["failure"], now["state"]) == (text, "failed" if text else "running")


# --- the header: verdict, age and next steps


@pytest.mark.parametrize("name", ["supervised", "zones"])
def test_the_verdict_in_pieces_is_that_of_lathe_run_after_every_piece(name):
    """Also by zones, and for a view that begins in the middle of a run."""
    zoned = {"zone_start": [0.0], "zone_width": [1.0], "zone_tolerance": [20e-6], "tolerance": 2e-6}
    loaded = (
        scenario("supervised", 12)
        if name == "supervised"
        else cells.scenario(spindle_encoder={"revolutions": 12.2}, tool=zoned)
    )
    recording, declared = harness.run(loaded).recording, judged(loaded.nodes)
    angle, tool = recording.of_type(messages.ENCODER)["angle_true"], recording.dense["/tool"]
    tolerances = part.Tolerances.of(declared, "/tool", form_doubt(loaded.nodes))
    running, late = (RunningForm.of(recording.types, tolerances.zones) for _ in range(2))
    size = recording.samples // 9
    for first in range(0, recording.samples, size):
        piece = slice(first, first + size)
        for each, begins in ((running, 0), (late, 3 * size)):
            if first >= begins:
                each.add(first, angle[piece], {field: signal[piece] for field, signal in tool.items()})
        cut = {topic: {n: s[: piece.stop] for n, s in fields.items()} for topic, fields in recording.dense.items()}
        found = part.verdict(loaded, replace(recording, dense=cut))
        assert tolerances.verdict(running) == found or found.revolutions == 0
        assert tolerances.verdict(running).told() == found.told()
    assert 3 < late.before == found.revolutions - tolerances.verdict(late).revolutions
    assert tolerances.verdict(late).in_tolerance
    assert tolerances.verdict(late).since == late.before + 1  # no word about revolutions that were not seen
    assert part.error_growth(running) == part.error_growth(recording.form)


def _evaluated(errors, doubt=0.0, **more):
    largest = np.array(errors) * 1e-6
    return Evaluation(judge(largest, 2e-6, doubt=doubt), growth(largest), **more)


_TURNED = [100.0, 10.0, 3.0, 1.5, 1.2, 1.0, 1.0]
_GOOD = _evaluated(_TURNED)
_DIVERGING = _evaluated([0.1] * 8 + [0.15 * 1.3**k for k in range(9)])
_FAULTY = replace(_GOOD, verdict=judge(np.ones(7) * 1e-6, 2e-6, unjudged="not measured: a fault"))
_LEFT = _evaluated([*_TURNED, 40.0, 480.0], until_out=judge(np.array(_TURNED) * 1e-6, 2e-6))


@pytest.mark.parametrize(
    ("evaluated", "out", "headline"),
    [
        (_GOOD, "", "good PART GOOD in tolerance (±2 µm) from revolution 4 on, 0.5 µm to spare"),
        (_GOOD, "the tool is on its way out", "open PART NOT JUDGED the tool is on its way out; in"),
        (_evaluated(_TURNED, missing="revolutions 8 to 9"), "", "open PART NOT JUDGED revolutions 8 to 9; in"),
        (_LEFT, "the tool is out of the part", "bad PART BAD the tool is out of the part, 480 µm from the form; up "),
        (_evaluated(_TURNED, doubt=1.5e-6), "", "open PART NOT JUDGED not shown in tolerance (±2 µm): 1 µm"),
        (_evaluated(_TURNED[3:]), "", "open PART NOT JUDGED 5 revolutions are needed to see whether"),
        (_evaluated([]), "", "open PART NOT JUDGED no complete revolution yet"),
        (_evaluated([*_TURNED, 3.0]), "", "bad PART BAD not in tolerance (±2 µm): 3 µm in the last revolution"),
        (_DIVERGING, "", "bad PART GOOD, BUT DIVERGES form error diverges from revolution"),
        (_FAULTY, "", "open PART NOT JUDGED not judged (±2 µm): not measured: a fault"),
        (Evaluation(missing="no tolerance: tool.tolerance = 0"), "", "open PART NOT JUDGED no tolerance: tool"),
        (_evaluated(_TURNED, loops=[("force: beyond", False)]), "", "bad PART GOOD, LOOP BAD in tolerance"),
        (Evaluation(loops=[("force: in tolerance", True)]), "", "good LOOP GOOD force: in tolerance"),
    ],
)  # fmt: skip
def test_a_part_is_good_only_with_every_ground(evaluated, out, headline):
    found = evaluated.headline(out)
    assert f"{found.mood} {found.title} {found.text}".startswith(headline)


_BAD = _evaluated([9.0] * 8)
_WORN = _evaluated([0.1] * 8 + [0.2 + 0.1 * k for k in range(9)])
_BENT, _PRESSED, _LAW = {"bent": True}, {"force": 200.0, "force_limit": 165.0}, {"memories": ["law"]}


@pytest.mark.parametrize(
    ("changed", "outlook", "alarmed", "advice"),
    [
        ({"evaluation": _GOOD}, _BENT, False, ""),
        ({}, _PRESSED, True, "the set point of the force, 200 N, is above the supervisor's"),
        ({}, _BENT, False, "the force bends tool and part by 9 µm"),
        ({}, {}, False, ""),
        ({}, _BENT, True, ""),  # the supervisor's step counts
        ({"falls": True, "unstable": True, **_LAW}, _BENT, False, "wait: learning is not over"),
        ({"unstable": True, **_LAW}, {}, False, "clear law, in which learning diverges; then set"),
        ({"unstable": True, "learning": True, "memories": ["a", "b"]}, {}, False, "freeze and clear a and b, in "),
        ({"unstable": True}, {}, False, ""),
        ({"limited": ["drive"], "unstable": True, **_LAW}, {}, False, "lower the speed, or ask less of drive"),
        ({"evaluation": _DIVERGING, **_LAW}, {}, False, "clear law, in which learning diverges; then set a smaller "),
        ({"evaluation": _WORN}, {}, False, "the error grows as by wear or drift: change a worn edge"),
    ],
)  # fmt: skip
def test_the_header_names_a_step_for_the_part_where_one_follows_from_its_state(changed, outlook, alarmed, advice):
    known = {"unstable": False, "falls": False, "learning": False, "memories": [], "limited": []}
    found = Situation(**{"evaluation": _BAD, "errors": np.full((4, 360), 9e-6), **known, **changed})
    assert found.advice(outlook, alarmed=alarmed).startswith(advice)
    assert bool(found.advice(outlook, alarmed=alarmed)) == bool(advice)


def test_the_advice_of_a_run_that_diverges_or_asks_for_too_much_force_is_told_to_the_page(opened):
    wrong = {"lead_time": 1e-4, "learning_gain": 0.5, "stop_ratio": 0.0, "allow_unstable": True}
    diverging = cells.scenario(
        spindle_encoder={"revolutions": 40.2}, learning_controller=wrong, tool={"tolerance": 2e-6}
    )
    beyond = scenario("supervised_turning", 2, "force_controller.set_point=[200.0]")
    for loaded, advice in (
        (diverging, "freeze and clear learning_controller, in"),
        (beyond, "the set point of the force"),
    ):
        shown = opened(loaded)
        assert shown.run()["advice"].startswith(advice)


def test_the_headline_names_what_is_not_judged(opened):
    """A tool without a tolerance, and a fault of the form."""
    for name, given, text in (
        ("piston", ["tool.tolerance=0.0"], "no tolerance: tool.tolerance = 0"),
        (
            "supervised",
            ["tool.faults=['revolution 1: tool.error off']"],
            "not judged (±2 µm): not measured from sample",
        ),
    ):
        shown = opened(scenario(name, 2, *given))
        found = shown.run()["part"]
        assert (found["title"], found["text"][: len(text)]) == ("PART NOT JUDGED", text)


def test_the_next_step_after_a_retraction_is_the_one_that_lasts(opened):
    """A reset alone retracts again, as the page says; after both memories are cleared, it holds."""
    fault = "fault coarse/command.position wrong scale=0.9"
    shown = opened(scenario("supervised_full_cell", 60))
    told = lambda: shown.now["next"]["reset"]  # noqa: E731

    def on(condition):
        while not condition(shown.now):
            shown.ask("step")
            later = shown.now["sample"] + 1
            shown.until(lambda now, later=later: now["state"] == "paused" and now["sample"] >= later)

    shown.now = {"sample": 0}
    on(lambda _: len(shown.rows) >= 12)
    assert (shown.now["part"]["title"], told()["text"]) == ("PART GOOD", "nothing to reset")
    shown.ask("act", node="electrodynamic_actuator", action=fault)
    on(lambda now: now["safety"]["state"] == "retracting")
    assert not told()["allowed"]
    assert "wait until the tool is out" in told()["text"]
    assert f"repair electrodynamic_actuator: {fault.removeprefix('fault ')}" in told()["text"]
    shown.ask("act", node="electrodynamic_actuator", action="repair coarse/command.position")
    on(lambda now: now["safety"]["state"] == "safe")
    both = "clear fine_controller and learning_controller, then reset; otherwise the tool may be retracted again"
    assert told()["text"].startswith(both)
    shown.ask("act", node="supervisor", action="reset")
    on(lambda now: now["safety"]["state"] == "nominal")
    on(lambda now: now["safety"]["state"] == "safe")
    assert told()["text"].startswith(both)
    for node in ("learning_controller", "fine_controller"):
        shown.ask("act", node=node, action="clear")
    on(lambda _: told()["text"].startswith("reset: the tool approaches the part again"))
    shown.ask("act", node="supervisor", action="reset")
    on(lambda now: now["safety"]["state"] == "nominal")
    now = shown.run()
    assert (now["safety"]["state"], now["part"]["title"]) == ("nominal", "PART GOOD")


@pytest.mark.parametrize(
    ("state", "reaction", "alarms", "more", "allowed", "text"),
    [
        (State.SAFE, Reaction.STOP, ["speed"], {}, False, "a reset is refused after a stop: begin a new run"),
        (State.RETRACTING, Reaction.RETRACT, ["force"], {}, False, "wait until the tool is out of the part"),
        (State.RETRACTING, Reaction.RETRACT, ["error"], {"faults": ["tool: x"]}, False, "repair tool: x, with which"),
        (State.NOMINAL, Reaction.NONE, [], {}, False, "nothing to reset"),
        (State.SAFE, Reaction.RETRACT, ["operator"], {"memories": ["law"]}, True, "reset: the tool approaches the "),
        (State.SAFE, Reaction.RETRACT, ["force"], {}, True, "reset: the tool approaches the part again; the alarm is "),
        (State.SAFE, Reaction.RETRACT, ["force"], {"faults": ["cut: x"]}, True, "repair cut: x, then reset; otherwise"),
        (State.DEGRADED, Reaction.FREEZE, ["stability_margin"], {}, True, "set a smaller learning_gain, then reset"),
    ],
)
def test_each_state_has_a_next_step(state, reaction, alarms, more, allowed, text):
    found = next_step.reset(state, reaction, alarms, **more)
    assert (found.allowed, found.text[: len(text)]) == (allowed, text)


def test_an_attached_panel_says_how_far_behind_it_is(retracted, monkeypatch):
    """Behind under load, up to date afterwards, behind another run; still when no sample comes."""
    types, heard = retracted
    clock = [100.0]
    monkeypatch.setattr(panel_age, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    live, backlog = attached(types), Backlog(2**25)

    def now():
        return news(live.view, Have(), 0.0)["now"]

    hear(live, heard[: len(heard) // 3])
    live.know()  # publishes at once
    assert now()["age"] == {"behind": pytest.approx(0.0, abs=0.1), "still": 0.0}
    hear(live, heard[len(heard) // 3 :], backlog)
    assert now()["age"]["behind"] == pytest.approx(2 / 3 * 8 * 60 / 1000, abs=0.1)
    backlog.close()
    for message in backlog:
        live.take(*message)
    live.end()
    clock[0] += 4.0
    assert now()["age"] == {"behind": 0.0, "still": 4.0}
    # Another run of the cell is heard, but not shown yet.
    monkeypatch.setattr(panel_age, "_OTHER", 0.1)
    hear(live, heard[:300], Backlog(2**25))
    assert now()["age"]["behind"] is None


def test_an_attached_panel_is_paused_only_while_no_samples_come(retracted, monkeypatch):
    """A run that this panel has held may be continued by somebody else."""
    types, heard = retracted
    clock = [100.0]
    monkeypatch.setattr(panel_age, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    live = attached(types)
    state = lambda: news(live.view, Have(), 0.0)["now"]["state"]  # noqa: E731
    hear(live, heard[: len(heard) // 3])
    live.know(held=True)
    clock[0] += 2.0
    assert state() == "paused"
    hear(live, heard[len(heard) // 3 : len(heard) // 2])
    assert state() == "running"


def test_lost_samples_leave_the_part_unjudged(retracted):
    """The revolutions before a gap do not count, and the part is not good while its newest ones are missing."""
    types, heard = retracted
    live = attached(types)
    blocks = [message for message in heard if message[1] in messages.block_types()]
    third = len(blocks) // 3
    hear(live, [*blocks[:third], *(each for each in blocks[third:] if each[1] != messages.TOOL)])
    live.know()
    assert "were not received" in news(live.view, Have(), 0.0)["now"]["part"]["text"]
