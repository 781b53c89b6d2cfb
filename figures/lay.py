# SPDX-License-Identifier: Apache-2.0
"""Draws img/lay.png of metrology.md."""

import numpy as np
from matplotlib.figure import Figure

import lathe_rc
from lathe_rc.analysis.metrology import Lay, lay
from place import PICTURES

BLUE, GREY = "#1f6f8b", "#777777"
NOSE, FEED = 0.8e-3, 0.1e-3

changes = ["spindle_encoder.revolutions=14", f"tool.nose_radius={NOSE}"]
found = lathe_rc.run(lathe_rc.load("piston", changes)).surface
assert isinstance(found, Lay), "it is fed"
turns = np.arange(14)[:, None] + np.arange(64) / 64
errorless = lay(np.zeros(turns.shape), FEED * turns, NOSE)

figure = Figure(figsize=(11, 4.0), layout="constrained")
surface, trace = figure.subplots(1, 2)
angles = 360.0 * np.arange(found.surface.shape[0] + 1) / found.surface.shape[0]
closed = np.concatenate((found.surface, found.surface[:1])) * 1e6
drawn = surface.pcolormesh(angles, found.height * 1e3, closed.T, shading="gouraud", cmap="viridis", rasterized=True)
surface.set(xlabel="angle [°]", ylabel="height [mm]", xticks=range(0, 361, 60))
figure.colorbar(drawn, ax=surface, label="deviation of the radius [µm]")
trace.plot(found.height * 1e3, found.surface[16] * 1e6, color=BLUE, lw=1.3, label="turned, at 90°")
trace.plot(errorless.height * 1e3, errorless.surface[16] * 1e6, color=GREY, lw=1.0, ls="--", label="errorless path")
trace.set(xlabel="height [mm]", ylabel="deviation of the radius [µm]")
trace.grid(visible=True, alpha=0.25)
trace.legend(fontsize=8)
figure.savefig(PICTURES / "lay.png", dpi=110)
