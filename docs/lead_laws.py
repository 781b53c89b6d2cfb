# SPDX-License-Identifier: Apache-2.0
"""Draws img/lead_laws.png of learning.md: constant against variable lead when the spindle speed swings."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from lathe_rc import harness
from lathe_rc.cell import messages, scenario

HERE = Path(__file__).parent
START = 3.0  # [s] the memory is frozen and the deviation begins
LAWS = {"constant_angle": "#c0392b", "variable": "#1f6f8b"}


def error_after(law: str, frequency: float) -> npt.NDArray[np.float64]:
    """Form error [µm] from `START` on, at 64 kHz, for a lead law and a deviation's frequency [rad/s]."""
    loaded = scenario.load(
        HERE.parent / "config" / "piston.yaml",
        [
            "tool.profile=harmonics",
            "tool.harmonic_order=[2]",
            "tool.harmonic_amplitude=[225e-6]",
            "tool.feed=0.0",
            "learning_controller.lead_time=2e-3",
            "learning_controller.q_time=130e-6",
            f"learning_controller.lead_law={law}",
            f"learning_controller.events=['second {START}: freeze']",
            f"spindle_encoder.deviation_frequency=[{frequency}]",
            f"spindle_encoder.deviation_start={START}",
            "spindle_encoder.revolutions=80",
        ],
    )
    error = harness.run(loaded).recording.of_type(messages.TOOL)["error"]
    return np.asarray(error[round(START * loaded.shared.sample_rate) :] * 1e6)


figure = Figure(figsize=(11, 3.6), layout="constrained")
over_time, over_frequency = figure.subplots(1, 2)
frequencies = np.geomspace(5.0, 213.0, 14)
for law, colour in LAWS.items():
    error = error_after(law, 10.7)
    over_time.plot(np.arange(error.size) / 64e3, error, color=colour, lw=0.8, label=law)
    worst = [np.abs(error_after(law, frequency)).max() for frequency in frequencies]
    over_frequency.loglog(frequencies, worst, ".-", color=colour, label=law)
over_time.set(xlabel="time since the deviation began [s]", ylabel="form error [µm]")
over_time.set_title("deviation of 10 % at 10.7 rad/s", fontsize=10)
over_frequency.set(xlabel="frequency of the deviation [rad/s]", ylabel="largest form error [µm]")
over_frequency.set_title("largest error, by frequency", fontsize=10)
for axes in (over_time, over_frequency):
    axes.grid(visible=True, which="both", alpha=0.25)
    axes.legend(fontsize=8)
figure.savefig(HERE / "img" / "lead_laws.png", dpi=130)
for frequency in (10.7, 106.0, 213.0):
    constant, variable = (np.abs(error_after(law, frequency)).max() for law in LAWS)
    times = constant / variable
    print(f"{frequency:5.1f} rad/s: constant {constant:.2f} µm, variable {variable:.2f} µm: {times:.1f} times less")
