# SPDX-License-Identifier: Apache-2.0
"""A controller that is killed goes on in another process, to the bit; a file from elsewhere runs no code."""

import os
import signal
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
from cells import all_but
from hypothesis import given, settings
from hypothesis import strategies as st
from lathe_rc_msgs.srv import Schedule

from lathe_rc import data_file, harness
from lathe_rc.bag import reader
from lathe_rc.bag.check import check as check_bag
from lathe_rc.blocks.delay_buffer import DelayBuffer, longest_delays
from lathe_rc.cell.changes import Restoring, changes
from lathe_rc.cell.scenario import load, new_stage
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import LatheError
from lathe_rc.messages import sample_fields
from lathe_rc.nodes.stage_role import StageRole
from lathe_rc.nodes.state_file import StateFile
from lathe_rc.protocol.restart import Restart

CONFIG = Path(__file__).parents[2] / "config"
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


def commands(cell, recording, keep_at, path, size=BLOCK):
    """The outputs of the controller, piece by piece; its state is kept and read again before some of them."""
    stage, tracks = new_stage(OWN, cell.nodes[OWN]), {}
    for port in stage.inputs:
        if port.topic not in tracks:
            ports = [each for each in stage.inputs if each.topic == port.topic]
            tracks[port.topic] = DelayBuffer(port.type, longest_delays(ports), size)
    whole, said = [], []
    for piece in range(samples(recording) // size):
        if piece in keep_at:
            past = {topic: (track.end, track.past()) for topic, track in tracks.items()}
            start, fresh = (new_stage(OWN, cell.nodes[OWN]) for _ in range(2))
            path.write_bytes(data_file.packed("state", [changes(stage, start), past]))
            change, past = data_file.read(path, "state", list)
            Restoring().restore(change, fresh)
            stage = fresh
            for topic, (end, kept) in past.items():
                tracks[topic].restart(0)
                tracks[topic].restart(end, kept)
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
    plain, said = commands(cell, recording, (), tmp_path / "state")
    assert np.array_equal(plain, recording.dense["/coarse/command"]["position"][: plain.size])
    # One that goes on gets what it has missed at once: pieces are longer than its feedback is late.
    size = 2 * cell.nodes[OWN].feedback_delay
    long, told = commands(cell, recording, (), tmp_path / "state", size=size)
    assert np.array_equal(long, plain[: long.size])
    assert told == said[: len(told)]

    @settings(max_examples=3)
    @given(st.sets(st.integers(0, samples(recording) // BLOCK - 1), max_size=8))
    def check(keep_at):
        again, told = commands(cell, recording, keep_at, tmp_path / "state")
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
    kept = [f"{OWN}.restart_file={tmp_path}/state", "spindle_encoder.revolutions=16.0"]
    kept += ["spindle_encoder.speed_factor=0.5"]  # on a busy machine, the run must not end before the second kill
    kept += [f"{OWN}.events=['sample 9000: clear', 'sample 9000: clear']"]  # equal messages that are no repeats
    cell, killer = load(CONFIG / "supervised.yaml", kept), Killer(OWN, [15_000, 40_000])
    result = harness.run(cell, mode="processes", groups=all_but(cell, OWN), bag=tmp_path / "bag", watch=killer)
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
    with harness.Processes(recorded, all_but(recorded, OWN), domain=domain) as processes:
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


def role(run_id="piston"):
    """A controller that has announced itself in a cell, without a node."""
    cell = load(CONFIG / "piston.yaml", [])
    table = cell.nodes[OWN].model_copy(update={"run_id": run_id})
    quiet = {
        "get_name": lambda: OWN,
        "get_logger": lambda: SimpleNamespace(info=print),
        "reporter": lambda *_, **__: 0,
        "announced": lambda _: (cell.nodes,),
    }
    master = SimpleNamespace(host="here", pid=1, members=[])
    protocol = SimpleNamespace(master=master, resumed=print, members={})
    node = SimpleNamespace(table=table, full_name=f"/{OWN}", protocol=protocol, **quiet)
    inputs = SimpleNamespace(state=dict, go_on=lambda *_: None)
    outputs = SimpleNamespace(framer=SimpleNamespace(companions=0))
    stage, start = (Cell(cell.nodes).stages[OWN] for _ in range(2))
    return SimpleNamespace(
        node=node, stage=stage, inputs=inputs, outputs=outputs, _start=start, blocks=0, samples=0, started=True
    )


def kept(role, path):
    own = {name: partial(getattr(StageRole, name), role) for name in ("feedback_delays", "state", "restore")}
    return Restart(role, SimpleNamespace(**own), StateFile(str(path)))


@pytest.fixture
def state(tmp_path):
    """A state file of a controller with two events."""
    restart = kept(role(), tmp_path / "state")
    restart.begin(joins=False)
    restart.keep_event("set learning_gain 0.5", 3.0)
    restart.keep_event("freeze", 1234567)
    return tmp_path / "state"


def resumed(state, **about):
    found = role(**about)
    kept(found, state).begin(joins=True)
    return found


def test_a_parameter_that_was_set_for_the_next_cycle_is_set_by_the_process_that_goes_on(state):
    """The state file keeps events by their sample and by their revolution."""
    assert state.stat().st_mode & 0o777 == 0o600
    assert resumed(state).stage.waiting == ["revolution 3: set learning_gain 0.5", "sample 1234567: freeze"]


def test_a_state_that_is_missing_foreign_damaged_or_open_to_others_is_refused(state, tmp_path):
    """A state file that is not this node's own is refused in one line, and starts no computation."""
    whole = state.read_bytes()
    other = {**data_file.read(state, "state", dict), "stage": ["attributes", {"tuned": ["value", 1]}]}
    wrong = {
        "the state of another node or run": whole,
        "not a state \\(it begins differently": b"\x80\x04N.",
        "damaged": whole.replace(b"freeze", b"unlock"),
        r"not a state \(no attribute 'tuned'\)": data_file.packed("state", other),
    }
    for why, content in wrong.items():
        state.write_bytes(content)
        with pytest.raises(LatheError, match=f"^{state}: {why}") as refusal:
            resumed(state, run_id="other" if content is whole else "piston")
        assert len(str(refusal.value).splitlines()) == 1
    state.chmod(0o620)
    with pytest.raises(LatheError, match="another user owns or may write this state; allowed: your own file, mode 600"):
        resumed(state)
    with pytest.raises(LatheError, match="cannot be read"):
        resumed(tmp_path / "none")
