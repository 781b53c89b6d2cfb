# SPDX-License-Identifier: Apache-2.0
"""A failed node is named, the others are ended, and the bag is readable."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rclpy
from cells import all_but, refusals, told_until_all_have_ended
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from lathe_bagtools.resimulation.resim import resimulate
from lathe_rc import harness, messages
from lathe_rc.bag import reader
from lathe_rc.bag.check import check
from lathe_rc.cell.scenario import load
from lathe_rc.errors import InputError, LatheError
from lathe_rc.nodes import process
from lathe_rc.nodes.report import Reporter
from lathe_rc.protocol.exchange import Exchange

CONFIG = Path(__file__).parents[2] / "config"
PISTON = CONFIG / "piston.yaml"
NODES = ["spindle_encoder", "learning_controller", "electrodynamic_actuator", "tool", "recorder"]


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


class Killer:
    """Sends a signal to a node at the first finished cycle."""

    def __init__(self, node: str, number: int) -> None:
        self.node, self.number, self.pids = node, number, {}

    def __call__(self, event: harness.Event) -> None:
        if event["event"] == "active":
            self.pids[event["node"]] = event["pid"]
        if event["event"] == "cycle" and self.number:
            os.kill(self.pids[self.node], self.number)
            self.number = 0


@pytest.mark.parametrize("node", [pytest.param("spindle_encoder", marks=pytest.mark.system), "recorder"])
def test_a_killed_node_is_named_and_the_bag_is_readable(node, tmp_path):
    bag = tmp_path / "bag"
    killer = Killer(node, signal.SIGKILL)
    scenario = load(PISTON, ["spindle_encoder.revolutions=200.0", "recorder.chunk_size=65536"])
    groups = [[name for name in NODES if name != node]]
    ends = "" if node == "spindle_encoder" else rf"; /{node} died: safe state from sample \d+ on"
    with pytest.raises(LatheError, match=f"^{node} was killed by SIGKILL{ends}$") as failure:
        harness.run(scenario, mode="processes", groups=groups, bag=bag, watch=killer)
    assert failure.value.exit_code == 1
    assert set(killer.pids) == set(NODES)
    assert not any(alive(pid) for pid in killer.pids.values())
    with AnyReader([bag]) as bags:
        assert sum(1 for _ in bags.messages()) > 100
    with next(bag.glob("*.mcap")).open("rb") as stream:
        assert sum(1 for _ in make_reader(stream).iter_messages()) > 100


#: Makes the disk full when a bag is closed.
FULL_AT_THE_END = """
import errno, os, sys

def close(self):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == "lathe_rc.nodes.recorder_role":
            sys.meta_path.remove(self)
            from lathe_rc.bag.writing.writer import BagWriter
            BagWriter.close = close

sys.meta_path.insert(0, Finder())
"""

#: So long that no run ends before what a test does to it.
RUN = ["spindle_encoder.revolutions=1000.0", "spindle_encoder.safe_time=0.1", "recorder.chunk_size=65536"]


@pytest.mark.parametrize("node", [pytest.param("electrodynamic_actuator", marks=pytest.mark.system), "supervisor"])
def test_the_death_of_a_member_ends_in_the_safe_state(node, tmp_path):
    """When a member dies, all others go on to the end that the time master declares; the drive retracts by itself."""
    bag, events = tmp_path / "bag", []
    scenario = load(CONFIG / "supervised.yaml", RUN)
    killer = Killer(node, signal.SIGKILL)

    def watch(event):
        killer(event)
        events.append(event)

    with pytest.raises(
        LatheError, match=rf"^{node} was killed by SIGKILL; /{node} died: safe state from sample \d+ on$"
    ):
        harness.run(scenario, mode="processes", groups=all_but(scenario, node), bag=bag, watch=watch)
    (safe,) = [event for event in events if event["event"] == "safe"]
    assert safe["lost"] == [f"/{node}"]
    assert safe["end"] == safe["sample"] + 6400
    recording = reader.read_bag(bag, whole=True)
    assert {signals.size for fields in recording.dense.values() for signals in fields.values()} == {safe["end"]}
    state = recording.of_type(messages.STATE)
    if node == "electrodynamic_actuator":
        # It is the drive itself that is gone: its newest position stands for what nobody knows.
        assert np.ptp(state["position"][safe["sample"] :]) == 0.0
    else:
        assert state["position"][-1] == pytest.approx(0.3e-3, abs=1e-6)
        jumps = np.abs(np.diff(state["position"], 2)).max() * 64e3**2
        assert jumps < 60.0, "the retraction is bounded [m/s²]"
    if node != "supervisor":
        (status,) = [each for each in recording.sparse["/safety/status"].values["monitor"] if each == "members_lost"]
        assert status
    sound = reader.read_bag(bag)
    assert safe["sample"] - 64 * 64 <= sound.samples <= safe["sample"], (
        "reading ends where samples may rest on held ones"
    )
    assert f"not read from sample {sound.samples} on: /" in sound.lost
    found = check(bag)
    assert not found.wrong
    assert any("the node was lost" in line for line in found.lost)
    with pytest.raises(InputError, match=r"nodes were lost on the way, /.* is held from sample"):
        resimulate(bag)


@pytest.mark.parametrize(
    ("mode", "groups"),
    [
        ("processes", [["spindle_encoder", "tool"], ["learning_controller", "recorder"]]),
        pytest.param("composed", None, marks=pytest.mark.system),
    ],
)
def test_a_member_that_fails_by_an_error_ends_in_the_safe_state(mode, groups, tmp_path):
    """When a member fails, the others go on, those of its own process among them, and the tool is taken out."""
    bag, events, lost = tmp_path / "bag", [], tmp_path / "nowhere" / "memory"
    sets = [f"learning_controller.memory_file={lost}", "learning_controller.events=['revolution 10: save']"]
    scenario = load(CONFIG / "supervised.yaml", [*RUN, *sets])
    if groups:
        groups = [*groups, *([name] for name in ("electrodynamic_actuator", "supervisor"))]
    why = rf"{re.escape(str(lost))}: the memory cannot be saved \(No such file or directory\)"
    with pytest.raises(LatheError, match=rf"^/learning_controller failed: {why}: safe state from sample \d+ on$"):
        harness.run(scenario, mode=mode, groups=groups, bag=bag, watch=events.append)
    (safe,) = [event for event in events if event["event"] == "safe"]
    assert safe["lost"] == ["/learning_controller"]
    complete = [event["monotonic_ns"] for event in events if event["event"] == "complete"]
    left = [event["monotonic_ns"] for event in events if event["event"] == "exit"]
    # The run fails by the time master's last event, which may be heard before the recorder's.
    assert all(complete < [moment] for moment in left), "DDS sends nothing again for a process that has left"
    assert complete or not left
    recording = reader.read_bag(bag, whole=True)
    assert {signals.size for fields in recording.dense.values() for signals in fields.values()} == {safe["end"]}
    assert recording.of_type(messages.STATE)["position"][-1] == pytest.approx(0.3e-3, abs=1e-6)
    assert "members_lost" in recording.sparse["/safety/status"].values["monitor"]
    assert not check(bag).wrong


def test_without_the_harness_the_members_leave_when_their_time_master_is_gone(tmp_path):
    """Without the harness the members end when their time master has died.

    Under ros2 launch or by hand nobody ends them: they see that no sample follows, and the bag is closed.
    """
    cell = harness.with_recorder(load(PISTON, RUN), tmp_path / "bag", keep=True)
    with harness.Processes(cell, all_but(cell, "spindle_encoder", "recorder")) as processes:
        processes.wait_for("cycle")
        os.kill(processes.pids["spindle_encoder"], signal.SIGKILL)
        told = told_until_all_have_ended(processes)
    said = [event["message"] for event in told if event["event"] == "abandoned"]
    assert said
    assert any("/spindle_encoder, the time master, is lost: no sample follows" in line for line in said)
    assert [event["complete"] for event in told if event["event"] == "closed"] == [False]
    codes = {event["node"]: event["code"] for event in told if event["event"] == "exit"}
    assert codes.pop("spindle_encoder") == -signal.SIGKILL
    assert set(codes.values()) == {LatheError.exit_code}
    assert not check(tmp_path / "bag").wrong


@pytest.mark.parametrize("mode", ["composed", pytest.param("processes", marks=pytest.mark.system)])
def test_a_bag_that_cannot_be_closed_is_a_failure_in_every_host(mode, tmp_path, monkeypatch):
    """A bag that cannot be closed is a failure in every host, also when all others have ended well."""
    (tmp_path / "sitecustomize.py").write_text(FULL_AT_THE_END, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{os.environ['PYTHONPATH']}")
    piston = load(PISTON, ["spindle_encoder.revolutions=6.0"])
    groups = [[name for name in piston.nodes if name != "recorder"]]  # interpreters are slow to start
    with pytest.raises(LatheError, match=r"bag: cannot be closed \(No space left on device\)"):
        harness.run(piston, mode=mode, groups=groups, bag=tmp_path / "bag", start="spawn")


@pytest.mark.parametrize(
    ("number", "mode"),
    [(signal.SIGINT, "composed"), pytest.param(signal.SIGTERM, "processes", marks=pytest.mark.system)],
)
def test_the_command_closes_its_bag_on_a_signal(number, mode, tmp_path):
    bag = tmp_path / "bag"
    command = [sys.executable, "-m", "lathe_rc", "run", str(PISTON), "--mode", mode, "--bag", str(bag)]
    command += ["--group", "learning_controller+electrodynamic_actuator+tool"] if mode == "processes" else []
    with subprocess.Popen([*command, "--speed-factor", "1.0"], stderr=subprocess.PIPE) as process:
        first = process.stderr.readline()
        assert first.startswith(b"revolution 1: "), first
        process.send_signal(number)
        _, errors = process.communicate()
    assert process.returncode == 1, errors
    assert b"Traceback" not in errors
    with AnyReader([bag]) as bags:
        assert sum(1 for _ in bags.messages()) > 10


def test_a_process_with_a_whole_cell_that_runs_flat_out_is_not_deaf(tmp_path):
    """Its own nodes let the next blocks go; signals, requests and timers have their turn in between, not at the end."""
    cell = harness.with_recorder(load(PISTON, ["spindle_encoder.revolutions=2000.0"]), tmp_path / "bag", keep=True)
    with harness.Processes(cell, [list(cell.nodes)]) as processes:
        processes.wait_for("cycle")
        os.kill(processes.pids["tool"], signal.SIGTERM)
        ended = next(event for event in processes.events(60.0) if event["event"] == "error")
        assert re.search(r"was ended by SIGTERM in the middle of a run; it ends at sample \d+ of \d+", ended["message"])


BAD = (  #: node, ROS arguments, and what is said of them
    ("tool", ["-p", "feed:=-1.0"], "tool.feed = -1.0; allowed: a finite number from 0 [m/rev]"),
    ("tool", ["-p", "fed:=1.0"], "tool.fed: unknown parameter"),
    ("spindle_encoder", ["-p", "nominal_rpm:=fast"], "spindle_encoder.nominal_rpm = 'fast'; allowed:"),
    ("learning_controller", ["-p", "events:=['soon: freeze']"], "learning_controller.events = 'soon: freeze'"),
    ("tool", ["--params-file", "/nowhere.yaml"], "Couldn't parse params file: '--params-file /nowhere.yaml'"),
    ("recorder", ["-p", "bag:=/"], "/ exists; a bag is never overwritten"),
    ("tool", ["-p", "tool:profile:=polygon", "--params-file", PISTON], "does not reach /tool, which has 'csv'"),
)


def test_a_node_alone_refuses_bad_parameters_in_one_line(domain, monkeypatch, tmp_path):
    """And its command ends with exit code 2."""
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    told = refusals(*(["node", node, "--ros-args", *arguments] for node, arguments, _ in BAD))
    for (code, said), (node, arguments, expected) in zip(told, BAD, strict=True):
        assert code == 2, (node, arguments, said)
        assert expected in said
        assert "Traceback" not in said


def test_the_nodes_themselves_refuse_a_cell_that_cannot_work(domain, tmp_path):
    """The time master makes the checks before the start with the announced parameters: also without the harness."""
    cell = harness.with_recorder(load(PISTON, ["learning_controller.q_time=10e-6"]), tmp_path / "bag", keep=True)
    file = tmp_path / "cell.yaml"
    file.write_text(cell.to_yaml(), encoding="utf-8")
    rclpy.init(args=["test", "--ros-args", "--params-file", str(file)])
    try:
        nodes = {name: process._make(name, cell.kind(name), Reporter(), Exchange()) for name in NODES}
        for node in nodes.values():
            node.trigger_configure()
        spindle = nodes["spindle_encoder"]
        spindle.trigger_activate()
        for name in NODES[1:]:
            spindle.protocol.hear_member(nodes[name].protocol.own, 0.0)
        spindle.attempt(spindle.role.check_cell)
        nodes["recorder"].role.clean_up()
        for node in nodes.values():
            node.destroy_node()
    finally:
        rclpy.shutdown()
    assert isinstance(spindle.protocol.failure, InputError)
    assert "learning diverges with electrodynamic_actuator: sup|Q - Z|" in str(spindle.protocol.failure)


def test_an_existing_bag_is_refused_before_anything_starts(tmp_path):
    with pytest.raises(InputError, match="exists; a bag is never overwritten"):
        harness.run(load(PISTON), mode="processes", bag=tmp_path)


def test_the_children_end_when_the_harness_is_killed(tmp_path):
    script = """
import sys
from pathlib import Path
from lathe_rc import harness
from lathe_rc.cell.scenario import load
slow = load(Path(sys.argv[1]), ["spindle_encoder.speed_factor=1.0"])
cell = harness.with_recorder(slow, Path(sys.argv[2]), keep=True)
with harness.Processes(cell, [[name] for name in cell.nodes]) as processes:
    processes.wait_for("cycle")
    print(*processes.pids.values(), flush=True)
    processes.wait_for_end()
"""
    with subprocess.Popen(
        [sys.executable, "-c", script, str(PISTON), str(tmp_path / "bag")], stdout=subprocess.PIPE
    ) as process:
        descriptors = [os.pidfd_open(int(pid)) for pid in process.stdout.readline().split()]
        process.kill()
    for descriptor in descriptors:
        # Readable when the process has ended.
        assert wait_readable(descriptor)
        os.close(descriptor)
    with AnyReader([tmp_path / "bag"]) as bags:
        assert sum(1 for _ in bags.messages()) > 100


def wait_readable(descriptor: int) -> bool:
    import select

    return bool(select.select([descriptor], [], [], 30)[0])


@pytest.mark.parametrize("mode", ["offline", "composed", pytest.param("processes", marks=pytest.mark.system)])
def test_a_number_that_is_not_finite_ends_the_run_in_every_host_and_is_named(tmp_path, mode, recwarn):
    """A number that is not finite ends the run in every host, with the name of its source.

    The command that the drive hears is 1e100 times what it was, four times.
    """
    times = [f"revolution {turn}: coarse/command.position wrong scale=1e100" for turn in range(1, 5)]
    cell = load(
        PISTON, ["spindle_encoder.revolutions=10.0", "allow_faults=true", f"electrodynamic_actuator.faults={times}"]
    )
    named = r"/coarse/state: /electrodynamic_actuator sends effort = inf at sample 14346; allowed: finite numbers"
    with pytest.raises(LatheError, match=named):
        harness.run(cell, mode=mode, bag=tmp_path / "bag")
    assert not recwarn.list, "the error says it, in one line"
    assert not check(tmp_path / "bag").wrong
