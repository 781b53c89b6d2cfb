# SPDX-License-Identifier: Apache-2.0
"""Prints the table of learning.md: the steady-error formula against a run of 100 revolutions."""

import numpy as np
from scipy.integrate import trapezoid

import lathe_rc
from lathe_rc import messages
from lathe_rc.cell.wiring import Cell
from place import CONFIG

WAVES = [2, 5, 10, 15, 20]
AMPLITUDE = 10e-6  # [m]

loaded = lathe_rc.load(
    CONFIG / "piston.yaml",
    [
        "spindle_encoder.deviation_amplitude=[0.0]",
        "spindle_encoder.revolutions=100",
        "tool.profile=harmonics",
        f"tool.harmonic_order={WAVES}",
        f"tool.harmonic_amplitude={[AMPLITUDE] * len(WAVES)}",
        "tool.feed=0.0",
    ],
)
cell = Cell(loaded.nodes)
drive = cell.stages["electrodynamic_actuator"].drive.plant.response
loop = cell.stages["learning_controller"].loop(drive)
speed = loaded.shared.nominal_speed

result = lathe_rc.run(loaded)
last = slice(*result.errors.starts[-2:])
angle = result.recording.of_type(messages.ENCODER)["angle_true"][last]
error = result.recording.of_type(messages.TOOL)["error"][last]

print(r"| waves | $\omega$ [rad/s] | $\lvert Q - \gamma Z\rvert$ | formula | run |")
print("| ---: | ---: | ---: | ---: | ---: |")
for waves in WAVES:
    at = np.array([waves])
    ran = abs(trapezoid(error * np.exp(-1j * waves * angle), angle)) / np.pi / AMPLITUDE
    factor, formula = abs(loop.operator(at, speed)[0]), abs(loop.steady_error(at, speed)[0])
    print(f"| {waves} | {waves * speed:.1f} | {factor:.3f} | {formula:.4e} | {ran:.4e} |")
