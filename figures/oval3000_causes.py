# SPDX-License-Identifier: Apache-2.0
"""Prints the table of studies.md: error of "ours" in oval3000 with causes changed, over both sets of drives."""

from collections.abc import Mapping

import numpy as np

from lathe_papers import cells, oval3000
from lathe_papers.judge import LAST, Judge
from lathe_rc.cell.parameters import Value
from lathe_rc.study import untracked

SEEDS, DRIVES, REVOLUTIONS = (oval3000.PUBLISHED, 1544672515), 64, 40
_DRIVE = "loaded_drive.coarse_"
CHANGED: dict[str, Mapping[str, Value]] = {
    "all of them": {},
    "no sensor noise, no rounding": {f"{_DRIVE}noise_rms": 0.0, "spindle_encoder.counts_per_revolution": 0},
    "no force": {"loaded_drive.radial_ratio": 0.0},
    "constant speed": {"spindle_encoder.random_rms": 0.0},
    "inverse of second order": {"controller.inverse": "second_order"},
    "no resonances": {f"{_DRIVE}mode_{name}": [] for name in ("frequency", "damping", "participation")},
}


def told(drive: Mapping[str, Value]) -> dict[str, Value]:
    """Return the model of the law that is the drive without its resonances."""
    return {f"controller.model_{name}": drive[_DRIVE + name] for name in ("natural_frequency", "damping", "delay")}


base = cells.load("oval3000", spindle_encoder={"revolutions": float(REVOLUTIONS)})
law = oval3000.entered(base, oval3000.LAWS["ours"])
drives = [drive for seed in SEEDS for drive in oval3000.drives_of(base, seed, DRIVES)]
rows = {name: [law.varied({**drive, **values}) for drive in drives] for name, values in CHANGED.items()}
rows["law told each drive, without resonances"] = [law.varied({**drive, **told(drive)}) for drive in drives]
print("| causes | worst [µm] | median [µm] | in ±2 µm |\n| --- | ---: | ---: | ---: |")
for name, made in rows.items():
    judged = cells.kept(made, Judge, untracked)
    errors = np.array([np.inf if each is None else each.largest[:REVOLUTIONS][-LAST:].max() for each in judged])
    by_set = errors.reshape(len(SEEDS), -1)
    worst, median, share = by_set.max(axis=-1), np.median(by_set, axis=-1), 100.0 * (by_set <= 2.0).mean(axis=-1)
    figures = (
        " and ".join(f"{value:.{digits}f}" for value in each) for each, digits in ((worst, 2), (median, 2), (share, 0))
    )
    print(f"| {name} | {' | '.join(figures)} % |", flush=True)
