# SPDX-License-Identifier: Apache-2.0
"""Vibration between tool and part.

The vibration is a closed-form function of time, so sample n does not depend on the samples before it:

    Δx(t) = Σ a_i·sin(ω_i·t + ψ_i)

A band-limited random vibration is a sum of such lines with seeded frequencies and phases. Source: Δx of paper 001,
Fig. 4 and eq. 6.
"""

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel
from lathe_rc.signals.checks import stacked
from lathe_rc.signals.noise import random_lines


@kernel
def evaluate(first: int, step: float, lines: Array, position: Array, velocity: Array) -> None:
    """Fill displacement [m] and velocity [m/s] of a vibration, starting at sample ``first``, shape (n,); ``step`` in s.

    ``lines`` has shape (3, m): amplitude [m], frequency [rad/s] and phase [rad].
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
    """Return vibration lines with given ``amplitude`` [m], ``frequency`` [rad/s] and ``phase`` [rad], shape (3, n).

    Raises:
        InputError: the arrays differ in length.
    """
    return stacked("vibration", amplitudes=amplitude, frequencies=frequency, phases=phase)


def band_limited_random(rms: float, low: float, high: float, lines: int, random: np.random.Generator) -> Array:
    """Return lines of a random vibration of ``rms`` [m] between ``low`` and ``high`` [rad/s] (see `random_lines`).

    There are no lines for an RMS of 0.

    Raises:
        InputError: the band is invalid.
    """
    if rms == 0.0:
        return np.empty((3, 0))
    if not 0.0 < low < high:
        raise InputError(f"random vibration: band {low:g}-{high:g} rad/s; allowed: 0 < low < high")
    return random_lines(rms, low, high, lines, random)
