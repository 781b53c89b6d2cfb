# SPDX-License-Identifier: Apache-2.0
"""Monitors, the state machine, what controllers do about it: bounded, the same everywhere, nothing without a cause."""

import functools
import itertools
import math
import operator
import subprocess
import sys

import numpy as np
import pytest
from cells import SCENARIOS, assert_resimulated, command, config, cuts, in_two
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from lathe_machine.control.bounded import Bounds, Mode, Takeover, motion, take_over
from lathe_machine.safety.monitors import Clearance, Lookout, Monitor, below, growth, index_pulses, rate, threshold
from lathe_machine.safety.rules import walk
from lathe_machine.stages.drive.electrodynamic_actuator import ElectrodynamicActuator
from lathe_machine.stages.feed.feed_drive import FeedDriveParameters, FeedDriveStage
from lathe_machine.stages.learning.learning_controller import LearningController
from lathe_machine.stages.supervisor import MEMBERS_LOST, SupervisorParameters
from lathe_rc import event_log, harness, messages
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.kinds import STAGES
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError
from lathe_rc.protocol import MemberState, Phase
from lathe_rc.safety import state_machine
from lathe_rc.safety.state_machine import RESET, RETRACTED, Reaction, State

STEP = 1.0 / 64000
CONFIG = SCENARIOS[0].parent


def test_constants_of_the_messages_are_those_of_the_code():
    """A node that reads SafetyStatus.REACTION_HOLD compares with what the supervisor sends."""
    types = messages.store().fielddefs
    told = {
        name: {constant: value for constant, _, value in types[f"{messages.PACKAGE}/msg/{name}"][0]}
        for name in ("SafetyStatus", "CellState", "Member")
    }
    states, reactions = ({f"{kind.__name__.upper()}_{each.name}": each for each in kind} for kind in (State, Reaction))
    assert told["SafetyStatus"] == states | reactions
    assert told["CellState"] == Phase.__members__
    assert told["Member"] == MemberState.__members__


# ---- bounded motions

bounds = st.builds(Bounds, st.floats(0.01, 1.0), st.floats(1.0, 200.0), st.floats(1e3, 1e6))
places = st.floats(-1e-3, 1e-3)


@given(bounds=bounds, start=places, end=places, velocity=st.floats(-0.05, 0.05))
def test_a_motion_keeps_within_its_bounds_and_ends_where_it_shall(bounds, start, end, velocity):
    positions = motion(start, velocity, end, bounds, 1e-5)
    assert positions[-1] == end
    whole = np.concatenate(([start], positions))
    moving, accelerating = np.diff(whole) / 1e-5, np.diff(whole, 2) / 1e-10
    # The last step is cut short by up to a sample.
    assert np.abs(moving[:-1]).max(initial=0.0) <= max(bounds.velocity, abs(velocity)) * (1 + 1e-6)
    assert np.abs(accelerating[:-1]).max(initial=0.0) <= bounds.acceleration * 1.001 + 1e-3


@given(bounds=bounds, start=places, velocity=st.floats(-0.5, 0.5))
def test_a_brake_comes_to_rest_in_the_direction_of_travel(bounds, start, velocity):
    positions = motion(start, velocity, None, bounds, 1e-5)
    travelled = (positions[-1] - start) * np.sign(velocity)
    assert travelled >= 0.0
    assert np.all(np.diff(positions) * np.sign(velocity) >= -1e-15)


def taken_over(lengths, changes, wave):
    takeover, out = Takeover(Bounds(0.1, 50.0, 1e5), 0.3e-3, STEP), wave.copy()
    for begin, end in itertools.pairwise(sorted({*changes, *itertools.accumulate(lengths, initial=0)})):
        if begin in changes:
            takeover.change(changes[begin])
        take_over(takeover.table, out[begin:end])
    return out


WAVE = 100e-6 * np.sin(np.arange(20_000) * STEP * 2 * np.pi * 33.0)


def test_a_command_that_is_retracted_and_given_back_never_jumps():
    changes = {1000: Mode.HOLD, 5000: Mode.RETRACT, 9000: Mode.FOLLOW}
    out = taken_over([20_000], changes, WAVE)
    assert_array_equal(out[:1000], WAVE[:1000])
    assert np.ptp(out[3000:5000]) == 0.0
    assert_allclose(out[8000:9000], 0.3e-3, rtol=1e-12)
    assert_array_equal(out[-1000:], WAVE[-1000:])
    assert np.abs(np.diff(out)).max() <= (0.1 + np.abs(np.diff(WAVE)).max() / STEP) * STEP * 1.001
    natural = np.abs(np.diff(WAVE, 2)).max() / STEP**2
    assert np.abs(np.diff(out, 2)).max() / STEP**2 <= 50.0 + 2.0 * natural


@given(velocity=st.floats(-5.0, 5.0), position=st.floats(-1e-3, 1e-3), goal=st.floats(-1e-3, 1e-3), hold=st.booleans())
def test_a_takeover_goes_no_further_the_wrong_way_than_it_takes_to_stop(velocity, position, goal, hold):
    """A retraction goes the wrong way no farther than the bounds need to stop.

    Noise in a command looks like a velocity; carried on, one such sample took the tool 1 mm into the part.
    """
    bounds = Bounds(0.05, 50.0, 1e5)
    takeover = Takeover(bounds, goal, STEP)
    take_over(takeover.table, position + velocity * STEP * np.array([-1.0, 0.0]))
    takeover.change(Mode.HOLD if hold else Mode.RETRACT)
    out = np.zeros(20_000)
    take_over(takeover.table, out)
    stopping = np.abs(motion(0.0, min(abs(velocity), 0.05), None, bounds, STEP)[-1]) + 1e-12
    low, high = (position, position) if hold else sorted((position, goal))
    assert low - stopping <= out.min()
    assert out.max() <= high + stopping
    assert np.abs(np.diff(out, prepend=position)).max() <= 0.05 * STEP * (1 + 1e-6)
    if not hold:
        assert out[-1] == goal


@given(velocity=st.floats(-5.0, 5.0), held=st.floats(-1e-3, 1e-3), wanted=st.floats(-1e-3, 1e-3))
def test_a_command_that_is_given_back_comes_near_its_own_along_a_bounded_motion(velocity, held, wanted):
    bounds = Bounds(0.05, 50.0, 1e5)
    takeover = Takeover(bounds, held, STEP)
    take_over(takeover.table, np.full(2, held))
    takeover.change(Mode.RETRACT)
    take_over(takeover.table, wanted + velocity * STEP * np.array([-1.0, 0.0]))
    takeover.change(Mode.FOLLOW)
    out = np.full(20_000, wanted)
    take_over(takeover.table, out)
    # Noise that looks like a velocity adds no more than a motion that begins as fast as it may.
    most = np.abs(motion(abs(held - wanted), 0.05, 0.0, bounds, STEP)).max()
    assert np.abs(out - wanted).max() <= max(most, abs(held - wanted)) * 1.05 + 1e-12
    assert np.abs(np.diff(out, prepend=held)).max() <= 0.05 * STEP * (1 + 1e-6)
    assert out[-1] == wanted


@given(far=st.floats(-1e300, 1e300), goal=st.floats(-1e-3, 1e-3), mode=st.sampled_from([Mode.HOLD, Mode.RETRACT]))
def test_a_command_that_has_diverged_is_retracted_and_given_back_in_time_all_the_same(far, goal, mode):
    """A way of 1e6 m at 0.1 m/s would take memory for months, and the tool would stay where it is."""
    reach = Bounds(0.1, 50.0, 1e5).reach(0.01)
    takeover = Takeover(Bounds(0.1, 50.0, 1e5), goal, STEP, reach=reach)
    take_over(takeover.table, np.full(100, far))
    takeover.change(mode)
    assert (takeover.skipped > 0.0) == (mode is Mode.RETRACT and abs(far - goal) > reach)
    for _ in range(2):
        out = np.full(1000, far)
        take_over(takeover.table, out)
        assert out[-1] == (goal if mode is Mode.RETRACT else far)
        assert np.abs(out - out[-1]).max() <= reach
    takeover.change(Mode.FOLLOW)
    given_back = np.full(1000, far)
    take_over(takeover.table, given_back)
    assert given_back[-1] == far


def test_a_command_that_is_not_finite_is_not_taken_over():
    takeover = Takeover(Bounds(0.1, 50.0, 1e5), 0.0, STEP)
    take_over(takeover.table, np.array([0.0, np.nan]))
    with pytest.raises(LatheError, match=r"^a command of nan with a rate of nan is taken over; allowed: finite"):
        takeover.change(Mode.RETRACT)


def test_a_monitor_that_only_warns_warns_again_after_a_reset():
    warns = ["supervisor.following_reaction=warn", "supervisor.error_reaction=warn", "supervisor.margin_limit=[]"]
    faults = [f"revolution {k} to {k}.2: coarse/state.measured_position wrong offset=1.3e-4" for k in (12, 18)]
    broken = f"electrodynamic_actuator.faults={faults}"
    result = harness.run(supervised("supervisor.events=['revolution 14: reset']", broken, *warns))
    told = [(monitor, state) for monitor, state, _, _ in status(result)]
    assert told.count(("following", State.NOMINAL)) == 2
    assert (RESET, State.NOMINAL) in told
    reaction = result.recording.dense["/safety"]["reaction"]
    reset = next(sample for monitor, _, _, sample in status(result) if monitor == RESET)
    assert (reaction[reset - 1], reaction[reset]) == (Reaction.WARN, Reaction.NONE)


WRONG = "tool.faults=['revolution 15 to 17: tool.measured_error wrong offset=1.0']"
LATE = ["supervisor.error_limit=0", "supervisor.growth_limit=0"]  # only what the command has become is noticed


def test_a_command_that_was_out_of_reach_is_told_of():
    result = harness.run(supervised(WRONG, *LATE))
    begin = status(result)[0][3] + 3200
    wanted = result.recording.dense["/coarse/command"]["position"]
    events = result.recording.sparse["/learning_controller/events"]
    reach = Bounds(0.05, 50.0, 1e5).reach(1.0)
    assert events.values["action"] == [f"out of reach: by {abs(wanted[begin - 1] - 0.3e-3) - reach:g}"]
    assert events.values["sample_index"] == [begin]
    assert abs(wanted[begin - 1]) > 0.1


def test_a_slide_says_so_too():
    stage = FeedDriveStage("feed_drive", FeedDriveParameters(command_limit=0.0))
    inputs, outputs = [{"command": np.full(64, 9.0)}], [messages.allocate(messages.STATE, 64)]
    stage.process(0, inputs, outputs)
    stage.go_safe()
    (told,) = stage.process(64, inputs, outputs)
    assert (told.topic, told.index) == ("feed_drive/events", 64)
    assert told.values["action"] == f"out of reach: by {9.0 - 10.0 / 1.875:g}"
    assert stage.process(128, inputs, outputs) == []


@pytest.mark.parametrize("node", ["feed_drive", "force_controller", "position_controller"])
def test_what_a_slide_may_be_commanded_is_within_reach(node):
    said = rf"^{node}.stop_time = 1 s: .* of 5.33 in that, .* command_limit .* it is 6; allowed"
    with pytest.raises(InputError, match=said):
        STAGES[node](node, STAGES[node].Parameters(command_limit=3.0, reaction_delay=64))


def test_a_command_with_steps_is_taken_over_without_its_velocity():
    takeover = Takeover(Bounds(10.0, 1000.0, math.inf), 0.0, STEP, carries=False)
    steps = np.where(np.arange(40_000) % 2 > 0, 0.51, 0.5)
    take_over(takeover.table, steps[:100])
    takeover.change(Mode.RETRACT)
    take_over(takeover.table, steps[100:20_000])
    takeover.change(Mode.FOLLOW)
    take_over(takeover.table, steps[20_000:])
    stopping = steps[99:20_000]
    assert stopping[-1] == 0.0
    assert stopping.max() == stopping[0]
    assert stopping.min() == 0.0
    assert np.abs(np.diff(stopping)).max() <= 10.0 * STEP * (1 + 1e-9)
    assert steps[20_000:].max() <= 0.51
    assert_array_equal(steps[-2:], [0.5, 0.51])


@given(lengths=cuts)
def test_the_cutting_of_a_takeover_into_blocks_leaves_no_trace(lengths):
    size = sum(lengths)
    changes = {size // 5: Mode.HOLD, size // 3: Mode.RETRACT, size // 2: Mode.FOLLOW}
    changes = {index: mode for index, mode in changes.items() if index > 0}
    assert_array_equal(taken_over([size], changes, WAVE[:size]), taken_over(lengths, changes, WAVE[:size]))


# ---- the state machine


@given(st.lists(st.sampled_from([*Reaction, RETRACTED, RESET])))
def test_safe_comes_after_retracting_alone_and_nominal_by_reset_alone(causes):
    state = State.NOMINAL
    for cause in causes:
        to = state_machine.after(state, cause)
        if to is None:
            continue
        if to is State.SAFE and state is not State.SAFE:
            assert (state, cause) == (State.RETRACTING, RETRACTED)
        if to is State.NOMINAL and state is not State.NOMINAL:
            assert cause == RESET
            assert state is not State.RETRACTING
        if cause in (Reaction.RETRACT, Reaction.STOP):
            assert to in (State.RETRACTING, State.SAFE)
        state = to


def test_the_page_has_the_tables_of_the_code():
    script = CONFIG.parent / "figures" / "safety.py"
    printed = subprocess.run([sys.executable, script, "--static"], capture_output=True, text=True, check=True).stdout
    page = (CONFIG.parent / "docs" / "safety.md").read_text(encoding="utf-8")
    for table in printed.strip().split("\n\n"):
        assert table in page, "run: python figures/safety.py --static"


def test_an_alarm_has_the_unit_of_its_limit():
    """Of each monitor that has a limit among the parameters of the supervisor."""
    limits = {"index_pulses": "index_limit", "error_growth": "growth_limit", "stability_margin": "margin_limit"}
    limits |= {name: f"{name}_limit" for name in ("speed", "acceleration", "error", "following", "stroke", "effort")}
    limits |= {"slide": "slide_limit", "force": "force_limit", "force_low": "force_low"}
    rows = SupervisorParameters.rows()
    assert {*limits.values()} == {name for name in rows if name.endswith(("_limit", "force_low"))}
    written = {"m": ("µm", 1e6), "rad/s^2": ("rad/s²", 1.0)}
    units = {name: rows[limit].unit for name, limit in limits.items() if rows[limit].unit != "1"}
    assert {name: written.get(unit, (unit, 1.0)) for name, unit in units.items()} == event_log.UNITS


def test_an_alarm_is_told_in_words_whatever_a_bag_says():
    values = {"state": 2, "reaction": 5, "monitor": "error", "subject": "tool", "value": 2.5e-5, "limit": 2e-5}
    said = event_log.text(Sparse("safety/status", messages.SAFETY_STATUS, 7, values))
    assert said == "error tool 25 µm, limit 20 µm: retracting, retract"
    strange = event_log.text(Sparse("safety/status", messages.SAFETY_STATUS, 7, values | {"state": 200, "limit": 0.0}))
    assert strange == "error tool: ?, retract"
    for drive, unit in (("coarse", "A"), ("fine", "V"), ("own", "A or V")):
        effort = values | {"monitor": "effort", "subject": drive, "value": 0.9, "limit": 0.8}
        said = event_log.text(Sparse("safety/status", messages.SAFETY_STATUS, 7, effort))
        assert said.startswith(f"effort {drive} 0.9 {unit}, limit 0.8 {unit}: ")
    bare = values | {"monitor": "reset refused", "subject": "", "limit": 0.0}
    said = event_log.text(Sparse("safety/status", messages.SAFETY_STATUS, 7, bare))
    assert said == "reset refused: retracting, retract"


# ---- monitors


class Looking:
    """Monitors that look at pieces of signals, and what they have found so far: name, sample, value."""

    def __init__(self, rules):
        monitors = [
            Monitor(name, "s", 0.0, Reaction.STOP, rule=rule, signal=signal, other=other)
            for name, (rule, signal, other) in rules.items()
        ]
        places = dict.fromkeys(place for each in monitors for place in (each.signal, each.other) if place)
        self.numbers = {place: number for number, place in enumerate(places)}
        self.lookout, self.found = Lookout(monitors, self.numbers), []

    def look(self, inputs, marks):
        for first, stop in itertools.pairwise(marks):
            piece = [{name: array[first:stop] for name, array in part.items()} for part in inputs]
            signals = tuple(np.ascontiguousarray(piece[place][name]) for place, name in self.numbers)
            walk(self.lookout.watch, signals, piece[0]["angle"], piece[0]["index_pulse"])
            told = self.lookout.found()
            assert [alarm.place for _, alarm in told] == sorted(alarm.place for _, alarm in told)
            self.found += [(monitor.name, first + alarm.place, alarm.value) for monitor, alarm in told]


TURN = 2 * np.pi


def lasting(beyond, needed, begin=0):
    """First sample at which so many in a row are beyond."""
    run = 0
    for k in range(begin, len(beyond)):
        run = run + 1 if beyond[k] else 0
        if run >= needed:
            return k
    return None


def index_fault(angle, pulse, limit):
    last, known = angle[0], False  # a pulse may come early after the first angle, but not late
    for k in range(angle.size):
        since = angle[k] - last
        if since > TURN + limit or since < -limit or (known and pulse[k] and since < TURN - limit):
            return k, abs(since - TURN)
        last, known = (angle[k], True) if pulse[k] else (last, known)
    return None, None


def growth_fault(pulse, error, limit, needed, floor):
    squares, count, before, grown = [0.0] * 128, None, math.nan, 0  # added up in an order that is quick
    for k in range(pulse.size):
        if pulse[k]:
            if count is not None:
                rms = math.sqrt(functools.reduce(operator.add, squares) / count)
                grown = grown + 1 if rms > limit * before and rms > floor else 0
                if grown >= needed:
                    return k, rms / before
                before = rms
            squares, count = [0.0] * 128, 0
        if count is not None:
            squares[count % 128] += error[k] * error[k]
            count += 1
    return None, None


def taken_one_by_one(angle, speed, pulse, error):
    """Alarms of the monitors below, from their definitions."""
    over = angle >= angle[0] + 1.5 * TURN
    begin = int(np.argmax(over)) if over.any() else angle.size
    change = np.abs(speed - np.concatenate((np.zeros(5), speed))[: speed.size])
    watched = {
        "speed": (lasting(~(np.abs(speed - 0.5) <= 3.0), 3), np.abs(speed - 0.5)),
        "gap": (lasting(~(np.abs(error - speed - 0.0) <= 4.0), 1), np.abs(error - speed)),
        "late": (lasting(~(np.abs(error) <= 2.0), 1, begin), np.abs(error)),
        "low": (lasting(~(speed >= -2.0), 2, begin), speed),
        "rate": (lasting(~(change <= 5.0), 1), change),
    }
    found = [(name, sample, values[sample]) for name, (sample, values) in watched.items() if sample is not None]
    for name, (sample, value) in (
        ("index_pulses", index_fault(angle, pulse, 0.7)),
        ("error_growth", growth_fault(pulse, error, 1.2, 2, 0.1)),
    ):
        if sample is not None:
            found.append((name, sample, value))
    return sorted(found)


@given(data=st.data(), size=st.integers(1, 700), seed=st.integers(0, 2**32 - 1), loud=st.floats(0.05, 2.0))
def test_all_monitors_at_once_find_what_their_definitions_say(data, size, seed, loud):
    random = np.random.default_rng(seed)
    speed, error = (loud * random.standard_normal(size) for _ in range(2))
    error *= 1.0 + np.arange(size) / size * random.integers(0, 5)
    angle = np.cumsum(random.uniform(0.0, 0.1, size))
    pulse = (np.diff(np.floor(angle / TURN), prepend=-1.0) > 0).astype(np.uint8)
    for broken in data.draw(st.lists(st.integers(0, size - 1), max_size=3)):
        random.choice([speed, error, angle])[broken] = random.choice([np.nan, np.inf, -5.0, 30.0])
        pulse[random.integers(size)] ^= 1
    rules = {
        "speed": (threshold(3.0, offset=0.5, samples=3), (0, "speed"), None),
        "gap": (threshold(4.0), (1, "measured_error"), (0, "speed")),
        "late": (threshold(2.0, after=1.5), (1, "measured_error"), None),
        "low": (below(-2.0, samples=2, after=1.5), (0, "speed"), None),
        "rate": (rate(5.0, window=5, step=1 / 5, before=0.0), (0, "speed"), None),
        "index_pulses": (index_pulses(0.7), (0, "angle"), None),
        "error_growth": (growth(1.2, cycles=2, floor=0.1), (1, "measured_error"), None),
    }
    inputs = [{"angle": angle, "speed": speed, "index_pulse": pulse}, {"measured_error": error}]
    looking = Looking(rules)
    looking.look(inputs, sorted({0, size, *data.draw(st.lists(st.integers(0, size), max_size=6))}))
    expected = [(name, sample, float(value)) for name, sample, value in taken_one_by_one(angle, speed, pulse, error)]
    assert repr(sorted(looking.found)) == repr(expected)


def test_an_alarm_comes_again_after_a_reset_alone():
    looking = Looking({"speed": (threshold(3.0), (0, "speed"), None)})
    inputs = [{"angle": np.zeros(8), "speed": np.arange(8.0), "index_pulse": np.zeros(8, np.uint8)}]
    looking.look(inputs, [0, 5, 8])
    looking.lookout.reset()
    looking.look(inputs, [6, 8])
    assert looking.found == [("speed", 4, 4.0), ("speed", 6, 6.0)]


def test_the_tool_is_out_when_it_has_been_for_long_enough():
    clearance = Clearance(1.0, 3)
    assert clearance.first(np.array([0.0, 1.0, 2.0])) is None
    assert clearance.first(np.array([1.0, 0.0])) == 0
    clearance.begin()
    assert clearance.first(np.array([1.0, 0.0, 1.0, 1.0, 1.0])) == 4


# ---- in the cell


def supervised(*overrides):
    return config("supervised", "spindle_encoder.revolutions=30", *overrides)


def status(result):
    found = result.recording.sparse["/safety/status"].values
    return list(zip(found["monitor"], found["state"], found["reaction"], found["sample_index"], strict=True))


STUCK = "electrodynamic_actuator.faults=['revolution 10: coarse/state.measured_position slow time=1e-3']"


def test_a_supervisor_that_sees_nothing_changes_nothing():
    with_it = harness.run(supervised()).digest
    without = harness.run(config("piston", "spindle_encoder.revolutions=30")).digest
    assert {topic: with_it[topic] for topic in without} == without
    assert set(with_it) - set(without) == {
        "/safety", "/safety/status", "/coarse/margin", "/supervisor/events", "/tool/events", "/spindle_encoder/events",
        "/electrodynamic_actuator/events",
    }  # fmt: skip


def test_a_fault_is_noticed_and_the_tool_leaves_the_part_along_a_bounded_profile():
    result = harness.run(supervised(STUCK))
    (first, *_, last) = status(result)
    assert first[:3] == ("error", State.RETRACTING, Reaction.RETRACT)
    assert last[:2] == (RETRACTED, State.SAFE)
    wanted = command(result)
    obeyed = first[3] + 3200
    assert_array_equal(np.flatnonzero(np.diff(wanted[last[3] + 6400 :])), [])
    assert wanted[-1] == 0.3e-3
    out = wanted[obeyed:]
    assert np.abs(np.diff(out)).max() <= 0.05 * STEP * 1.001
    assert np.abs(np.diff(out, 2)).max() <= 50.0 * STEP**2 * 1.001
    assert result.recording.of_type(messages.TOOL)["displacement"][-1] > 0.28e-3


LOST = "spindle_encoder.faults=['revolution 10: encoder.angle garbage amplitude=100']"


@pytest.mark.parametrize(
    ("fault", "mode"), [(STUCK, "processes"), pytest.param(LOST, "composed", marks=pytest.mark.system)]
)
def test_reactions_are_the_same_in_every_host(fault, mode):
    loaded = supervised(fault, "spindle_encoder.revolutions=14")
    assert harness.run(loaded, mode=mode, groups=in_two(loaded)).digest == harness.run(loaded).digest


def test_a_reset_gives_the_command_back_and_learning_goes_on():
    passing = STUCK.replace("revolution 10", "revolution 10 to 11")
    result = harness.run(supervised(passing, "supervisor.events=['revolution 15: reset']"))
    assert [told[:2] for told in status(result)][-2:] == [(RETRACTED, State.SAFE), (RESET, State.NOMINAL)]
    given_back = status(result)[-1][3] + 3200
    assert np.abs(np.diff(command(result)[given_back - 10 : given_back + 100])).max() <= 0.05 * STEP
    # Once all is over the form error is what it was before.
    assert result.errors.rms[-1] < 2.0 * result.errors.rms[8]
    assert result.recording.of_type(messages.SAFETY)["state"][-1] == State.NOMINAL


def test_an_operator_takes_the_tool_out_and_lets_it_approach_again():
    result = harness.run(supervised("supervisor.events=['revolution 12: retract', 'revolution 15: reset']"))
    told = [one[:2] for one in status(result) if one[0] != "error"]  # that of the tool's own way out
    assert told == [("operator", State.RETRACTING), (RETRACTED, State.SAFE), (RESET, State.NOMINAL)]


def test_a_finer_channel_learns_again_only_when_the_coarse_one_is_back():
    """Neither the errors of the way back nor the commands of the reaction reach the memory or the identified drive."""
    sets = ["supervisor.events=['revolution 20: retract', 'revolution 24: reset']", "spindle_encoder.revolutions=50"]
    result = harness.run(config("supervised_two_channel", *sets))
    assert [one[:2] for one in status(result)][-1] == (RESET, State.NOMINAL)
    fine = result.recording.sparse["/fine/learning"].values
    waits = np.flatnonzero(~np.array(fine["joined"]))
    assert waits[-1] > 22
    assert np.array(fine["max_error"])[waits[-1] + 1] < 15e-6
    assert np.ptp(np.array(fine["stability_margin"])[8:]) < 1e-3
    assert result.errors.rms[-1] < 1e-8


def test_a_stop_is_not_reset():
    stop = "spindle_encoder.faults=['revolution 10 to 10.1: encoder.speed wrong scale=1.5']"
    result = harness.run(supervised(stop, "supervisor.events=['revolution 15: reset']"))
    assert result.recording.of_type(messages.SAFETY)["reaction"][-1] == Reaction.STOP


def test_a_reset_while_the_tool_is_on_its_way_out_is_refused():
    broken = "spindle_encoder.faults=['revolution 20: encoder.speed wrong scale=1.5']"
    (stopped, *_) = status(harness.run(supervised(broken)))
    result = harness.run(supervised(broken, f"supervisor.events=['sample {stopped[3] + 1}: reset']"))
    told = status(result)
    assert ("reset refused", State.RETRACTING, Reaction.STOP, stopped[3] + 1) in told
    assert told[-1][:2] == (RETRACTED, State.SAFE)


@pytest.mark.parametrize(
    ("fault", "begins"),
    [
        ("sample 0: encoder missed_index", 1),
        ("revolution 5.5: encoder missed_index", 5),
        ("sample 7: encoder.index_pulse off", 1),
    ],
)
def test_an_index_track_that_is_dead_is_noticed_also_from_the_start(fault, begins):
    result = harness.run(supervised(f"spindle_encoder.faults=['{fault}']"))
    (first, *_) = status(result)
    assert first[0] == "index_pulses"
    angle = result.recording.of_type(messages.ENCODER)["angle_true"][first[3]]
    assert_allclose(angle / TURN, begins if begins == 1 else begins + 1, atol=2e-3)


def test_an_index_track_that_is_still_dead_is_noticed_again_after_a_reset():
    result = harness.run(supervised("spindle_encoder.faults=['revolution 5: encoder missed_index']",
                                    "supervisor.events=['revolution 12: reset']"))  # fmt: skip
    told = [each[0] for each in status(result)]
    assert told.index("index_pulses") < told.index(RESET) < told.index("index_pulses", told.index(RESET))


def test_a_supervisor_without_drives_is_safe_at_once_when_members_are_lost():
    stage = Cell(config("supervised_turning").nodes).stages["supervisor"]
    stage.lose(0)
    inputs = [
        {name: np.zeros(64, messages.sample_fields(port.type)[name]) for name in port.fields} for port in stage.inputs
    ]
    outputs = [messages.allocate(port.type, 64) for port in stage.outputs]
    told = stage.advance(0, inputs, outputs)
    assert outputs[0]["state"].tolist() == [State.SAFE] * 64
    assert next(each for each in told if each.type == messages.SAFETY_STATUS).values["monitor"] == MEMBERS_LOST


def test_an_angle_that_no_controller_can_use_ends_in_the_safe_state_not_in_an_error():
    result = harness.run(supervised(LOST))
    assert "lost" in result.recording.sparse["/learning_controller/events"].values["action"]
    assert (RETRACTED, State.SAFE) in [told[:2] for told in status(result)]


@pytest.mark.parametrize(
    ("scenario", "monitor", "subject", "watched", "limit", "seconds"),
    [
        ("supervised", "following", "coarse", "coarse/command.position coarse/state.measured_position", 30e-6, 1e-3),
        ("supervised", "stroke", "coarse", "coarse/state.measured_position", 100e-6, 0.0),
        ("supervised", "effort", "coarse", "coarse/state.effort", 0.02, 5e-3),
        ("supervised_turning", "slide", "longitudinal", "longitudinal/state.measured_position", 0.3e-3, 0.0),
    ],
)
def test_a_drive_is_watched_by_the_signals_that_its_monitor_names(scenario, monitor, subject, watched, limit, seconds):
    sets = [f"supervisor.{monitor}_limit=[{limit}]", f"supervisor.{monitor}_reaction=warn"]
    recording = harness.run(config(scenario, "spindle_encoder.revolutions=12", *sets)).recording
    signals = (recording.dense[f"/{topic}"][name] for topic, name in (each.split(".") for each in watched.split()))
    value = np.abs(functools.reduce(operator.sub, signals))
    told = recording.sparse["/safety/status"].values
    index = lasting(value > limit, max(1, round(seconds / STEP)))
    assert (monitor, subject, index, value[index]) in zip(
        told["monitor"], told["subject"], told["sample_index"], told["value"], strict=True
    )


def test_acceleration_is_the_change_of_the_measured_speed_over_its_window():
    sets = ["supervisor.acceleration_limit=20.0", "supervisor.acceleration_reaction=warn", "supervisor.speed_limit=0.0"]
    result = harness.run(supervised(*sets))
    speed = result.recording.of_type(messages.ENCODER)["speed"]
    nominal = 1000.0 * TURN / 60.0
    change = np.abs(speed - np.concatenate((np.full(640, nominal), speed))[: speed.size]) / (640 * STEP)
    (told,) = status(result)
    assert (told[0], told[3]) == ("acceleration", np.flatnonzero(change > 20.0)[0])


SLOW = STUCK.replace("revolution 10", "revolution 12")


def commanded(reaction, *overrides):
    """Command, and the sample from which on the reaction is obeyed."""
    asked = ["supervisor.growth_limit=0.0", "supervisor.following_limit=[]", f"supervisor.error_reaction={reaction}"]
    result = harness.run(supervised(SLOW, *asked, *overrides))
    (monitor, *_, index), *more = status(result)
    assert (monitor, more) == ("error", [])
    return result, command(result), index + 3200


def test_a_warning_changes_nothing_that_moves():
    _, warned, _ = commanded("warn")
    assert_array_equal(warned, command(harness.run(supervised(SLOW, "supervisor.error_limit=0.0",
                       "supervisor.growth_limit=0.0", "supervisor.following_limit=[]"))))  # fmt: skip


def test_falling_back_freezes_the_memory_and_if_so_asked_the_lead():
    result, frozen, obeyed = commanded("fall_back")
    told = result.recording.sparse["/coarse/learning"].values
    learning = np.array(told["learning"])[np.array(told["sample_index"]) > obeyed]
    assert learning.size > 5
    assert not learning.any()
    _, constant, _ = commanded("fall_back", "learning_controller.fall_back=constant_lead")
    assert_array_equal(constant[:obeyed], frozen[:obeyed])
    assert np.abs(constant - frozen)[obeyed:].max() > 1e-6, "the speed swings by a tenth"
    _, learned, _ = commanded("warn")
    assert np.abs(learned - frozen)[obeyed:].max() > 1e-6


def test_at_a_steady_speed_a_constant_lead_is_the_lead():
    steady = ["spindle_encoder.deviation_amplitude=[0.0]"]
    _, frozen, _ = commanded("fall_back", *steady)
    _, constant, _ = commanded("fall_back", *steady, "learning_controller.fall_back=constant_lead")
    assert_allclose(constant, frozen, atol=1e-12)


def test_to_hold_is_to_come_to_rest_and_stay():
    result, held, obeyed = commanded("hold")
    moves = np.flatnonzero(np.diff(held))
    assert obeyed < moves[-1] < obeyed + 3200
    assert np.abs(np.diff(held[obeyed:], 2)).max() <= 50.0 * STEP**2 * 1.001
    assert result.recording.of_type(messages.SAFETY)["state"][-1] == State.DEGRADED


def test_a_broken_tool_stops_the_feed():
    broken = "cutting_process.faults=['revolution 200: cut tool_broken length=1e-3']"
    result = harness.run(config("supervised_turning", broken))
    ((monitor, state, reaction, index),) = status(result)
    assert (monitor, state, reaction) == ("force_low", State.DEGRADED, Reaction.HOLD)
    velocity = result.recording.of_type(messages.STATE)["velocity"]
    assert velocity[index] > 1e-3
    assert abs(velocity[-1]) < 1e-9


# ---- the stability margin

# A slow swing of 5 % of the speed; at the top of it the margin is least.
SWING = [
    "spindle_encoder.deviation_amplitude=[0.05]",
    "spindle_encoder.deviation_frequency=[3.0]",
    "supervisor.margin_after=0.0",
]


def margin_of(result):
    return result.recording.dense["/coarse/margin"]["stability_margin"]


def test_the_margin_that_is_published_is_that_of_the_newest_cycle():
    result = harness.run(supervised(*SWING))
    told, margin = result.recording.sparse["/coarse/learning"].values, margin_of(result)
    ends = [0, *told["sample_index"], margin.size]
    assert told["stability_margin"][0] != margin[0] > 0.0
    for value, (start, stop) in zip([margin[0], *told["stability_margin"]], itertools.pairwise(ends), strict=True):
        assert np.all(margin[start:stop] == value)
    # It rises and falls with the speed of the cycle.
    speed = result.recording.of_type(messages.ENCODER)["speed_true"]
    mean = [speed[start:stop].mean() for start, stop in itertools.pairwise(told["sample_index"])]
    assert np.corrcoef(mean, told["stability_margin"][1:])[0, 1] < -0.99


def test_the_margin_is_that_of_the_drive_as_it_is():
    """The published margin follows the identified drive.

    A drive that is faster than was believed: the margin falls when that has been identified.
    """
    faster = ["electrodynamic_actuator.natural_frequency=1200.0", "spindle_encoder.deviation_amplitude=[0.0]"]
    believed = "learning_controller.model_natural_frequency=1038.0"
    loaded = supervised(*faster, believed, "supervisor.margin_limit=[0.05]", "supervisor.error_limit=0.0")
    result = harness.run(loaded)
    margin = margin_of(result)
    stage = LearningController("controller", loaded.nodes["learning_controller"])
    drive = ElectrodynamicActuator("drive", loaded.nodes["electrodynamic_actuator"])
    speed = stage.parameters.nominal_speed
    true = 1.0 - stage.loop(drive.responses()["coarse/command"]).supremum(speed)
    assert_allclose(margin[-1], true, rtol=1e-3)
    assert margin[0] > 0.055
    assert margin[-1] < 0.05
    assert [told[0] for told in status(result)] == ["stability_margin"]


def test_learning_stops_where_the_margin_falls_below_its_limit():
    margin = margin_of(harness.run(supervised(*SWING)))
    limit = 0.3 * margin.max() + 0.7 * margin.min()
    result = harness.run(supervised(*SWING, f"supervisor.margin_limit=[{limit}]"))
    ((monitor, state, reaction, index),) = status(result)
    assert (monitor, state, reaction) == ("stability_margin", State.DEGRADED, Reaction.FREEZE)
    assert index == np.flatnonzero(margin <= limit)[0]
    told = result.recording.sparse["/coarse/learning"].values
    frozen = [cycle > index + 3200 for cycle in told["sample_index"]]
    assert [not learning for learning in told["learning"]] == frozen
    assert any(frozen)
    assert not all(frozen)


def test_the_margin_is_watched_alike_in_every_block_and_re_simulation(tmp_path):
    watched = [*SWING, "supervisor.margin_limit=[0.054]", "spindle_encoder.revolutions=12"]
    result = harness.run(supervised(*watched), bag=tmp_path / "bag")
    assert status(result)[0][0] == "stability_margin"
    assert harness.run(supervised(*watched, "block_size=17")).digest == result.digest
    assert_resimulated(tmp_path / "bag")


# ---- the feed obeys

PASSING = [
    "spindle_encoder.revolutions=130", "cutting_process.faults=['revolution 60 to 61: cut hard_spot factor=2']",
    "supervisor.events=['revolution 90: reset']",
]  # fmt: skip


def turning(*overrides):
    return config("supervised_turning", *PASSING, *overrides)


@pytest.fixture(scope="module")
def turned():
    return harness.run(turning())


def feed(result):
    dense = result.recording.dense
    return dense["/longitudinal/command"]["command"], dense["/longitudinal/state"]["effort"], dense["/cut"]["force"]


def test_the_feed_is_brought_to_rest_along_a_bounded_profile(turned):
    told = status(turned)
    assert told[0][:3] == ("force", State.DEGRADED, Reaction.HOLD)
    begin, end = told[0][3] + 64, told[-1][3]
    given, effort, _ = feed(turned)
    assert abs(given[begin - 1]) > 0.1
    for whole in (given, effort):
        part = whole[begin - 1 : end]
        assert part[-1] == 0.0
        assert np.abs(np.diff(part)).max() <= 10.0 * STEP * (1 + 1e-9)
        assert np.abs(np.diff(part, 2)).max() <= 1000.0 * STEP**2 * (1 + 1e-3)


def test_after_a_reset_the_force_comes_back_without_a_bump_and_without_overshoot(turned):
    told = status(turned)
    assert told[-1][:3] == (RESET, State.NOMINAL, Reaction.NONE)
    given, _, force = feed(turned)
    back = told[-1][3] + 64
    assert np.abs(np.diff(given[back - 1 : back + 640])).max() < 0.005
    # What the derivative makes of the ramp; a set point that is there at once would ask for 0.8 more.
    assert np.abs(given[back : back + 640]).max() < 0.15
    assert force[told[-1][3]] < 1.0
    assert force[back:].max() < 1.05 * 150.0
    assert_allclose(force[-32_000:].mean(), 150.0, atol=2.0)


def test_a_frozen_force_controller_keeps_its_integral_and_goes_on():
    fault = "cutting_process.faults=['revolution 60: cut.measured_force wrong scale=1.2']"
    result = harness.run(turning("supervisor.force_reaction=freeze", fault))
    ((monitor, _, reaction, index), *_) = status(result)
    assert (monitor, reaction) == ("force", Reaction.FREEZE)
    given, _, force = feed(result)
    # P alone against 20 %: with the integral the force falls to 125 N.
    settled = slice(index + 32_000, status(result)[-1][3])
    assert force[settled].mean() > 127.0
    assert np.ptp(given[settled]) > 0.0


def soon(*overrides):
    """The same hold and reset, without the seconds in which the force settles before and after."""
    passing = ["cutting_process.faults=['revolution 20 to 21: cut hard_spot factor=2']",
               "supervisor.events=['revolution 30: reset']", "spindle_encoder.revolutions=34"]  # fmt: skip
    return turning(*passing, *overrides)


@pytest.mark.system
def test_the_feed_reacts_alike_in_every_host():
    """The feed reacts at the same samples in every host.

    It is held and goes on, also where supervisor and cut are processes of their own, in blocks of any length.
    """
    result, cell, outside = harness.run(soon()), soon(), ["supervisor", "cutting_process"]
    assert [told[:2] for told in status(result)] == [("force", State.DEGRADED), (RESET, State.NOMINAL)]
    groups = [[name for name in cell.nodes if name not in outside], *([name] for name in outside)]
    assert harness.run(cell, mode="processes", groups=groups).digest == result.digest
    assert harness.run(soon("block_size=17")).digest == result.digest


def obedient(folder, name, node, *overrides):
    """A scenario of one slide with a supervisor that watches the speed of the spindle."""
    text = (CONFIG / f"{name}.yaml").read_text(encoding="utf-8")
    text = text.replace("members: [", "members: [supervisor, ")
    text = text.replace("ros__parameters:\n", "ros__parameters:\n    allow_faults: true\n", 1)
    text += """
/supervisor:
  ros__parameters:
    speed_limit: 1.0
    speed_reaction: hold
"""
    (folder / "cell.yaml").write_text(text, encoding="utf-8")
    delay = f"{node}.reaction_delay=64"
    return scenarios.load(folder / "cell.yaml", [delay, "feed_drive.reaction_delay=64", *overrides])


def test_a_slide_that_a_link_positions_stands_and_goes_on(tmp_path):
    """A slide that a link positions stands while the feed is held, and goes on to its set point after a reset."""
    fault = "spindle_encoder.faults=['second 0.1 to 0.11: encoder.speed wrong scale=2']"
    reset = "supervisor.events=['second 1.0: reset']"
    result = harness.run(obedient(tmp_path, "approach", "position_controller", fault, reset))
    position = result.recording.dense["/cross/state"]["position"]
    stood = position[round(0.9 / STEP) : round(1.0 / STEP)]
    # It coasts beyond the set point: what the link would have braked with comes no more.
    assert stood[0] > 5.5e-3
    assert np.ptp(stood) < 1e-6
    assert_allclose(position[-1], 5e-3, atol=5e-6)


def test_a_drive_that_is_commanded_a_position_stays_there(tmp_path):
    """A drive that is commanded a position stays where it is when the feed is held."""
    fault = "spindle_encoder.faults=['second 40 to 41: encoder.speed wrong scale=2']"
    changes = [
        "spindle_encoder.revolutions=60.0",
        "position_controller.commands=position",
        "supervisor.speed_limit=0.5",
    ]
    result = harness.run(obedient(tmp_path, "periodic", "position_controller", fault, *changes))
    effort = result.recording.dense["/cross/state"]["effort"]
    given = result.recording.dense["/cross/command"]["command"]
    assert abs(effort[40_000]) > 0.05
    assert effort[-1] == effort[41_000] != 0.0
    assert given[-1] == given[41_000] != 0.0


def test_a_re_simulation_reacts_in_the_same_way(tmp_path):
    harness.run(supervised(STUCK, "supervisor.events=['revolution 26: reset']"), bag=tmp_path / "bag")
    assert_resimulated(tmp_path / "bag")
