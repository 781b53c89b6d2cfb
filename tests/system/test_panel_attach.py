# SPDX-License-Identifier: Apache-2.0
"""``lathe panel --attach``: a cell of nodes is shown and commanded, and waits for no page."""

import contextlib
import http.client
import json
import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from cells import until

import lathe_rc
from lathe_live.page_server import TOKEN
from lathe_live.panel_view import Have
from lathe_rc import harness
from lathe_rc.cell.scenario import load

HELD = ["spindle_encoder.simulation_services=playing"]
SUPERVISED = Path(__file__).parents[2] / "config" / "supervised.yaml"


class Asked:
    """Questions to a panel, by its address."""

    def __init__(self, line):
        self._address = urlsplit(re.search(r"http://\S+", line)[0])

    def ask(self, name, **question):
        connection = http.client.HTTPConnection(self._address.hostname, self._address.port, timeout=30)
        token = self._address.query.partition("=")[2]
        connection.request("POST", f"/ask/{name}", json.dumps(question), {TOKEN: token})
        answer = connection.getresponse()
        return answer.status, json.loads(answer.read())

    def until(self, condition):
        def look():
            _, told = self.ask("frame", **vars(Have()))
            return condition(told) and told

        return until(look)

    def pause(self):
        assert self.ask("pause") == (200, {})
        self.until(lambda told: told["now"]["state"] == "paused")


@contextlib.contextmanager
def panel_of(domain):
    words = [sys.executable, "-m", "lathe_rc", "panel", "supervised", "--attach", "--no-browser", "--set", *HELD]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield Asked(process.stdout.readline())
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=30)
        finally:
            process.kill()
        assert process.returncode == 0, errors
        assert "Traceback" not in errors


@pytest.fixture
def attached(domain):
    with panel_of(domain) as asked:
        yield asked


@pytest.mark.system
def test_a_running_cell_is_shown_and_broken_from_the_page(attached, domain):
    """The fault is an event at the sample that the page is told; the same event offline gives the same run."""
    cell = load(SUPERVISED, ["spindle_encoder.revolutions=60", "spindle_encoder.speed_factor=0.5", *HELD])
    found = []
    running = threading.Thread(target=lambda: found.append(harness.run(cell, mode="composed", domain=domain)))
    running.start()
    attached.until(lambda told: told["now"].get("angle", 0.0) > 60.0)
    attached.pause()  # the run is not over before its fault, however busy the machine
    status, told = attached.ask("act", node="spindle_encoder", action="fault encoder missed_index")
    assert status == 200, told
    assert attached.ask("act", node="learning_controller", action="frieze")[0] == 400
    assert attached.ask("start") == (200, {})
    attached.until(lambda told: told["now"]["safety"]["state"] == "safe")
    running.join()
    last = attached.until(lambda told: told["now"]["state"] == "ended")
    assert any("index_pulses" in line["text"] for line in last["log"])
    assert len(last["rows"]) > 15
    again = load(SUPERVISED, ["spindle_encoder.revolutions=60", f"spindle_encoder.events={json.dumps([told['text']])}"])
    assert found[0].digest == harness.run(again).digest


@pytest.mark.system
def test_a_panel_that_attaches_to_a_retracted_machine_shows_state_alarm_and_fault(domain, tmp_path):
    """It hears the latched messages of before; one that was there all along shows the retraction at once.

    When the cell is killed, the lamp is late and keeps its state.
    """
    given = ["revolutions=4000", "speed_factor=0.1", "faults=['revolution 5: encoder missed_index']"]
    loaded = load(SUPERVISED, [f"spindle_encoder.{each}" for each in given])
    cell = harness.with_recorder(loaded, tmp_path / "bag", keep=True)
    with (
        panel_of(domain) as first,
        harness.Processes(cell, [[name] for name in cell.nodes], domain=domain) as processes,
    ):

        def retracted(told):
            safety = told["now"]["safety"]
            return safety["state"] == "safe" and safety["cause"]

        shown = first.until(retracted)
        assert shown["now"]["safety"]["cause"].startswith("index_pulses encoder")
        with panel_of(domain) as late:
            safety = late.until(retracted)["now"]["safety"]
            assert safety["since"] == shown["now"]["safety"]["since"]
            told = late.until(lambda told: told["now"]["faults"])
            assert told["now"]["faults"] == ["spindle_encoder: encoder missed_index"]
            # Latched messages of several nodes come in any order.
            late.until(lambda told: any(line["text"].startswith("index_pulses encoder") for line in told["log"]))
            for pid in processes.pids.values():
                os.kill(pid, signal.SIGKILL)
            for panel in (first, late):
                safety = panel.until(lambda told: told["now"]["safety"]["late"])["now"]["safety"]
                assert (safety["state"], safety["age"] >= 3.0) == ("safe", True)


@pytest.mark.system
def test_a_running_cell_is_paced_paused_and_recorded_from_the_page(attached, domain, tmp_path):
    """While it is held, no sample is computed; pace and pause change no digest."""
    given = ["spindle_encoder.revolutions=40", "spindle_encoder.speed_factor=0.2", *HELD]
    found = []
    running = threading.Thread(
        target=lambda: found.append(harness.run(load(SUPERVISED, given), mode="composed", domain=domain)), daemon=True
    )
    running.start()
    attached.until(lambda told: told["now"].get("angle", 0.0) > 20.0)
    attached.pause()
    assert "step" in attached.ask("about")[1]["cannot"]
    assert attached.ask("state", values={})[1]["answers"]  # the page of the loops is a tab
    assert attached.ask("record", bag=str(tmp_path / "bag"))[0] == 200
    assert "is being recorded" in attached.ask("record", bag=str(tmp_path / "another"))[1]["error"]
    event = {"node": "learning_controller", "action": "learn"}
    _, told = attached.ask("act", **event)
    assert attached.ask("pace", factor=-1.0)[0] == 400
    assert attached.ask("pace", factor=0.5) == (200, {})
    assert attached.until(lambda told: told["now"]["pace"] == 0.5)["now"]["state"] == "paused"
    assert attached.ask("act", **event) == (200, told)  # the first sample not computed is the same
    assert attached.ask("start") == (200, {})
    attached.until(lambda told: told["now"].get("angle", 0.0) > 100.0)
    attached.pause()
    assert attached.ask("record", bag="") == (200, {})
    assert attached.ask("start") == (200, {})
    running.join()
    attached.until(lambda told: told["now"]["state"] == "ended")
    events = f"learning_controller.events={json.dumps(2 * [told['text']])}"
    assert found[0].digest == harness.run(load(SUPERVISED, [*given, events])).digest
    assert lathe_rc.read_bag(tmp_path / "bag").dense["/tool"]["error"].size > 0
