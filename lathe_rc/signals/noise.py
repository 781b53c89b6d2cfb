# SPDX-License-Identifier: Apache-2.0
"""Measurement noise and quantisation of a sensor."""

import zlib

import numpy as np
import numpy.typing as npt

from lathe_rc.jit import kernel

Array = npt.NDArray[np.float64]


@kernel
def quantise(value: float, resolution: float) -> float:
    """What a converter or sensor of a ``resolution`` makes of a value, in the same unit; 0 for none."""
    if resolution > 0.0:
        return float(np.rint(value / resolution) * resolution)
    return value


class Sensor:
    """Adds white noise and rounds to a resolution; both off when 0.

    Args:
        noise_rms: root mean square of the noise, in the unit of the signal.
        resolution: quantisation step, in the unit of the signal.
        seed: the scenario's seed.
        name: who measures; makes the noise of each sensor its own.

    Attributes:
        disturbs: False if it measures what is true.
    """

    def __init__(self, noise_rms: float, resolution: float, seed: int, name: str) -> None:
        self._noise_rms, self._resolution = noise_rms, resolution
        self.disturbs = noise_rms > 0.0 or resolution > 0.0
        # A stream of normal numbers does not depend on the lengths in which it is drawn.
        self._random = np.random.default_rng(np.random.SeedSequence([seed, zlib.crc32(name.encode())]))

    def measure(self, true: Array, measured: Array) -> None:
        """Fill ``measured`` from ``true``; both of shape (n,)."""
        measured[:] = true
        if self._noise_rms > 0.0:
            measured += self._noise_rms * self._random.standard_normal(true.size)
        if self._resolution > 0.0:
            np.rint(measured / self._resolution, out=measured)
            measured *= self._resolution
