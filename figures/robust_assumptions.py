# SPDX-License-Identifier: Apache-2.0
"""Prints the table of robust.md: the error with everything at once where the law knows something wrong; five seeds."""

from collections.abc import Sequence

import numpy as np

from lathe_machine.stages.learning.learner import CheckedLoop
from lathe_papers import cells, judge, robust
from lathe_rc.arrays import Complex
from lathe_rc.cell.wiring import Cell
from lathe_rc.study import untracked

SEEDS = range(5)
OWN_FORM = {"controller.harmonic_order": [2], "controller.harmonic_amplitude": [225e-6]}
LOBES = {"profile.harmonic_order": [2, 3], "profile.harmonic_amplitude": [225e-6, 5e-6]}
CASES: dict[str, robust.Values] = {
    "all at once, as told": {},
    "delay 20 % longer than told": {"loaded_drive.coarse_delay": 1.2 * 0.36e-3},
    "delay 20 % shorter than told": {"loaded_drive.coarse_delay": 0.8 * 0.36e-3},
    "disc eccentric by 100 µrad": {"spindle_encoder.disc_eccentricity": 100e-6},
    "sensor with 200 nm of noise": {"loaded_drive.coarse_noise_rms": 200e-9},
    "form told 1 % too small": {**OWN_FORM, "controller.harmonic_amplitude": [0.99 * 225e-6]},
    "5 µm of three lobes not told": {**OWN_FORM, **LOBES},
    "edge gives way beyond the sensor": {"loaded_drive.cut_elasticity": "realistic", "tool.deflects": True},
}
MODE = (2 * np.pi * 900.0, 0.02, 0.01)  # [rad/s], damping, part of the drive's static compliance

bases = {
    seed: cells.load(
        "robust_cutting", {"seed": seed}, spindle_encoder={"revolutions": 40.0}, controller=robust.LAWS["ours"]
    )
    for seed in SEEDS
}


def worst(cases: Sequence[robust.Values]) -> judge.Array:
    """Largest error of the last ten revolutions [µm] by case and seed."""
    made = [bases[seed].varied({**robust.model(), **case}) for case in cases for seed in SEEDS]
    judged = cells.kept(made, judge.Judge, untracked)
    return np.reshape([np.nan if each is None else each.largest[30:40].max() for each in judged], (len(cases), -1))


def row(name: str, errors: judge.Array) -> str:
    """A line of the table."""
    return f"| {name} | {' '.join(f'{error:.2f}' for error in errors)} | {errors.max():.2f} |"


print("| | largest error by seed [µm] | worst |\n| --- | --- | ---: |")
for name, errors in zip(CASES, worst(list(CASES.values())), strict=True):
    print(row(name, errors))
drives = [robust.machine(*factors) for factors in robust.drives_near(16)]
print(row("drives at the 16 corners of ±20 %", worst(drives).max(axis=0)))

cell = Cell(bases[0].varied(robust.model()).nodes)
law, drive = cell.stages["controller"], cell.stages["loaded_drive"].responses()["coarse/command"]
frequency, damping, part = MODE


def swings(at: judge.Array) -> Complex:
    """The drive with a mode of its frame."""
    p = 1j * at
    mode = part / (1.0 + 2.0 * damping * p / frequency + (p / frequency) ** 2)
    return drive(at) + mode * np.exp(-p * robust.TOLD[2])


loop = CheckedLoop(law, [swings], law.checked_speeds(*cell.master.speed_range()))
print(f"\nwith a mode of 900 Hz: {law.factor} = {loop.factor({}):.3g}; cure: {' or '.join(loop.cures())}")
