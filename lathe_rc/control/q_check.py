# SPDX-License-Identifier: Apache-2.0
"""Whether a Q filter is one: what repetitive control and the check before a start believe of it."""

import numpy as np

from lathe_rc.control.q_filter import Exponential, QFilter
from lathe_rc.errors import InputError

_EXACT, _CLOSE = 1e-9, 1e-6  # allowed at 0 radians, and between what is said and what is done
_WAVES = 7


def check(q: QFilter) -> None:
    """Compare what a filter does with what it says.

    Raises:
        InputError: response and smoothing do not belong together, or Q(0) is not 1.
    """
    if q.ratio >= 0.0 and type(q).smooth is not Exponential.smooth:
        raise InputError("it derives from Exponential, which is computed elsewhere; allowed: derive from QFilter")
    if q.chunk < 1 or q.reach < 0:
        raise InputError(f"reach = {q.reach}, chunk = {q.chunk} grid points; allowed: 0 and 1, or more")
    radians = np.linspace(0.0, np.pi, _WAVES)
    response = np.asarray(q.response(radians))
    if response.shape != radians.shape or response.dtype.kind != "f" or not np.all(np.isfinite(response)):
        raise InputError(
            f"response(radians) gives {response.dtype} of shape {response.shape} for {_WAVES} values; allowed: a "
            "finite real number for each (a filter without phase)"
        )
    if abs(response[0] - 1.0) > _EXACT:
        raise InputError(f"Q(0) = {response[0]:.10g}; allowed: 1, or the memory forgets what does not change")
    # Waves of all frequencies at once, each with a phase of its own: what adds up right is linear and without phase.
    place = np.arange(-q.reach, q.chunk + q.reach)
    waves = np.cos(np.outer(radians, place) + np.arange(_WAVES)[:, None])
    smoothed = np.full(q.chunk, np.nan)
    q.smooth(waves.sum(axis=0), smoothed)
    error = np.abs(smoothed - response @ waves[:, q.reach : q.reach + q.chunk]).max()
    if not error <= _CLOSE:
        raise InputError(
            f"smooth differs from response by {error:.3g} for waves of amplitude 1; allowed: {_CLOSE:g} (smooth fills "
            "all of its second argument, and response is the gain of what it does)"
        )
