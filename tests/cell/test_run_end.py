# SPDX-License-Identifier: Apache-2.0
"""Reactions of the harness to the ends of a cell's processes, without processes: the tests play these."""

import subprocess

import pytest
from cells import scenario

from lathe_rc import harness
from lathe_rc.commands.progress import TROUBLE
from lathe_rc.errors import LatheError


class Made:
    """A process with the methods of `lathe_rc.process_launcher.Child` that ends as told, or when it is killed."""

    def __init__(self, run, name):
        self._run, self._name, self.returncode = run, name, None

    def poll(self):
        return self.returncode

    def wait(self, timeout=None):
        if self.returncode is None:
            raise subprocess.TimeoutExpired(self._name, timeout)
        return self.returncode

    def send_signal(self, number):
        """Write no stack trace."""

    def kill(self):
        self.end(-9)

    def end(self, code):
        self.returncode = code
        self._run._say("exit", self._name, code=code)


class Cell:
    """A cell, each node a process of its own."""

    def __init__(self, folder):
        whole = harness.with_recorder(scenario(), folder / "bag", keep=True)
        self.run = harness.Processes(whole, [[name] for name in whole.nodes])
        self.run._folder, self.told = folder, []
        self.run._children = self.nodes = {name: Made(self.run, name) for name in whole.nodes}

    def begin(self):
        self.say("block0", "spindle_encoder")
        return self

    def say(self, event, name, **values):
        self.run._say(event, name, **values)

    def end_all(self, code, *, but=()):
        for name, node in self.nodes.items():
            if name not in but:
                node.end(code)

    def complete(self):
        self.say("complete", "recorder", blocks=100)
        self.say("closed", "recorder", complete=True)

    def wait_for_end(self):
        return self.run.wait_for_end(self.told.append)

    def stuck(self):
        return [event["node"] for event in self.told if event["event"] == "stuck"]


@pytest.fixture
def waiting(tmp_path, monkeypatch):
    """A cell that has not begun, and whose processes have no time to leave."""
    monkeypatch.setattr("lathe_rc.harness.processes._FAREWELL", 0.0)
    monkeypatch.setattr("lathe_rc.harness.processes._GRACE", 0.0)
    return Cell(tmp_path)


@pytest.fixture
def cell(waiting):
    """A cell in the midst of its run."""
    return waiting.begin()


def test_a_process_that_ends_without_a_word_before_the_run_is_named(waiting):
    """The others would wait for it, and the harness for them."""
    waiting.say("done", "tool")  # shut down by its lifecycle: an operator may start another one
    waiting.nodes["tool"].end(0)
    waiting.nodes["recorder"].end(0)
    with pytest.raises(LatheError, match=r"^recorder has ended before the run began"):
        waiting.wait_for_end()


def test_a_process_that_does_not_end_after_a_complete_run_is_killed_and_named(cell):
    """Nothing is lost: all samples are in a closed bag."""
    cell.complete()
    cell.end_all(0, but=["tool"])
    assert cell.wait_for_end()["complete"]["blocks"] == 100
    assert cell.stuck() == ["tool"]
    assert cell.nodes["tool"].poll() == -9
    with pytest.raises(LatheError, match="no node has reported anything for 0 s"):  # nobody is left to wait for
        cell.run.wait_for("cycle")


def test_a_process_that_does_not_end_after_the_safe_state_is_killed_and_named(cell):
    """It has said that it is done, as all others that still run: nothing is lost without it."""
    cell.nodes["electrodynamic_actuator"].end(-9)
    cell.say("safe", "spindle_encoder", lost=["/electrodynamic_actuator"])
    cell.say("done", "tool")
    cell.end_all(1, but=["electrodynamic_actuator", "tool"])
    with pytest.raises(LatheError, match=r"^electrodynamic_actuator was killed by SIGKILL; the run did not come to"):
        cell.wait_for_end()
    assert cell.stuck() == ["tool"]


def test_a_process_that_crashes_while_leaving_a_complete_run_is_named_and_nothing_is_lost(cell):
    cell.complete()
    cell.nodes["tool"].end(-11)
    cell.end_all(0, but=["tool"])
    cell.wait_for_end()
    ends = {event["node"]: TROUBLE["exit"](event) for event in cell.told if event["event"] == "exit"}
    assert ends.pop("tool") == "tool was killed by SIGSEGV"
    assert not any(ends.values())


def test_a_closed_bag_makes_no_success_of_a_safe_state_without_its_spindle(cell):
    cell.nodes["tool"].end(-9)
    cell.say("safe", "spindle_encoder", lost=["/tool"])
    cell.complete()
    cell.nodes["spindle_encoder"].end(-9)
    cell.end_all(1, but=["tool", "spindle_encoder"])
    with pytest.raises(LatheError, match=r"^tool was killed by SIGKILL; the run did not come to its end"):
        cell.wait_for_end()


def test_the_signal_that_killed_a_member_is_named_if_it_is_known_only_after_the_end_of_the_cell(cell):
    cell.nodes["supervisor"] = Made(cell.run, "supervisor")
    cell.say("dead", "spindle_encoder", member="/supervisor")
    cell.say("safe", "spindle_encoder", lost=["/supervisor"])
    cell.nodes["supervisor"].returncode = -9
    cell.say("error", "spindle_encoder", message="/supervisor died: safe state from sample 64 on", exit_code=1)
    with pytest.raises(LatheError, match=r"^supervisor was killed by SIGKILL; /supervisor died: safe state from"):
        cell.wait_for_end()
