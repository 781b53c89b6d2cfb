# SPDX-License-Identifier: Apache-2.0
"""Searches for the parameters of learning.md and prints how good the table of paper 001 can get."""

import numpy as np

from lathe_papers.formulas.tuning import LEAD_LAG, LIMITS, PLAIN, START, TuningParameters, nearest, smallest_deviation


def row(name: str, spread: str, tuning: TuningParameters) -> str:
    """A row of the table of searches."""
    largest = 100 * np.abs(tuning.deviations()).max(axis=1)
    fine, coarse = tuning.fine.natural_frequency, tuning.coarse.natural_frequency
    sup = " ".join(f"{value:.3f}" for value in tuning.suprema())
    return f"| {name} | {spread} | {coarse:.0f} {fine:.0f} | {sup} | {' '.join(f'{value:.1f}' for value in largest)} |"


print(r"| search | factor | ωn coarse, fine [rad/s] | $\sup\lvert Q - Z\rvert$ | largest deviation by row [%] |")
print("| --- | ---: | ---: | ---: | ---: |")
print(row("start", "1", START))
plain = nearest()
print(row("nearest, no lead-lag", "1", plain))
print(row("smallest, no lead-lag", "4/3", smallest_deviation(lead_lag=False)))
print(row("smallest, no lead-lag, row 3 by 1.5", "4/3", smallest_deviation(lead_lag=False, weights=LIMITS / 0.1)))
for factor, name in ((1.1, "1.1"), (4 / 3, "4/3"), (1.6, "1.6"), (2.0, "2")):
    found = smallest_deviation(lead_lag=True, spread=factor)
    print(row("smallest, lead-lag", name, found))
    if name == "4/3":
        lead_lag = found
print(f"\nas in lathe_papers/formulas/tuning.py: plain {plain == PLAIN}, lead-lag {lead_lag == LEAD_LAG}")
