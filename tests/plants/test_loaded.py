# SPDX-License-Identifier: Apache-2.0
"""Drives and cut as one mechanical system: limits to the bit, balances, stiffness, chatter, the current loop."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from cells import scenario
from numpy.testing import assert_allclose

from lathe_machine.analysis.regeneration import Regeneration
from lathe_machine.plants.coil import Coil
from lathe_machine.plants.cutting import CuttingProcess
from lathe_machine.plants.cutting_force import RIGID, SpecificForce
from lathe_machine.plants.piezo import Stack
from lathe_machine.plants.tool_drive import Piezo, ToolDrive
from lathe_machine.plants.workpiece import Workpiece
from lathe_machine.transfer import TransferFunction
from lathe_papers.formulas.loaded import compliance, compliance_in_series
from lathe_rc import harness
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import LatheError

STEP = 1 / 64000
SPEED = 100.0  # [rad/s]
SERVO = {"natural_frequency": 1038.0, "damping": 0.804, "moving_mass": 1.2}
STACK = {"tool_frequency": 14600.0, "tool_damping": 0.299, "mass_ratio": 0.1}
COIL = Coil(resistance=2.0, inductance=2e-3, bandwidth=12e3)
FORCE_CONSTANT = 30.0
DELAY = 23 * STEP  # whole samples: what the servo follows is linear from sample to sample


def loaded(*, series=False, coil=None, radial=0.4, step=STEP, servo=None, stack=None, **piezo):
    fine = Piezo(
        Stack(stroke=15e-6, step=step, method="foh"), *{**STACK, **(stack or {})}.values(), full_voltage=100.0, **piezo
    )
    return ToolDrive(
        **{"stroke": 1e-3, **SERVO, **(servo or {})},
        delay=DELAY,
        force_constant=FORCE_CONSTANT,
        radial=radial,
        coil=coil,
        piezo=fine if series else None,
        step=step,
        method="foh",
        kept=8192,
    )


def cutting(stiffness=300e3, depth=0.3e-3, lag=2e-3, step=STEP, **options):
    """A cut whose K is ``stiffness`` at a feed of 1 mm."""
    return CuttingProcess(
        material=SpecificForce(kc1=stiffness / 1e-3), depth=depth, lag=lag, elasticity=RIGID, step=step, **options
    )


def turning(samples, step=STEP, speed=SPEED, **given):
    """The inputs of a block, at constant speed and a feed of 1 mm."""
    rate = np.full(samples, speed)
    found = {"command": np.zeros(samples), "angle": rate * step * np.arange(samples), "speed": rate}
    return found | {"feed_velocity": 1e-3 * rate / (2 * np.pi)} | given


# --- limits, to the bit


FORM = {"harmonic_order": [2], "harmonic_amplitude": [50e-6]}
CUT = {"depth": 0.3e-3, "lag": 2e-3, "elasticity": "realistic", "gap_start": [1.0], "gap_width": [0.4]}
CUT |= {"run_out_order": [1], "run_out_amplitude": [5e-6], "regeneration": 0.5}


def cell(*drives, **nodes):
    """A cell with these nodes and no other drive than them."""
    whole = scenario(profile=FORM, tool={"reference": "topic", "drives": list(drives)}, **nodes).nodes
    kept = {name: table for name, table in whole.items() if name in nodes or name != "electrodynamic_actuator"}
    return Scenario("test", kept)


def together(**values):
    """A drive and its cut as one node."""
    cut = {f"cut_{name}": value for name, value in CUT.items()}
    return cell("coarse", loaded_drive={**cut, **values})


FINE = {"fine_use_command": False, "fine_use_reference": True}


@pytest.mark.parametrize(
    ("one", "drive", "values"),
    [
        ("loaded_drive", "electrodynamic_actuator", {}),
        ("loaded_series_drive", "series_drive", FINE),
        pytest.param(
            "loaded_series_drive", "series_drive", {**FINE, "fine_compensates": ["coarse"]}, marks=pytest.mark.system
        ),
    ],
)
def test_without_a_force_on_them_drives_and_their_cut_are_those_of_two_nodes(one, drive, values):
    drives = ("coarse", "fine") if values else ("coarse",)
    cut = {f"cut_{name}": value for name, value in CUT.items()}
    apart = harness.run(cell(*drives, cutting_process={"moved_by": ["tool"], **CUT}, **{drive: values})).digest
    joined = harness.run(cell(*drives, **{one: {**cut, "radial_ratio": 0.0, **values}})).digest
    topics = ["/cut", "/tool", "/coarse/command", *(f"/{drive}/state" for drive in drives)]
    assert [joined[topic] for topic in topics] == [apart[topic] for topic in topics]


def test_a_mass_that_nothing_moves_is_a_rigid_drive():
    """The force moves it by less than the last bit of the chip; what the coil would need for it is another matter."""
    runs = [harness.run(together(radial_ratio=radial, coarse_moving_mass=1e30)) for radial in (0.0, 0.4)]
    assert runs[0].digest["/cut"] == runs[1].digest["/cut"]
    forms = [run.recording.dense["/tool"]["displacement"] for run in runs]
    assert_allclose(forms[0], forms[1], rtol=0.0, atol=1e-30)


# --- balances of momentum and energy

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)
_NODES, _WEIGHTS = (_NODES[:, None] + 1) / 2, _WEIGHTS / 2  # of the unit interval


def within(left, right, step):
    """A quantity and its rate within each step, shape (6, n), by value, rate and curvature at both ends of each."""
    basis = [
        np.polynomial.Polynomial(each)
        for each in (
            [1, 0, 0, -10, 15, -6], [0, 1, 0, -6, 8, -3], [0, 0, 0.5, -1.5, 1.5, -0.5],
            [0, 0, 0, 10, -15, 6], [0, 0, 0, -4, 7, -3], [0, 0, 0, 0.5, -1, 0.5],
        )
    ]  # fmt: skip
    values = [each * step**order for ends in (left, right) for order, each in enumerate(ends)]
    value = sum(each(_NODES) * known for each, known in zip(basis, values, strict=True))
    return value, sum(each.deriv()(_NODES) * known for each, known in zip(basis, values, strict=True)) / step


def moving(*derivatives, step):
    """The same of what has no jump in its curvature."""
    return within([each[:-1] for each in derivatives], [each[1:] for each in derivatives], step)


def linear(signal):
    return signal[:-1] + _NODES * np.diff(signal)


def balanced(gained, powers, step):
    """Whether what is gained is the integral of all that brings it, to a billionth of what goes through."""
    integral = step * float(_WEIGHTS @ sum(powers).sum(axis=1))
    through = step * float(_WEIGHTS @ sum(map(np.abs, powers)).sum(axis=1))
    return abs(gained - integral) < 1e-9 * through


def run_with_a_keyway(machine, step, samples=12_000, **given):
    """A form out of a round blank with a keyway: command, what is made, and the radial force."""
    time = step * np.arange(samples)
    command = 100e-6 * np.sin(2 * SPEED * time) * np.minimum(time / 5e-3, 1.0)
    process = cutting(step=step, lag=0.5e-3, part=Workpiece(gaps=[(0.5, 0.5)]))
    made = machine.block(process, 0, turning(samples, step, command=command, **given))
    assert made["depth_of_cut"].min() == 0.0 < made["depth_of_cut"].max()  # it has been through the keyway
    late = round(DELAY / step)
    return np.concatenate((np.zeros(late), command[:-late])), made, 0.4 * made["force"]


def test_momentum_and_energy_of_the_electrodynamic_drive_and_the_cut_are_in_balance():
    mass, w, zeta = SERVO["moving_mass"], SERVO["natural_frequency"], SERVO["damping"]
    late, made, pushes = run_with_a_keyway(loaded(), STEP)
    x, v = made["position"], made["velocity"]
    position, velocity = moving(x, v, w**2 * (late - x) - 2 * zeta * w * v + pushes / mass, step=STEP)
    servo = mass * (w**2 * (linear(late) - position) - 2 * zeta * w * velocity)
    forces = [servo, linear(pushes)]
    assert balanced(mass * (v[-1] - v[0]), forces, STEP)
    assert balanced(0.5 * mass * (v[-1] ** 2 - v[0] ** 2), [force * velocity for force in forces], STEP)
    # What the drive feels is what the chip makes: the force is that of the chip that the published position leaves.
    chip = np.maximum(0.3e-3 - x, 0.0)
    cuts = made["depth_of_cut"] > 0.0
    assert_allclose(made["depth_of_cut"][cuts], chip[cuts], rtol=0, atol=1e-16)


def test_momentum_and_energy_of_drives_in_series_and_the_cut_are_in_balance():
    step, w1, z1 = STEP / 4, SERVO["natural_frequency"], SERVO["damping"]
    w2, z2, mass = STACK["tool_frequency"], STACK["tool_damping"], SERVO["moving_mass"]
    tool = STACK["mass_ratio"] * mass
    time = step * np.arange(48_000)
    e = 5e-6 * np.sin(3000.0 * time)
    late, made, pushes = run_with_a_keyway(loaded(series=True, step=step), step, 48_000, set_point=e)
    x1, v1 = made["position"], made["velocity"]
    x2, v2 = x1 + made["extension"], v1 + made["extension_velocity"]
    q = w2**2 * (e - x2 + x1) - 2 * z2 * w2 * (v2 - v1)
    carriage, v_1 = moving(x1, v1, w1**2 * (late - x1) - 2 * z1 * w1 * v1 - 0.1 * q, step=step)
    position, v_2 = moving(x2, v2, q + pushes / tool, step=step)
    servo = mass * (w1**2 * (linear(late) - carriage) - 2 * z1 * w1 * v_1)
    stack = tool * (w2**2 * (linear(e) - position + carriage) - 2 * z2 * w2 * (v_2 - v_1))
    force = linear(pushes)
    assert balanced(tool * (v2[-1] - v2[0]), [stack, force], step)
    assert balanced(mass * (v1[-1] - v1[0]) + tool * (v2[-1] - v2[0]), [servo, force], step)
    energy = 0.5 * mass * v1**2 + 0.5 * tool * v2**2
    assert balanced(energy[-1] - energy[0], [servo * v_1, stack * (v_2 - v_1), force * v_2], step)


def test_momentum_and_energy_of_coil_drive_and_cut_are_in_balance():
    """From the winding to the chip: the voltage is what stands through a step, no larger than its limit."""
    mass, coil = SERVO["moving_mass"], replace(COIL, voltage_limit=2.0)
    _, made, pushes = run_with_a_keyway(loaded(coil=coil), STEP)
    x, v, i = made["position"], made["velocity"], made["current"]
    _, velocity = moving(x, v, (FORCE_CONSTANT * i + pushes) / mass, step=STEP)
    charge = (mass * np.diff(v) - STEP * (pushes[1:] + pushes[:-1]) / 2) / FORCE_CONSTANT
    voltage = (coil.inductance * np.diff(i) + coil.resistance * charge + FORCE_CONSTANT * np.diff(x)) / STEP
    assert np.abs(voltage).max() == pytest.approx(2.0, rel=1e-6)
    assert np.mean(np.abs(voltage) > 1.999) > 0.01

    def ends(n, u):
        rate = (u - coil.resistance * i[n] - FORCE_CONSTANT * v[n]) / coil.inductance
        acceleration = (FORCE_CONSTANT * i[n] + pushes[n]) / mass
        return i[n], rate, -(coil.resistance * rate + FORCE_CONSTANT * acceleration) / coil.inductance

    before, after = slice(None, -1), slice(1, None)
    current, _ = within(ends(before, voltage), ends(after, voltage), STEP)
    forces = [FORCE_CONSTANT * current, linear(pushes)]
    assert balanced(mass * (v[-1] - v[0]), forces, STEP)
    energy = 0.5 * mass * v**2 + 0.5 * coil.inductance * i**2
    powers = [voltage * current, -coil.resistance * current**2, linear(pushes) * velocity]
    assert balanced(energy[-1] - energy[0], powers, STEP)


# --- stiffness and chatter


def steady(machine, frequency, **cut):
    """Tool over radial force [m/N] at a frequency: the blank waves, and the drive gives way."""
    period = round(2 * np.pi / frequency / STEP)
    time = STEP * np.arange(40 * period)
    wave = 20e-6 * np.sin(2 * np.pi / (period * STEP) * time)
    made = machine.block(cutting(lag=0.0, **cut), 0, turning(time.size, allowance=wave))
    kernel = np.exp(-2j * np.pi * np.arange(20 * period) / period)
    moved, force = ((made["position"] + made["extension"])[-kernel.size :], 0.4 * made["force"][-kernel.size :])
    return (moved @ kernel) / (force @ kernel), 2 * np.pi / (period * STEP)


MACHINES = {
    "alone": (loaded, lambda: compliance(**SERVO)),
    "coil": (lambda: loaded(coil=COIL), lambda: compliance(**SERVO, coil=COIL, force_constant=FORCE_CONSTANT)),
    "series": (lambda: loaded(series=True), lambda: compliance_in_series(**SERVO, **STACK)),
}


@pytest.mark.parametrize("name", MACHINES)
def test_static_stiffness_is_that_of_the_formula(name):
    """Deflection over radial force of a slow cut, to 1e-6."""
    make, formula = MACHINES[name]
    made = make().block(cutting(lag=0.0), 0, turning(8000))
    moved = made["position"][-1] + made["extension"][-1]
    assert moved / (0.4 * made["force"][-1]) == pytest.approx(float(formula().response(0.0).real), rel=1e-6)


@pytest.mark.parametrize("frequency", [300.0, 1000.0, 3000.0])
@pytest.mark.parametrize("name", MACHINES)
def test_dynamic_stiffness_is_that_of_the_formula(name, frequency):
    """Deflection over radial force of a sine, within 1 %."""
    make, formula = MACHINES[name]
    found, exact = steady(make(), frequency)
    assert abs(found / formula().response(exact) - 1.0) < 0.01


def chatter(machine, stiffness, period, samples, kick):
    """Motion of the tool [m] from a slow entry into the cut on, after which the blank kicks once."""
    step, still = machine.step, 1e-4
    engagement = round(0.125 / step)
    part = np.minimum(np.arange(samples + engagement) / engagement, 1.0)
    allowance = -still * (1 - part**3 * (10 - 15 * part + 6 * part**2))
    allowance[engagement : engagement + 20] += kick
    process = cutting(stiffness, still, lag=0.0, step=step, overlap=1.0)
    made = machine.block(process, 0, turning(allowance.size, step, speed=2 * np.pi / period, allowance=allowance))
    assert made["depth_of_cut"][engagement:].min() > 0.0
    return (made["position"] + made["extension"])[engagement:]


@pytest.mark.parametrize("factor", [0.99, 1.01])
@pytest.mark.parametrize("name", ["alone", "series"])
def test_the_cut_chatters_beyond_the_limit_of_the_drive_s_compliance(name, factor):
    """1 % below the limit a kick dies away, 1 % above it grows, as the characteristic root says."""
    servo, stack = {**SERVO, "damping": 0.1}, {**STACK, "tool_damping": 0.05}
    formula = compliance(**servo) if name == "alone" else compliance_in_series(**SERVO, **stack)
    top = tuple(0.4 * each for each in formula.numerator)
    cut = Regeneration(TransferFunction(top, formula.denominator))
    worst = cut.worst()
    period, stiffness = worst.period(1 if name == "alone" else 10), factor * worst.stiffness
    root = cut.root(stiffness, period, 1j * worst.frequency)
    step = STEP if name == "alone" else STEP / 4
    samples = round(2.5 / abs(root.real) / step)
    make = partial(loaded, series=name == "series", step=step, servo=servo if name == "alone" else None, stack=stack)
    kicked, quiet = (chatter(make(), stiffness, period, samples, kick) for kick in (1e-8, 0.0))
    third, changed = samples // 3, kicked - quiet
    ratio = np.std(changed[2 * third :]) / np.std(changed[third : 2 * third])
    assert np.sign(root.real) == np.sign(factor - 1.0)
    assert np.log(ratio) / (third * step) == pytest.approx(root.real, rel=0.1)


# --- the current loop, limits, refusals


def test_a_fast_current_loop_is_the_drive_of_the_papers():
    frequency = np.array([50.0, 200.0, 500.0, 1000.0])
    ideal, step = loaded(step=STEP / 8), STEP / 8
    fast = loaded(step=step, coil=replace(COIL, bandwidth=200e3))
    assert_allclose(fast.coarse_response(frequency), ideal.coarse_response(frequency), rtol=0.02)


@pytest.mark.parametrize("series", [False, True])
def test_a_response_is_that_of_a_run(series):
    machine = loaded(series=series, coil=COIL, radial=0.0)
    frequency, period = 2 * np.pi / (640 * STEP), 640
    command = 1e-5 * np.sin(frequency * STEP * np.arange(20 * period))
    position = machine.block(cutting(), 0, turning(command.size, command=command))["position"]
    kernel = np.exp(-1j * frequency * STEP * np.arange(period))
    found = (position[-period:] @ kernel) / (command[-period:] @ kernel)
    assert_allclose(found, machine.coarse_response(frequency), rtol=1e-6)


def test_current_and_its_slope_stay_within_their_limits():
    coil = replace(COIL, current_limit=0.5, slew_rate=400.0)
    command = np.repeat([0.0, 300e-6], 4000)
    made = loaded(coil=coil, radial=0.0).block(cutting(), 0, turning(8000, command=command))
    current = made["current"]
    assert 0.49 < np.abs(current).max() < 0.5 * 1.05  # the loop swings over its set point by a little
    assert 390.0 < np.abs(np.diff(current)).max() / STEP < 500.0
    free = loaded(coil=COIL, radial=0.0).block(cutting(), 0, turning(8000, command=command))
    assert np.abs(free["current"]).max() > 5.0


def test_an_end_stop_holds_the_drive_against_the_force():
    machine = loaded(servo={"stroke": 10e-6})
    made = machine.block(cutting(lag=0.0), 0, turning(4000))
    assert made["position"][-1] == 10e-6
    assert made["depth_of_cut"][-1] == pytest.approx(0.29e-3, rel=1e-12)


def test_a_stack_is_torn_off_its_preload():
    time = STEP * np.arange(4000)
    shaken = turning(4000, set_point=10e-6 * np.sin(9000.0 * time))  # 0.12 kg · 10 µm · (9000 rad/s)²: 97 N
    loaded(series=True, preload=300.0).block(cutting(), 0, shaken)
    with pytest.raises(LatheError, match="tears the stack off its preload"):
        loaded(series=True, preload=50.0).block(cutting(), 0, shaken)


def test_a_tool_breaks_as_in_a_cut_of_its_own():
    values = {"allow_faults": True, "faults": ["sample 8000: cut tool_broken length=0.2e-3"], "cut_gap_start": []}
    run = harness.run(together(**values, cut_gap_width=[], cut_regeneration=0.0)).recording.dense
    before, after = (run["/cut"]["force"][n] for n in (7900, 9500))
    assert after == pytest.approx(before / 3, rel=0.3)


@pytest.mark.system
def test_what_a_limited_coil_cannot_is_said():
    limits = {"coarse_loop": "current", "coarse_voltage_limit": 0.1, "cut_depth": 0.0}
    events = harness.run(together(**limits)).recording.sparse["/loaded_drive/events"]
    assert events.values["action"][0] == "limited: coil"
