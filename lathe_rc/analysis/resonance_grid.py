# SPDX-License-Identifier: Apache-2.0
"""Grids of frequencies that resolve resonances narrower than the distance of their points.

Near a pole s = -σ ± jω0 a response is A + R/(σ + j(ω - ω0)), a circle that is run through within some σ. Points at
ω - ω0 = σ·sinh(u), at even distances of u, divide this circle evenly and the way from there to the next resonance in
even ratios.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from lathe_rc.arrays import Array, Complex
from lathe_rc.jit import kernel

_NARROW, _REACH = 2.0, 8.0  # σ below which a pole is resolved, and ends of its points, in distances of the grid
_EVERY = 0.1  # distance of u
_LEAST = 1e-9  # of σ over ω0 + the distance of the grid
_FINE, _PEAKS = 65, 3  # points around each peak, and peaks of a grid without a resonance

NO_POLES = np.zeros(0, np.complex128)


def poles_of(response: Callable[..., Any]) -> Complex:
    """Return the poles of a response [rad/s], shape (k,): those that its object has as ``poles``, or none."""
    return np.asarray(getattr(getattr(response, "__self__", response), "poles", NO_POLES), np.complex128)


def with_images(poles: Complex, step: float, highest: float) -> Complex:
    """Return poles in the upper half plane up to ``highest`` [rad/s], with the images that sampling makes of them."""
    turn = 2j * np.pi / step
    both = np.concatenate((poles, poles.conj()))
    every = np.unique(both + turn * np.arange(np.ceil(highest * step / (2.0 * np.pi)) + 1.0)[:, None])
    return np.asarray(every[(every.imag >= 0.0) & (every.imag <= highest)])


class Grid(NamedTuple):
    """Points between which a function is searched for peaks.

    Attributes:
        points: increasing, shape (n,).
        apart: distance to the farther neighbour of each, shape (n,).
        peaks: number of peaks around which `near_peaks` refines the grid.
    """

    points: Array
    apart: Array
    peaks: int

    @classmethod
    def even(cls, points: Array) -> "Grid":
        """Return a grid of evenly distributed points from 0."""
        return cls(points, np.full(points.size, points[1]), _PEAKS)

    @classmethod
    def uneven(cls, points: Array, peaks: int = _PEAKS) -> "Grid":
        """Return a grid of any increasing points."""
        gaps = np.diff(points, prepend=points[0], append=points[-1])
        return cls(points, np.maximum(gaps[1:], gaps[:-1]), peaks)

    def resolving(self, poles: Complex) -> "Grid":
        """Return the grid with further points around the poles, in units of the points, that it does not resolve."""
        points = self.points
        place = np.clip(np.searchsorted(points, poles.imag), 1, points.size - 1)
        apart = points[place] - points[place - 1]
        width = np.maximum(abs(poles.real), _LEAST * (poles.imag + apart))
        narrow = np.flatnonzero(width < _NARROW * apart)
        if not narrow.size:
            return self
        around = [points]
        for k in narrow:
            most = np.arcsinh(_REACH * apart[k] / width[k])
            around.append(poles.imag[k] + width[k] * np.sinh(np.linspace(-most, most, round(2.0 * most / _EVERY) + 1)))
        whole = np.unique(np.concatenate(around))
        whole = whole[(whole >= points[0]) & (whole <= points[-1])]
        return Grid.uneven(whole, self.peaks + narrow.size)

    def near_peaks(self, size: Array) -> Array:
        """Return fine points around the highest peaks of a function with the values ``size``, ends included.

        If ``size`` is not finite somewhere, only the first such point is returned.
        """
        return _near_peaks(*self, size)


@kernel
def _near_peaks(points: Array, apart: Array, peaks: int, size: Array) -> Array:
    """Implement `Grid.near_peaks`."""
    last = points.size - 1
    heights, places = np.full(peaks, -np.inf), np.zeros(peaks, np.int64)  # in rising order, by insertion
    for k in range(last + 1):
        if not size[k] < np.inf:
            return np.array([points[k]])
        if k in (0, last) or (size[k] >= size[k - 1] and size[k] >= size[k + 1]):
            below = 0
            while below < peaks and size[k] >= heights[below]:
                if below:
                    heights[below - 1], places[below - 1] = heights[below], places[below]
                heights[below], places[below] = size[k], k
                below += 1
    near = np.empty(peaks * _FINE)
    for i in range(near.size):
        place = places[i // _FINE]
        near[i] = points[place] + (2.0 * (i % _FINE) / (_FINE - 1) - 1.0) * apart[place]
        near[i] = min(max(near[i], points[0]), points[last])
    return near
