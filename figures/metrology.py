# SPDX-License-Identifier: Apache-2.0
"""Draws img/metrology.png of metrology.md and prints its table: an eccentric, lobed form, measured."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.projections.polar import PolarAxes

import lathe_rc
from lathe_rc import messages
from lathe_rc.analysis.metrology import measure
from place import CONFIG, PICTURES

CUTOFF = 50.0  # [UPR]
SHOWN = {4: "#c0392b", 60: "#1f6f8b"}  # revolutions

loaded = lathe_rc.load(
    CONFIG / "piston.yaml",
    [
        "tool.profile=harmonics",
        "tool.harmonic_order=[1, 2, 4, 12]",
        "tool.harmonic_amplitude=[20e-6, 100e-6, 8e-6, 2e-6]",
        "tool.feed=0.0",
        "electrodynamic_actuator.noise_rms=0.2e-6",
        "spindle_encoder.revolutions=60",
    ],
)
recording = lathe_rc.run(loaded).recording
part = measure(
    recording.of_type(messages.ENCODER)["angle_true"],
    recording.of_type(messages.TOOL)["error"],
    highest=20,
    roundness_cutoff=CUTOFF,
    roughness_cutoff=CUTOFF,
)

print("| revolution | RMS | peak to valley | centre x, y | RONt | RONq | UPR 2 | UPR 4 | UPR 12 | Ra | Rq |")
print("| ---: | ---: | ---: | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
for revolution in (1, 4, 6, 10, 60):
    k = revolution - 1
    around = part.roundness
    numbers = [part.form.rms[k], part.form.peak_to_valley[k]]
    numbers += [around.peak_to_valley[k], around.rms[k], *part.undulations.amplitude[k, [2, 4, 12]]]
    numbers += [part.roughness.ra[k], part.roughness.rq[k]]
    texts = [f"{number * 1e6:.3f}" for number in numbers]
    texts.insert(2, f"{around.x[k] * 1e6:.3f}, {around.y[k] * 1e6:.3f}")
    print(f"| {revolution} | {' | '.join(texts)} |")

figure = Figure(figsize=(11, 4.2), layout="constrained")
chart = figure.add_subplot(1, 2, 1, projection="polar")
by_order = figure.add_subplot(1, 2, 2)
assert isinstance(chart, PolarAxes)
points = part.profile.shape[1]
around = np.linspace(0.0, 2 * np.pi, points + 1)
for place, (revolution, colour) in enumerate(SHOWN.items()):
    k = revolution - 1
    profile = np.append(part.profile[k], part.profile[k, 0]) * 1e6
    found = part.roundness
    circle = (found.radius[k] + found.x[k] * np.cos(around) + found.y[k] * np.sin(around)) * 1e6
    chart.plot(around, profile, color=colour, lw=1.2, label=f"revolution {revolution}")
    chart.plot(around, circle, color=colour, lw=0.8, ls="--")
    bars = np.arange(21) + 0.4 * (place - 0.5)
    by_order.bar(bars, part.undulations.amplitude[k] * 1e6, 0.4, color=colour, label=f"revolution {revolution}")
chart.set_rlim(-6.0, 3.0)
chart.set_rgrids([-3.0, 0.0, 3.0], ["−3 µm", "", "+3 µm"], fontsize=7)
chart.set_rlabel_position(112)
chart.tick_params(labelsize=8)
chart.set_title("radius, and least-squares circles (dashed)", fontsize=10)
by_order.set(xlabel="undulations per revolution", ylabel="amplitude [µm]", yscale="log", xticks=range(0, 21, 2))
by_order.set_title("undulations", fontsize=10)
by_order.grid(visible=True, alpha=0.25)
by_order.legend(fontsize=8)
figure.savefig(PICTURES / "metrology.png", dpi=130)
