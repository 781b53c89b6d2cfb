# SPDX-License-Identifier: Apache-2.0
"""A controller that is killed goes on in another process, to the bit; a file from elsewhere runs no code."""

import os
import pickle
import signal
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
from hypothesis import given, settings
from hypothesis import strategies as st
from lathe_rc_msgs.srv import Schedule

from lathe_rc import files, harness
from lathe_rc.bag import reader
from lathe_rc.bag.check import check as check_bag
from lathe_rc.cell import state_file
from lathe_rc.cell.delay_buffer import DelayBuffer, longest_delays
from lathe_rc.cell.scenario import load
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import LatheError
from lathe_rc.messages import sample_fields
from lathe_rc.nodes.restart import Restart

CONFIG = Path(__file__).parents[1] / "config"
BLOCK = 64
OWN = "learning_controller"
LAWS = {
    "plain": ("piston", []),
    "supervised": ("supervised", ["electrodynamic_actuator.faults=['revolution 8: coarse/command.position off']"]),
    "exact": ("exact_invariance", []),
    "inverse": ("piston", [f"{OWN}.correction=second_order_inverse", f"{OWN}.lead_time=0.36e-3"]),
    "fir": ("piston", [f"{OWN}.q_filter=fir", f"{OWN}.allow_unstable=true"]),
    "gaussian": ("piston", [f"{OWN}.q_filter=gaussian"]),
    "tuned": ("piston", [f"{OWN}.events=['revolution 4: set lead_time 1.3e-3', 'revolution 6.5: set q_time 90e-6']"]),
}


def samples(recording):
    return recording.dense["/tool"]["error"].size


def commands(cell, table, recording, keep_at, path, size=BLOCK):
    """The outputs of the controller, piece by piece; its state is kept and read again before some of them."""
    stage, tracks = Cell(cell.nodes).stages[OWN], {}
    for port in stage.inputs:
        if port.topic not in tracks:
            ports = [each for each in stage.inputs if each.topic == port.topic]
            tracks[port.topic] = DelayBuffer(port.type, longest_delays(ports), size)
    whole, said = [], []
    for piece in range(samples(recording) // size):
        if piece in keep_at:
            state_file.save(path, state_file.dump({"stage": stage, "tracks": tracks}))
            fresh = {"stage": Cell(cell.nodes).stages[OWN], "tracks": tracks}
            state = state_file.load(path, table, fresh)
            stage, tracks = state["stage"], state["tracks"]
        for topic, track in tracks.items():
            for name, array in track.extend(size).items():
                array[:] = recording.dense[f"/{topic}"][name][piece * size :][:size]
        inputs = [tracks[port.topic].view(piece * size - port.delay, size) for port in stage.inputs]
        outputs = [{name: np.empty(size, kind) for name, kind in sample_fields(p.type).items()} for p in stage.outputs]
        said += [(each.topic, each.index, str(each.values)) for each in stage.advance(piece * size, inputs, outputs)]
        whole.append(outputs[0]["position"])
    return np.concatenate(whole), said


@pytest.mark.parametrize("law", LAWS)
def test_a_controller_goes_on_from_its_kept_state_to_the_bit(law, tmp_path):
    name, sets = LAWS[law]
    cell = load(CONFIG / f"{name}.yaml", [*sets, "spindle_encoder.revolutions=12.0"])
    recording = harness.run(cell).recording
    plain, said = commands(cell, cell.nodes[OWN], recording, (), tmp_path / "state")
    assert np.array_equal(plain, recording.dense["/coarse/command"]["position"][: plain.size])
    # One that goes on gets what it has missed at once: pieces are longer than its feedback is late.
    size = 2 * cell.nodes[OWN].feedback_delay
    long, told = commands(cell, cell.nodes[OWN], recording, (), tmp_path / "state", size=size)
    assert np.array_equal(long, plain[: long.size])
    assert told == said[: len(told)]

    @settings(max_examples=6)
    @given(st.sets(st.integers(0, samples(recording) // BLOCK - 1), max_size=8))
    def check(keep_at):
        again, told = commands(cell, cell.nodes[OWN], recording, keep_at, tmp_path / "state")
        assert np.array_equal(again, plain)
        assert told == said

    check()


# ---- nodes ----------------------------------------------------------------------------------------------


class Killer:
    """Sends SIGKILL to a node once the run has come to each of some samples, and keeps what it hears."""

    def __init__(self, node, at):
        self.node, self.at, self.pids, self.events = node, list(at), {}, []

    def __call__(self, event):
        self.events.append(event)
        if event["event"] == "active":
            self.pids[event["node"]] = event["pid"]
        if self.at and event["event"] == "progress" and event["samples"] >= self.at[0]:
            self.at.pop(0)
            os.kill(self.pids[self.node], signal.SIGKILL)

    def all(self, kind):
        return [event for event in self.events if event["event"] == kind]


def test_a_killed_controller_goes_on_in_another_process_to_the_bit(tmp_path):
    """A killed controller goes on to the bit, twice in a supervised run: what comes twice is taken once."""
    kept = [f"{OWN}.restart_file={tmp_path}/state", "spindle_encoder.revolutions=40.0"]
    kept += [f"{OWN}.events=['sample 9000: clear', 'sample 9000: clear']"]  # equal messages that are no repeats
    cell, killer = load(CONFIG / "supervised.yaml", kept), Killer(OWN, [30_000, 90_000])
    result = harness.run(cell, mode="processes", bag=tmp_path / "bag", watch=killer)
    assert result.digest == harness.run(cell).digest
    assert reader.read_bag(tmp_path / "bag").digests() == result.digest
    assert check_bag(tmp_path / "bag").exit_code == 0
    assert [event["member"] for event in killer.all("dead")] == [f"/{OWN}"] * 2
    window = cell.nodes[OWN].window
    assert [event["blocks"] % window for event in killer.all("resumed")] == [0, 0]  # states are kept exactly then
    assert not killer.all("safe")


def test_an_event_that_was_asked_for_is_kept_when_a_state_of_before_is_written(ghost, domain, tmp_path):
    """Killed at once after it has promised to freeze its memory, a controller keeps its word, at the same sample."""
    kept = [f"{OWN}.restart_file={tmp_path}/state", "spindle_encoder.revolutions=20.0"]
    cell = load(CONFIG / "piston.yaml", [*kept, "spindle_encoder.speed_factor=0.5"])  # else it may end before DDS tells
    client = ghost.create_client(Schedule, f"/{OWN}/schedule")
    recorded = harness.with_recorder(cell, tmp_path / "bag", keep=True)
    with harness.Processes(recorded, [[name] for name in recorded.nodes], domain=domain) as processes:
        assert client.wait_for_service(20.0)
        processes.wait_for("cycle")
        future = client.call_async(Schedule.Request(action="freeze"))
        rclpy.spin_until_future_complete(ghost, future, timeout_sec=60.0)
        os.kill(processes.pids[OWN], signal.SIGKILL)
        processes.wait_for("resumed")
        processes.wait_for_end()
    assert future.result().accepted
    promised = future.result().sample_index
    expected = harness.run(load(CONFIG / "piston.yaml", [
        "spindle_encoder.revolutions=20.0", f"{OWN}.events=['sample {promised}: freeze']",
    ]))  # fmt: skip
    assert reader.read_bag(tmp_path / "bag").digests() == expected.digest


# ---- the file -------------------------------------------------------------------------------------------


def loaded(path):
    cell = load(CONFIG / "piston.yaml")
    return state_file.load(path, cell.nodes[OWN], {"stage": Cell(cell.nodes).stages[OWN]})


class Call:
    """An object of which pickle makes a call."""

    def __init__(self, function, *arguments):
        self.function, self.arguments = function, arguments

    def __reduce__(self):
        return self.function, self.arguments


def named(module, name, *arguments):
    """A pickle that calls what has a dotted name in a module, with texts."""
    texts = b"".join(b"\x8c" + bytes([len(text)]) + text.encode() for text in arguments)
    start = b"\x80\x04\x8c" + bytes([len(module)]) + module.encode() + b"\x8c" + bytes([len(name)]) + name.encode()
    return start + b"\x93(" + texts + b"tR."


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x80",
        b"\x80\x04N.",
        pickle.dumps([1]),
        pickle.dumps({"stage": 1, "more": 2}),
        b"cposix\nmk\x0bdir\n.",  # found by benchmarks/fuzz.py: its bytes made two lines of the refusal
        pickle.dumps(Path()),
        pickle.dumps(np.zeros(3)),
        named("lathe_papers.formulas.angle_domain", "np.f2py.subprocess.Popen", "true"),
        named("lathe_rc.bag.writing.writer", "BagWriter", "bag"),
    ],
)
def test_what_is_no_state_is_refused(data, tmp_path):
    path = tmp_path / "state"
    path.write_bytes(files.sealed(data))
    path.chmod(0o600)
    with pytest.raises(LatheError, match=f"^{path}: not a state of this node") as refusal:
        loaded(path)
    assert len(str(refusal.value).splitlines()) == 1


def test_a_state_from_elsewhere_runs_no_code(tmp_path):
    path, made = tmp_path / "state", tmp_path / "made"
    path.write_bytes(files.sealed(pickle.dumps({"stage": Call(os.mkdir, str(made))})))
    path.chmod(0o600)
    with pytest.raises(LatheError, match=r"not a state of this node \(UnpicklingError: posix.mkdir\)"):
        loaded(path)
    assert not made.exists()


def test_an_array_takes_no_more_than_its_bytes(tmp_path):
    path = tmp_path / "state"
    pickled = state_file.dump({"stage": np.zeros(8)}).replace(b"<f8", b"|O8")
    path.write_bytes(files.sealed(pickled))
    path.chmod(0o600)
    with pytest.raises(LatheError, match="not a state of this node"):
        loaded(path)


def test_a_state_that_others_may_write_is_refused(tmp_path):
    path = tmp_path / "state"
    state_file.save(path, state_file.dump({"stage": 1}))
    path.chmod(0o620)
    with pytest.raises(LatheError, match="another user owns or may write this state; allowed: your own file, mode 600"):
        loaded(path)


def test_a_state_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(LatheError, match="cannot be read"):
        loaded(tmp_path / "none")


def test_a_parameter_that_was_set_for_the_next_cycle_is_set_by_the_process_that_goes_on(tmp_path):
    """The state file keeps events by their sample and by their revolution."""
    cell = load(CONFIG / "piston.yaml", [])
    master = SimpleNamespace(host="here", pid=1, members=[])

    def role():
        quiet = {
            "get_name": lambda: OWN,
            "get_logger": lambda: SimpleNamespace(info=print),
            "reporter": lambda *_, **__: 0,
            "announced": lambda _: (cell.nodes,),
        }
        protocol = SimpleNamespace(master=master, resumed=print, members={})
        node = SimpleNamespace(table=cell.nodes[OWN], full_name=f"/{OWN}", protocol=protocol, **quiet)
        inputs = SimpleNamespace(buffers={}, queues={}, wire=print)
        outputs = SimpleNamespace(framer=SimpleNamespace(companions=0))
        stage = Cell(cell.nodes).stages[OWN]
        return SimpleNamespace(
            node=node, stage=stage, inputs=inputs, outputs=outputs, blocks=0, samples=0, started=True
        )

    first, second = role(), role()
    kept = Restart(first, str(tmp_path / "state"))
    kept.begin(joins=False)
    kept.keep_event("set learning_gain 0.5", 3.0)
    kept.keep_event("freeze", 9000)
    Restart(second, str(tmp_path / "state")).begin(joins=True)
    assert second.stage.waiting == ["revolution 3: set learning_gain 0.5", "sample 9000: freeze"]
