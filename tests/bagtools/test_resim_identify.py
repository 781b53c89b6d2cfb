# SPDX-License-Identifier: Apache-2.0
"""Bags from which parts are missing: what can be identified is, and the rest is asked for."""

import json
from pathlib import Path

import numpy as np
import pytest
from bags import lathe
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from lathe_bagtools.resimulation.resim import resimulate
from lathe_machine.analysis import drive_fit
from lathe_machine.plants.electrodynamic import ElectrodynamicDrive
from lathe_machine.signals.measured_profile import read_csv
from lathe_rc import harness, messages, resources
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.cell import scenario as scenarios
from lathe_rc.errors import InputError

STEP = 1.0 / 64000.0
PISTON = resources.find(Path("piston.yaml"))
WITH = ["--scenario", PISTON]
TRUE = {"natural_frequency": 900.0, "damping": 0.7, "delay": 0.5e-3}
THREE = ENCODER, COMMAND, STATE = "/encoder", "/coarse/command", "/coarse/state"


def stripped(source, target, topics, change=lambda _topic, message: message, about=None):
    """A bag of some topics, which may have new names, that says ``about`` itself what is given; by rosbags alone."""
    topics = topics if isinstance(topics, dict) else {topic: topic for topic in topics}
    store = messages.store()
    with Reader(source) as old, Writer(target, version=9, storage_plugin=StoragePlugin.MCAP) as new:
        wanted = [connection for connection in old.connections if connection.topic in topics]
        for key, text in (about or {}).items():
            new.set_custom_data(key, text)
        made = {c.topic: new.add_connection(topics[c.topic], c.msgtype, typestore=store) for c in wanted}
        for connection, stamp, data in old.messages(wanted):
            message = messages.decode(connection.msgtype, bytes(data))
            for name in messages.sample_fields(connection.msgtype):
                setattr(message, name, getattr(message, name).copy())
            message = change(connection.topic, message)
            if message is not None:
                new.write(made[connection.topic], stamp, store.serialize_cdr(message, connection.msgtype))
    return target


def recorded(path, *, revolutions=16, **more):
    sets = [f"electrodynamic_actuator.{name}={value!r}" for name, value in {**TRUE, **more}.items()]
    loaded = scenarios.load(PISTON, [f"spindle_encoder.revolutions={float(revolutions)!r}", *sets])
    return harness.run(loaded, bag=path)


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """A run of another drive than piston.yaml has, and a bag with three of its topics."""
    folder = tmp_path_factory.mktemp("clean")
    result = recorded(folder / "whole")
    return result, stripped(folder / "whole", folder / "part", THREE)


def test_the_drive_comes_back_and_the_run_with_it(clean):
    result, bag = clean
    found = resimulate(bag, scenario=PISTON, identified=True)
    (drive,) = found.drives
    assert drive.before == {"natural_frequency": 1038.0, "damping": 0.804, "delay": 0.36e-3}
    for name, value in TRUE.items():
        assert drive.fit.values[name] == pytest.approx(value, rel=1e-6)
        assert getattr(found.scenario.nodes["electrodynamic_actuator"], name) == drive.fit.values[name]
    assert drive.fit.nrmse < 1e-9
    assert drive.fit.vague == ()
    assert found.positions == [(STATE, "measured_position")]
    assert_allclose(found.recorded_rms, result.errors.rms, rtol=1e-9)
    assert_allclose(found.rms, result.errors.rms, rtol=1e-5)
    assert found.between_rms.max() < 1e-12


def test_without_identification_the_scenarios_drive_counts(clean):
    result, bag = clean
    found = resimulate(bag, scenario=PISTON)
    assert found.drives == []
    assert_allclose(found.recorded_rms, result.errors.rms, rtol=1e-9)
    assert found.rms[1] < 0.8 * found.recorded_rms[1]
    assert found.between_rms[1] > 1e-6


def test_noise_and_quantisation_leave_the_drive_within_its_errors(tmp_path):
    recorded(tmp_path / "bag", noise_rms=50e-9, resolution=20e-9)
    bag = stripped(tmp_path / "bag", tmp_path / "part", THREE)
    found = resimulate(bag, scenario=PISTON, identified=True)
    fit = found.drives[0].fit
    for name, value in TRUE.items():
        assert abs(fit.values[name] - value) < 4.0 * fit.errors[name]
        assert fit.errors[name] < 1e-3 * value
    # The sensor's own noise is all that is left: 50 nm and a step of 20 nm.
    noise = np.hypot(50e-9, 20e-9 / np.sqrt(12.0))
    assert fit.residual_rms == pytest.approx(noise, rel=0.02)
    assert_allclose(found.between_rms, noise, rtol=0.05)


def test_identification_needs_no_scenario_and_asks_for_the_rest(clean, tmp_path):
    _, bag = clean
    said = lathe("resim", bag, "--identify", "--write-parameters", tmp_path / "drive.yaml")
    assert said.exit_code == 0
    assert "natural_frequency │ rad/s │" in said.stdout
    assert "R² = " in said.stdout
    assert "not re-simulated: the bag holds no scenario" in said.stdout
    assert "drives, controllers and the form of the part (--scenario FILE)" in said.stdout
    told = json.loads(lathe("resim", bag, "--identify", "--json").stdout)
    assert told["drives"][0]["identified"] == pytest.approx(TRUE, rel=1e-6)
    assert told["drives"][0]["scenario"] is None
    # What was written is a parameter file of that node.
    with_it = resimulate(bag, scenario=PISTON, controller=tmp_path / "drive.yaml")
    assert with_it.between_rms.max() < 1e-12


def test_the_written_parameters_are_a_scenario(clean, tmp_path):
    result, bag = clean
    file = tmp_path / "found.yaml"
    said = lathe("resim", bag, *WITH, "--identify", "--write-parameters", file, "--json")
    assert said.exit_code == 0
    told = json.loads(said.stdout)
    assert (told["changed"], told["equal"], told["positions"]) == (True, False, [[STATE, "measured_position"]])
    again = json.loads(lathe("run", file, "--revolutions", 16, "--json").stdout)
    assert_allclose(again["error_um"]["per_revolution_rms"], result.errors.rms * 1e6, rtol=1e-5)
    # Over itself, with the profile that lies beside it.
    assert lathe("resim", bag, "--scenario", file, "--identify", "--write-parameters", file).exit_code == 0


@pytest.mark.parametrize("beyond", ["gain=0.8", "mode_frequency=[6000.0]"])
def test_a_drive_beyond_the_identified_model_is_refused(clean, tmp_path, beyond):
    modes = [f"electrodynamic_actuator.{name}=[0.01]" for name in ("mode_damping", "mode_participation")]
    sets = [f"electrodynamic_actuator.{beyond}", *(modes if "mode" in beyond else [])]
    (tmp_path / "other.yaml").write_text(scenarios.load(PISTON, sets).to_yaml())
    refused = lathe("resim", clean[1], "--scenario", tmp_path / "other.yaml", "--identify")
    assert refused.exit_code == 2
    assert f"electrodynamic_actuator has {beyond.replace('=', ' = ')}; allowed: " in refused.stderr


def test_the_result_is_a_complete_bag(clean, tmp_path):
    _, bag = clean
    assert lathe("resim", bag, *WITH, "-o", tmp_path / "whole").exit_code == 0
    found = lathe("resim", tmp_path / "whole")
    assert found.exit_code == 0
    assert "equal to the recording to the bit: 9 topics" in found.stdout


def test_encoder_and_position_alone_are_served_under_their_own_names(clean, tmp_path):
    result, whole = clean
    bag = stripped(whole, tmp_path / "bag", {ENCODER: "/spindle/angle", STATE: "/axis_7"})
    named = {"encoder": "/spindle/angle", "coarse/state": "/axis_7"}
    names = [part for name, topic in named.items() for part in ("--topic", f"{name}={topic}")]
    said = lathe("resim", bag, *WITH, *names)
    assert said.exit_code == 0
    assert "recorded: /axis_7 measured_position" in said.stdout
    assert "positions differ by" in said.stdout
    assert_allclose(resimulate(bag, scenario=PISTON, topics=named).recorded_rms, result.errors.rms, rtol=1e-9)
    for more in ([], WITH):
        asked = lathe("resim", bag, "--identify", *more, *names)
        assert asked.exit_code == 2
        assert "without its command: ActuatorCommand on /coarse/command" in asked.stderr
        assert "--scenario FILE" in asked.stderr


def test_a_machine_that_knows_no_truth_and_began_elsewhere(clean, tmp_path):
    """No true angle, some turns before sample 0, log times of another clock."""
    result, whole = clean

    def change(topic, message):
        if topic == ENCODER:
            message.angle += 6.0 * np.pi
            message.angle_true[:] = message.speed_true[:] = 0.0
        return message

    bag = stripped(whole, tmp_path / "bag", [ENCODER, STATE], change)
    found = resimulate(bag, scenario=PISTON)
    assert_allclose(found.recorded_rms, result.errors.rms, rtol=1e-6)


def test_a_bag_with_its_scenario_and_not_all_topics_is_compared_in_what_it_has(clean, tmp_path):
    result, part = clean
    with BagSource(part.parent / "whole") as source:
        about = dict(source.about)
    bag = stripped(part.parent / "whole", tmp_path / "bag", [ENCODER, STATE], about=about)
    told = json.loads(lathe("resim", bag, "--json").stdout)
    assert (told["equal"], told["changed"], told["different"]) == (True, False, [])
    assert {COMMAND, "/tool"} <= set(told["not_recorded"])
    changed = resimulate(bag, ["learning_controller.lead_time=1.2e-3"])
    assert changed.different == [STATE]
    assert_allclose(changed.recorded_rms, result.errors.rms, rtol=1e-9)


@pytest.mark.parametrize(
    ("topics", "arguments", "said"),
    [
        ([ENCODER, STATE], [], "the bag holds no scenario; it has /coarse/state (ActuatorState), /encoder"),
        ([ENCODER, STATE], [], "to identify the drive, its command: ActuatorCommand on /coarse/command"),
        ([STATE], [], "missing: the spindle: EncoderBlock on /encoder (or --topic encoder=/TOPIC)"),
        ([ENCODER], [], "to compare with, the tool's position: ActuatorState on /coarse/state"),
        ([STATE], WITH, "no encoder, and a re-simulation needs the recorded spindle"),
        ([STATE, COMMAND], [*WITH, "--topic", "encoder=/shaft"], "has no such topic; it has /coarse/"),
        ([ENCODER, STATE], [*WITH, "--topic", "angle=/encoder"], "the cell has no angle; allowed: coar"),
        ([ENCODER, STATE], [*WITH, "--topic", "tool=/encoder"], "/encoder is lathe_rc_msgs/msg/Encoder"),
        ([ENCODER, STATE], [*WITH, "--topic", "encoder"], "allowed: NAME=/TOPIC"),
        ([ENCODER, STATE], [*WITH, "--set", "sample_rate=32000"], "allowed: sample_rate = 64000 Hz"),
        (THREE, ["--identify", "-o", "bag2"], "need a cell, and the bag holds no scenario"),
        ([ENCODER], ["--write-form", "form.csv"], "no form without the tool's position"),
    ],
)
def test_what_is_missing_is_named(clean, tmp_path, topics, arguments, said):
    found = lathe("resim", stripped(clean[1], tmp_path / "bag", topics), *arguments)
    assert found.exit_code == 2
    assert said in found.stderr
    assert found.stderr.count("\n") == 1


def _spoil(topic, field, value, at=700):
    def change(name, message):
        if name == topic and message.block.first_index == at // 64 * 64:
            getattr(message, field)[at % 64] = value
        return message

    return change


def _cut(topic):
    return lambda name, message: None if name == topic and message.block.first_index == 640 else message


def _slower(name, message):
    if name == STATE and message.block.first_index >= 640:
        message.block.step_ns = 20000
    return message


def _still(name, message):
    if name == COMMAND:
        message.position[:] = 1e-4
    return message


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_spoil(STATE, "measured_position", np.nan), f"{STATE}: measured_position = nan at sample 700"),
        (_spoil(ENCODER, "angle_true", -np.inf), f"{ENCODER}: angle_true = -inf at sample 700"),
        (_spoil(ENCODER, "angle_true", 0.0), f"{ENCODER}: angle_true goes by -1.1"),
        (_spoil(ENCODER, "angle_true", 1e300), f"{ENCODER}: angle_true goes by 1e+300 rad at sample 700"),
        (_spoil(STATE, "measured_position", 1e300), "position = 1e+300 m at sample 700"),
        (_cut(STATE), f"{STATE} goes from sample 640 to 704"),
        (_cut(ENCODER), f"{ENCODER} goes from sample 640 to 704"),
        (_still, "the command does not move"),
        (_slower, f"{STATE}: the step changes from 15625 to 20000 ns at sample 640"),
    ],
)
def test_hostile_values_are_refused(clean, tmp_path, change, said):
    found = lathe("resim", stripped(clean[1], tmp_path / "bag", THREE, change), *WITH, "--identify")
    assert found.exit_code in (1, 2)
    assert said in found.stderr
    assert found.stderr.count("\n") == 1


def test_the_form_is_the_position_averaged_by_angle(tmp_path):
    """Of a part that does not change along its length, once learned."""
    form = {"profile": "harmonics", "harmonic_order": "[2, 3]", "harmonic_amplitude": "[100e-6, 20e-6]", "feed": 0.0}
    sets = ["spindle_encoder.revolutions=30.0", *(f"tool.{name}={value}" for name, value in form.items())]
    harness.run(scenarios.load(PISTON, sets), bag=tmp_path / "whole")
    bag = stripped(tmp_path / "whole", tmp_path / "bag", [ENCODER, STATE])
    said = lathe("resim", bag, *WITH, "--write-form", tmp_path / "form.csv", "--json")
    assert said.exit_code == 0
    angle = np.linspace(0.0, 2.0 * np.pi, 100)
    wanted = 100e-6 * np.sin(2.0 * angle) + 20e-6 * np.sin(3.0 * angle)
    assert_allclose(read_csv(tmp_path / "form.csv").deviation(angle, 0.0), wanted, atol=1e-6)
    used = ["--set", f"tool.profile_file={tmp_path / 'form.csv'}"]
    assert max(json.loads(lathe("resim", bag, *WITH, *used, "--json").stdout)["rms_um"][10:]) < 2.0


# ------------------------------------------------------------------ the fit alone


def simulated(command, natural_frequency, damping, delay, method="foh"):
    drive = ElectrodynamicDrive(
        natural_frequency=natural_frequency, damping=damping, delay=delay, stroke=1.0, moving_mass=1.0,
        force_constant=1.0, step=STEP, method=method,
    )  # fmt: skip
    position, velocity, current = np.empty((3, command.size))
    drive.block(command, position, velocity, current)
    return position


def rich(samples, seed):
    """A command with some of everything up to 3 kHz [m]."""
    random = np.random.default_rng(seed)
    time = np.arange(samples) * STEP
    frequency = np.geomspace(10.0, 3000.0, 24)
    phase = random.uniform(0.0, 2.0 * np.pi, frequency.size)
    return 1e-4 * np.sum(
        np.sin(2.0 * np.pi * frequency[:, None] * time + phase[:, None]) / frequency[:, None] ** 0.5, 0
    )


@settings(max_examples=15)
@given(
    natural_frequency=st.floats(200.0, 8000.0),
    damping=st.floats(0.05, 3.0),
    delay=st.floats(0.0, 5e-3),
    method=st.sampled_from(["foh", "tustin"]),
    cut=st.integers(0, 3000),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_drive_of_the_physical_box_is_found(natural_frequency, damping, delay, method, cut, seed):
    """Also when the record begins in the middle of a motion."""
    command = rich(16384, seed)
    position = simulated(command, natural_frequency, damping, delay, method)
    fit = drive_fit.fit(command[cut:], position[cut:], STEP, method=method)
    assert fit.values["natural_frequency"] == pytest.approx(natural_frequency, rel=1e-5)
    assert fit.values["damping"] == pytest.approx(damping, rel=1e-5)
    assert fit.values["delay"] == pytest.approx(delay, abs=1e-9)
    assert fit.nrmse < 1e-6


@pytest.mark.parametrize("correlated", [False, True])
def test_the_standard_errors_are_those_of_repeated_records(correlated):
    """Of white noise and of noise behind a low-pass of 0.5 ms, 20 records each."""
    command = rich(8192, 1)
    position = simulated(command, **TRUE)
    random = np.random.default_rng(7)
    found, said = [], []
    for _ in range(20):
        noise = random.standard_normal(position.size)
        if correlated:
            noise = np.convolve(noise, np.exp(-np.arange(320) / 32.0))[: noise.size] / 4.0
        fit = drive_fit.fit(command, position + 1e-6 * noise, STEP)
        found.append(list(fit.values.values()))
        said.append(list(fit.errors.values()))
    assert_allclose(np.mean(said, axis=0), np.std(found, axis=0), rtol=0.5)
    assert_allclose(np.mean(found, axis=0), list(TRUE.values()), rtol=5e-3)


def test_a_step_of_the_command_is_enough():
    command = np.where(np.arange(65536) < 21200, 0.0, 1e-4)
    noise = 1e-8 * np.random.default_rng(3).standard_normal(command.size)
    fit = drive_fit.fit(command, simulated(command, **TRUE) + noise, STEP)
    for name, value in TRUE.items():
        assert abs(fit.values[name] - value) < 4.0 * fit.errors[name]
    assert fit.condition < 30.0


def test_one_harmonic_alone_is_refused_and_a_little_more_is_warned_of():
    """Its amplitude and phase are two numbers; a drive has three."""
    time = np.arange(64000) * STEP
    sine = 1e-4 * np.sin(2.0 * np.pi * 33.0 * time)
    with pytest.raises(InputError, match=r"the command (does not tell|leaves) natural_frequency"):
        drive_fit.fit(sine[32000:], simulated(sine, **TRUE)[32000:], STEP)
    fit = drive_fit.fit(sine, simulated(sine, **TRUE), STEP)
    assert "natural_frequency" in fit.vague
    assert fit.condition > 1000.0


HIDDEN = "nothing to identify|leaves|does not tell"
SLOW = 1e-6 * np.sin(2.0 * np.pi * 5.0 * np.arange(32768) * STEP)


@pytest.mark.parametrize(
    ("command", "position", "said"),
    [
        (np.zeros(100), np.zeros(100), "512 or more"),
        (np.zeros(1000), np.zeros(900), "as many of each"),
        (np.full(1000, np.nan), np.zeros(1000), "command = nan m at sample 0"),
        (rich(1000, 0), np.full(1000, 1e9), "position = 1000000000.0 m at sample 0"),
        (np.full(1000, 1e-3), rich(1000, 0), "the command does not move"),
        (rich(1000, 0), np.full(1000, 1e-3), "the position does not move"),
        (rich(1000, 0), -rich(1000, 0), HIDDEN),
        (
            SLOW,
            simulated(SLOW, **TRUE) + 1e-6 * np.random.default_rng(5).standard_normal(SLOW.size),
            HIDDEN,
        ),  # by noise
    ],
)
def test_records_that_say_nothing_are_refused(command, position, said):
    with pytest.raises(InputError, match=said):
        drive_fit.fit(command, position, STEP)
