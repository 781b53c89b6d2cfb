# SPDX-License-Identifier: Apache-2.0
"""Causes that limit a form error, judged by its last revolutions: learning that goes on, what repeats, what changes.

Only a budget (`lathe_rc.judge.budget`) gives the share of each cause.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from lathe_rc.messages import Samples

WARN = "warn"

_FEWEST = 4  # smallest number of revolutions for a trend
_CHANGE = 0.05  # change of the form error over the last revolutions below which it counts as constant
_VARIES = 0.005  # smallest relative deviation at which a speed counts as varying
_SOME = 0.1  # smallest share of the power that is reported


@dataclass(frozen=True)
class Finding:
    """Sentence about a run, whether it is good or bad news, and whether it says that the form error still falls."""

    text: str
    mood: str = ""
    falls: bool = False


def form_limits(profiles: Samples, *, excess: float, learning: bool, causes: Iterable[str]) -> Iterator[Finding]:
    """Yield findings on the form error and on its repeatable and variable parts; none for fewer than 4 revolutions.

    Args:
        profiles: form errors of the last revolutions at uniformly spaced angles [µm], shape (revolutions, points).
        excess: largest error over the tolerance; up to 1: in tolerance, or there is no tolerance.
        learning: whether the cell has a learning controller.
        causes: names of the causes that make one revolution differ from the next.
    """
    count = len(profiles)
    power = float(np.mean(profiles**2)) if count >= _FEWEST else 0.0
    if not power:
        return
    trend = _trend(np.sqrt(np.mean(profiles**2, axis=-1)), excess)
    if trend:
        yield trend
    # The mean of count revolutions still contains 1/count of the variable power; the factor corrects this.
    mean = profiles.mean(axis=0)
    share = min(float(np.mean((profiles - mean) ** 2)) * count / (count - 1) / power, 1.0)
    left = ": what learning and its Q filter leave" if learning and not trend else ""
    named = ", ".join(causes)
    parts = [
        (1.0 - share, f"repeats from revolution to revolution, {_largest(mean)}{left}"),
        (share, f"changes from revolution to revolution{': ' if named else ''}{named}"),
    ]
    if trend:
        parts.pop()  # it contains what learning changes
    for part, text in sorted(parts, reverse=True):
        if part >= _SOME:
            yield Finding(f"{part:.0%} of the form error's power in the last {count} revolutions {text}.")


def _largest(profile: Samples) -> str:
    """Return the largest part of a profile [µm] in words: the size of the part, or an undulation."""
    amplitude = np.abs(np.fft.rfft(profile)) * 2.0 / profile.size
    order, size = int(np.argmax(amplitude[1:])) + 1, amplitude[0] / 2.0
    if size * np.sqrt(2.0) > amplitude[order]:  # it has the larger power
        return f"most in the size of the part ({size:.3g} µm of the radius)"
    return f"most at {order} {'wave' if order == 1 else 'waves'} a turn ({amplitude[order]:.3g} µm)"


def _trend(rms: Samples, excess: float) -> Finding | None:
    """Return a finding on the trend of the form error, if the error clearly falls or grows in the last revolutions."""
    half = len(rms) // 2
    before, after = rms[:half], rms[-half:]
    factor = float(after.mean() / before.mean()) if before.mean() else 1.0
    each = float(np.median(rms[1:] / rms[:-1])) if rms.all() else 1.0  # a step is not a trend
    if after.max() < before.min() and factor < 1.0 - _CHANGE and each < 1.0:
        turns = math.ceil(math.log(1.0 / excess) / math.log(each)) if excess > 1.0 else 0
        more = f"; in tolerance after some {turns} more, if it goes on like this" if turns else ""
        text = f"Learning is not over: the form error falls by {1.0 - each:.1%} a revolution{more}."
        return Finding(text, WARN, falls=True)
    if after.min() > before.max() and factor > 1.0 + _CHANGE and each > 1.0:
        return Finding(f"The form error grows by {each - 1.0:.1%} a revolution in the last {len(rms)}.", WARN)
    return None


def varying_speed(low: float, high: float) -> list[str]:
    """Return the variation of a spindle speed between two extremes, in words, if it is large enough."""
    deviation = (high - low) / (high + low) if low > 0.0 and math.isfinite(high) else 0.0
    return [f"speed (which varies by ±{deviation:.1%})"] if deviation >= _VARIES else []
