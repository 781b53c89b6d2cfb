# SPDX-License-Identifier: Apache-2.0
"""Prints a table that studies.md cites: counts that pass a ratio of small numbers, and the sample rate as cure."""

import re

import lathe_rc
from lathe_papers import cells
from lathe_rc.cell.wiring import Cell

STARTS = (0.0, 0.018, 0.037)  # [s] by which the deviation begins later: less than a revolution
COUNTS = (2048, 4096, 8192)
HEAD = ("counts", "c at 64 kHz", "near", "this law [µm]", "over the variable lead", "cure", "this law [µm]", "ratio")


def largest(name: str, counts: int, rate: int) -> float:
    """Largest error of 8 revolutions [µm] in a deviation of 20 rad/s that began before; the worst of three starts."""
    made = [
        cells.load(
            name,
            {"sample_rate": rate},
            spindle_encoder={
                "counts_per_revolution": counts,
                "deviation_frequency": [20.0],
                "deviation_start": 3.0 + later,
                "revolutions": 62.0,
            },
        )
        for later in STARTS
    ]
    return max(float(out.kept.largest[54:62].max()) * 1e6 for out in lathe_rc.run_many(made) if out.kept)


print(f"| {' | '.join(HEAD)} |\n|{' ---: |' * len(HEAD)}")
for counts in COUNTS:
    cell = Cell(cells.load("robust", spindle_encoder={"counts_per_revolution": counts}).nodes)
    cell.check()
    near, rate = re.findall(r"near (\S+):.*sample_rate = (\d+)", cell.warnings[0])[0]
    row = []
    for each in (64_000, int(rate)):
        ours, plain = (largest(name, counts, each) for name in ("robust", "speed_deviation"))
        row += [f"{ours:.2f}", f"{ours / plain:.2f}"]
    passed = counts * 1000 / 60 / 64_000
    print(f"| {counts} | {passed:.3f} | {near} | {row[0]} | {row[1]} | {int(rate) // 1000} kHz | {row[2]} | {row[3]} |")
