# SPDX-License-Identifier: Apache-2.0
"""Draws img/resonance_map.png and prints the tables of robust.md: inverses of second and of fourth order.

The drives of oval3000 have two resonances anywhere from 500 to 3000 Hz. An argument is another number of drives.
"""

import sys
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from lathe_papers import cells, oval3000
from lathe_papers.judge import LAST, Judge
from lathe_papers.marks import point
from lathe_rc.cell.parameters import Values
from lathe_rc.study import untracked
from place import PICTURES

SEED, DRIVES, REVOLUTIONS = 56, int(sys.argv[1]) if len(sys.argv) > 1 else 200, 30
EDGES = (500.0, 600.0, 700.0, 850.0, 1200.0, 3000.0)  # [Hz] of the lower resonance
ORDERS = ("second_order", "fourth_order")
_DRIVE = "loaded_drive.coarse_"
Array = npt.NDArray[np.float64]


def hertz(*modes: float) -> Values:
    """Return frequencies of the resonances [Hz] as parameters of the drive."""
    return {f"{_DRIVE}mode_frequency": [2.0 * np.pi * each for each in modes]}


#: beyond what the law is made for; the drives are the first of the map, with other parameters
LIMITS: dict[str, Values] = {
    "resonances of oval3000, 900 and 1600 Hz": hertz(900.0, 1600.0),
    "the same, speed constant": {**hertz(900.0, 1600.0), "spindle_encoder.random_rms": 0.0},
    "the same, 500 nm of noise": {**hertz(900.0, 1600.0), f"{_DRIVE}noise_rms": 500e-9},
    "the same, 4096 counts": {**hertz(900.0, 1600.0), "spindle_encoder.counts_per_revolution": 4096},
    "the same, 1024 counts": {**hertz(900.0, 1600.0), "spindle_encoder.counts_per_revolution": 1024},
    "the same, delay twice that of the model": {**hertz(900.0, 1600.0), f"{_DRIVE}delay": 0.4e-3},
    "close to each other, 900 and 950 Hz": hertz(900.0, 950.0),
    "within the band of the form, 380 and 1600 Hz": hertz(380.0, 1600.0),
}

base = cells.load("oval3000", spindle_encoder={"revolutions": float(REVOLUTIONS)})
laws = [oval3000.entered(base, {**oval3000.LAWS["ours"], "inverse": order}) for order in ORDERS]
modes = np.sort(np.random.default_rng(SEED).uniform(500.0, 3000.0, (DRIVES, 2)), axis=1)
drives = [
    {**drive, **hertz(*both)}
    for drive, both in zip(oval3000.drives_of(base, SEED, DRIVES), modes.tolist(), strict=True)
]


def errors_of(varied: list[Values]) -> Array:
    """Return the largest errors of the last revolutions [µm], by order and drive; inf for a stopped run."""
    judged = cells.kept([law.varied(drive) for law in laws for drive in varied], Judge, untracked)
    found = [np.inf if each is None else each.largest[:REVOLUTIONS][-LAST:].max() for each in judged]
    return np.reshape(found, (len(laws), -1))


def row(name: str, errors: Array) -> str:
    """Return a row of a table: worst and median of each order, and the drives that the fourth makes worse."""
    figures = [f"{value:.2f}" for each in errors for value in (each.max(), np.median(each))]
    worse = int((errors[1] > 1.1 * errors[0]).sum())
    return f"| {name} | {errors.shape[1]} | {' | '.join(figures)} | {worse} |"


errors = errors_of(drives)
columns = "drives | second order, worst [µm] | median | fourth order, worst [µm] | median | worse by a tenth |"
print(f"| lower resonance | {columns}\n| --- |{' ---: |' * 6}")
for low, high in pairwise(EDGES):
    here = (modes[:, 0] >= low) & (modes[:, 0] < high)
    if here.any():
        print(row(f"{low:.0f} to {high:.0f} Hz", errors[:, here]), flush=True)
print(f"\n| resonances | {columns}\n| --- |{' ---: |' * 6}")
for name, values in LIMITS.items():
    print(row(name, errors_of([{**drive, **values} for drive in drives[:32]])), flush=True)

figure = Figure(figsize=(7.0, 3.4), layout="constrained")
axes = figure.subplots()
for number, name in enumerate(ORDERS):
    axes.loglog(modes[:, 0], errors[number], ls="", ms=4, mfc="none", label=name.replace("_", " "), **point(number))
axes.axhline(2.0, color="black", lw=0.8, ls=":")
axes.set(xlabel="lower resonance [Hz]", ylabel="largest form error [µm]")
axes.set_xticks([500, 700, 1000, 1500, 2000, 3000], ["500", "700", "1000", "1500", "2000", "3000"])
axes.minorticks_off()
axes.grid(alpha=0.3)
axes.legend()
figure.savefig(PICTURES / "resonance_map.png", dpi=120)
