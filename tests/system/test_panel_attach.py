# SPDX-License-Identifier: Apache-2.0
"""``lathe panel --attach``: a cell of nodes is shown and commanded, and waits for no page."""

import http.client
import json
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from lathe_rc import harness
from lathe_rc.cell.scenario import load
from lathe_rc.view.page_server import TOKEN
from lathe_rc.view.panel_view import Have

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
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline:
            _, told = self.ask("frame", **vars(Have()))
            if condition(told):
                return told
            threading.Event().wait(0.1)
        raise AssertionError(told["now"])


@pytest.fixture
def attached(domain):
    words = [sys.executable, "-m", "lathe_rc", "panel", "supervised", "--attach", "--no-browser"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        yield Asked(process.stdout.readline())
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30)
        assert process.returncode == 0, errors
        assert "Traceback" not in errors


@pytest.mark.system
def test_a_running_cell_is_shown_and_broken_from_the_page(attached, domain):
    """The fault is an event at the sample that the page is told; the same event offline gives the same run."""
    cell = load(SUPERVISED, ["spindle_encoder.revolutions=60", "spindle_encoder.speed_factor=0.5"])
    found = []
    running = threading.Thread(target=lambda: found.append(harness.run(cell, mode="composed", domain=domain)))
    running.start()
    attached.until(lambda told: told["now"].get("angle", 0.0) > 60.0)
    status, told = attached.ask("act", node="spindle_encoder", action="fault encoder missed_index")
    assert status == 200, told
    assert attached.ask("act", node="learning_controller", action="frieze")[0] == 400
    attached.until(lambda told: told["now"]["safety"]["state"] == "safe")
    running.join()
    last = attached.until(lambda told: told["now"]["state"] == "ended")
    assert any("index_pulses" in line["text"] for line in last["log"])
    assert len(last["history"]) > 20
    again = load(SUPERVISED, ["spindle_encoder.revolutions=60", f"spindle_encoder.events={json.dumps([told['text']])}"])
    assert found[0].digest == harness.run(again).digest
