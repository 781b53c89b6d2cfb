# SPDX-License-Identifier: Apache-2.0
"""Random numbers of a run: noise and quantisation of sensors, lines of a random disturbance."""

import zlib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.arrays import Array, put
from lathe_rc.jit import inlined, kernel

Integers = npt.NDArray[np.int64]

DRAWN = 8192  #: numbers that a stream draws at a time, at most


@inlined
def quantise(value: float, resolution: float) -> float:
    """A value as a converter or sensor of a ``resolution`` gives it, in the same unit; 0 for none."""
    if resolution > 0.0:
        return float(np.rint(value / resolution) * resolution)
    return value


class Drawn(NamedTuple):
    """Normal numbers for kernels, mean 0 and RMS 1.

    Attributes:
        values: drawn in advance.
        used: how many of them have been, shape (1,).
    """

    values: Array
    used: Integers


class NormalStream:
    """A stream of normal numbers; the lengths in which it is drawn leave no trace.

    Args:
        seed: the scenario's seed.
        name: makes the stream its owner's own.
        on: without, nothing is ever drawn.

    Attributes:
        drawn: for kernels, which take the next numbers from it.
    """

    def __init__(self, seed: int, name: str, *, on: bool = True) -> None:
        if on:
            self._random = np.random.default_rng(np.random.SeedSequence([seed, zlib.crc32(name.encode())]))
        size = DRAWN if on else 0
        self.drawn = Drawn(np.empty(size), np.array([size], np.int64))

    def draw(self, numbers: int) -> None:
        """Have so many numbers in advance, up to 8192."""
        values, used = self.drawn
        if values.size and used[0] + numbers > values.size:
            # Unused numbers move to the front: the order of use is that of drawing, whatever the blocks.
            left = values.size - used[0]
            values[:left] = values[used[0] :].copy()
            self._random.standard_normal(out=values[left:])
            used[0] = 0

    def draw_along(self, samples: int) -> Iterator[slice]:
        """Pieces of a block of any length, each with its numbers drawn."""
        for start in range(0, samples, DRAWN):
            piece = slice(start, min(start + DRAWN, samples))
            self.draw(piece.stop - start)
            yield piece


def random_lines(rms: float, low: float, high: float, lines: int, random: np.random.Generator) -> Array:
    """Amplitude, frequency [rad/s] and phase [rad] of sines with an RMS between two frequencies, shape (3, lines).

    The lines are equal, one in each of as many equal parts of the band, with frequency and phase drawn from
    ``random``: the sum repeats only after many periods and nears a normal distribution.
    """
    frequency = low + (high - low) * (np.arange(lines) + random.random(lines)) / lines
    phase = random.uniform(0.0, 2.0 * np.pi, lines)
    return np.stack((np.full(lines, rms * np.sqrt(2.0 / lines)), frequency, phase))


class SensorTable(NamedTuple):
    """A `Sensor` for kernels.

    Attributes:
        noise: for its noise.
        rms: of the noise, in the unit of the signal.
        resolution: quantisation step, in the unit of the signal.
    """

    noise: Drawn
    rms: float
    resolution: float


@kernel
def measure(sensor: SensorTable, true: Array, measured: Array) -> None:
    """Fill ``measured`` from ``true``; both of shape (n,), and as many numbers drawn if there is noise."""
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


class Sensor:
    """Adds white noise and rounds to a resolution; both off when 0.

    Args:
        noise_rms: root mean square of the noise, in the unit of the signal.
        resolution: quantisation step, in the unit of the signal.
        seed: the scenario's seed.
        name: who measures; makes the noise of each sensor its own.

    Attributes:
        table: for `measure`.
    """

    def __init__(self, noise_rms: float, resolution: float, seed: int, name: str) -> None:
        self._stream = NormalStream(seed, name, on=noise_rms > 0.0)
        self.table = SensorTable(self._stream.drawn, noise_rms, resolution)

    def draw(self, samples: int) -> None:
        """Draw the noise of the next samples, up to 8192."""
        self._stream.draw(samples)

    def measure(self, true: Array, measured: Array) -> None:
        """Fill ``measured`` from ``true``; both of shape (n,)."""
        for piece in self._stream.draw_along(true.size):
            measure(self.table, true[piece], measured[piece])
