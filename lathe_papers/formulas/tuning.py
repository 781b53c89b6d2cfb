# SPDX-License-Identifier: Apache-2.0
"""Tuning of the channel parameters to reproduce the table of steady errors in paper 001.

The paper prints amplitudes of the steady error to two digits, but no parameters. Both searches start from the
parameters of an earlier identification (`START`), keep sup|Q - Z| of both channels below 1 and end at
rounded parameters:

- `nearest` changes as few digits as possible so that every entry lies within its limit;
- `smallest_deviation` minimises the largest deviation of any entry.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from lathe_papers.formulas.structures import Channel, direct_compensation, iterative, supremum
from lathe_rc.arrays import Array
from lathe_rc.errors import LatheError

FREQUENCIES = np.array([500.0, 1000.0, 1500.0, 2000.0])  #: [rad/s]
ROWS = (
    "one coarse channel",
    "with direct piezo compensation",
    "two self-learning coarse drives",
    "self-learning coarse and piezo",
)
PRINTED = np.array(
    [
        [1.2e-3, 6.6e-3, 2.6e-2, 6.6e-2],
        [2.4e-5, 2.6e-4, 1.6e-3, 5.3e-3],
        [1.5e-6, 4.3e-5, 6.9e-4, 4.3e-3],
        [4.9e-7, 1.1e-5, 8.9e-5, 3.5e-4],
    ]
)  #: the table of paper 001
LIMITS = np.array([0.10, 0.10, 0.15, 0.10])  #: largest allowed deviation of each row
HIGHEST = (3e4, 2e5)  #: upper limit of the frequencies in sup|Q - Z|, coarse and fine channel [rad/s]


@dataclass(frozen=True)
class TuningParameters:
    """Tuning parameters of the coarse and the fine channel."""

    coarse: Channel
    fine: Channel

    def table(self) -> Array:
        """Amplitudes of the steady error, shape (4, 4): `ROWS` by `FREQUENCIES`."""
        coarse, fine = self.coarse.steady_error(FREQUENCIES), self.fine.steady_error(FREQUENCIES)
        direct = direct_compensation(coarse, self.fine.drive(FREQUENCIES))
        return np.abs(np.stack((coarse, direct, iterative(coarse, coarse), iterative(coarse, fine))))

    def deviations(self) -> Array:
        """Relative deviations from the printed table, shape (4, 4)."""
        return np.asarray(self.table() / PRINTED - 1.0)

    def suprema(self) -> tuple[float, float]:
        """Suprema sup|Q - Z| of the coarse and the fine channel."""
        channels = zip((self.coarse, self.fine), HIGHEST, strict=True)
        coarse, fine = (supremum(channel.factor, highest).magnitude for channel, highest in channels)
        return coarse, fine


START = TuningParameters(
    Channel(natural_frequency=1038.0, damping=0.804, delay=0.36e-3, lead_time=1.425e-3, q_time=67.0e-6),
    Channel(natural_frequency=14_600.0, damping=0.299, delay=0.0, lead_time=97.0e-6, q_time=38.2e-6),
)
PLAIN = TuningParameters(replace(START.coarse, q_time=66.9e-6), START.fine)  #: result of `nearest`
LEAD_LAG = TuningParameters(
    Channel(
        natural_frequency=782.0,
        damping=0.603,
        delay=0.36e-3,
        lead_time=1.127e-3,
        q_time=73.1e-6,
        lead_lag=(855e-6, 100e-6),
    ),
    Channel(
        natural_frequency=19_500.0,
        damping=0.395,
        delay=0.0,
        lead_time=72.8e-6,
        q_time=40.5e-6,
        lead_lag=(744e-6, 626e-6),
    ),
)  #: result of `smallest_deviation` with lead-lag

# A channel as a vector: ωn, ζ, T0 - τ, time constant of Q, T1, T2, each scaled by the unit given here.
_FIELDS = 6
_LAG_UNIT = 1e-4  # unit of T1 and T2 [s]
_ROUNDING_ORDER = (5, 4, 11, 10, 0, 1, 6, 7, 2, 8, 3, 9)  # parameters that the others compensate best come first
_STABILITY_GRIDS = (
    np.linspace(10.0, HIGHEST[0], 300),
    np.concatenate((np.linspace(10.0, 4e4, 300), np.linspace(4e4, HIGHEST[1], 60))),
)  # [rad/s]; the worst frequencies lie near the fine channel's resonance
_STEPS = ((1.0, 1e-3, 1e-6, 1e-7), (100.0, 1e-3, 1e-6, 1e-7))  # last digits of START, coarse and fine


def _vector(tuning: TuningParameters) -> Array:
    return np.array(
        [
            value
            for channel in (tuning.coarse, tuning.fine)
            for value in (
                channel.natural_frequency,
                channel.damping,
                channel.lead_time - channel.delay,
                channel.q_time,
                *channel.lead_lag,
            )
        ]
    )


def _tuning(vector: Array) -> TuningParameters:
    def channel(part: Array, delay: float) -> Channel:
        natural_frequency, damping, net_lead, q_time, lead, lag = map(float, part)
        # Sums and products of rounded numbers have rounding errors in the last digits; 15 digits are exact.
        lead_time = float(f"{net_lead + delay:.15g}")
        return Channel(natural_frequency, damping, delay, lead_time, q_time, (lead, lag))

    # The delays of START are kept: Z depends only on the lead minus the delay.
    return TuningParameters(channel(vector[:_FIELDS], START.coarse.delay), channel(vector[_FIELDS:], START.fine.delay))


_UNITS = np.where(_vector(START) > 0.0, _vector(START), _LAG_UNIT)


def _acceptable(tuning: TuningParameters, limits: Array, margin: float) -> bool:
    return bool(np.all(np.abs(tuning.deviations()) <= limits[:, None])) and max(tuning.suprema()) <= 1.0 - margin


def _digit_changes(count: int) -> Iterator[TuningParameters]:
    """Yield all tunings that differ from `START` by ``count`` steps in last digits, without lead-lag."""
    places = [(i, step) for i, step in enumerate(_STEPS[0])]
    places += [(_FIELDS + i, step) for i, step in enumerate(_STEPS[1])]
    signed = [(place, sign * step) for place, step in places for sign in (-1.0, 1.0)]
    for changes in itertools.combinations_with_replacement(signed, count):
        vector = _vector(START)
        for place, change in changes:
            vector[place] += change
        yield _tuning(np.array([float(f"{value:.12g}") for value in vector]))


def nearest(limits: Array = LIMITS, margin: float = 0.03, changes: int = 3) -> TuningParameters:
    """Return the tuning without lead-lag that meets the limits with the fewest last-digit steps from `START`.

    Args:
        limits: largest allowed relative deviation of each row, shape (4,).
        margin: smallest allowed 1 - sup|Q - Z| of both channels.
        changes: maximum number of steps to try.

    Returns:
        Among tunings with equally few steps, the one that minimises the largest ratio of a deviation to its limit.

    Raises:
        LatheError: no tuning meets the limits within ``changes`` steps.
    """
    for count in range(changes + 1):
        found = [tuning for tuning in _digit_changes(count) if _acceptable(tuning, limits, margin)]
        if found:
            return min(found, key=lambda tuning: float((np.abs(tuning.deviations()) / limits[:, None]).max()))
    raise LatheError(f"no tuning within {changes} steps of digits meets the limits; allow more deviation or steps")


def _shortfall(vector: Array, margin: float) -> Array:
    """Return 1 - margin - |Q - Z| at the frequencies of a grid: negative where a channel is not stable enough."""
    tuning = _tuning(vector)
    channels = zip((tuning.coarse, tuning.fine), _STABILITY_GRIDS, strict=True)
    return np.concatenate([1.0 - margin - np.abs(channel.factor(grid)) for channel, grid in channels])


def _minimax(start: Array, bounds: Sequence[tuple[float, float]], weights: Array, margin: float) -> tuple[float, Array]:
    """Minimise the largest weighted |log(entry/printed)|; return the minimum (inf: no solution) and its vector."""

    def logs(vector: Array) -> Array:
        return np.asarray((np.log1p(_tuning(vector).deviations()) / weights[:, None]).ravel())

    def slack(scaled: Array) -> Array:
        vector, bound = scaled[:-1] * _UNITS, scaled[-1]
        deviation = logs(vector)
        return np.concatenate((bound - deviation, bound + deviation, _shortfall(vector, margin)))

    # The bound as an additional variable makes the minimax smooth, as sequential quadratic programming requires.
    def largest(scaled: Array) -> float:
        return float(scaled[-1])

    first = np.append(start, np.abs(logs(start * _UNITS)).max())
    found = scipy.optimize.minimize(
        largest,
        first,
        method="SLSQP",
        bounds=[*bounds, (0.0, None)],
        constraints=scipy.optimize.NonlinearConstraint(slack, 0.0, np.inf),
        options={"maxiter": 500, "ftol": 1e-10},
    )
    return float(found.fun) if found.success else np.inf, np.asarray(found.x[:-1])


def smallest_deviation(
    *,
    lead_lag: bool,
    weights: Array | None = None,
    spread: float = 4.0 / 3.0,
    margin: float = 0.05,
    digits: int = 3,
    starts: int = 24,
    seed: int = 0,
) -> TuningParameters:
    """Return the rounded tuning that minimises the largest deviation from the printed table.

    The log ratio is minimised in the minimax sense by sequential quadratic programming from random starts. The
    parameters are then rounded one by one and fixed, while the others are optimised again.

    Args:
        lead_lag: whether both channels have the correction (1 + pT1)/(1 + pT2), T1 and T2 from 0.1 to 2 ms.
        weights: weights of the rows, shape (4,); a row of weight 1.5 may deviate 1.5 times as much. Default: all 1.
        spread: largest factor by which ωn and ζ of the drives may differ from `START`.
        margin: smallest allowed 1 - sup|Q - Z| of both channels.
        digits: significant digits of each parameter.
        starts: number of starts.
        seed: random seed of the starts.

    Raises:
        LatheError: no start converged.
    """
    rows = np.ones(len(ROWS)) if weights is None else weights
    near, wide = (1.0 / spread, spread), (0.5, 2.0)
    lag = (1.0, 20.0) if lead_lag else (0.0, 0.0)
    bounds = [near, near, wide, wide, lag, lag] * 2
    random = np.random.default_rng(seed)
    best, vector = np.inf, np.empty(0)
    for _ in range(starts):
        start = np.array([random.uniform(low, high) for low, high in bounds])
        value, found = _minimax(start, bounds, rows, margin)
        if value < best:
            best, vector = value, found
    if not np.isfinite(best):
        raise LatheError(f"none of {starts} starts converged with a margin of {margin:g}; allow a smaller margin")
    for place in _ROUNDING_ORDER:
        rounded = float(f"{vector[place] * _UNITS[place]:.{digits}g}") / _UNITS[place]
        bounds[place] = (rounded, rounded)  # fixed from here on
        vector[place] = rounded
        _, vector = _minimax(vector, bounds, rows, margin)
    return _tuning(np.array([float(f"{value:.{digits}g}") for value in vector * _UNITS]))
