# SPDX-License-Identifier: Apache-2.0
"""The piezo drive: its response, saturation, creep, what linearisation leaves; the stage and its set point."""

import numpy as np
import pytest
from cells import cuts, in_blocks
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.signal import lsim

from lathe_papers.formulas.responses import second_order as ideal
from lathe_rc import messages
from lathe_rc.analysis.hysteresis_fit import from_signals, identify
from lathe_rc.cell.stage import compile_kernels
from lathe_rc.cell.stages.piezo_actuator import PiezoActuator, PiezoActuatorParameters
from lathe_rc.errors import InputError
from lathe_rc.plants.hysteresis import WEIGHTS, BoucWen, PrandtlIshlinskii
from lathe_rc.plants.linear import second_order
from lathe_rc.plants.piezo import PiezoDrive, Stack, extend

WN, ZETA, STROKE, VOLTS = 14600.0, 0.299, 15e-6, 100.0
STEP = 1 / 64000
TABLE = np.array([500.0, 1000.0, 1500.0, 2000.0])

PAIRS = {
    None: lambda _: (None, None),
    "plays": lambda scale: (PrandtlIshlinskii(), PrandtlIshlinskii().identified(scale).inverse()),
    "bouc_wen": lambda scale: (BoucWen(), BoucWen().identified(scale).inverse()),
}


def make_drive(kind=None, *, linearised=True, scale=1.0, lag=0.0, slew=np.inf, creep=0.0, method="foh"):
    forward, inverse = PAIRS[kind](scale)
    stack = Stack(
        stroke=STROKE,
        amplifier_lag=lag,
        slew_rate=slew,
        hysteresis=forward,
        inverse=inverse if linearised else None,
        creep_per_decade=creep,
        creep_times=np.array([0.01, 0.1, 1.0]),
        step=STEP,
        method=method,
    )
    return PiezoDrive(stack, natural_frequency=WN, damping=ZETA, full_voltage=VOLTS, step=STEP, method=method)


def drive(machine, set_point, lengths=None):
    """Position, velocity and voltage."""
    motion = np.empty((3, set_point.size))
    in_blocks(lengths or [set_point.size], lambda _, *parts: machine.block(*parts), set_point, *motion)
    return motion


def amplitude(signal, frequency, period):
    """Complex amplitude of a sine in the last period."""
    time = np.arange(signal.size)[-period:] * STEP
    return 2j / period * (signal[-period:] * np.exp(-1j * frequency * time)).sum()


# --- linear


@pytest.mark.parametrize("method", ["foh", "tustin"])
@pytest.mark.parametrize("lag", [0.0, 40e-6])
@pytest.mark.parametrize("kind", PAIRS)
def test_drive_answers_a_sine_as_its_response_says(kind, lag, method):
    """Without a lag between inverse and hysteresis a linearised drive is linear; without hysteresis always."""
    machine = make_drive(kind if lag == 0.0 else None, lag=lag, method=method)
    period = 160
    frequency = 2 * np.pi / (period * STEP)
    set_point = 0.5 * STROKE * np.sin(frequency * np.arange(40 * period) * STEP)
    position, velocity, _ = drive(machine, set_point)
    expected = machine.linear.response(frequency) * 0.5 * STROKE
    assert_allclose(amplitude(position, frequency, period), expected, rtol=1e-9)
    assert abs(amplitude(velocity, frequency, period)) == pytest.approx(frequency * abs(expected), rel=1e-3)
    assert machine.saturated == 0


@pytest.mark.parametrize("lag", [0.0, 40e-6])
def test_response_nears_the_ideal(lag):
    expected = ideal(TABLE, WN, ZETA) / (1 + 1j * TABLE * lag)
    assert_allclose(make_drive(lag=lag).linear.response(TABLE), expected, rtol=2e-4)


def test_row_of_the_uncompensated_is_that_of_the_spec():
    """spec/learning.md prints .020 .040 .061 .083; its ζ = 0.299 gives them to 4 %."""
    left = np.abs(1.0 - make_drive().linear.response(TABLE))
    assert_allclose(left, [0.0205, 0.0414, 0.0629, 0.0853], atol=2e-4)
    assert_allclose(left, [0.020, 0.040, 0.061, 0.083], rtol=0.04)


def test_foh_is_exact_for_set_points_linear_between_samples():
    set_point = STROKE / 4 * np.random.default_rng(1).normal(size=300).clip(-3, 3)
    position, velocity, _ = drive(make_drive(), set_point)
    a, b = second_order(WN, ZETA)
    fine = np.interp(np.arange(-8, 300 * 8) / 8, np.arange(-1, 300), np.append(0.0, set_point))
    _, _, states = lsim((a, b[:, None], np.eye(2), np.zeros((2, 1))), fine, np.arange(fine.size) * STEP / 8)
    assert_allclose(position, states[8::8, 0][:300], atol=1e-9 * STROKE)
    assert_allclose(velocity, states[8::8, 1][:300], atol=1e-9 * STROKE * WN)


@pytest.mark.parametrize("kind", PAIRS)
def test_the_amplifier_changes_its_voltage_no_faster_than_its_slew_rate(kind):
    """200 times full voltage in a second; what it cannot follow is counted, sample by sample as in a block."""
    machine, other = (make_drive(kind, slew=200.0) for _ in range(2))
    set_point = np.repeat([0.0, 0.8, -0.4], [10, 1000, 1000]) * STROKE
    _, _, voltage = drive(machine, set_point)
    slope = np.abs(np.diff(voltage)) / STEP
    assert slope.max() == pytest.approx(200.0 * VOLTS, rel=1e-6)
    assert machine.saturated == pytest.approx(np.sum(slope > 199.99 * VOLTS), abs=2)
    assert voltage[-1] == pytest.approx(drive(make_drive(kind), set_point)[2][-1], rel=1e-9)
    single = [extend(other.table.stack, other.table.memory, value) for value in set_point]
    assert sum(cut for _, cut in single) == machine.saturated
    assert np.array_equal(other.table.memory, machine.table.memory)


def test_step_response_overshoots_as_its_damping_says():
    position = drive(make_drive(), np.full(2000, 0.5 * STROKE))[0]
    damped = np.sqrt(1 - ZETA**2)
    assert position.max() / position[-1] == pytest.approx(1 + np.exp(-np.pi * ZETA / damped), abs=2e-3)
    assert position[-1] == pytest.approx(0.5 * STROKE)


def test_amplifier_lag_is_exact_for_set_points_linear_between_samples():
    """Voltage after a ramp from sample -1 on: t - T·(1 - e^{-t/T})."""
    lag, slope = 40e-6, 0.02
    voltage = drive(make_drive(lag=lag), slope * STROKE * np.arange(1, 41))[2]
    time = np.arange(1, 41) * STEP
    assert_allclose(voltage / VOLTS, slope / STEP * (time + lag * np.expm1(-time / lag)), rtol=1e-10)


def test_lag_far_below_the_step_is_refused():
    with pytest.raises(InputError, match=r"lag of 1e-09 s at a step of 1.5625e-05 s; allowed: at least 1.5625e-08"):
        make_drive(lag=1e-9)


# --- saturation


@pytest.mark.parametrize("kind", PAIRS)
def test_drive_saturates_at_full_voltage_and_counts(kind):
    """A slow triangle of 1.5 strokes stands beyond the stroke for a third of its time."""
    set_point = 1.5 * STROKE * (2 / np.pi) * np.arcsin(np.sin(2 * np.pi * np.arange(30_000) / 10_000))
    machine = make_drive(kind)
    position, _, voltage = drive(machine, set_point)
    # Bouc-Wen's inverse asks for a little more than full voltage until its loop is steady.
    assert machine.saturated == pytest.approx(10_000, abs=4 if kind != "bouc_wen" else 40)
    assert np.abs(voltage).max() <= VOLTS
    assert np.abs(voltage[-10_000:]).max() == pytest.approx(VOLTS, rel=0.01)
    assert np.abs(position).max() == pytest.approx(STROKE, rel=0.01)


@pytest.mark.parametrize("kind", ["plays", "bouc_wen"])
def test_linearisation_survives_saturation(kind):
    """The inverse does not wander on while the voltage stands still."""
    swing = np.sin(2 * np.pi * np.arange(40_000) / 10_000)
    set_point = STROKE * np.where(np.arange(40_000) < 20_000, 1.7, 0.6) * swing
    position = drive(make_drive(kind), set_point)[0]
    assert_allclose(position[-10_000:], set_point[-10_000:], atol=1e-3 * STROKE)


def test_set_point_at_the_stroke_is_no_saturation():
    machine = make_drive("plays")
    drive(machine, np.tile([STROKE, -STROKE], 5000))
    assert machine.saturated == 0


def test_voltage_that_a_wrong_inverse_asks_for_is_counted():
    """The set point stays within the stroke; at its ends the inverse of too flat a model wants more than there is."""
    set_point = STROKE * np.sin(2 * np.pi * np.arange(20_000) / 10_000)
    machine = make_drive("plays", scale=0.85)
    voltage = drive(machine, set_point)[2]
    at_limit = np.abs(voltage) == VOLTS
    assert at_limit.sum() > 1000
    assert machine.saturated == at_limit.sum()


# --- hysteresis


@pytest.mark.parametrize(("kind", "loop"), [(None, 0.0), ("plays", 0.13), ("bouc_wen", 0.13)])
def test_loop_without_linearisation(kind, loop):
    """In a swing of a second the lag of the resonance, 41 µs, is nothing."""
    points = 64000
    set_point = STROKE * np.sin(2 * np.pi * np.arange(4 * points) / points)
    position = drive(make_drive(kind, linearised=False), set_point)[0][-points:]
    rising, falling = position[0], position[points // 2]
    assert (falling - rising) / np.ptp(position) == pytest.approx(loop, abs=2e-3)


# --- creep


def test_creep_grows_by_its_part_in_each_decade():
    rate = 0.02
    position = drive(make_drive(creep=rate), np.full(70_000, 0.5 * STROKE))[0]
    # The set point rises from 0 in the step before sample 0, and the resonance lags by 2ζ/ωn.
    time = (np.arange(70_000) + 0.5) * STEP - 2 * ZETA / WN
    crept = 1 + rate * sum(-np.expm1(-time / tau) for tau in (0.01, 0.1, 1.0))
    assert_allclose(position[2000:] / (0.5 * STROKE), crept[2000:], rtol=1e-6)
    k = [3200, 32_000]
    assert np.diff(position[k])[0] / (0.5 * STROKE) == pytest.approx(rate, rel=0.15)


def test_creep_is_in_the_response():
    machine = make_drive(creep=0.05)
    frequency = 2 * np.pi * 5.0
    expected = 1 + 0.05 * sum(1 / (1 + 1j * frequency * tau) for tau in (0.01, 0.1, 1.0))
    assert_allclose(machine.linear.response(frequency) / make_drive().linear.response(frequency), expected, rtol=1e-5)
    set_point = 0.5 * STROKE * np.sin(frequency * np.arange(64_000 * 6) * STEP)
    measured = amplitude(drive(machine, set_point)[0], frequency, 12_800)
    assert_allclose(measured, machine.linear.response(frequency) * 0.5 * STROKE, rtol=1e-3)


@given(cuts, st.sampled_from(list(PAIRS)), st.sampled_from([0.0, 40e-6]), st.sampled_from([0.0, 0.02]))
def test_cuts_change_nothing(lengths, kind, lag, creep):
    set_point = np.random.default_rng(2).normal(scale=STROKE, size=sum(lengths))
    options = {"lag": lag, "creep": creep, "scale": 0.9}
    whole, cut = make_drive(kind, **options), make_drive(kind, **options)
    assert np.array_equal(drive(cut, set_point, lengths), drive(whole, set_point))
    assert cut.saturated == whole.saturated


# --- stage


def stage(name="piezo_actuator", **values):
    return PiezoActuator(name, PiezoActuatorParameters.read(name, values))


def advance(made, *inputs, lengths=None):
    """State that a stage makes of its inputs' arrays."""
    samples = inputs[0].size
    ports = [port.fields[0] for port in made.inputs]
    assert len(ports) == len(inputs)
    state = messages.allocate(messages.STATE, samples)

    def block(first, *parts):
        rows = len(inputs)
        given_to = [{field: part} for field, part in zip(ports, parts[:rows], strict=True)]
        made.advance(first, given_to, [dict(zip(state, parts[rows:], strict=True))])

    in_blocks(lengths or [samples], block, *inputs, *state.values())
    return state


def topics(made):
    return [(port.topic, port.type, port.fields, port.delay) for port in made.inputs]


COMMAND = ("fine/command", messages.COMMAND, ("position",), 0)
REFERENCE = ("reference", messages.REFERENCE, ("expected",), 0)


def source(name):
    return (f"{name}/state", messages.STATE, ("measured_position",), 0)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({}, [COMMAND]),
        ({"use_reference": True}, [COMMAND, REFERENCE]),
        (
            {"use_command": False, "use_reference": True, "compensates": ["coarse", "vibration"]},
            [REFERENCE, source("coarse"), source("vibration")],
        ),
        ({"use_command": False, "compensates": ["vibration"]}, [source("vibration")]),
    ],
)
def test_stage_reads_what_it_is_asked_for(values, expected):
    made = stage(**values)
    assert topics(made) == expected
    assert [(output.topic, output.type) for output in made.outputs] == [("fine/state", messages.STATE)]
    compile_kernels(made)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"use_command": False},
            "^piezo.use_command, use_reference, compensates: there is no set point; allowed: one of them or more",
        ),
        ({"compensates": ["a", "b", "a"]}, r"^piezo.compensates = \['a', 'b', 'a'\]; allowed: each displacement once"),
        (
            {"play_thresholds": [0.1, 0.2]},
            "^piezo.play_thresholds, play_weights, play_proportional: plays: 2 thresholds and 10 weights",
        ),
        ({"play_thresholds": [0.2, 0.1], "play_weights": [0.1, 0.1]}, ": play thresholds"),
        ({"play_proportional": 0.1, "play_weights": [-0.02] * 10}, ": play weights: slope .* after 5 plays"),
        (
            {"hysteresis": "bouc_wen", "bouc_wen_a": 0.8},
            "^piezo.bouc_wen_a, bouc_wen_beta, bouc_wen_gamma: Bouc-Wen A = 0.8",
        ),
        ({"identified_thresholds": [0.1]}, "^piezo.identified_weights: empty"),
        ({"identified_weights": [0.1]}, "^piezo.identified_thresholds, .*: plays: 10 thresholds and 1 weights"),
        ({"amplifier_lag": 1e-12}, "^piezo.amplifier_lag, creep_shortest: lag of 1e-12 s"),
        ({"events": ["revolution 3: freeze"]}, "^piezo.events: event 'freeze'"),
    ],
)
def test_stage_refuses_what_cannot_work(values, message):
    with pytest.raises(InputError, match=message) as refusal:
        stage("piezo", **values)
    assert len(str(refusal.value).splitlines()) == 1


def test_direct_compensation_follows_the_error_of_the_same_sample():
    """Set point δ1 = Xd - X1 (paper 001, Fig. 4), less the vibration that the part sees."""
    random = np.random.default_rng(4)
    reference = 200e-6 * np.sin(np.arange(1000) / 50)
    coarse = reference + random.normal(scale=2e-6, size=1000)
    vibration = random.normal(scale=1e-6, size=1000)
    made = stage(use_command=False, use_reference=True, compensates=["coarse", "vibration"])
    state = advance(made, reference, coarse, vibration)
    alone = drive(make_drive("plays"), reference - coarse - vibration)
    assert_allclose([state["position"], state["velocity"], state["effort"]], alone, rtol=1e-9, atol=1e-15)
    assert made.drive.saturated == 0


def test_compensated_sine_leaves_the_formula():
    """Δx·(1 - Wpk) of a vibration (paper 001, eq. 6)."""
    period = 160
    frequency = 2 * np.pi / (period * STEP)
    vibration = 1e-6 * np.sin(frequency * np.arange(40 * period) * STEP)
    made = stage(use_command=False, compensates=["vibration"])
    left = vibration + advance(made, vibration)["position"]
    expected = 1e-6 * (1 - made.drive.linear.response(frequency))
    assert_allclose(amplitude(left, frequency, period), expected, rtol=1e-8)


@given(cuts)
def test_cuts_change_nothing_in_the_stage(lengths):
    random = np.random.default_rng(5)
    command, coarse = random.normal(scale=STROKE, size=(2, sum(lengths)))
    values = {"compensates": ["coarse"], "noise_rms": 1e-8, "hysteresis": "bouc_wen"}
    whole = advance(stage(**values), command, coarse)
    cut = advance(stage(**values), command, coarse, lengths=lengths)
    assert all(np.array_equal(whole[name], cut[name]) for name in whole)


def test_sensor_measures_with_noise_and_resolution():
    state = advance(stage(noise_rms=1e-8, resolution=2e-9), np.full(20_000, 5e-6))
    noise = (state["measured_position"] - state["position"])[1000:]
    assert noise.std() == pytest.approx(1e-8, rel=0.03)
    assert_allclose(state["measured_position"] / 2e-9, np.rint(state["measured_position"] / 2e-9), atol=1e-6)


@pytest.mark.parametrize("values", [{}, {"hysteresis": "bouc_wen"}, {"hysteresis": "none"}])
def test_default_drive_is_linear(values):
    made = stage(**values)
    command = 0.9 * STROKE * np.sin(2 * np.pi * np.arange(128_000) / 64_000)
    position = advance(made, command)["position"]
    assert_allclose(position, command, atol=1e-3 * STROKE)  # of which the lag of 41 µs makes a quarter
    assert_allclose(made.responses()["fine/command"](TABLE), make_drive().linear.response(TABLE))


def test_drive_is_identified_from_its_own_signals():
    """Linearisation off, a slow sine over the stroke; identify; that model linearises it."""
    command = STROKE * np.sin(2 * np.pi * np.arange(128_000) / 64_000)
    state = advance(stage(linearisation="none"), command)
    found = identify(from_signals({"/fine/command": {"position": command}, "/fine/state": state}), STROKE).model
    assert_allclose(found.weights, WEIGHTS, atol=2e-3)
    values = {"identified_weights": found.weights.tolist(), "identified_proportional": found.proportional}
    position = advance(stage(**values), command)["position"]
    assert_allclose(position, command, atol=1e-3 * STROKE)


def test_linearisation_takes_what_was_identified():
    """Other plays than those of the drive: the chain of both by hand."""
    command = STROKE * np.sin(2 * np.pi * np.arange(20_000) / 10_000)
    values = {"identified_thresholds": [0.2, 0.5], "identified_weights": [0.1, 0.1], "identified_proportional": 0.8}
    state = advance(stage(**values), command)
    voltage = np.empty_like(command)
    PrandtlIshlinskii(np.array([0.2, 0.5]), np.array([0.1, 0.1]), 0.8).inverse().block(command / STROKE, voltage)
    assert_allclose(state["effort"] / VOLTS, voltage.clip(-1, 1), atol=1e-12)
