# SPDX-License-Identifier: Apache-2.0
"""Fit of a drive with modes: simulated measurements give back the drive that made them, in every kind and format."""

import json
import re
import sys
from dataclasses import replace

import numpy as np
import pytest
import scipy.io
import scipy.signal
import yaml
from click.testing import CliRunner
from numpy.testing import assert_allclose
from pyarrow import parquet, table

import lathe_rc
from drive_fit_accuracy import RATE, STEP, TURN, drawn, errors, measured, noisy, simulated
from lathe_commission import modal_fit
from lathe_commission.commands import fit_drive
from lathe_commission.drive_measurement import data, step_response
from lathe_commission.modal_fit import ResponseData, StepData
from lathe_explore.sweep.space import Space
from lathe_machine.analysis.modal_drive import ModalDrive
from lathe_rc.analysis import frequency_response
from lathe_rc.analysis.frequency_response import FrequencyResponse, estimate
from lathe_rc.cell import cells_file
from lathe_rc.cli import main
from lathe_rc.commands import measured as measured_options
from lathe_rc.errors import InputError
from lathe_rc.signals import measurement_file
from lathe_rc.signals.quantities import parse_columns

TRUE = ModalDrive(
    TURN * 165.0, 0.8, 7 * STEP, (TURN * 905.0, TURN * 1620.0), (0.02, 0.018), (0.012, -0.02)
)  # its delay is one of whole samples
SERVO = ModalDrive(
    TURN * 123.0, 0.8, 3 * STEP, (TURN * 905.0, TURN * 1620.0), (0.024, 0.02), (0.012, -0.005), -0.9, (0.006, 0.01),
    (1.4e-4, 1.1e-3), (0.03, -0.2),
)  # fmt: skip
PLAIN = ModalDrive(TURN * 165.0, 0.8, 7 * STEP)
HOLDS = ("zero", "linear")
FREQUENCY = TURN * np.linspace(5.0, 2500.0, 300)


def assert_found(found, true, delay=2e-6):
    """Frequencies within 0.5 %, dampings within 10 %."""
    assert np.less_equal(errors(found, true), (5e-3, 0.1, delay)).all(), (found, true)


# --- model


def test_step_and_frequency_response_of_the_model_are_scipys():
    for drive in (TRUE, SERVO):
        parts = [([v * w, share * w**2], [1.0, 2.0 * z * w, w**2]) for w, z, share, v in drive.sections]
        parts += [([share], [t, 1.0]) for t, share in drive.lags]
        time = np.linspace(0.0, 20e-3, 500)
        steps = drive.gain * sum(scipy.signal.step(part, T=time)[1] for part in parts)
        assert_allclose(drive.step(time + drive.delay), steps, atol=1e-6)
        responses = drive.gain * sum(scipy.signal.freqs(*part, FREQUENCY)[1] for part in parts)
        assert_allclose(drive.response(FREQUENCY), responses * np.exp(-1j * FREQUENCY * drive.delay), rtol=1e-9)


def test_derivatives_are_those_of_the_response():
    for drive in (TRUE, SERVO):
        x = drive.searched()
        for place in range(x.size):
            offset = np.zeros(x.size)
            offset[place] = 1e-6
            ahead, behind = (drive.at(x + sign * offset).response(FREQUENCY) for sign in (1, -1))
            assert_allclose(drive.derivatives(FREQUENCY)[:, place], (ahead - behind) / 2e-6, atol=1e-5)


# --- fits


def test_a_drive_is_found_in_a_frequency_response():
    """Frequencies within 0.5 %, dampings within 10 %, the delay within 2 µs; the set covers the true drive."""
    random = np.random.default_rng(44)
    true = drawn(random)
    fit = modal_fit.fit(ResponseData(measured(true, FREQUENCY, random)))
    assert_found(fit.drive, true)
    assert fit.distance(true) < fit.limit
    drives = fit.drives(32, seed=0)
    assert drives[0] is fit.drive
    assert_allclose([fit.distance(drive) for drive in drives[1:]], fit.limit, rtol=1e-6)
    assert drives == fit.drives(32, seed=0) != fit.drives(32, seed=1)


def test_gain_lag_and_modes_are_found_without_an_uncertainty():
    """A further lag and noise of 0.5 % at logarithmic frequencies; a lag far above them counts as delay."""
    random = np.random.default_rng(5)
    frequency = TURN * np.geomspace(2.0, 3000.0, 400)
    modes = (TURN * 410.0, TURN * 900.0, TURN * 1600.0), (0.03, 0.02, 0.015), (0.02, 0.012, -0.01)
    true = ModalDrive(TURN * 165.0, 0.7, 0.32e-3, *modes, -1.7)
    value = true.response(frequency) / (1.0 + 1j * frequency / 3e5)
    value *= 1.0 + 5e-3 * (random.normal(size=400) + 1j * random.normal(size=400))
    fit = modal_fit.fit(ResponseData(FrequencyResponse(frequency, value)))
    assert_allclose(fit.drive.mode_frequency, true.mode_frequency, rtol=5e-3)
    assert_allclose(fit.drive.mode_damping, true.mode_damping, rtol=0.1)
    assert_allclose(fit.drive.delay, true.delay + 1.0 / 3e5, atol=5e-6)
    assert fit.drive.gain == pytest.approx(-1.7, rel=0.01)
    assert fit.model_error == pytest.approx(0.005, rel=0.2)


def third_order(random):
    """A real pole in series with drive and modes."""
    pole = TURN * random.uniform(250.0, 600.0)
    plain = replace(drawn(random), gain=random.uniform(0.5, 2.0))
    return lambda frequency: plain.response(frequency) / (1.0 + 1j * frequency / pole)


def delayed_servo(random):
    """A voice coil under a PD controller, with two modes and a delay in its loop."""
    w, delay = TURN * random.uniform(100.0, 150.0), random.uniform(30e-6, 80e-6)
    modes = drawn(random).modes

    def response(frequency):
        p = 1j * frequency
        coil = 1.0 / p**2 + sum(abs(share) / (p**2 + 2.0 * z * v * p + v**2) for v, z, share, _ in modes)
        loop = w**2 * (1.0 + 1.4 * p / w) * coil * np.exp(-p * delay)
        return w**2 * coil * np.exp(-p * delay) / (1.0 + loop)

    return response


@pytest.mark.parametrize("kind", [third_order, delayed_servo])
def test_drives_that_are_no_sum_of_normal_modes_lie_in_the_envelope_of_their_fits(kind):
    """Real poles in series, and a delay in the loop, which no rational model has."""
    random = np.random.default_rng(20)
    true, deviation = kind(random), 1e-3
    value = true(FREQUENCY) * (1.0 + deviation * (random.normal(size=(2, FREQUENCY.size)).T @ [1.0, 1j]))
    fit = modal_fit.fit(ResponseData(FrequencyResponse(FREQUENCY, value, np.full(FREQUENCY.size, deviation))))
    assert np.all(np.abs(true(FREQUENCY) - fit.drive.response(FREQUENCY)) < fit.envelope(FREQUENCY))
    assert fit.model_error < 1e-3
    responses = np.array([drive.response(FREQUENCY) for drive in fit.drives(32, 0)])
    off = np.abs(responses - fit.drive.response(FREQUENCY)) / np.abs(fit.drive.response(FREQUENCY))
    assert off.max() < 0.05


def commands(random):
    """Return a command of each kind by name."""
    time = np.arange(60_000) * STEP
    lines = np.zeros(5001, complex)
    lines[2:1500] = np.exp(1j * random.uniform(0.0, TURN, 1498))
    return {
        "noise": random.normal(size=time.size),
        "chirp": scipy.signal.chirp(time, 5.0, time[-1], 3000.0, phi=-90),
        "multisine": np.tile(np.fft.irfft(lines), 6),
    }


@pytest.mark.parametrize("kind", ["noise", "chirp", "multisine"])
def test_drive_is_found_in_a_record(kind):
    """Each kind of command, at 60 dB; the response lies within its uncertainty."""
    random = np.random.default_rng(5)
    command = commands(random)[kind]
    response = estimate(command, noisy(simulated(TRUE, command), random), STEP)
    error = np.abs(response.value - response.smoothed(TRUE.response)) / np.abs(response.value)
    assert 0.2 < np.mean((error / response.deviation) ** 2) / 2.0 < 1.5
    fit = modal_fit.fit(ResponseData(response), modes=None if kind == "chirp" else 2)
    assert_found(fit.drive, TRUE, 0.1e-6)
    assert fit.distance(TRUE) < fit.limit


def test_estimate_is_scipys():
    random = np.random.default_rng(6)
    command = random.normal(size=20_000)
    position = noisy(simulated(PLAIN, command), random, 0.3)
    options = {"fs": RATE, "window": "hann", "nperseg": 1000, "noverlap": 750, "detrend": False}
    u, y = command - command.mean(), position - position.mean()
    frequency, cross = scipy.signal.csd(u, y, **options)
    found = estimate(command, position, STEP, hold="none", resolution=20.0)
    places = np.round(found.frequency / (TURN * 20.0)).astype(int)
    assert_allclose(found.frequency, TURN * frequency[places], rtol=0.5)
    assert_allclose(found.value, (cross / scipy.signal.welch(u, **options)[1])[places], rtol=1e-9)
    assert_allclose(found.coherence, scipy.signal.coherence(u, y, **options)[1][places], rtol=1e-9)


def test_hold_of_the_command_is_taken_out():
    command = np.random.default_rng(7).normal(size=40_000)
    response = simulated(PLAIN, command, "zoh")
    held, linear = (
        modal_fit.fit(ResponseData(estimate(command, response, STEP, hold=hold)), modes=0).drive for hold in HOLDS
    )
    assert_found(held, PLAIN, 0.05e-6)
    assert linear.delay - PLAIN.delay == pytest.approx(STEP / 2.0, rel=0.02)


def test_drive_is_found_in_a_step(tmp_path):
    random = np.random.default_rng(8)
    time = np.arange(400) * STEP
    fit = modal_fit.fit(StepData(time, TRUE.step(time) + 1e-4 * random.normal(size=time.size)), modes=2)
    assert_found(fit.drive, TRUE)
    assert fit.distance(TRUE) < fit.limit
    command = np.where(np.arange(1000) < 100, 2e-6, 12e-6)
    position = np.concatenate((np.full(100, 2e-6), 2e-6 + 10e-6 * TRUE.step((np.arange(900) + 0.5) * STEP)))
    path = tmp_path / "step.csv"
    rows = np.stack((np.arange(1000) * STEP, command * 1e6, position * 1e6), axis=1)
    np.savetxt(path, rows, "%.15g", ",", header="time,command_um,response_um", comments="")
    found = step_response(measurement_file.read(path, {}))
    assert_allclose(found.response, TRUE.step(found.time), atol=1e-9)


def test_frequencies_of_a_sweeps_end_alone_are_too_few():
    command = scipy.signal.chirp(np.arange(60_000) * STEP, 3000.0, 3.0, 5.0)
    with pytest.raises(InputError, match="follows the command at 0 frequencies"):
        estimate(command, simulated(PLAIN, command), STEP, highest=TURN * 40.0)


def test_step_may_lie_within_its_times():
    time = np.arange(-200, 400) * STEP
    fit = modal_fit.fit(StepData(time, PLAIN.step(time)), modes=0)
    assert_found(fit.drive, PLAIN, 0.1e-6)


def test_drive_keeps_a_part_of_its_own():
    """No cell takes participations of normal modes that sum up to 1 or more."""
    near = ModalDrive(TURN * 300.0, 0.5, 1e-3, (TURN * 60.0,), (0.2,), (0.95,))
    drives = modal_fit.ModalFit(near, np.diag([0.1] * 7) ** 2, 0.0, {}).drives(32, 0)
    assert max(sum(drive.mode_participation) for drive in drives) == pytest.approx(1.0 - 0.01 * 0.05)


def test_lines_of_a_command_count_at_their_own_frequencies():
    """A run of the machine commands harmonics of the spindle, which lie between the bins."""
    random, time = np.random.default_rng(10), np.arange(60_000) * STEP
    swing = 1.0 + 0.3 * np.sin(TURN * 0.7 * time)
    command = swing * sum(np.cos(TURN * 16.97 * k * time + random.uniform(0.0, TURN)) / k for k in range(1, 30))
    response = estimate(command, noisy(simulated(PLAIN, command), random), STEP)
    lines = np.round(response.frequency / (TURN * 16.97)) * TURN * 16.97
    assert np.count_nonzero(np.abs(response.frequency - lines) < TURN * 0.3) > 20
    fit = modal_fit.fit(ResponseData(response), modes=0)
    assert_found(fit.drive, PLAIN, 1e-6)


def test_bag_of_a_run_has_the_columns_of_its_drive(tmp_path):
    recording = lathe_rc.run(lathe_rc.load("piston", ["spindle_encoder.revolutions=1"]), bag=tmp_path / "bag").recording
    found = measured_options.opened(tmp_path / "bag", [])
    command, response = found.read("command", "response")
    assert np.array_equal(command, recording.dense["/coarse/command"]["position"])
    assert np.array_equal(response, recording.dense["/coarse/state"]["measured_position"])
    assert found.clock(None, "command", "response").step == pytest.approx(1.0 / 64_000.0)
    (other,) = measured_options.opened(tmp_path / "bag", ["response=/tool.error"]).read("response")
    assert np.array_equal(other, recording.dense["/tool"]["error"])


# --- command and files


@pytest.fixture(autouse=True)
def no_figure(request, monkeypatch):
    """Draw the fit in one test alone: each figure takes as long as a fit."""
    if request.function is not test_command_writes_parameters_set_and_points:
        monkeypatch.setattr(fit_drive, "_draw", lambda *_: None)


def lathe(folder, *arguments):
    places = ["-o", str(folder / "drive.yaml"), "--figure", str(folder / "fit.png")]
    return CliRunner().invoke(main, ["fit", "drive", *map(str, arguments), *places])


def response_file(folder, drive, points=400):
    frequency = np.linspace(5.0, 2500.0, points)
    value = drive.response(TURN * frequency)
    path = folder / "response.csv"
    rows = np.stack((frequency, 20.0 * np.log10(np.abs(value)), np.degrees(np.angle(value))), axis=1)
    np.savetxt(path, rows, "%.15g", ",", header="frequency_hz,magnitude_db,phase_deg", comments="")
    return path


def test_command_writes_parameters_set_and_points(tmp_path):
    """The set is read as cells of a sweep, the points as a measurement with the same fit."""
    done = lathe(tmp_path, response_file(tmp_path, TRUE), "--modes", 2)
    assert done.exit_code == 0, done.stderr
    assert "mode 2 " in done.stdout
    assert (tmp_path / "fit.png").stat().st_size > 10_000
    (table_of,) = yaml.safe_load((tmp_path / "drive.yaml").read_text()).values()
    assert table_of["ros__parameters"] == {
        name: pytest.approx(value, rel=1e-5) for name, value in TRUE.parameters().items()
    }
    cells = cells_file.read(tmp_path / "drive.drives.csv")
    assert len(cells) == 33
    name = "electrodynamic_actuator.mode_damping"
    assert cells[0][name] == pytest.approx([0.02, 0.018], rel=1e-5)
    points = measurement_file.read(tmp_path / "drive.points.csv", {})
    again = modal_fit.fit(data(points), modes=2)
    assert_found(again.drive, TRUE, 1e-9)


def test_uncertainty_of_a_file_stands_beside_its_coherence(tmp_path):
    """The coherence has no use then, and no number of averages."""
    random, path = np.random.default_rng(3), tmp_path / "points.csv"
    response = measured(PLAIN, FREQUENCY, random)
    frequency_response.write_points(path, response, response.deviation, "points")
    found = frequency_response.of_measurement(measurement_file.read(path, {}))
    assert_allclose(found.deviation, response.deviation, rtol=1e-9)
    assert found.averages == 0.0
    done = lathe(tmp_path, path, "--averages", 32)
    assert "--averages of a response with a relative_uncertainty; allowed: with a coherence alone" in done.stderr


def test_set_of_drives_without_modes_runs_in_a_scenario(tmp_path):
    done = lathe(tmp_path, response_file(tmp_path, PLAIN), "--json", "--drives", 4)
    assert json.loads(done.stdout)["modes"] == 0
    piston = lathe_rc.load("piston")
    space = Space(given=cells_file.read(tmp_path / "drive.drives.csv"))
    space.check(piston)
    assert space.count(piston) == 5


def points_of(folder, name, value, frequency, uncertainty=1e-3):
    path = folder / f"{name}.csv"
    rows = np.stack((frequency / TURN, np.abs(value), np.degrees(np.angle(value)), np.full(value.size, uncertainty)))
    header = "frequency_hz,magnitude,phase_deg,relative_uncertainty"
    np.savetxt(path, rows.T, "%.12g", ",", header=header, comments="")
    return path


def shown(random, value, uncertainty=1e-3):
    return value * (1.0 + uncertainty * (random.normal(size=(2, value.size)).T @ [1.0, 1j]))


def test_reversed_phase_and_inverse_are_refused_with_their_cure(tmp_path):
    """The cure cures."""
    random, frequency = np.random.default_rng(12), TURN * np.linspace(5.0, 800.0, 120)
    value = shown(random, replace(PLAIN, gain=0.8).response(frequency))
    done = lathe(tmp_path, points_of(tmp_path, "turned", value.conj(), frequency), "--modes", 0)
    assert (done.exit_code, done.stdout) == (2, "")
    cure = re.search(r"convention exp\(-jωt\); allowed: exp\(jωt\) \(--column (\S+)\)", done.stderr)[1]
    done = lathe(tmp_path, tmp_path / "turned.csv", "--column", cure, "--modes", 0, "--json")
    assert json.loads(done.stdout)["parameters"]["gain"] == pytest.approx(0.8, rel=1e-2)
    done = lathe(tmp_path, points_of(tmp_path, "inverse", 1.0 / value, frequency), "--modes", 0)
    assert done.exit_code == 2
    assert "inverse.csv: the response is the inverse of that of a drive" in done.stderr


def test_swapped_columns_and_a_reversed_sensor_of_a_record_are_recognised(tmp_path):
    random = np.random.default_rng(13)
    command = scipy.signal.lfilter([0.3], [1.0, -0.7], random.normal(size=20_000))
    response = noisy(simulated(replace(PLAIN, gain=-1.4), command), random)
    rows = np.stack((np.arange(command.size) * STEP, command, response), axis=1)
    for name, header in (("swapped", "time,response,command"), ("record", "time,command,response")):
        np.savetxt(tmp_path / f"{name}.csv", rows, "%.12g", ",", header=header, comments="")
    done = lathe(tmp_path, tmp_path / "swapped.csv", "--band", "5:800", "--modes", 0)
    assert done.exit_code == 2
    cure = re.search(r"command and position are swapped; allowed: (.*)\n", done.stderr)[1].split()
    done = lathe(tmp_path, tmp_path / "swapped.csv", "--band", "5:800", "--modes", 0, *cure)
    assert done.exit_code == 0, done.stderr
    gain, hint = re.search(r"gain: (\S+) .*(--column \S+)\)", done.stdout).groups()
    assert float(gain) == pytest.approx(-1.4, rel=1e-2)
    assert hint == "--column response=command:-1"
    done = lathe(
        tmp_path, tmp_path / "record.csv", "--band", "5:800", "--modes", 0, "--column", "response=response:-1", "--json"
    )
    assert json.loads(done.stdout)["parameters"]["gain"] == pytest.approx(1.4, rel=1e-2)


def test_a_fit_beyond_its_bound_is_shown_and_writes_nothing(tmp_path):
    """A response that no drive has: exit code 1, with its figures."""
    random, frequency = np.random.default_rng(14), TURN * np.linspace(5.0, 2500.0, 60)
    value = PLAIN.response(frequency) * np.exp(0.5 * random.normal(size=(2, 60)).T @ [1.0, 1j])
    done = lathe(tmp_path, points_of(tmp_path, "wild", value, frequency), "--modes", 0)
    assert done.exit_code == 1
    assert "error of the model beyond the noise" in done.stdout
    assert re.search(r"wild.csv: fit: .*; allowed: .*; nothing is written\n", done.stderr)
    assert [path.name for path in tmp_path.iterdir()] == ["wild.csv"]


def test_a_resonance_between_the_points_is_found_or_named(tmp_path, monkeypatch):
    """Tails of little noise tell it; with more noise the points to measure are named."""
    monkeypatch.setattr(modal_fit, "_has_fit", lambda *_: False)  # swapped columns have a test of their own
    random, frequency = np.random.default_rng(15), TURN * np.geomspace(5.0, 2500.0, 60)
    narrow = replace(TRUE, mode_frequency=(frequency[50] * 1.03, TURN * 1620.0), mode_damping=(0.005, 0.018))
    value = narrow.response(frequency)
    done = lathe(tmp_path, points_of(tmp_path, "few", shown(random, value), frequency))
    assert done.exit_code == 0, done.stderr
    assert "mode 2 " in done.stdout
    assert re.search(r"a resonance .* lies between the points at .* its height there rests on the model", done.stdout)
    done = lathe(tmp_path, points_of(tmp_path, "noisy", shown(random, value, 0.05), frequency, 0.05))
    assert done.exit_code == 1
    named = re.findall(r"measure from (\S+) to (\S+) Hz in steps of", done.stderr)
    for mode in narrow.mode_frequency:
        assert any(float(low) < mode / TURN < float(high) for low, high in named), done.stderr


def test_points_that_are_left_out_are_said(tmp_path):
    frequency = np.linspace(0.0, 790.0, 80)
    value = PLAIN.response(TURN * frequency)
    rows = np.stack((frequency, value.real, value.imag, np.where(frequency > 590.0, 0.2, 0.999)), axis=1)
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header="frequency_hz,real,imaginary,coherence", comments="")
    found = frequency_response.of_measurement(measurement_file.read(tmp_path / "a.csv", {}))
    assert found.left_out == (
        "1 of 80 points left out, at 0 Hz: no response at 0 Hz",
        "20 of 79 points left out, between 600 and 790 Hz: coherence below 0.5",
    )


def test_set_of_several_measurements_covers_all_of_them(tmp_path):
    """Their points stand beside the parameters, and those of an earlier fit are gone."""
    random, frequency = np.random.default_rng(16), TURN * np.linspace(5.0, 800.0, 100)
    states = [replace(PLAIN, natural_frequency=TURN * hertz) for hertz in (160.0, 172.0)]
    files = [
        points_of(tmp_path, f"s{k}", shown(random, one.response(frequency)), frequency) for k, one in enumerate(states)
    ]
    (tmp_path / "drive.points-3.csv").write_text("old")
    (tmp_path / "drive.points-mine.csv").write_text("kept")
    done = lathe(tmp_path, *files, "--modes", 0, "--json", "--drives", 4)
    assert done.exit_code == 0, done.stderr
    (table_of,) = yaml.safe_load((tmp_path / "drive.yaml").read_text()).values()
    assert table_of["ros__parameters"]["natural_frequency"] == pytest.approx(TURN * 160.0, rel=1e-3)
    cells = cells_file.read(tmp_path / "drive.drives.csv")
    found = [cell["electrodynamic_actuator.natural_frequency"] / TURN for cell in cells]
    assert_allclose(found, [160.0] * 5 + [172.0] * 5, rtol=5e-3)
    assert sorted(path.name for path in tmp_path.glob("drive.points*")) == [
        "drive.points-2.csv", "drive.points-mine.csv", "drive.points.csv",
    ]  # fmt: skip
    assert json.loads(done.stdout)["further"][0]["modes"] == 0


def written(folder, kind, time, command, response):
    """Write a record with the library of its format, in µm."""
    u, x = command * 1e6, response * 1e6
    path = folder / f"record.{kind}"
    if kind == "csv":
        rows = (f"{a:.17g};{b:.17g};{c:.17g}\n".replace(".", ",") for a, b, c in zip(time, u, x, strict=True))
        path.write_text("# tool\nt [s];u_set [um];x_act [um]\n" + "".join(rows))
    elif kind == "parquet":
        parquet.write_table(table({"time_s": time, "u_set_um": u, "x_act_um": x}), path)
    elif kind == "mat":
        scipy.io.savemat(path, {"record": {"time": time, "u_set_um": u, "x_act_um": x}, "note": "servo"})
    elif kind == "tdms":
        import nptdms

        about = {"wf_increment": STEP, "unit_string": "um"}
        channels = [nptdms.ChannelObject("servo", name, values, about) for name, values in (("u", u), ("x", x))]
        with nptdms.TdmsWriter(path) as writer:
            writer.write_segment(channels)
    else:
        import asammdf

        file = asammdf.MDF(version="4.10")
        signals = [asammdf.Signal(v, timestamps=time, name=name, unit="um") for name, v in (("u", u), ("x", x))]
        file.append(signals)
        file.save(path)
        file.close()
    return path


@pytest.mark.parametrize(
    ("kind", "columns"),
    [
        ("csv", ["time=t [s]", "command=u_set [um]", "response=x_act [um]"]),
        ("parquet", ["command=u_set_um", "response=x_act_um:um"]),
        ("mat", ["time=record.time", "command=record.u_set_um", "response=record.x_act_um:1e-6"]),
        ("tdms", ["command=u", "response=x"]),
        ("mf4", ["command=u", "response=x"]),
    ],
)
def test_formats_are_read_as_their_libraries_write_them(tmp_path, kind, columns):
    random = np.random.default_rng(9)
    time, command, response = np.arange(50) * STEP, *(1e-5 * random.normal(size=(2, 50)))
    path = written(tmp_path, kind, time, command, response)
    found = measurement_file.read(path, parse_columns(columns))
    for values, wanted in zip(found.read("command", "response"), (command, response), strict=True):
        assert_allclose(values, wanted, rtol=1e-12)
    assert found.clock(None, "command", "response").step == pytest.approx(STEP)


def starting(folder, kind, late, first):
    """Two channels of a record that begin ``late`` seconds apart, as each format states it."""
    path = folder / f"{late}.{kind}"
    values = np.sin(np.arange(50.0))
    if kind == "tdms":
        import nptdms

        start = np.datetime64("2015-11-20T20:13:43.500000") + np.timedelta64(first, "us")
        about = {"wf_increment": STEP, "wf_start_offset": 0.0, "unit_string": "m"}
        times = {"u": start, "x": start + np.timedelta64(round(late * 1e6), "us")}
        channels = [
            nptdms.ChannelObject("servo", name, values, {**about, "wf_start_time": at}) for name, at in times.items()
        ]
        with nptdms.TdmsWriter(path) as writer:
            writer.write_segment(channels)
    elif kind == "mat":
        time = first + STEP * np.arange(50)
        scipy.io.savemat(path, {"u": {"time": time, "u": values}, "x": {"time_ms": 1e3 * (time + late), "x": values}})
    else:
        import asammdf

        file = asammdf.MDF(version="4.10")
        for name, begin in (("u", 0.0), ("x", late)):
            file.append([asammdf.Signal(values, timestamps=begin + STEP * np.arange(50), name=name, unit="m")])
        file.save(path)
        file.close()
    return path


@pytest.mark.parametrize(
    ("kind", "late", "first"),
    [("tdms", 3e-3, 0), ("tdms", -3e-3, 1), ("tdms", STEP, 999_999), ("mat", 2e-3, 1.7), ("mf4", 3e-3, 0)],
)
def test_columns_that_begin_at_different_times_are_refused(tmp_path, kind, late, first):
    """A record of a response, and pairs of command and displacement without a time; columns of one start are read."""
    suffix = {"mat": ("u.u", "x.x")}.get(kind, ("u", "x"))
    for response in ("response", "displacement"):
        columns = parse_columns([f"command={suffix[0]}:m", f"{response}={suffix[1]}:m"])
        together = measurement_file.read(starting(tmp_path, kind, 0.0, first), columns)
        assert len(together.read("command", response)) == 2
        assert together.clock(None, "command", response).step == pytest.approx(STEP)
        apart = measurement_file.read(starting(tmp_path, kind, late, first), columns)
        with pytest.raises(InputError, match=f"begin at different times, {abs(late):.6g} s apart; cut both alike"):
            apart.read("command", response)


def test_a_rate_beside_a_stated_sampling_is_refused(tmp_path):
    path = starting(tmp_path, "tdms", 0.0, 0)
    done = lathe(tmp_path, path, "--column", "command=u", "--column", "response=x", "--rate", 100)
    assert done.exit_code == 2
    assert "--rate 100 beside the sampling that the file states; leave --rate out" in done.stderr


def test_damaged_files_are_refused_in_one_line(tmp_path):
    """A header of another format, and pages that are damaged after a sound header."""
    (tmp_path / "none.mf4").write_bytes(b"MDF 4.10" * 100)
    done = lathe(tmp_path, tmp_path / "none.mf4")
    assert (done.exit_code, done.stdout) == (2, "")
    assert re.fullmatch("lathe: .*none.mf4: no readable MDF file .*\n", done.stderr)
    columns = np.random.default_rng(9).normal(size=(3, 50))
    path = written(tmp_path, "parquet", *columns)
    pages = bytearray(path.read_bytes())
    pages[4:100] = b"\xff" * 96
    path.write_bytes(pages)
    done = lathe(tmp_path, path, "--column", "command=u_set_um", "--column", "response=x_act_um")
    assert (done.exit_code, done.stdout) == (2, "")
    assert re.fullmatch("lathe: .*record.parquet: damaged after its header; .*\n", done.stderr)


@pytest.mark.parametrize("points", [30, 50])
def test_each_frequency_has_one_coherence(tmp_path, points):
    frequency = np.linspace(5.0, 2500.0, 40)
    columns = {"frequency": frequency, "response": PLAIN.response(TURN * frequency), "coherence": np.full(points, 0.9)}
    scipy.io.savemat(tmp_path / "response.mat", columns)
    done = lathe(tmp_path, tmp_path / "response.mat")
    assert done.exit_code == 2
    assert f"40 of frequency, {points} of coherence; allowed: as many of each" in done.stderr


def test_missing_reader_is_named_with_its_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "nptdms", None)
    (tmp_path / "a.tdms").write_bytes(b"TDSm")
    done = lathe(tmp_path, tmp_path / "a.tdms")
    assert done.exit_code == 1
    assert "lathe_rc[formats]" in done.stderr


HEADER = "time_ms,command_um,response_um\n"
RISE, LATE = (
    "time,response\n" + "".join(f"{begin + k / 10},{min(k / 9, 1)}\n" for k in range(30)) for begin in (0.0, 12.3)
)
POINTS = "frequency,real,imaginary\n" + "".join(f"{k},1,0\n" for k in range(1, 40))
EVEN = "".join(f"{k * 0.05:.9g},{np.sin(k * k):.9g},{np.cos(k):.9g}\n" for k in range(600))


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("a,b\n1,2\n", [], "columns 'a', 'b'; allowed: time and response of a step"),
        (HEADER + EVEN, ["--column", "command=u"], "--column command=u: .* has no such column; it has 'time_ms', "),
        (HEADER + EVEN, ["--column", "pace=u"], "allowed: QUANTITY=COLUMN"),
        (
            HEADER + EVEN,
            ["--column", "command=u:furlong"],
            "no unit 'furlong' of command; allowed: m, mm, um, nm, in, 1, or a",
        ),
        (HEADER.replace("_um", " [V]", 1) + EVEN, [], "has the unit 'V'; allowed for command"),
        (HEADER + EVEN + "30.3,1,1\n", [], "not in even steps.*resample the record, or give --rate"),
        (HEADER + EVEN + "30,x,1\n", [], ":602: 'command_um' is 'x'; allowed: a finite number"),
        ("\n".join((HEADER + EVEN).splitlines()[:300]), [], r"record: \d+ samples; allowed: 512 or more"),
        (HEADER + EVEN, [], "the response follows the command at"),
        (HEADER + EVEN, ["--band", "0:5"], "the response follows the command at 0 frequencies .* a wider --band"),
        (HEADER, [], "no rows below its header; allowed: one or more"),
        (HEADER + EVEN, ["--band", "5:9000"], "up to 9000 Hz of a record at 20000 Hz; allowed: up to 8000 Hz"),
        (HEADER + EVEN, ["--rate", 2e4], "--rate 20000 beside the times in 'time_ms'; leave --rate out"),
        (RISE, ["--rate", 10], "--rate does not apply to a step response with times; leave it out"),
        (RISE, ["--band", "0:5"], "--band does not apply to a step response; leave it out"),
        (RISE, ["--resolution", 1], "--resolution does not apply to a step response; leave it out"),
        (RISE, ["--averages", 9], "--averages does not apply to a step response; leave it out"),
        (LATE, [], "step response: times from 12.3 to 15.2 s; allowed: from 0 or before"),
        (POINTS, ["--band", "50:60"], r"record\.csv: --band: frequency response: 0 points; allowed: 16 or more"),
        (POINTS, ["--rate", 10], "--rate does not apply to a frequency response; leave it out"),
        (POINTS, ["--averages", 9], "--averages of a response with no coherence; allowed: with a coherence alone"),
        (HEADER + EVEN, ["--band", "9:1"], "--band '9:1'; allowed: LOW:HIGH in Hz"),
        ("command,response\n" + "1,1\n" * 3, [], "no time; give --rate HZ"),
        ("frequency,real\n1,1\n", [], "allowed: frequency with magnitude and phase"),
        ("frequency,real,imaginary\n1,1,0\n", [], "1 points; allowed: 16 or more"),
        ("frequency,real,imaginary,coherence\n1,1,0,2\n", [], "coherence 2 in row 1; allowed: from 0 to 1"),
        (
            "frequency,real,imaginary\n" + "".join(f"{k},9,0\n" for k in range(1, 40)),
            [],
            "magnitude 9 at 1 Hz, the lowest frequency; .*:0.1111",
        ),
        ("time,response\n" + "".join(f"{k},{k}\n" for k in range(20)), [], "step response: ends at 19; allowed"),
        (
            "time,response\n" + "".join(f"{k},{k / 19}\n" for k in range(20)),
            [],
            "in its last quarter; allowed: a change",
        ),
    ],
)
def test_unusable_measurements_are_refused_in_one_line(tmp_path, text, options, message):
    path = tmp_path / "record.csv"
    path.write_text(text)
    done = lathe(tmp_path, path, *options)
    assert (done.exit_code, done.stdout) == (2, ""), done.stdout
    assert len(done.stderr.splitlines()) == 1
    assert re.search(message, done.stderr), done.stderr
    assert not (tmp_path / "drive.yaml").exists()


def test_averages_of_overlapping_windows_are_fewer_than_segments():
    window = scipy.signal.get_window("hann", 512)
    assert frequency_response._independent(window, 128, 400) == pytest.approx(400 / 1.93, rel=0.01)
    assert frequency_response._independent(window, 256, 400) == pytest.approx(400 / 1.056, rel=0.01)
