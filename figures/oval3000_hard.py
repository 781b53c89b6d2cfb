# SPDX-License-Identifier: Apache-2.0
"""Prints the table of studies.md: "ours" in oval3000_hard with one of its causes, over the published set."""

import numpy as np

from lathe_papers import cells, oval3000
from lathe_papers.judge import LAST, Judge
from lathe_rc.cell.parameters import Value
from lathe_rc.study import untracked

DRIVES, REVOLUTIONS = 64, 40
_DRIVE = "loaded_drive.coarse_"
CAUSES: dict[str, dict[str, Value]] = {
    "gain 5 % above the model": {f"{_DRIVE}gain": 1.05},
    "gain drifts by 5 % within the part": {f"{_DRIVE}gain": 1.0, f"{_DRIVE}gain_drift": 0.0625},
    "modes fall by 3 %": {f"{_DRIVE}mode_drift": -0.0375},
    "jitter of 1 µs": {f"{_DRIVE}sampling_jitter": 1e-6},
    "error motion of 1 µm": {},
}
base = cells.load("oval3000_hard", spindle_encoder={"revolutions": float(REVOLUTIONS)})
law = oval3000.entered(base, oval3000.LAWS["ours"])
drives = oval3000.drives_of(base, oval3000.PUBLISHED, DRIVES)
none: dict[str, Value] = {
    f"{_DRIVE}gain": 1.0,
    f"{_DRIVE}gain_drift": 0.0,
    f"{_DRIVE}mode_drift": 0.0,
    f"{_DRIVE}sampling_jitter": 0.0,
    "tool.error_motion_order": [],
    "tool.error_motion_amplitude": [],
    "tool.error_motion_phase": [],
}
rows = {"none of them": none, **{name: none | values for name, values in CAUSES.items()}}
rows["error motion of 1 µm"] = {name: value for name, value in none.items() if not name.startswith("tool.")}
print("| cause alone | worst [µm] | median [µm] | in its zones |\n| --- | ---: | ---: | ---: |")
for name, values in rows.items():
    judged = cells.kept([law.varied({**drive, **values}) for drive in drives], Judge, untracked)
    errors, over = np.array(
        [
            (np.inf, np.inf)
            if each is None
            else [part[:REVOLUTIONS][-LAST:].max() for part in (each.largest, each.excess(2.0))]
            for each in judged
        ]
    ).T
    print(
        f"| {name} | {errors.max():.2f} | {np.median(errors):.2f} | {100.0 * (over <= 1.0).mean():.0f} % |", flush=True
    )
