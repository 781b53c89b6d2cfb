# SPDX-License-Identifier: Apache-2.0
"""The piezo drive: its response, saturation, creep, what linearisation leaves; the stage and its set point."""

import numpy as np
import pytest
from cells import cuts
from hypothesis import given
from hypothesis import strategies as st
from machines import amplitude, run
from numpy.testing import assert_allclose
from scipy.signal import lsim

from lathe_commission.hysteresis_fit import from_signals, identify
from lathe_machine.plants.hysteresis import WEIGHTS, BoucWen, PrandtlIshlinskii
from lathe_machine.plants.linear import second_order
from lathe_machine.plants.piezo import PiezoDrive, Stack, extend
from lathe_machine.stages.drive.piezo_actuator import PiezoActuator, PiezoActuatorParameters
from lathe_papers.formulas.responses import second_order as ideal
from lathe_rc import messages
from lathe_rc.cell.stage import compile_kernels

WN, ZETA, STROKE, VOLTS = 14600.0, 0.299, 15e-6, 100.0
STEP = 1 / 64000
TABLE = np.array([500.0, 1000.0, 1500.0, 2000.0])
CREEP_TIMES = np.array([0.01, 0.1, 1.0])
PERIOD = 160
FREQUENCY = 2 * np.pi / (PERIOD * STEP)
SINE = np.sin(FREQUENCY * np.arange(40 * PERIOD) * STEP)

PAIRS = {
    None: lambda _: (None, None),
    "plays": lambda scale: (PrandtlIshlinskii(), PrandtlIshlinskii().identified(scale).inverse()),
    "bouc_wen": lambda scale: (BoucWen(), BoucWen().identified(scale).inverse()),
}


def make_drive(kind=None, *, linearised=True, scale=1.0, method="foh", **values):
    forward, inverse = PAIRS[kind](scale)
    stack = Stack(
        **{"stroke": STROKE, **values},
        hysteresis=forward,
        inverse=inverse if linearised else None,
        creep_times=CREEP_TIMES,
        step=STEP,
        method=method,
    )
    return PiezoDrive(stack, natural_frequency=WN, damping=ZETA, full_voltage=VOLTS, step=STEP, method=method)


def drive(machine, set_point, lengths=None):
    """Position, velocity and voltage."""
    return run(lambda _, *parts: machine.block(*parts), 3, set_point, lengths=lengths)


# --- linear


@pytest.mark.parametrize("method", ["foh", "tustin"])
@pytest.mark.parametrize(("kind", "lag"), [*((kind, 0.0) for kind in PAIRS), (None, 40e-6)])
def test_drive_answers_a_sine_as_its_response_says(kind, lag, method):
    """Without a lag between inverse and hysteresis a linearised drive is linear; without hysteresis always."""
    machine = make_drive(kind, amplifier_lag=lag, method=method)
    position, velocity, _ = drive(machine, 0.5 * STROKE * SINE)
    expected = machine.linear.response(FREQUENCY) * 0.5 * STROKE
    assert_allclose(amplitude(position, FREQUENCY, PERIOD, STEP), expected, rtol=1e-9)
    assert abs(amplitude(velocity, FREQUENCY, PERIOD, STEP)) == pytest.approx(FREQUENCY * abs(expected), rel=1e-3)
    assert machine.saturated == 0


@pytest.mark.parametrize("lag", [0.0, 40e-6])
def test_response_nears_the_ideal(lag):
    expected = ideal(TABLE, WN, ZETA) / (1 + 1j * TABLE * lag)
    assert_allclose(make_drive(amplifier_lag=lag).linear.response(TABLE), expected, rtol=2e-4)


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
    machine, other = (make_drive(kind, slew_rate=200.0) for _ in range(2))
    set_point = np.repeat([0.0, 0.8, -0.4], [10, 1000, 1000]) * STROKE
    _, _, voltage = drive(machine, set_point)
    slope = np.abs(np.diff(voltage)) / STEP
    assert slope.max() == pytest.approx(200.0 * VOLTS, rel=1e-6)
    assert machine.saturated == pytest.approx(np.sum(slope > 199.99 * VOLTS), abs=2)
    assert voltage[-1] == pytest.approx(drive(make_drive(kind), set_point)[2][-1], rel=1e-9)
    single = [extend(other.table.stack, other.table.memory, value) for value in set_point]
    assert sum(cut for _, cut in single) == machine.saturated
    assert np.array_equal(other.table.memory, machine.table.memory)


def test_amplifier_lag_is_exact_for_set_points_linear_between_samples():
    """Voltage after a ramp from sample -1 on: t - T·(1 - e^{-t/T})."""
    lag, slope = 40e-6, 0.02
    voltage = drive(make_drive(amplifier_lag=lag), slope * STROKE * np.arange(1, 41))[2]
    time = np.arange(1, 41) * STEP
    assert_allclose(voltage / VOLTS, slope / STEP * (time + lag * np.expm1(-time / lag)), rtol=1e-10)


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


# --- creep


def test_creep_grows_by_its_part_in_each_decade():
    rate = 0.02
    position = drive(make_drive(creep_per_decade=rate), np.full(70_000, 0.5 * STROKE))[0]
    # The set point rises from 0 in the step before sample 0, and the resonance lags by 2ζ/ωn.
    time = (np.arange(70_000) + 0.5) * STEP - 2 * ZETA / WN
    crept = 1 + rate * sum(-np.expm1(-time / tau) for tau in CREEP_TIMES)
    assert_allclose(position[2000:] / (0.5 * STROKE), crept[2000:], rtol=1e-6)
    k = [3200, 32_000]
    assert np.diff(position[k])[0] / (0.5 * STROKE) == pytest.approx(rate, rel=0.15)


def test_creep_is_in_the_response():
    frequency = 2 * np.pi * 5.0
    expected = 1 + 0.05 * sum(1 / (1 + 1j * frequency * tau) for tau in CREEP_TIMES)
    crept, plain = (make_drive(creep_per_decade=rate).linear.response(frequency) for rate in (0.05, 0.0))
    assert_allclose(crept / plain, expected, rtol=1e-5)


@given(cuts, st.sampled_from(list(PAIRS)), st.sampled_from([0.0, 40e-6]), st.sampled_from([0.0, 0.02]))
def test_cuts_change_nothing(lengths, kind, lag, creep):
    set_point = np.random.default_rng(2).normal(scale=STROKE, size=sum(lengths))
    whole, cut = (make_drive(kind, amplifier_lag=lag, creep_per_decade=creep, scale=0.9) for _ in range(2))
    assert np.array_equal(drive(cut, set_point, lengths), drive(whole, set_point))
    assert cut.saturated == whole.saturated


# --- stage


def stage(name="piezo_actuator", **values):
    return PiezoActuator(name, PiezoActuatorParameters.read(name, values))


def advance(made, *inputs):
    """State that a stage makes of its inputs' arrays."""
    state = messages.allocate(messages.STATE, inputs[0].size)
    given_to = [{port.fields[0]: array} for port, array in zip(made.inputs, inputs, strict=True)]
    made.advance(0, given_to, [state])
    return state


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({}, ["fine/command"]),
        ({"use_reference": True}, ["fine/command", "reference"]),
        (
            {"use_command": False, "use_reference": True, "compensates": ["coarse", "vibration"]},
            ["reference", "coarse/state", "vibration/state"],
        ),
        ({"use_command": False, "compensates": ["vibration"]}, ["vibration/state"]),
    ],
)
def test_stage_reads_what_it_is_asked_for(values, expected):
    made = stage(**values)
    assert [port.topic for port in made.inputs] == expected
    kinds = {"fine/command": (messages.COMMAND, ("position",)), "reference": (messages.REFERENCE, ("expected",))}
    state = (messages.STATE, ("measured_position",))
    assert all((port.type, port.fields) == kinds.get(port.topic, state) for port in made.inputs)
    assert not any(port.delay for port in made.inputs)
    assert [(output.topic, output.type) for output in made.outputs] == [("fine/state", messages.STATE)]
    compile_kernels(made)


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
    made = stage(use_command=False, compensates=["vibration"])
    left = 1e-6 * SINE + advance(made, 1e-6 * SINE)["position"]
    expected = 1e-6 * (1 - made.drive.linear.response(FREQUENCY))
    assert_allclose(amplitude(left, FREQUENCY, PERIOD, STEP), expected, rtol=1e-8)


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
