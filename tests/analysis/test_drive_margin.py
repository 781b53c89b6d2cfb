# SPDX-License-Identifier: Apache-2.0
"""Drive margin of laws without a cycle, and of measured drives: what it promises happens in runs."""

import json
from typing import NamedTuple

import numpy as np
import pytest
from cells import assert_resimulated, config, form_error, scenario
from shown_page import ShownPage

from lathe_machine import Plant, PlantParameters
from lathe_machine.plants.linear import discretise, second_order
from lathe_rc import allowed_code, harness, kernel, parameter
from lathe_rc.analysis.frequency_response import FrequencyResponse, write_points
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError
from lathe_rc.view.report import write_report

WN, ZETA, TAU = 1038.0, 0.804, 0.36e-3
COMPOUND = {
    "stage": "compound_controller",
    "proportional": 1.9,
    "integral": 28.0,
    "derivative": 1.4e-4,
    "derivative_bandwidth": 19e3,
}
LAWS = {
    "compound": COMPOUND,
    "AFC": {"stage": "resonant_controller", "highest_order": 12, "rate": 18.0},
    "ADRC": {"stage": "lathe_papers.adrc:Adrc", "observer_bandwidth": 2000.0, "control_bandwidth": 1750.0},
}


CYCLES = {
    "lead": {"learning_gain": 0.7},
    "flat Q": {"q_filter": "fir", "q_pass": 1000.0, "q_stop": 2500.0, "learning_gain": 0.5},
    "inverse": {"correction": "second_order_inverse", "lead_time": TAU, "model_damping": 0.5},
    "disturbance": {
        "stage": "disturbance_controller",
        "identify": False,
        "follows_speed": False,
        "observer_bandwidth": 0.0,
        "learned_waves": 20.0,
        "model_natural_frequency": 800.0,
    },
}  #: repetitive laws that lose the margin at some wave


class WrongParameters(PlantParameters):
    frequency: float = parameter(1e3, "where the error is largest", "rad/s")
    size: float = parameter(0.0, "largest relative error")
    phase: float = parameter(1.0, "its phase there", "rad")


class State(NamedTuple):
    filters: np.ndarray  # of the error: b0, b1, b2, a1, a2 of a band pass and of an all-pass, shape (2, 5)
    past: np.ndarray  # shape (2, 2)
    transition: np.ndarray
    weights: np.ndarray
    state: np.ndarray
    line: np.ndarray
    place: np.ndarray  # of the next command, and the delay


@kernel
def move(m: State, command: float) -> tuple[float, float, float]:
    error = command
    for i in range(2):
        f, p = m.filters[i], m.past[i]
        out = f[0] * error + p[0]
        p[0] = f[1] * error - f[3] * out + p[1]
        p[1] = f[2] * error - f[4] * out
        error = out
    n = m.place[0]
    m.line[n % m.line.size] = command + error
    x, v = m.state[0], m.state[1]
    for i in range(2):
        m.state[i] = m.transition[i, 0] * x + m.transition[i, 1] * v
        for j in range(3):
            m.state[i] += m.weights[i, j] * m.line[(n - m.place[1] - j) % m.line.size]
    m.place[0] = n + 1
    return m.state[0], m.state[1], 0.0


class Wrong(Plant):
    """The papers' drive with the relative error Δ(p): of the size and phase at its frequency, smaller elsewhere."""

    Parameters = WrongParameters
    sample = staticmethod(move)

    def _plant(self):
        return discretise(*second_order(WN, ZETA), TAU, self.parameters.step, "foh")

    def _filters(self):
        parameters = self.parameters
        at = parameters.frequency * parameters.step
        narrow, square = 0.5 * np.sin(at), parameters.size / (1.0 + 0.5 * np.sin(at))
        band = [square * narrow, 0.0, -square * narrow, -2.0 * np.cos(at) / (1.0 + narrow)]
        band.append((1.0 - narrow) / (1.0 + narrow))
        # (c + 1/z)/(1 + c/z) turns by 0 to -π, and a sign does the rest.
        turn, sign = parameters.phase % (2.0 * np.pi) - 2.0 * np.pi, 1.0
        if turn < -np.pi:
            turn, sign = turn + np.pi, -1.0
        c = np.sin((at + turn) / 2.0) / np.sin((at - turn) / 2.0)
        return np.array([band, [sign * c, sign, 0.0, c, 0.0]])

    def start(self):
        plant = self._plant()
        line, place = np.zeros(1024), np.array([0, plant.delay])
        return State(self._filters(), np.zeros((2, 2)), plant.transition, plant.weights, np.zeros(2), line, place)

    def response(self, frequency):
        back = np.exp(-1j * frequency * self.parameters.step)
        error = 1.0
        for b0, b1, b2, a1, a2 in self._filters():
            error = error * (b0 + b1 * back + b2 * back**2) / (1.0 + a1 * back + a2 * back**2)
        return self._plant().response(frequency) * (1.0 + error)


def cell(law, revolutions=40.0, order=2, **error):
    allowed_code.allow_named("test_drive_margin:Wrong")
    allowed_code.allow_named("lathe_papers.adrc:Adrc")
    free = {"stroke": 1e6, "max_velocity": 1e9, "max_acceleration": 1e12}
    return scenario(
        {"block_size": 16},
        spindle_encoder={"revolutions": revolutions},
        learning_controller={"allow_unstable": True, "stop_ratio": 0.0, "feedback_delay": 16, **law},
        electrodynamic_actuator={"stage": "test_drive_margin:Wrong", **free, **error},
        tool={"profile": "harmonics", "harmonic_order": [order], "harmonic_amplitude": [1e-6]},
    )


def worst_error(law):
    """The margin of a law, and the error of its size with the worst phase."""
    checked = Cell(cell(law).nodes)
    checked.check()
    margin = checked.drive_margins["learning_controller"]
    frequency, stage = margin.waves * margin.speed, checked.stages["learning_controller"]
    response = checked.stages["electrodynamic_actuator"].response
    own, fed = stage.characteristic(response, np.array([frequency]), margin.speed)
    delta = (-(own + fed) / fed)[0]
    assert abs(delta) == pytest.approx(margin.error, rel=1e-4)
    return margin.error, {"frequency": frequency, "phase": float(np.angle(delta))}


@pytest.mark.parametrize("law", CYCLES)
def test_an_error_above_the_margin_of_a_repetitive_law_diverges_in_a_run_and_a_smaller_one_does_not(law):
    """Each repetitive law, at the wave with the least margin that goes on from revolution to revolution."""
    checked = Cell(cell(CYCLES[law]).nodes)
    speed, stage = 1000 * np.pi / 30, checked.stages["learning_controller"]
    response, waves = checked.stages["electrodynamic_actuator"].response, np.linspace(1.0, 13.0, 12001)
    margins, factors = stage.smallest_errors(response, waves, speed), stage.factors(response, waves, speed)[-1]
    # A wave w is one of the loop where its factor has the phase 2πw.
    beyond = np.angle(factors * np.exp(-2j * np.pi * waves))
    own = np.flatnonzero((np.diff(np.sign(beyond)) != 0) & (np.abs(beyond[1:]) < 1.0))
    place = own[np.argmin(margins[own])]
    margin, wave = margins[place], waves[place]
    assert 0.05 < margin < 0.95

    def largest(phase):
        error = margin * np.exp(1j * phase)
        return np.abs(stage.factors(lambda w: (1.0 + error) * response(w), np.array([wave]), speed)).max()

    error = {"frequency": wave * speed, "phase": max(np.linspace(-np.pi, np.pi, 1441).tolist(), key=largest)}
    growth = []
    for part in (1.03, 0.97):
        found = harness.run(cell(CYCLES[law], 60.0, order=round(wave), size=part * margin, **error))
        changes = np.std(np.diff(form_error(found)[: 60 * 3840].reshape(60, -1), axis=0), axis=1)
        growth.append((changes[58] / changes[38]) ** (1 / 20))
    assert 1.03 > growth[0] > 1.002
    assert 0.97 < growth[1] < 0.998


@pytest.mark.parametrize("law", LAWS)
def test_an_error_above_the_margin_of_a_feedback_law_diverges_in_a_run_and_a_smaller_one_does_not(law):
    """The smallest error found, 3 % larger and 3 % smaller, in runs; the margin of the drive in error is 0, or not."""
    margin, error = worst_error(LAWS[law])
    assert 0.05 < margin < 0.95
    above, below = (harness.run(cell(LAWS[law], 120.0, size=part * margin, **error)) for part in (1.03, 0.97))
    assert above.drive_margins["learning_controller"].error == 0.0
    assert 0.0 < below.drive_margins["learning_controller"].error < 0.04
    rms = [found.errors.rms for found in (above, below)]
    assert rms[0][119] > 1.05 * rms[0][100] > 1.1 * rms[0][80]
    assert rms[1][119] < 1.001 * rms[1][100] < 1.002 * rms[1][80]


# --- measured drives

HZ = np.linspace(1.0, 4000.0, 2000)
RESONANCE = 5655.0  # [rad/s], unknown to the model
FILE = "electrodynamic_actuator.response_file"


def measured(path, size):
    """The papers' drive with a resonance that adds ``size`` times its response, in the file of ``lathe fit drive``."""
    p, plant = 2j * np.pi * HZ, discretise(*second_order(WN, ZETA), TAU, 1 / 64_000, "foh")
    own = 0.04 * RESONANCE * p
    value = plant.response(p.imag) * (1.0 + size * own / (p * p + own + RESONANCE**2))
    write_points(path, FrequencyResponse(p.imag, value), np.full(HZ.size, 1e-3), "a test")
    return value


def cell_of(law, file=""):
    return scenario({"block_size": 16}, learning_controller=law, electrodynamic_actuator={"response_file": file})


def checked(*changes):
    found = Cell(config("piston", *changes).nodes)
    found.check()
    return found


@pytest.mark.parametrize("size", [0.0, 2.0])
def test_margin_is_that_of_the_measured_points_where_they_leave_less(tmp_path, size):
    """An error of the margin, in the worst phase, brings the factor of a cycle to 1 at its point, and at no other."""
    value = measured(tmp_path / "points.csv", size)
    model = checked().drive_margins["learning_controller"]
    cell = checked(f"{FILE}={tmp_path / 'points.csv'}")
    found, stage = cell.drive_margins["learning_controller"], cell.stages["learning_controller"]
    frequency, speeds = 2.0 * np.pi * HZ, cell.loops["learning_controller"][0].speeds
    q_z = [stage.factors(lambda _: value, frequency / speed, speed)[0] for speed in speeds]
    q = [stage.factors(lambda _: 0.0 * value, frequency / speed, speed)[0] for speed in speeds]
    each = np.array([(1.0 - abs(whole)) / abs(own - whole) for whole, own in zip(q_z, q, strict=True)])
    if size:
        assert found.error < 0.1 * model.error
        assert found.error == pytest.approx(each.min(), rel=1e-9)
        assert found.waves * found.speed == pytest.approx(frequency[each.argmin() % HZ.size])
    else:
        assert found == model
        assert each.min() == pytest.approx(model.error, rel=1e-3)


def test_measured_drive_with_which_the_loop_diverges_is_refused_with_a_cure(tmp_path):
    measured(tmp_path / "points.csv", 4.0)
    given = f"{FILE}={tmp_path / 'points.csv'}"
    with pytest.raises(InputError, match=r"diverges with electrodynamic_actuator as measured: .*49") as refusal:
        checked(given)
    checked(given, str(refusal.value).partition("allowed: below 1 (")[2].partition(";")[0].replace(" ", ""))
    compound = [{"stop_ratio": 0.0, "feedback_delay": 16, **COMPOUND}, given.partition("=")[2]]
    Cell(cell_of(*compound).nodes).check()
    measured(tmp_path / "points.csv", -40.0)
    with pytest.raises(InputError, match=r"as measured is unstable at .*: a stable one \(smaller gains of its PID"):
        Cell(cell_of(*compound).nodes).check()


@pytest.mark.usefixtures("no_pictures")
def test_bag_holds_the_measured_points_for_a_resimulation(tmp_path):
    """Whatever the name of the file, whose content alone is in the bag; its loop is that of the report's figure."""
    measured(tmp_path / "points.txt", 2.0)
    given = config("piston", f"{FILE}={tmp_path / 'points.txt'}", "spindle_encoder.revolutions=2")
    result = harness.run(given, bag=tmp_path / "bag")
    (tmp_path / "points.txt").unlink()
    assert_resimulated(tmp_path / "bag")
    write_report(tmp_path / "bag", tmp_path / "page.html")
    page = ShownPage((tmp_path / "page.html").read_text(encoding="utf-8"))
    assert f"margin {result.drive_margins['learning_controller']}" in str(page.specs)


def test_a_loop_without_feedback_has_no_limit_in_json():
    off = {"proportional": 0.0, "integral": 0.0, "derivative": 0.0}
    result = harness.run(cell_of({**COMPOUND, **off, "feedback_delay": 16}))
    assert result.drive_margins["learning_controller"].error == np.inf
    assert json.loads(json.dumps(result.summary()))["drive_margin"]["learning_controller"]["error"] is None
