# SPDX-License-Identifier: Apache-2.0
"""Draws img/predistortion.png of force_position.md and prints its tables."""

import numpy as np
from matplotlib.figure import Figure

from lathe_machine.analysis.shaft import Shaft
from lathe_machine.control.predistortion import Predistortion, cancelling, contraction, proportional, turned
from place import PICTURES

STIFFNESS = 233.3e3  # W4 of paper 004 [N/m]
DEPTH = 150.0 / STIFFNESS  # [m]
LENGTH, DIAMETER = 0.6, 0.034  # [m]
SPRINGS = {"head": 2e7, "tail": 1e7, "carriage": 5e7}  # [N/m]
CHUCK = {**SPRINGS, "chuck_rotation": 2e-6}
SHAFTS = {
    "between centres": Shaft(LENGTH, DIAMETER, "centres", **SPRINGS),
    "chuck and centre": Shaft(LENGTH, DIAMETER, "chuck_and_centre", **CHUCK),
    "chuck alone": Shaft(LENGTH, DIAMETER, "chuck", **CHUCK),
}
COLOURS = ("#1f6f8b", "#c0392b", "#e08e0b", "#777777")

z = np.linspace(0.0, LENGTH, 121)
law = proportional(STIFFNESS)
shaft = SHAFTS["between centres"].compliance(z)
figure = Figure(figsize=(13, 4.0), layout="constrained")
compliances, errors, learning = figure.subplots(1, 3)

print("| support | head stock | middle | tail stock or end |")
print("| --- | ---: | ---: | ---: |")
for (name, each), colour in zip(SHAFTS.items(), COLOURS, strict=False):
    ends = each.compliance(np.array([0.0, 0.5, 1.0]) * LENGTH) * 1e9
    print(f"| {name} | {ends[0]:.0f} | {ends[1]:.0f} | {ends[2]:.0f} |")
    compliances.semilogy(z * 1e3, each.compliance(z) * 1e9, color=colour, lw=1.4, label=name)
compliances.axhline(385.0, color=COLOURS[3], lw=0.9, ls=":", label="W3 of paper 004, static")

straight = turned(shaft, law, DEPTH, np.zeros(z.size))
paths = {
    "none": np.zeros(z.size),
    "deflection seen, taken off once": -straight,
    "solved": cancelling(shaft, law, DEPTH),
    "solved for a shaft 20 % too stiff": cancelling(shaft / 1.2, law, DEPTH),
}
print("\n| path | largest offset | largest error | force in the middle |")
print("| --- | ---: | ---: | ---: |")
for (name, path), colour in zip(paths.items(), (COLOURS[3], COLOURS[2], COLOURS[0], COLOURS[1]), strict=True):
    radius = turned(shaft, law, DEPTH, path)
    middle = float(law(DEPTH - radius)[z.size // 2])
    print(f"| {name} | {np.abs(path).max() * 1e6:.2f} µm | {np.abs(radius).max() * 1e6:.2f} µm | {middle:.1f} N |")
    errors.plot(z * 1e3, radius * 1e6, color=colour, lw=1.4, label=name)

print("\n| gain | contraction | error of parts 1, 2, 3, 5, 10 [µm RMS] |")
print("| ---: | ---: | --- |")
for gain, colour in zip((1.0, 0.5, 1.8), COLOURS, strict=False):
    random = np.random.default_rng(1)
    path, found = Predistortion(z, np.zeros(z.size)), []
    for _ in range(15):
        radius = turned(shaft, law, DEPTH, path.offsets)
        found.append(float(np.sqrt(np.mean(radius**2))) * 1e6)
        path = path.corrected(z, radius + random.normal(0.0, 0.2e-6, z.size), gain)
    shown = ", ".join(f"{found[part - 1]:.3f}" for part in (1, 2, 3, 5, 10))
    print(f"| {gain:g} | {contraction(shaft, STIFFNESS, gain):.3f} | {shown} |")
    learning.semilogy(np.arange(1, 16), found, "o-", ms=3, color=colour, lw=1.2, label=f"gain {gain:g}")
learning.axhline(0.2, color=COLOURS[3], lw=0.9, ls=":", label="noise of the measurement")

compliances.set(xlabel="height from the head stock [mm]", ylabel="compliance [nm/N]")
compliances.set_title("compliance under the tool", fontsize=10)
errors.set(xlabel="height from the head stock [mm]", ylabel="radius error [µm]", ylim=(-2, 78))
errors.set_title("between centres at 150 N", fontsize=10)
learning.set(xlabel="part", ylabel="radius error [µm RMS]", ylim=(0.03, 400))
learning.set_title("learned from part to part, from no model on", fontsize=10)
for axes in (compliances, errors, learning):
    axes.grid(visible=True, which="both", alpha=0.25)
    axes.legend(fontsize=8, loc="upper left" if axes is compliances else "upper right")
figure.savefig(PICTURES / "predistortion.png", dpi=130)
