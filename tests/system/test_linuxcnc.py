# SPDX-License-Identifier: Apache-2.0
"""Stages as components of LinuxCNC, run by halrun on the wall clock of a simulation: examples/linuxcnc."""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from bags import some
from cells import SCENARIOS
from test_c_libraries import REFUSED

from lathe_export.c_library.hal import export_hal
from lathe_rc import harness
from lathe_rc.cell.scenario import load
from lathe_rc.cell.wiring import Cell

pytestmark = [
    pytest.mark.system,
    pytest.mark.timeout(600),
    pytest.mark.skipif(shutil.which("halcompile") is None, reason="no linuxcnc-uspace-dev"),
]

EXAMPLES = Path(__file__).parents[2] / "examples" / "linuxcnc"
MODULES = Path("/usr/lib/linuxcnc/modules")
NAMES = {
    "spindle_encoder": "turning", "learning_controller": "law", "electrodynamic_actuator": "drive", "tool": "tip"
}  # fmt: skip
RATES = (4000, 8000)
SAMPLES = 6000  # 13 revolutions at 8 kHz

#: waits for pins, so that no time is awaited; {} are lines of its own
DRIVER = """
import subprocess, sys, time
import hal
component = hal.component("driver")
component.ready()
def sets(name, value):
    subprocess.run(["halcmd", "sets", name, value], check=True)
def until(what, pins):
    deadline = time.monotonic() + 60
    while not what(*map(hal.get_value, pins)):
        if time.monotonic() > deadline:
            sys.exit(f"{{pins}}: {{[*map(hal.get_value, pins)]}}")
        time.sleep(0.01)
{}
"""


def piston(rate, *further):
    return load("piston", [f"sample_rate={rate}", "learning_controller.feedback_delay=100", *further])


@pytest.fixture(scope="module")
def halrun(tmp_path_factory):
    """Runs a HAL file in its folder, with the modules of a sampling rate installed; returns what it says."""
    with tempfile.TemporaryDirectory() as fifo:
        Path(fifo).chmod(0o777)  # rtapi_app gives up the rights of root before it binds its socket
        environment = os.environ | {"RTAPI_UID": "65534", "RTAPI_FIFO_PATH": f"{fifo}/rtapi"}
        installed = None

        def run(rate, file, *options, code=0, **variables):
            nonlocal installed
            if installed != rate:
                for node, name in NAMES.items():
                    place = tmp_path_factory.mktemp(name) / name
                    export_hal(piston(rate), node, place, name=name, samples=1)
                    subprocess.run(["make", "install"], cwd=place, check=True)
                installed = rate
            values = {name: str(value) for name, value in variables.items()}
            command = ["halrun", *options, file]
            done = subprocess.run(
                command, cwd=file.parent, env=environment | values, capture_output=True, text=True, check=False
            )
            said = done.stdout + done.stderr
            assert done.returncode == code, said
            return said

        yield run
        for name in NAMES.values():
            (MODULES / f"{name}.so").unlink(missing_ok=True)


@pytest.fixture
def examples(tmp_path):
    return Path(shutil.copytree(EXAMPLES, tmp_path / "linuxcnc"))


def driven(file, lines, started="start\n"):
    """Let a HAL file end with some lines of Python in place of its own end."""
    (file.parent / "driver.py").write_text(DRIVER.format(lines), encoding="utf-8")
    begin = file.read_text(encoding="utf-8").partition("\nstart\n")[0]
    file.write_text(f"{begin}\n{started}loadusr -w /usr/bin/python3 driver.py\n", encoding="utf-8")
    return file


@pytest.mark.parametrize("rate", RATES)
def test_a_cell_in_hal_has_the_bits_of_the_engine(rate, halrun, examples, tmp_path):
    """Spindle, law, drive and tip as four components in one thread, at 4 kHz and 8 kHz, over 13 revolutions."""
    halrun(rate, examples / "cell.hal", PERIOD=10**9 // rate, SAMPLES=SAMPLES)
    harness.run(piston(rate, "spindle_encoder.revolutions=30"), bag=tmp_path / "bag")
    compared = [sys.executable, examples / "compare.py", examples / "samples.txt", tmp_path / "bag"]
    done = subprocess.run(compared, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.count(f"{SAMPLES} samples, equal")) == (0, 5), done.stdout + done.stderr


def test_a_thread_of_another_period_is_a_fault(halrun, examples):
    """No sample is computed; the message names both periods."""
    file = driven(examples / "cell.hal", "until(lambda fault, reason: fault and reason == -100, PINS)".replace(
        "PINS", "['law.fault', 'law.reason']"))  # fmt: skip
    said = halrun(4000, file, PERIOD=125000, SAMPLES=1)
    assert "law: thread of 125000 ns; allowed: the sample period, 250000 ns" in said


def test_a_bad_input_is_a_fault_that_holds_the_command_until_reset(halrun, examples):
    """NaN: by name in the log; enable and reset begin anew with 0. A parameter beyond its limits falls back."""
    file = driven(examples / "cell.hal", """
until(lambda command: command < -1e-5, ["law.coarse-command-position"])
hal.set_p("law.learning-gain", "7")
until(lambda gain: gain == 1, ["law.learning-gain"])
hal.set_p("law.learning-gain", "0.5")
subprocess.run(["halcmd", "unlinkp", "law.tool-measured-error"], check=True)
hal.set_p("law.tool-measured-error", "nan")
until(lambda fault, reason: fault and reason == -2, ["law.fault", "law.reason"])
held = hal.get_value("law.coarse-command-position")
assert held != 0
hal.set_p("law.tool-measured-error", "1e-5")
assert hal.get_value("law.fault") and hal.get_value("law.coarse-command-position") == held
hal.set_p("law.reset", "1")
until(lambda fault, command: not fault and command == 0, ["law.fault", "law.coarse-command-position"])
hal.set_p("law.reset", "0")
until(lambda command: command != 0, ["law.coarse-command-position"])
assert hal.get_value("law.learning-gain") == 0.5
""")  # fmt: skip
    said = halrun(4000, file, PERIOD=250000, SAMPLES=1)
    assert "tool.measured_error: the input is not finite" in said


def test_a_lathe_with_an_encoder_in_counts_learns_the_form(halrun, examples):
    """From sim_encoder with 600 counts: 230 µm before, less than 5 µm after; index pulse, latch, and one reset."""
    file = driven(examples / "lathe.hal", """
until(lambda waits, enabled: not waits and not enabled, ["encoder.0.index-enable", "law.enable"])
def error():
    end, largest = hal.get_value("encoder.0.position") + 2.0, 0.0
    while hal.get_value("encoder.0.position") < end:
        largest = max(largest, abs(hal.get_value("tip.tool-measured-error")))
        time.sleep(0.001)
    return largest
assert error() > 200e-6
sets("reset", "true")
until(lambda ok: ok, ["estop-latch.0.ok-out"])
sets("reset", "false")
until(lambda enabled: enabled, ["law.enable"])
deadline = time.monotonic() + 100
while (last := error()) > 5e-6:
    assert time.monotonic() < deadline, last
subprocess.run(["halcmd", "unlinkp", "law.tool-measured-error"], check=True)
hal.set_p("law.tool-measured-error", "nan")
until(lambda ok, enabled: not ok and not enabled, ["estop-latch.0.ok-out", "law.enable"])
hal.set_p("law.tool-measured-error", "0")
assert hal.get_value("law.fault")
sets("reset", "true")
until(lambda ok, fault: ok and not fault, ["estop-latch.0.ok-out", "law.fault"])
sets("reset", "false")
until(lambda enabled: enabled, ["law.enable"])
sets("index-enable", "true")  # the angle will jump: the law stops before it does
until(lambda enabled: not enabled, ["law.enable"])
assert not hal.get_value("law.fault")
""")  # fmt: skip
    halrun(4000, file, "-i", "lathe.ini")


def test_each_stage_compiles_as_a_component(tmp_path):
    """One of each different compiled step that the scenarios have."""
    steps = {}
    for path in SCENARIOS:
        for name, stage in Cell(load(path).nodes).stages.items() if path.stem not in REFUSED else ():
            steps.setdefault(stage.native().name, (path, name))
    for number, (path, name) in enumerate(some([*steps.values()], 4)):
        place = tmp_path / str(number)
        export_hal(load(path), name, place, name="part", samples=1)
        subprocess.run(["make"], cwd=place, check=True)
        assert (place / "part.so").exists()
