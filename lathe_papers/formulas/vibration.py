# SPDX-License-Identifier: Apache-2.0
"""How far direct piezo compensation reduces a band-limited vibration (paper 001, eq. 6: 2 to 3 times).

A measured vibration Δx commands the piezo; Δx·(1 - Wpk) is left. With the spectrum S of Δx, the RMS falls by

    sqrt(∫S dω / ∫S·|1 - Wpk|² dω)

Hysteresis that is not linearised stands before Wpk. For a sine it acts like its describing function N, so
1 - N·Wpk takes the place of 1 - Wpk; harmonics that it makes are left out.
"""

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import scipy

from lathe_papers.formulas.responses import Array, Response
from lathe_papers.formulas.structures import uncompensated

Spectrum = Callable[[Array], Array]

_GRID = 4097  # frequencies of the integral that a band is read from


def flat(frequency: Array) -> Array:
    """Equal power at all frequencies, shape (n,)."""
    return np.ones_like(frequency)


def reduction(compensator: Response, band: float, spectrum: Spectrum = flat) -> float:
    """RMS of a vibration over what is left of it.

    Args:
        compensator: Wpk, or N·Wpk.
        band: the vibration has frequencies from 0 to this [rad/s], above 0.
        spectrum: power density at frequencies [rad/s], in any unit.
    """

    def left(frequency: float) -> float:
        at = np.array([frequency])
        return float((spectrum(at) * np.abs(uncompensated(compensator(at))) ** 2)[0])

    before = scipy.integrate.quad(lambda frequency: float(spectrum(np.array([frequency]))[0]), 0.0, band, limit=500)[0]
    after = scipy.integrate.quad(left, 0.0, band, limit=500)[0]
    return math.sqrt(before / after) if after > 0.0 else math.inf


def widest_band(compensator: Response, wanted: float, highest: float, spectrum: Spectrum = flat) -> float:
    """Band [rad/s] up to which a vibration is reduced ``wanted`` times or more.

    Args:
        compensator: Wpk, or N·Wpk.
        wanted: RMS before over RMS after.
        highest: largest band looked at [rad/s].
        spectrum: see `reduction`.

    Returns:
        The first band at which the reduction falls to ``wanted``: 0 if the lowest frequencies are reduced less
        already, inf if it is more up to ``highest``.
    """
    grid = np.linspace(0.0, highest, _GRID)
    power = spectrum(grid)
    too_much: Array = power * (np.abs(uncompensated(compensator(grid))) ** 2 - wanted**-2)
    excess = scipy.integrate.cumulative_trapezoid(too_much, grid, initial=0)
    reached = np.flatnonzero(excess[1:] > 0.0)  # below the vibration's lowest frequency it stays 0
    if not reached.size:
        return math.inf
    k = int(reached[0])
    if k == 0:
        return 0.0
    return float(grid[k] + (grid[k + 1] - grid[k]) * excess[k] / (excess[k] - excess[k + 1]))


def describing_function(amplitude: float, thresholds: Array, weights: Array, proportional: float) -> complex:
    """N of a Prandtl-Ishlinskii hysteresis for a sine: first harmonic of the output over the input.

    Of a play with the threshold r and the amplitude A, with c = 1 - 2r/A,

        N = 1/2 + (asin c + c·sqrt(1 - c²))/π - j·(4/π)·(r/A)·(1 - r/A)      and 0 for r >= A

    Args:
        amplitude: A, in units of the half-stroke, above 0.
        thresholds: r_i of the plays, shape (n,).
        weights: p_i, shape (n,).
        proportional: p0.
    """
    ratio = np.minimum(np.asarray(thresholds, dtype=np.float64) / amplitude, 1.0)
    cosine = 1.0 - 2.0 * ratio
    real = 0.5 + (np.arcsin(cosine) + cosine * np.sqrt(1.0 - cosine**2)) / np.pi
    plays: npt.NDArray[np.complex128] = real - 4j / np.pi * ratio * (1.0 - ratio)
    return complex(proportional + weights @ plays)
