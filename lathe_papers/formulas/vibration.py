# SPDX-License-Identifier: Apache-2.0
"""Reduction of a band-limited vibration by direct piezo compensation (paper 001, eq. 6: 2 to 3 times).

A measured vibration Δx commands the piezo, and Δx·(1 - Wpk) remains. With the spectrum S of Δx, the RMS decreases by

    sqrt(∫S dω / ∫S·|1 - Wpk|² dω)

Hysteresis without linearisation precedes Wpk. For a sine it acts like its describing function N, so 1 - N·Wpk replaces
1 - Wpk; the harmonics of the hysteresis are neglected.
"""

import math
from collections.abc import Callable

import numpy as np
import scipy

from lathe_papers.formulas.responses import Response
from lathe_papers.formulas.structures import uncompensated
from lathe_rc.arrays import Array, Complex

Spectrum = Callable[[Array], Array]

_GRID = 4097  # number of frequencies of the integral from which a band is determined


def flat(frequency: Array) -> Array:
    """Return a flat spectrum: equal power at all frequencies, shape (n,)."""
    return np.ones_like(frequency)


def reduction(compensator: Response, band: float, spectrum: Spectrum = flat) -> float:
    """Return the ratio of the RMS of a vibration to the RMS of its remainder.

    Args:
        compensator: response Wpk of the piezo, or N·Wpk.
        band: upper limit of the vibration's frequencies [rad/s], above 0; the lower limit is 0.
        spectrum: power density over frequency [rad/s], in any unit.
    """

    def left(frequency: float) -> float:
        at = np.array([frequency])
        return float((spectrum(at) * np.abs(uncompensated(compensator(at))) ** 2)[0])

    before = scipy.integrate.quad(lambda frequency: float(spectrum(np.array([frequency]))[0]), 0.0, band, limit=500)[0]
    after = scipy.integrate.quad(left, 0.0, band, limit=500)[0]
    return math.sqrt(before / after) if after > 0.0 else math.inf


def widest_band(compensator: Response, wanted: float, highest: float, spectrum: Spectrum = flat) -> float:
    """Return the widest band [rad/s] in which a vibration is reduced by a factor of at least ``wanted``.

    Args:
        compensator: response Wpk of the piezo, or N·Wpk.
        wanted: required reduction, RMS before over RMS after.
        highest: widest band of the search [rad/s].
        spectrum: power density over frequency [rad/s], as in `reduction`.

    Returns:
        The first band at which the reduction falls to ``wanted``: 0 if even the lowest frequencies are reduced less,
        inf if the reduction exceeds ``wanted`` up to ``highest``.
    """
    grid = np.linspace(0.0, highest, _GRID)
    power = spectrum(grid)
    too_much: Array = power * (np.abs(uncompensated(compensator(grid))) ** 2 - wanted**-2)
    excess = scipy.integrate.cumulative_trapezoid(too_much, grid, initial=0)
    reached = np.flatnonzero(excess[1:] > 0.0)  # the integral stays 0 below the lowest frequency of the vibration
    if not reached.size:
        return math.inf
    k = int(reached[0])
    if k == 0:
        return 0.0
    return float(grid[k] + (grid[k + 1] - grid[k]) * excess[k] / (excess[k] - excess[k + 1]))


def describing_function(amplitude: float, thresholds: Array, weights: Array, proportional: float) -> complex:
    """Return the describing function N of a Prandtl-Ishlinskii hysteresis.

    N is the ratio of the output's first harmonic to a sinusoidal input.

    For one play operator with threshold r, at the amplitude A and with c = 1 - 2r/A,

        N = 1/2 + (asin c + c·sqrt(1 - c²))/π - j·(4/π)·(r/A)·(1 - r/A)      and 0 for r >= A

    Args:
        amplitude: amplitude A of the sine, in units of the half-stroke, above 0.
        thresholds: thresholds r_i of the play operators, shape (n,).
        weights: weights p_i of the play operators, shape (n,).
        proportional: weight p0 of the proportional term.
    """
    ratio = np.minimum(np.asarray(thresholds, dtype=np.float64) / amplitude, 1.0)
    cosine = 1.0 - 2.0 * ratio
    real = 0.5 + (np.arcsin(cosine) + cosine * np.sqrt(1.0 - cosine**2)) / np.pi
    plays: Complex = real - 4j / np.pi * ratio * (1.0 - ratio)
    return complex(proportional + weights @ plays)
