# SPDX-License-Identifier: Apache-2.0
"""Prints a table that learning.md cites, of a form that changes along the part: the formula against a run."""

import numpy as np
import numpy.typing as npt

import lathe_rc
from lathe_papers.formulas.structures import Channel, steady_error
from lathe_rc import messages
from lathe_rc.analysis.metrology import POINTS, measure, undulations
from place import CONFIG

loaded = lathe_rc.load(
    CONFIG / "piston.yaml",
    [
        "spindle_encoder.deviation_amplitude=[0.0]",
        "spindle_encoder.revolutions=100",
        "tool.profile=piston",
        "tool.feed=0.5e-3",
    ],
)
speed = loaded.shared.nominal_speed
drive, controller, tool = (loaded.nodes[name] for name in ("electrodynamic_actuator", "learning_controller", "tool"))
channel = Channel(
    drive.natural_frequency, drive.damping, drive.delay, lead_time=controller.lead_time, q_time=controller.q_time
)


def error(waves: float) -> complex:
    """δ/Xd at any number of waves per revolution; the cycle is one revolution."""
    q, z = channel.q(waves * speed), channel.z(waves * speed)
    return complex(steady_error(q, z, 1.0, 2 * np.pi * waves))


def envelope(waves: int, terms: list[npt.NDArray[np.float64]]) -> npt.NDArray[np.complex128]:
    """Error of an amplitude A(φ) at ``waves`` from A, A' and A'': Taylor's series of the formula in ν."""
    d = 1e-3
    low, middle, high = (error(waves + off) for off in (-d, 0.0, d))
    first, second = (high - low) / (2 * d), (high - 2 * middle + low) / d**2
    return np.asarray(middle * terms[0] - 1j * first * terms[1] - second * terms[2] / 2)


result = lathe_rc.run(loaded)
angle = result.recording.of_type(messages.ENCODER)["angle_true"]
ran = measure(angle, result.recording.of_type(messages.TOOL)["error"], highest=2).undulations.amplitude

print("| revolution | UPR 0 formula [µm] | run [µm] | UPR 2 formula [µm] | run [µm] | UPR 2 if it repeated [µm] |")
print("| ---: | ---: | ---: | ---: | ---: | ---: |")
for revolution in (30, 60, 90):
    phi = 2 * np.pi * (revolution - 1 + np.arange(POINTS) / POINTS)
    farther = max(tool.piston_widest, tool.piston_length - tool.piston_widest)
    z = (tool.feed * phi / (2 * np.pi) - tool.piston_widest) / farther
    slope = tool.feed / (2 * np.pi) / farther
    squares = [z**2, 2 * slope * z, np.full(POINTS, 2 * slope**2)]  # z² and its derivatives
    growth = tool.piston_ovality - tool.piston_ovality_middle
    oval = [growth * square / 4 for square in squares]
    oval[0] = oval[0] + tool.piston_ovality_middle / 4
    barrel = [-tool.piston_barrel * square - part for square, part in zip(squares, oval, strict=True)]
    left = np.real(envelope(0, barrel) + envelope(2, oval) * np.exp(2j * phi))
    formula = undulations(left[None], 2).amplitude[0] * 1e6
    run = ran[revolution - 1] * 1e6
    repeated = abs(error(2.0)) * oval[0].mean() * 1e6
    print(f"| {revolution} | {formula[0]:.4f} | {run[0]:.4f} | {formula[2]:.4f} | {run[2]:.4f} | {repeated:.4f} |")
