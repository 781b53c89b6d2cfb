# SPDX-License-Identifier: Apache-2.0
"""Vibration of the tool against the part.

A closed form of time, so that sample n does not depend on the samples before it:

    Δx(t) = Σ a_i·sin(ω_i·t + ψ_i)

A band-limited random vibration is a sum of such lines with seeded frequencies and phases. Source: Δx of paper 001,
Fig. 4 and eq. 6.
"""

import numpy as np
import numpy.typing as npt

from lathe_rc.errors import InputError
from lathe_rc.jit import kernel

Array = npt.NDArray[np.float64]


@kernel
def evaluate(first: int, step: float, lines: Array, position: Array, velocity: Array) -> None:
    """Fill displacement [m] and velocity [m/s] from sample ``first`` on, shape (n,); ``step`` in s.

    ``lines`` is (3, m): amplitude [m], frequency [rad/s], phase [rad].
    """
    for k in range(position.size):
        t = (first + k) * step
        x = v = 0.0
        for i in range(lines.shape[1]):
            amplitude, frequency = lines[0, i], lines[1, i]
            angle = frequency * t + lines[2, i]
            x += amplitude * np.sin(angle)
            v += amplitude * frequency * np.cos(angle)
        position[k], velocity[k] = x, v


def harmonic(amplitude: Array, frequency: Array, phase: Array) -> Array:
    """Lines of given ``amplitude`` [m], ``frequency`` [rad/s] and ``phase`` [rad], each of shape (n,); (3, n).

    Raises:
        InputError: arrays of different lengths.
    """
    if not amplitude.size == frequency.size == phase.size:
        raise InputError(
            f"vibration: {amplitude.size} amplitudes, {frequency.size} frequencies and {phase.size} phases; "
            "give as many of each"
        )
    return np.stack((amplitude, frequency, phase))


def band_limited_random(rms: float, low: float, high: float, lines: int, random: np.random.Generator) -> Array:
    """Random vibration of ``rms`` [m] between ``low`` and ``high`` [rad/s] as lines, shape (3, ``lines``).

    The lines are equal, one in each of as many equal parts of the band, with frequency and phase drawn from
    ``random``: the sum repeats only after many periods and nears a normal distribution.

    Raises:
        InputError: a band that is none.
    """
    if rms == 0.0:
        return np.empty((3, 0))
    if not 0.0 < low < high:
        raise InputError(f"random vibration: band {low:g}-{high:g} rad/s; allowed: 0 < low < high")
    frequency = low + (high - low) * (np.arange(lines) + random.random(lines)) / lines
    phase = random.uniform(0.0, 2.0 * np.pi, lines)
    return np.stack((np.full(lines, rms * np.sqrt(2.0 / lines)), frequency, phase))
