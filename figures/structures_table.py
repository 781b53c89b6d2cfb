# SPDX-License-Identifier: Apache-2.0
"""Prints tables that learning.md cites: parameters, convergence and steady errors against those of paper 001."""

from lathe_papers.formulas.structures import Channel, contraction, cycles, lead_errors, supremum
from lathe_papers.formulas.tuning import FREQUENCIES, HIGHEST, LEAD_LAG, PLAIN, PRINTED, ROWS, START

SETS = {"plain": PLAIN, "lead-lag": LEAD_LAG}


def parameters(name: str, channel: Channel) -> str:
    """A row of the table of parameters."""
    lead, lag = channel.lead_lag
    correction = f"{lead * 1e6:.0f}, {lag * 1e6:.0f}" if lead != lag else "none"
    return (
        f"| {name} | {channel.natural_frequency:.0f} | {channel.damping:.3f} | {channel.delay * 1e6:.0f} "
        f"| {channel.lead_time * 1e6:.1f} | {channel.q_time * 1e6:.1f} | {correction} |"
    )


def convergence(name: str, channel: Channel, highest: float) -> str:
    """A row of the table of convergence."""
    peak = supremum(channel.factor, highest)
    short, long = lead_errors(channel.q, channel.z, highest)
    factors = contraction(channel.q(FREQUENCIES), channel.z(FREQUENCIES))
    each = " ".join(f"{factor:.3f}" for factor in factors)
    return (
        f"| {name} | {peak.magnitude:.3f} at {peak.frequency:.0f} | {short * 1e6:+.1f} {long * 1e6:+.1f} "
        f"| {each} | {cycles(factors, 0.01).max():.0f} |"
    )


channels = [
    (f"{name}, {which}", channel, highest)
    for name, tuning in SETS.items()
    for which, channel, highest in zip(("coarse", "fine"), (tuning.coarse, tuning.fine), HIGHEST, strict=True)
]
print("| channel | ωn [rad/s] | ζ | τ [µs] | T0 [µs] | time of Q [µs] | T1, T2 [µs] |")
print("| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
for name, channel, _ in channels:
    print(parameters(name, channel))

NEAR = r"\lvert Q - Z\rvert$"
print(f"\n| channel | $\\sup{NEAR}, ω [rad/s] | T0 off by [µs] | ${NEAR} at 500 … 2000 rad/s | cycles to 1 % |")
print("| --- | ---: | ---: | --- | ---: |")
for name, channel, highest in channels:
    print(convergence(name, channel, highest))

for name, tuning in {"start": START, **SETS}.items():
    print(f"\n| {name} | 500 | 1000 | 1500 | 2000 |")
    print("| --- | ---: | ---: | ---: | ---: |")
    for row, values, deviations in zip(ROWS, tuning.table(), tuning.deviations(), strict=True):
        entries = (f"{value:.3e} ({100 * off:+.1f} %)" for value, off in zip(values, deviations, strict=True))
        print(f"| {row} | {' | '.join(entries)} |")

print("\n| printed | 500 | 1000 | 1500 | 2000 |")
print("| --- | ---: | ---: | ---: | ---: |")
for row, values in zip(ROWS, PRINTED, strict=True):
    print(f"| {row} | {' | '.join(f'{value:.1e}' for value in values)} |")
