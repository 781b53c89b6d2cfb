# SPDX-License-Identifier: Apache-2.0
"""Prints the best settings of the laws of oval3000 from grids: smallest worst error over 16 drives.

The seed of the drives is not the published one of the study. Names of laws as arguments select some of them.
"""

import sys
from itertools import product

import numpy as np

from lathe_papers import cells, oval3000
from lathe_papers.judge import LAST, Judge
from lathe_rc.study import untracked

SEED, DRIVES, REVOLUTIONS = 1, 16, 40
_FLAT: dict[str, list[object]] = {
    "q_filter": ["fir"], "q_pass": [1000.0, 2000.0, 3000.0], "q_stop": [5000.0, 7500.0], "q_ripple": [1e-3],
}  # fmt: skip
GRIDS: dict[str, dict[str, list[object]]] = {
    "lead": {
        **_FLAT, "lead_time": [1.25e-3, 1.4e-3, 1.55e-3, 1.7e-3], "learning_gain": [1.0, 0.5, 0.25],
    },
    "adapt.": {**_FLAT, "lead_time": [0.2e-3, 0.3e-3], "learning_gain": [0.3, 0.1, 0.03, 0.01]},
    "comp.": {
        "proportional": [0.0, 0.2, 0.5, 1.0], "integral": [10.0, 100.0, 300.0, 700.0],
        "derivative": [0.0, 0.3e-3, 1e-3], "derivative_bandwidth": [1600.0],
    },
    "AFC": {"highest_order": [8, 12, 16], "rate": [4.0, 8.0, 12.0, 16.0, 24.0]},
    "ADRC": {
        "observer_bandwidth": [1000.0, 1500.0, 1750.0, 2000.0, 2250.0, 2500.0, 3000.0],
        "control_bandwidth": [1000.0, 1250.0, 1500.0, 1750.0, 2000.0, 2250.0, 2500.0],
    },
    "norm.": {"highest_order": [8, 10, 12, 16], "change_weight": [0.03, 0.1, 0.3, 1.0]},
    "ours": {
        "learned_waves": [6.0, 7.5, 9.0, 11.0], "learning_bandwidth": [3000.0, 8000.0],
        "observer_bandwidth": [0.0, 400.0, 700.0, 1200.0], "identify": [False, True],
    },
}  # fmt: skip

base = cells.load("oval3000", spindle_encoder={"revolutions": float(REVOLUTIONS)})
drives = oval3000.drives_of(base, SEED, DRIVES)
for law in sys.argv[1:] or GRIDS:
    settings = [dict(zip(GRIDS[law], values, strict=True)) for values in product(*GRIDS[law].values())]
    laws = [oval3000.entered(base, {**oval3000.LAWS[law], **each}) for each in settings]
    judged = cells.kept([each.varied(drive) for each in laws for drive in drives], Judge, untracked)
    errors = [np.inf if each is None else each.largest[:REVOLUTIONS][-LAST:].max() for each in judged]
    worst = np.reshape(errors, (len(laws), -1)).max(axis=-1)
    print(f"{law}: best of {len(laws)}", flush=True)
    for k in np.argsort(worst)[:5]:
        margin = oval3000.margins(laws[k], drives).min()
        print(f"  {worst[k]:8.2f} µm, drive margin {margin:.2f}  {settings[k]}", flush=True)
