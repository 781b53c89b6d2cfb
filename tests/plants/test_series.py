# SPDX-License-Identifier: Apache-2.0
"""The piezo on the carriage: two masses, their limits, direct compensation within a sample; the stage."""

import numpy as np
import pytest
from cells import cuts
from hypothesis import given
from hypothesis import strategies as st
from machines import amplitude, assert_refused, run
from numpy.testing import assert_allclose
from scipy.signal import lsim

from lathe_machine.plants.electrodynamic import ElectrodynamicDrive
from lathe_machine.plants.hysteresis import BoucWen, PrandtlIshlinskii
from lathe_machine.plants.piezo import PiezoDrive, Stack
from lathe_machine.plants.tool_drive import Piezo, ToolDrive
from lathe_machine.plants.tool_motion import advance as move
from lathe_machine.stages.drive.electrodynamic_actuator import ElectrodynamicActuator, ElectrodynamicActuatorParameters
from lathe_machine.stages.drive.piezo_actuator import PiezoActuator, PiezoActuatorParameters
from lathe_machine.stages.drive.series_drive import SeriesDriveParameters, SeriesDriveStage
from lathe_papers.formulas.responses import in_series
from lathe_rc import messages
from lathe_rc.cell.parameters import NodeParameters
from lathe_rc.cell.stage import compile_kernels

W1, Z1, TAU = 1038.0, 0.804, 0.36e-3
W2, Z2, STROKE = 14600.0, 0.299, 15e-6
STEP = 1 / 64000
TABLE = np.array([500.0, 1000.0, 1500.0, 2000.0])
#: two periods of one sample count, far enough from each other
PERIOD = 640
SLOW, FAST = 2 * np.pi / (PERIOD * STEP), 8 * np.pi / (PERIOD * STEP)


OPERATORS = {
    None: lambda: (None, None),
    "plays": lambda: (PrandtlIshlinskii(), PrandtlIshlinskii().identified(0.9).inverse()),
    "bouc_wen": lambda: (BoucWen(), BoucWen().inverse()),
}
SERVO = {"natural_frequency": W1, "damping": Z1, "delay": TAU, "stroke": 1.0, "moving_mass": 1.2}
SERVO |= {"force_constant": 30.0, "method": "foh"}


def make_stack(kind=None, lag=0.0, step=STEP, stroke=STROKE):
    forward, inverse = OPERATORS[kind]()
    return Stack(stroke=stroke, amplifier_lag=lag, hysteresis=forward, inverse=inverse, step=step, method="foh")


def make_drive(stack=None, *, ratio=0.1, feedback=False, step=STEP, tool_damping=Z2, **options):
    stack = stack or make_stack(step=step)
    piezo = Piezo(stack, W2, tool_damping, mass_ratio=ratio, full_voltage=100.0, feedback=feedback)
    return ToolDrive(piezo=piezo, step=step, **{**SERVO, **options})


def drive(machine, command, set_point, noise=None, lengths=None):
    """Rows: carriage, its velocity, current, measured, extension, its velocity, voltage."""
    noise = np.zeros_like(command) if noise is None else noise

    def block(first, command, set_point, noise, *motion):
        move(machine.table, first, command, set_point, noise, np.empty(0), motion)

    return run(block, 7, command, set_point, noise, lengths=lengths)


def sine(frequency, size, periods=20):
    return size * np.sin(frequency * np.arange(periods * PERIOD) * STEP)


# --- response


def series(frequency, ratio):
    """Two masses by their equations in p, written down elsewhere."""
    carriage = {"carriage_natural_frequency": W1, "carriage_damping": Z1}
    return in_series(frequency, natural_frequency=W2, damping=Z2, mass_ratio=ratio, **carriage)


@pytest.mark.parametrize("ratio", [0.0, 0.1, 0.5])
def test_response_is_that_of_two_masses(ratio):
    assert_allclose(make_drive(ratio=ratio).fine_response(TABLE), series(TABLE, ratio), rtol=3e-4)


@pytest.mark.parametrize(
    ("ratio", "damping", "printed", "within"),
    [
        (0.1, 0.299, [0.039, 0.101, 0.133, 0.150], 2.2e-3),
        # The spec's other row is 2-3 % below that of its ζ = 0.299; with the ζ of that row both have all its digits.
        (0.1, 0.292, [0.039, 0.101, 0.133, 0.150], 6e-4),
        (0.0, 0.292, [0.020, 0.040, 0.061, 0.083], 6e-4),
    ],
)
def test_rows_of_the_spec(ratio, damping, printed, within):
    """spec/learning.md: |1 - Wpk| with m/M = 0.1, and the row without a coupling."""
    left = np.abs(1 - make_drive(ratio=ratio, tool_damping=damping).fine_response(TABLE))
    assert_allclose(left, printed, atol=within)


@pytest.mark.parametrize("lag", [0.0, 40e-6])
@pytest.mark.parametrize("feedback", [False, True])
def test_tool_and_carriage_answer_as_their_responses_say(feedback, lag):
    """Both answer at the command's frequency and at the set point's; with feedback the piezo does to both."""
    command, set_point = sine(SLOW, 4e-6), sine(FAST, 4e-6)
    machine = make_drive(make_stack(lag=lag), feedback=feedback)
    motion = drive(machine, command, set_point)
    carriage, tool = motion[0], motion[0] + motion[4]
    assert_allclose(amplitude(carriage, SLOW, PERIOD, STEP), 4e-6 * machine.coarse_response(SLOW), rtol=1e-8)
    assert_allclose(amplitude(tool, FAST, PERIOD, STEP), 4e-6 * machine.fine_response(FAST), rtol=1e-8)


def test_foh_is_exact_for_inputs_linear_between_samples():
    random = np.random.default_rng(1)
    command, set_point = random.normal(size=(2, 300)) * [[1e-3], [4e-6]]
    set_point = set_point.clip(-STROKE, STROKE)
    ratio, part = 0.3, 5 / 8
    motion = drive(make_drive(ratio=ratio, delay=(23 + part) * STEP), command, set_point)
    # States: carriage, its velocity, extension, its velocity, with the sum of forces on each mass.
    servo, tool = np.array([-(W1**2), -2 * Z1 * W1]), np.array([-(W2**2), -2 * Z2 * W2])
    a = np.zeros((4, 4))
    a[0, 1] = a[2, 3] = 1.0
    a[1, :2], a[1, 2:] = servo, -ratio * tool
    a[3, :2], a[3, 2:] = -servo, (1 + ratio) * tool
    b = np.zeros((4, 2))
    b[1], b[3] = [W1**2, -ratio * W2**2], [-(W1**2), (1 + ratio) * W2**2]
    fine = np.arange(-8, 300 * 8) / 8
    inputs = [
        np.interp(fine - late, np.arange(-1, 300), np.append(0.0, signal), left=0.0)
        for signal, late in ((command, 23 + part), (set_point, 0.0))
    ]
    _, _, states = lsim((a, b, np.eye(4), np.zeros((4, 2))), np.stack(inputs, axis=1), (fine + 1) * STEP)
    found = motion[[0, 1, 4, 5]]
    assert_allclose(found, states[8::8].T, atol=1e-9, rtol=1e-9)
    assert_allclose(found[2], states[8::8, 2], atol=1e-9 * STROKE, rtol=1e-7)


# --- limits


def test_without_mass_the_carriage_is_the_coarse_drive():
    command = np.random.default_rng(2).normal(scale=1e-3, size=3000).cumsum() / 10
    set_point = 0.5 * STROKE * np.sin(np.arange(3000) / 20)
    alone = np.empty((3, 3000))
    ElectrodynamicDrive(**SERVO, step=STEP).block(command, *alone)
    assert_allclose(drive(make_drive(ratio=0.0), command, set_point)[:3], alone, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", OPERATORS)
def test_without_mass_the_extension_is_the_fine_drive(kind):
    set_point = 0.9 * STROKE * np.sin(np.arange(3000) / 20)
    fine = PiezoDrive(make_stack(kind), natural_frequency=W2, damping=Z2, full_voltage=100.0, step=STEP, method="foh")
    alone = np.empty((3, 3000))
    fine.block(set_point, *alone)
    motion = drive(make_drive(make_stack(kind), ratio=0.0), np.zeros(3000), set_point)
    assert_allclose(motion[4:], alone, rtol=1e-9, atol=1e-9 * STROKE)
    assert_allclose(motion[0], 0.0, atol=1e-20)


def test_end_stop_holds_the_carriage_and_lets_the_tool_swing():
    command = np.where(np.arange(6400) < 3200, 3e-3, -0.5e-3)
    carriage, velocity, _, _, extension, rate, _ = drive(make_drive(stroke=1e-3), command, np.zeros(6400))
    at_stop = carriage == 1e-3
    assert carriage.max() == 1e-3
    assert np.all(velocity[at_stop] <= 0.0)
    arrived, left = np.flatnonzero(at_stop)[[0, -1]]
    assert np.all(at_stop[arrived : left + 1])
    assert 3200 < left < 3300
    # The carriage stops dead; the tool keeps its speed and throws the piezo out by nearly that speed over ω2.
    before = velocity[arrived - 1]
    assert before + rate[arrived - 1] == pytest.approx(rate[arrived], rel=0.05)
    swing = extension[arrived : arrived + 40].max()
    assert swing == pytest.approx(before / W2 * np.exp(-Z2 * np.arccos(Z2) / np.sqrt(1 - Z2**2)), rel=0.05)


# --- direct compensation


@pytest.mark.parametrize("kind", OPERATORS)
@pytest.mark.parametrize("lag", [0.0, 40e-6])
@pytest.mark.parametrize("resolution", [0.0, 2e-9])
def test_feedback_takes_off_the_position_of_the_same_sample(kind, lag, resolution):
    """The set point that it must have had, given to the same drive without feedback, moves it in the same way."""
    random = np.random.default_rng(3)
    command, noise = sine(SLOW, 1e-4), random.normal(scale=1e-8, size=20 * PERIOD)
    reference = make_drive(ratio=0.0).coarse_response(SLOW)
    wanted = np.imag(1e-4 * reference * np.exp(1j * SLOW * np.arange(20 * PERIOD) * STEP)) + sine(FAST, 5e-6)
    made = make_drive(make_stack(kind, lag), feedback=True, resolution=resolution)
    closed = drive(made, command, wanted, noise)
    again = drive(make_drive(make_stack(kind, lag), resolution=resolution), command, wanted - closed[3], noise)
    assert_allclose(again[[0, 4]], closed[[0, 4]], atol=1e-15)
    assert_allclose(again[6], closed[6], atol=1e-8)
    read = closed[0] + noise
    if resolution:
        assert np.abs(closed[3] - read).max() <= resolution / 2 * (1 + 1e-6)
    else:
        assert np.array_equal(closed[3], read)


def test_feedback_without_a_delay_leaves_the_formula():
    """Tool over reference from the two-mass equations in p: with e = r - x1, x2 = Wpk·e and x1 = G·e."""
    machine = make_drive(feedback=True)
    p = 1j * TABLE
    tool = series(TABLE, 0.1)
    reaction = -0.1 * p**2 / (p**2 + 2 * Z1 * W1 * p + W1**2) * tool
    assert_allclose(machine.fine_response(TABLE), tool / (1 + reaction), rtol=3e-4)
    wi = make_drive().coarse_response(TABLE)
    assert_allclose(machine.coarse_response(TABLE), wi / (1 + reaction), rtol=3e-4)


def test_feedback_that_would_oscillate_is_refused():
    """A loose servo and a slow amplifier; simulated in spite of the refusal, the same drive swings itself up."""
    options = {"damping": 0.005, "tool_damping": 0.005}
    assert_refused(
        lambda: make_drive(make_stack(lag=1e-3), feedback=True, **options),
        r"oscillates over the carriage with m/M = 0.1: largest pole 1\.0",
    )
    machine, still = make_drive(make_stack(lag=1e-3, stroke=1.0), **options), np.zeros(1)
    late, size = np.zeros(1), np.empty(30_000)
    for first in range(size.size):
        motion = np.empty((7, 1))
        move(machine.table, first, np.full(1, 1e-6 * (first < 100)), -late, still, np.empty(0), tuple(motion))
        late, size[first] = motion[0], abs(motion[0, 0])
    assert size[-6400:].max() > 1.5 * size[6400:12_800].max()


def test_step_too_coarse_for_the_feedback_is_refused():
    coarse = 1 / 4000
    assert_refused(
        lambda: make_drive(make_stack("bouc_wen", step=coarse), ratio=1.0, feedback=True, step=coarse),
        r"moves the carriage by 0\.721 of itself within a sample; allowed: below 0.5",
    )


@given(cuts, st.sampled_from(list(OPERATORS)), st.booleans(), st.floats(0.0, 1e-3))
def test_cuts_change_nothing(lengths, kind, feedback, delay):
    random = np.random.default_rng(4)
    command, set_point, noise = random.normal(size=(3, sum(lengths))) * [[2e-3], [STROKE], [1e-8]]
    options = {"feedback": feedback, "delay": delay, "stroke": 1e-4, "resolution": 1e-9}
    whole, cut = (make_drive(make_stack(kind, 40e-6), **options) for _ in range(2))
    assert np.array_equal(drive(cut, command, set_point, noise, lengths), drive(whole, command, set_point, noise))


# --- stage

DIRECT = {"fine_use_command": False, "fine_use_reference": True, "fine_compensates": ["coarse"]}


def stage(name="series_drive", **values):
    return SeriesDriveStage(name, SeriesDriveParameters.read(name, values))


def advance(made, *inputs):
    """States of carriage and piezo from the inputs' arrays."""
    states = [messages.allocate(port.type, inputs[0].size) for port in made.outputs]
    given_to = [{port.fields[0]: np.ascontiguousarray(array)} for port, array in zip(made.inputs, inputs, strict=True)]
    made.advance(0, given_to, states)
    return states


def test_table_has_the_parameters_of_both_drives():
    shared = {*NodeParameters.rows(), "discretisation"}
    rows = SeriesDriveParameters.rows()
    expected = dict.fromkeys((*shared, "mass_ratio"))
    for prefix, table in (("coarse_", ElectrodynamicActuatorParameters), ("fine_", PiezoActuatorParameters)):
        expected |= {prefix + name: row for name, row in table.rows().items() if name not in shared}
    assert set(rows) == set(expected)
    for name, row in expected.items():
        if row is not None:
            assert (rows[name].default, rows[name].unit, rows[name].allowed()) == (row.default, row.unit, row.allowed())
            assert rows[name].doc == row.doc or name == "coarse_moving_mass"


def test_values_reach_the_tables_of_the_drives():
    values = {"seed": 3, "coarse_damping": 0.7, "fine_damping": 0.1, "discretisation": "tustin"}
    table = SeriesDriveParameters.read("node", values)
    for part, damping in ((table.coarse, 0.7), (table.fine, 0.1)):
        assert (part.damping, part.seed, part.discretisation) == (damping, 3, "tustin")


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({}, ["coarse/command", "fine/command"]),
        ({**DIRECT, "fine_compensates": ["vibration", "coarse"]}, ["coarse/command", "reference", "vibration/state"]),
    ],
)
def test_stage_reads_what_it_is_asked_for(values, expected):
    made = stage(**values)
    assert [(port.topic, port.delay) for port in made.inputs] == [(topic, 0) for topic in expected]
    assert [port.topic for port in made.outputs] == ["coarse/state", "fine/state"]
    compile_kernels(made)


def test_stage_without_mass_is_the_two_stages():
    """Both commands; of the piezo's extension only what the carriage's acceleration bends is left between them."""
    command = np.random.default_rng(5).normal(scale=1e-5, size=2000).cumsum()
    learned = 0.8 * STROKE * np.sin(np.arange(2000) / 30)
    made = stage(mass_ratio=0.0, coarse_stroke=2e-3)
    assert set(made.responses()) == {"coarse/command", "fine/command"}
    assert made.limits()["coarse/state"].stroke == 2e-3
    coarse, fine = advance(made, command, learned)
    still = advance(stage(mass_ratio=0.0), command, np.zeros(2000))[1]
    alone = messages.allocate(messages.STATE, 2000)
    actuator = ElectrodynamicActuator("electrodynamic_actuator", ElectrodynamicActuatorParameters())
    actuator.process(0, [{"position": command}], [alone])
    for field, expected in alone.items():
        assert_allclose(coarse[field], expected, rtol=1e-9, atol=1e-12)
    piezo = PiezoActuator("piezo_actuator", PiezoActuatorParameters())
    piezo.process(0, [{"position": learned}], [alone])
    assert_allclose(fine["position"] - still["position"], alone["position"], atol=1e-9 * STROKE)
    assert_allclose(fine["effort"], alone["effort"], rtol=1e-9, atol=1e-9)


def test_sensors_measure_each_with_its_own_noise():
    made = stage(coarse_noise_rms=1e-8, fine_noise_rms=1e-8, fine_resolution=1e-9, coarse_resolution=1e-9)
    states = advance(made, np.zeros(20_000), np.zeros(20_000))
    noises = [state["measured_position"] - state["position"] for state in states]
    assert_allclose([noise.std() for noise in noises], 1e-8, rtol=0.03)
    assert abs(np.corrcoef(noises)[0, 1]) < 0.03
    assert_allclose(noises, 1e-9 * np.rint(np.divide(noises, 1e-9)), atol=1e-15)


def test_direct_compensation_in_the_stage():
    """δ1 = Xd - X1 is the piezo's set point: with little to bend it, the tool follows the reference."""
    machine = stage(**DIRECT)
    command = sine(SLOW, 100e-6)
    reference = np.imag(100e-6 * make_drive().coarse_response(SLOW) * np.exp(1j * SLOW * np.arange(12_800) * STEP))
    reference += sine(FAST, 3e-6)
    coarse, fine = advance(machine, command, reference)
    error = reference - coarse["position"] - fine["position"]
    left = amplitude(error, FAST, PERIOD, STEP) / 3e-6
    assert_allclose(left, 1 - machine.drive.fine_response(FAST), rtol=1e-3)
    assert np.array_equal(coarse["measured_position"], coarse["position"])
