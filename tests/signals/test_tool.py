# SPDX-License-Identifier: Apache-2.0
"""The tool against the part: the true form error, and what the controller can know of it."""

import numpy as np
import pytest
from cells import config, encoder, run
from numpy.testing import assert_allclose, assert_array_equal

from lathe_machine.signals.profile import Piston
from lathe_rc import harness, messages

TURN = 2 * np.pi
PISTON = {"profile": "piston", "feed": 2e-3, "start_height": 0.01}
FORM = Piston(ovality=0.5e-3, ovality_middle=0.4e-3, barrel=30e-6, length=0.06, widest=0.02)


def desired(angle):
    """The piston's form where the feed has brought the tool."""
    heights = 0.01 + 2e-3 * angle / TURN
    return np.array([FORM.deviation(np.array([a]), h)[0] for a, h in zip(angle, heights, strict=True)])


@pytest.fixture(scope="module")
def rough():
    """Encoder, drive and tool in a run with a coarse encoder and a noisy sensor."""
    result = run(
        spindle_encoder={"revolutions": 3.0, "counts_per_revolution": 1000, "deviation_amplitude": [0.05],
                         "deviation_frequency": [10.7]},
        electrodynamic_actuator={"noise_rms": 1e-6, "resolution": 1e-7},
        tool=PISTON,
    )  # fmt: skip
    signals = result.recording
    return encoder(result), signals.of_type(messages.STATE), signals.of_type(messages.TOOL)


def test_form_error_is_true(rough):
    angle, drive, tool = rough
    assert_allclose(tool["height"], 0.01 + 2e-3 * angle["angle_true"] / TURN, rtol=1e-12)
    assert_allclose(tool["reference"], desired(angle["angle_true"]), atol=2e-8)
    assert np.array_equal(tool["displacement"], drive["position"])
    assert np.array_equal(tool["error"], tool["reference"] - drive["position"])


def test_measured_error_is_that_of_the_measured_angle_and_position(rough):
    angle, drive, tool = rough
    assert np.abs(angle["angle"] - angle["angle_true"]).max() > 1e-3
    assert np.std(drive["measured_position"] - drive["position"]) == pytest.approx(1e-6, rel=0.02)
    assert_allclose(tool["measured_error"], desired(angle["angle"]) - drive["measured_position"], atol=2e-8)


def test_ideal_sensors_measure_the_error():
    tool = run(tool=PISTON).recording.of_type(messages.TOOL)
    assert np.array_equal(tool["measured_error"], tool["error"])


def test_an_error_motion_is_in_the_part_and_in_no_sensor():
    without, found = (
        harness.run(config("oval3000", "spindle_encoder.revolutions=4", *changes)).recording
        for changes in (
            [],
            [
                "tool.error_motion_order=[2, 5]",
                "tool.error_motion_amplitude=[1e-6, 0.5e-6]",
                "tool.error_motion_phase=[0.0, 1.0]",
            ],
        )
    )
    angle = found.dense["/encoder"]["angle_true"]
    motion = 1e-6 * np.sin(2.0 * angle) + 0.5e-6 * np.sin(5.0 * angle + 1.0)
    assert_allclose(found.dense["/tool"]["error"] - without.dense["/tool"]["error"], motion, atol=1e-15)
    for topic, field in (
        ("/tool", "measured_error"),
        ("/tool", "displacement"),
        ("/coarse/state", "measured_position"),
    ):
        assert_array_equal(found.dense[topic][field], without.dense[topic][field])
