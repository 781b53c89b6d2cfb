# SPDX-License-Identifier: Apache-2.0
"""Plausibility of a file of encoder counts: its time stamps, its speed, and the counts between index pulses."""

from collections.abc import Sequence

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError

_CLOSE = 4.0  # a reading closer to the one before than the mean interval by this factor may belong to a burst
_BURST = 0.05  # share of the motion within such intervals, beyond their share of the time, that makes bursts
_IDLE = 3.0  # the spindle stands if no count comes in the time of so many counts at nominal speed
_JUMP = 8.0  # two readings whose speed exceeds the median by this factor hold a jump of the counter
_RUN_UP = 2.0  # a revolution that takes longer than the median by this factor belongs to the run-up
_STRANGE = 0.01  # deviation from the nominal speed from which lost or wrong counts are suspected
_NEAR = 0.004  # distance of a ratio of speeds from one that has a name
_RAREST = 32  # of so many pulses, one that is lost has a name
_MULTIPLES = {
    0.25: "a quarter (x1 for x4?) of nominal_rpm",
    0.5: "half (x2 for x4?) of nominal_rpm",
    2.0: "twice (x4 for x2?) nominal_rpm",
    4.0: "four times (x4 for x1?) nominal_rpm",
}
_MULTIPLE = 0.1  # relative distance of a ratio of speeds from such a multiple
_LEAST_ROOM = 2.0  # [count] that two index pulses may differ by: the rounding of both


def turned_by(counts: Sequence[int | float], wraps: int, *, inverted: bool) -> Array:
    """Return the counts turned forward since the first of n readings, shape (n,); see `counts.CountedAngle`."""
    moved = np.diff(np.array(counts, dtype=object))  # between integers, before any rounding
    if wraps:
        moved = ((2 * moved + wraps) % (2 * wraps) - wraps) / 2
    return np.concatenate(([0.0], np.cumsum(moved.astype(float)))) * (-1.0 if inverted else 1.0)


def check_stamps(time: Array, turned: Array) -> None:
    """Check that the times [s] of readings are not those of their arrival in bursts, shape (n,).

    Raises:
        InputError: many readings follow at once upon the one before, although the spindle has turned between them.
    """
    since, moved = np.diff(time), np.maximum(np.diff(turned), 0.0)
    close = since < since.mean() / _CLOSE
    if moved[close].sum() > moved.sum() * (_BURST + np.maximum(since[close], 0.0).sum() / since.sum()):
        raise InputError(
            f"time stamps come in bursts: {np.count_nonzero(close)} of {close.size} readings come less than "
            f"{since.mean() / _CLOSE * 1e3:.3g} ms after the one before, {since.mean() * 1e3:.3g} ms on average; "
            "allowed: the time at which the counter was read, not that of arrival (as of USB)"
        )


def typical_speed(time: Array, turned: Array, counts: int, nominal: float) -> float | None:
    """Return the mean speed of the revolutions, without standstill, run-up and jumps; None without any motion.

    Args:
        time: times of readings [s], shape (n,).
        turned: counts turned forward, shape (n,).
        counts: counts per revolution.
        nominal: nominal speed [rev/s].

    Returns:
        Mean speed [rev/s] of the revolutions that take less than twice the median time.
    """
    places = np.concatenate(([0], np.flatnonzero(np.diff(turned)) + 1))
    since, moved = np.diff(time[places]), np.diff(turned[places])
    moving = (moved > 0.0) & (since <= max(_IDLE / (nominal * counts), 10.0 * np.median(np.diff(time))))
    moving &= moved < _JUMP * since * np.median(moved[moving] / since[moving]) if moving.any() else False
    clock = np.concatenate(([0.0], np.cumsum(since[moving])))
    revolutions = np.concatenate(([0.0], np.cumsum(moved[moving]))) / counts
    if not clock[-1] > 0.0:
        return None
    if revolutions[-1] < 1.0:
        return float(revolutions[-1] / clock[-1])
    periods = np.diff(np.interp(np.arange(np.floor(revolutions[-1]) + 1.0), revolutions, clock))
    return float(1.0 / periods[periods < _RUN_UP * np.median(periods)].mean())


def check_speed(rpm: float, nominal_rpm: float, counts: int, max_deviation: float) -> str:
    """Compare the typical speed of a file with the nominal speed [1/min].

    Returns:
        Warning about a speed that lost pulses or other counts per revolution would explain; empty without one.

    Raises:
        InputError: it deviates by more than ``max_deviation``.
    """
    ratio = rpm / nominal_rpm
    if abs(ratio - 1.0) > max_deviation:
        at = next((at for at in _MULTIPLES if abs(ratio / at - 1.0) < _MULTIPLE), ratio)
        raise InputError(
            f"{rpm:.4g} rpm on average is {_MULTIPLES.get(at, f'{ratio:.3g} of nominal_rpm')} = {nominal_rpm:g}; "
            f"allowed: within max_deviation = {max_deviation:g} (counts_per_revolution = {counts * at:.0f}, or "
            f"nominal_rpm = {rpm:.4g} if the spindle turns so)"
        )
    if abs(ratio - 1.0) <= _STRANGE:
        return ""
    each = min(round(1.0 / abs(ratio - 1.0)), _RAREST)  # of so many pulses, one is lost or false
    guesses = [(1000.0 / 1024.0, "1000 for 1024 lines"), (1024.0 / 1000.0, "1024 for 1000 lines")]
    guesses += [(1.0 + sign / each, f"{each + sign}/{each}") for sign in (-1, 1)]
    named = next((text for at, text in guesses if abs(ratio - at) < _NEAR), "")
    return (
        f"{rpm:.4g} rpm on average is {ratio:.4g}{f' ({named}?)' if named else ''} of nominal_rpm = {nominal_rpm:g}: "
        "the speed of the spindle, lost pulses or other counts_per_revolution; an index column tells which "
        "(docs/devices.md)"
    )


def index_counts(
    pulses: Sequence[tuple[int, int | float]], time_ns: Sequence[int], counts: Sequence[int | float],
    turned: Array, wraps: int, *, timed: bool, inverted: bool,
) -> Array:  # fmt: skip
    """Return the counts turned forward, since the first reading, at the index pulses, shape (pulses,).

    Args:
        pulses: place of the first reading after each pulse, and time [ns] or counter of the pulse.
        time_ns: times of the readings.
        counts: their counters.
        turned: counts turned forward at them, shape (n,).
        wraps: see `turned_by`.
        timed: whether the pulses have times instead of counters.
        inverted: see `turned_by`.
    """
    if timed:
        since = [float(at - time_ns[0]) for _, at in pulses]
        return np.interp(since, [float(at - time_ns[0]) for at in time_ns], turned)
    # From the pulse to the reading after it, across a counter that begins anew between them.
    return np.array(
        [turned[place] - turned_by([count, counts[place]], wraps, inverted=inverted)[1] for place, count in pulses]
    )


def check_index(at: Array, counts: int, max_reverse: float) -> str:
    """Check the counts between index pulses.

    Args:
        at: counts turned forward at the pulses, shape (pulses,).
        counts: counts per revolution.
        max_reverse: counts that the counter may tremble by.

    Returns:
        Warning about pulses that are too few for a check; empty otherwise.

    Raises:
        InputError: pulses are not whole revolutions apart.
    """
    if at.size < 2:
        return f"{at.size} index pulses: lost counts are not looked for; two or more show them"
    between = np.diff(at)
    off = between - counts * np.maximum(np.round(between / counts), 1.0)
    wrong = np.flatnonzero(np.abs(off) > max(max_reverse, _LEAST_ROOM))
    if wrong.size:
        raise InputError(
            f"{between[wrong[0]]:.6g} counts from index pulse {wrong[0] + 1} to the next, and "
            f"{np.median(between):.6g} in the middle; allowed: counts_per_revolution = {counts} (lost or false pulses, "
            f"{off.sum():+.6g} counts in {wrong.size} of {between.size} revolutions; or another counts_per_revolution)"
        )
    return ""
