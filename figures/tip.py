# SPDX-License-Identifier: Apache-2.0
"""Draws img/tip.png of signals.md."""

import numpy as np
from matplotlib.figure import Figure

from lathe_machine.signals.profile import Harmonics
from lathe_machine.signals.profile_table import ProfileTable
from lathe_machine.signals.tip_path import TipPath, steepest_fall
from place import PICTURES

RADIUS, TIP = 2e-3, 0.4e-3
BLUE, RED, GREY = "#1f6f8b", "#c0392b", "#777777"

form = Harmonics(np.array([2.0]), np.array([225e-6]), np.zeros(1))
angle = np.linspace(0.0, 2 * np.pi, 721)
wanted = RADIUS + form.deviation(angle, 0.0)
slope = 450e-6 * np.cos(2 * angle) / wanted
missing = TipPath(form, RADIUS, TIP).deviation(angle, 0.0) - form.deviation(angle, 0.0)
fall = steepest_fall(ProfileTable(form), RADIUS, 0.0)
first = TIP * (np.hypot(1.0, slope) - 1.0)
print(f"at most {missing.max() * 1e6:.2f} µm too deep; ρ·(1/cos β - 1): {first.max() * 1e6:.2f} µm")
print(f"falls by {fall.clearance:.4f} rad at {fall.angle:.3f} rad")

figure = Figure(figsize=(11, 4.6), layout="constrained")
shape, curves = figure.add_subplot(121, projection="polar"), figure.add_subplot(122)
shape.plot(angle, wanted * 1e3, color=GREY, lw=1.4, label="form, and what the corrected path leaves")
shape.plot(angle, (wanted - 20.0 * missing) * 1e3, color=RED, lw=1.2, label="left by the form as the path, × 20")
shape.set_rlim(0.0, 2.6)
shape.set_rticks([1.0, 2.0])
shape.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, -0.22))
turn = np.degrees(angle)
curves.plot(turn, missing * 1e6, color=RED, lw=1.4, label="too deep without correction")
curves.plot(turn, first * 1e6, color=GREY, ls="--", lw=1.2, label="ρ·(1/cos β − 1)")
curves.set(xlabel="angle [°]", ylabel="[µm]", xlim=(0, 360), ylim=(-0.5, 12.5), xticks=range(0, 361, 60))
falling = curves.twinx()
falling.plot(turn, -np.degrees(np.arctan(slope)), color=BLUE, lw=1.2, label="fall of the form")
falling.axhline(np.degrees(fall.clearance), color=BLUE, ls=":", lw=1.2, label="clearance that it needs")
falling.set_ylabel("[°]", color=BLUE)
falling.set_ylim(-14, 18)
lines = [*curves.get_lines(), *falling.get_lines()]
curves.legend(lines, [str(line.get_label()) for line in lines], fontsize=8, loc="upper center", ncols=2)
curves.grid(visible=True, alpha=0.25)
figure.savefig(PICTURES / "tip.png", dpi=110)
