# SPDX-License-Identifier: Apache-2.0
"""Sensor noise, quantisation, and spectral lines of random disturbances."""

import zlib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from lathe_rc.arrays import Array, Integers, put
from lathe_rc.jit import inlined, kernel

DRAWN = 8192  #: largest number of random numbers that a stream draws at once


@inlined
def quantise(value: float, resolution: float) -> float:
    """Round a value to a ``resolution`` in the same unit, as a converter or sensor does; 0 for no rounding."""
    if resolution > 0.0:
        return float(np.rint(value / resolution) * resolution)
    return value


class DrawnNumbers(NamedTuple):
    """Normal random numbers with mean 0 and RMS 1, for kernels.

    Attributes:
        values: numbers drawn in advance.
        used: number of values already used, shape (1,).
    """

    values: Array
    used: Integers


class NormalStream:
    """Stream of normal random numbers that do not depend on how many are drawn at a time.

    Args:
        seed: the scenario's seed.
        name: name of the owner; selects an independent stream.
        on: whether any numbers are drawn.

    Attributes:
        generator: NumPy's generator of the numbers; only if any are drawn.
        drawn: numbers drawn in advance, for kernels.
    """

    def __init__(self, seed: int, name: str, *, on: bool = True) -> None:
        if on:
            self.generator = np.random.default_rng(np.random.SeedSequence([seed, zlib.crc32(name.encode())]))
        size = DRAWN if on else 0
        self.drawn = DrawnNumbers(np.zeros(size), np.array([size], np.int64))

    def draw(self, numbers: int) -> None:
        """Ensure that ``numbers`` random numbers are drawn in advance, up to 8192."""
        values, used = self.drawn
        if values.size and used[0] + numbers > values.size:
            # Unused numbers move to the front, so that numbers are used in the order drawn for any block length.
            left = values.size - used[0]
            values[:left] = values[used[0] :].copy()
            self.generator.standard_normal(out=values[left:])
            used[0] = 0

    def draw_along(self, samples: int) -> Iterator[slice]:
        """Yield slices of a block of any length, each after drawing the numbers for it."""
        for start in range(0, samples, DRAWN):
            piece = slice(start, min(start + DRAWN, samples))
            self.draw(piece.stop - start)
            yield piece


def random_lines(rms: float, low: float, high: float, lines: int, random: np.random.Generator) -> Array:
    """Return amplitude, frequency [rad/s] and phase [rad] of random sines with a given total RMS, shape (3, lines).

    All lines have the same amplitude. The band from ``low`` to ``high`` is divided into equal sections, one for
    each line, whose frequency and phase are drawn from ``random``. The sum repeats only after many periods and is
    nearly normally distributed.
    """
    frequency = low + (high - low) * (np.arange(lines) + random.random(lines)) / lines
    phase = random.uniform(0.0, 2.0 * np.pi, lines)
    return np.stack((np.full(lines, rms * np.sqrt(2.0 / lines)), frequency, phase))


class SensorTable(NamedTuple):
    """Noise and resolution of a sensor for kernels (see `Sensor`).

    Attributes:
        noise: random numbers for the noise.
        rms: RMS of the noise, in the unit of the signal.
        resolution: quantisation step, in the unit of the signal.
    """

    noise: DrawnNumbers
    rms: float
    resolution: float


@kernel
def measure(sensor: SensorTable, true: Array, measured: Array) -> None:
    """Fill ``measured`` from ``true`` with noise and rounding, both of shape (n,), using n of the drawn numbers."""
    if sensor.rms > 0.0:
        noise, place = sensor.noise.values, sensor.noise.used[0]
        for k in range(true.size):
            measured[k] = true[k] + sensor.rms * noise[place + k]
        sensor.noise.used[0] = place + true.size
    else:
        put(measured, true)
    if sensor.resolution > 0.0:
        for k in range(true.size):
            measured[k] = quantise(measured[k], sensor.resolution)


@kernel
def drawn(sensor: SensorTable, numbers: int) -> Array:
    """Return the noise of ``numbers`` samples, shape (n,); empty without noise."""
    found = np.zeros(numbers if sensor.rms > 0.0 else 0)
    measure(sensor, found, found)
    return found


class Sensor:
    """Sensor that adds white noise and rounds to a resolution; 0 disables either.

    Args:
        noise_rms: RMS of the noise, in the unit of the signal.
        resolution: quantisation step, in the unit of the signal.
        seed: the scenario's seed.
        name: name of the sensor; selects an independent noise stream.

    Attributes:
        stream: stream of the noise.
        table: constants and random numbers for `measure`.
    """

    def __init__(self, noise_rms: float, resolution: float, seed: int, name: str) -> None:
        self.stream = NormalStream(seed, name, on=noise_rms > 0.0)
        self.table = SensorTable(self.stream.drawn, noise_rms, resolution)

    def measure(self, true: Array, measured: Array) -> None:
        """Fill ``measured`` from ``true`` with noise and rounding, both of shape (n,)."""
        for piece in self.stream.draw_along(true.size):
            measure(self.table, true[piece], measured[piece])
