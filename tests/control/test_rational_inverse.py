# SPDX-License-Identifier: Apache-2.0
"""The disturbance law with an inverse of fourth order, and its identification during the cut."""

import numpy as np
import pytest
import scipy
from cells import config
from numpy.testing import assert_allclose

import lathe_rc
from lathe_machine.analysis.modal_drive import ModalDrive
from lathe_machine.analysis.rational_model import rational_model
from lathe_machine.control import rational_fit, rational_inverse
from lathe_rc import messages
from lathe_rc.cell import batch
from lathe_rc.cell.wiring import Cell

STEP = 1 / 64000
DRIVE = ModalDrive(1036.7, 0.7, 0.2e-3, (5654.9,), (0.02,), (0.02,))
MODEL = rational_model(DRIVE.response, DRIVE.delay)
SHORT = ["spindle_encoder.revolutions=12.5", "loaded_drive.coarse_mode_frequency=[5654.9]"]
SHORT += ["loaded_drive.coarse_mode_damping=[0.02]", "loaded_drive.coarse_mode_participation=[0.02]"]
STEADY = ["spindle_encoder.random_rms=0.0"]


def found(*changes):
    """Largest error of the last revolution [µm], state of the law at its end, and its events."""
    (outcome,) = batch.run_many([config("oval3000", *SHORT, *changes)], Kept)
    assert outcome.error is None, outcome.error
    return outcome.kept


class Kept:
    """Keeper of the law and of the form error."""

    heard = ("tool.error",)

    def __init__(self, cell, samples):
        self.law, self.errors, self.events = cell.stages["controller"], [], []

    def chunk(self, first, samples, dense, sparse):
        self.errors.append(dense["tool"]["error"].copy())
        self.events += [each.values["action"] for each in sparse.get("controller/events", [])]

    def kept(self):
        return np.abs(np.concatenate(self.errors))[-1280:].max() * 1e6, self.law.law.known.rational, self.events


def test_a_model_of_a_drive_with_one_resonance_is_exact():
    frequency = np.linspace(10.0, 8000.0, 50)
    error = DRIVE.response(frequency) * rational_fit.inverse_response(MODEL, frequency)
    assert_allclose(error * np.exp(1j * frequency * DRIVE.delay), 1.0, atol=1e-7)


def test_inverse_gives_the_command_with_which_the_drive_follows_a_form_at_any_speed():
    """The response of the drive, by SciPy, to the inverse of a form whose speed varies is the form."""
    time = STEP * np.arange(12_800)
    angle = 314.0 * time + 0.1 * np.sin(250.0 * time)
    speed, acceleration = 314.0 + 25.0 * np.cos(250.0 * time), -6250.0 * np.sin(250.0 * time)
    form, slope, bow = (sum(k**n * np.cos(k * angle + n * np.pi / 2) / k**2 for k in (2, 5, 8)) for n in range(3))
    inverse = rational_inverse.rational_inverse(MODEL, step=STEP, points=64, bandwidth=5655.0, judge=None)
    second = speed**2 * bow + acceleration * slope
    given = zip(form, speed * slope, second, strict=True)
    command = [rational_inverse.inverted(inverse, rational_inverse.FORM, 0.0, *each) for each in given]
    drive = scipy.signal.lti([MODEL[5], MODEL[4], 1.0], [*MODEL[3::-1], 1.0])
    position = scipy.signal.lsim(drive, command, time)[1]
    assert np.abs(position - form)[9600:].max() < 1e-4 * np.abs(form).max()
    assert np.abs(np.array(command) - form)[9600:].max() > 0.1 * np.abs(form).max()


def test_resonance_is_identified_during_the_cut():
    """From the nominal drive of second order, under force and with noise, over the band of the form."""
    error, law, events = found()
    assert error < 1.0
    frequency = 2 * np.pi * np.array([100.0, 200.0, 300.0, 400.0])
    ratio = DRIVE.response(frequency) * rational_fit.inverse_response(law.model[0], frequency)
    assert np.abs(ratio * np.exp(1j * frequency * DRIVE.delay) - 1.0).max() < 0.05
    assert events[0] == "model adopted"
    before, _, none = found("controller.inverse=second_order")
    assert before > 1.5 * error
    assert not none


def test_a_command_that_repeats_identifies_no_model():
    """At constant speed the measurements of the first revolutions, whose command still changes, do not suffice here."""
    _, law, events = found(*STEADY)
    assert not rational_inverse.is_rational(law)
    assert "model adopted" not in events


def test_a_drive_of_second_order_is_inverted_as_before_to_the_bit():
    second, fourth = (
        lathe_rc.run(config("robust_cutting", "spindle_encoder.revolutions=12", f"controller.inverse={order}"))
        for order in ("second_order", "fourth_order")
    )
    assert fourth.digest["/coarse/command"] == second.digest["/coarse/command"]
    events = fourth.recording.sparse["/controller/events"].values["action"]
    assert events[-1] == "model refused: it has no resonance (damping of the zeros above 0.5)"


@pytest.mark.parametrize("changes", [['controller.events=["second 0.001: freeze"]'], ["controller.identify=false"]])
def test_nothing_is_adopted_without_learning(changes):
    _, law, events = found(*changes)
    assert not rational_inverse.is_rational(law)
    assert not [each for each in events if each.startswith("model")]


def test_clear_discards_the_measurements_and_keeps_the_model():
    _, law, _ = found("spindle_encoder.revolutions=9.0")
    adopted = law.model[0].copy()
    _, law, _ = found("spindle_encoder.revolutions=9.02", 'controller.events=["revolution 9.0: clear"]')
    assert not law.fit.sums.any()
    assert_allclose(law.model[0], adopted, rtol=0)


def judge(model=MODEL, **changes):
    values = {"nominal_speed": 314.16, "learned_waves": 7.5, "points_per_revolution": 512, "learning_gain": 0.5}
    values |= {"learning_bandwidth": 8000.0, "observer_bandwidth": 0.0, "late": 0.45e-3}
    return rational_fit.judge_of(model, **{**values, **changes})


def test_margin_of_a_model_is_that_of_the_check_before_the_start():
    """With the given model as the drive and the new one as the model of the law."""
    lists = [
        f"controller.model_denominator={MODEL[:4].tolist()}", f"controller.model_numerator={MODEL[4:].tolist()}"
    ]  # fmt: skip
    law = Cell(config("oval3000", *lists).nodes).stages["controller"]
    given = np.array([2 * 0.8 / 900.0, 1 / 900.0**2, 0.0, 0.0, 0.0, 0.0])
    table = judge(given)
    smallest = law.smallest_errors(
        lambda frequency: np.exp(-1j * frequency * 0.2e-3) / rational_fit.inverse_response(given, frequency),
        table.frequency / 314.16,
        314.16,
    )
    assert rational_fit.drive_margin(table, MODEL) == pytest.approx(smallest.min(), rel=1e-6)


def test_a_model_with_which_learning_would_diverge_is_unsafe():
    fit = rational_fit.no_rational_measurements(5655.0, STEP, 64, judge())
    assert rational_fit.safe(fit, MODEL) == rational_fit.ADOPTED
    small = MODEL * np.array([1.0, 30.0, 1.0, 1.0, 1.0, 1.0])  # ten times the response
    assert rational_fit.safe(fit, small) == rational_fit.UNSAFE
    assert rational_fit.safe(fit, MODEL * np.array([1, 1, 1, 1, 0.1, 1])) == rational_fit.UNSTABLE
    assert rational_fit.safe(fit, MODEL * np.array([1, 1, 1, 1, 100, 1])) == rational_fit.SMOOTH


def test_law_starts_with_the_resonances_of_the_drive_unless_others_are_given():
    assert not Cell(config("oval3000").nodes).stages["controller"].parameters.model_denominator
    cell = config("robust", "disturbance_controller.inverse=fourth_order").varied(
        {f"electrodynamic_actuator.{name}": value for name, value in DRIVE.parameters().items()}
    )
    known = Cell(cell.nodes).stages["disturbance_controller"]
    assert_allclose(known.parameters.coefficients("law"), MODEL, rtol=1e-6)
    assert rational_inverse.is_rational(known.law.known.rational)


def test_blocks_and_a_checkpoint_beside_a_candidate_change_no_bit(tmp_path):
    """Nor does a start from a checkpoint while a model settles that is adopted after it."""
    length = "spindle_encoder.revolutions=8.0"
    made = config("oval3000", length)
    whole = lathe_rc.run(made, checkpoints={"revolution:4.5": tmp_path / "state", "revolution:7.5": tmp_path / "late"})
    again, end = (lathe_rc.run(made, start_from=tmp_path / name) for name in ("state", "late"))
    small = lathe_rc.run(config("oval3000", length, "block_size=8"))
    assert small.digest["/coarse/command"] == whole.digest["/coarse/command"]
    late, command = (each.recording.of_type(messages.COMMAND)["position"] for each in (again, whole))
    assert np.array_equal(command[-late.size :], late)
    events = [each.recording.sparse["/controller/events"].values.get("action") for each in (whole, again, end)]
    assert "model adopted" in events[1]
    assert events[0] == events[1]
    assert not events[2], "what was told before the start is not told again"
