# SPDX-License-Identifier: Apache-2.0
"""Zero-phase smoothing filters over the angle: the Q of repetitive control (paper 001: Q = 1 + Wф).

All filters have Q(0) = 1 and a width fixed in angle. With the width κ in grid points they agree at low frequencies,
Q(ν) ≈ 1 - (κν)² for ν radians per grid point, so that `q_time` has the same meaning for each of them:

    exponential      1/(1 + 4κ²·sin²(ν/2))      kernel r^|j|: two first-order recursions
    Gaussian         exp(-(κν)²)                kernel of standard deviation √2·κ
    moving average   sin(aν)/(aν), a = √6·κ     running sum
    FIR              Kaiser-windowed low-pass, flat up to a pass frequency

A filter is applied to a fixed number of grid points at a time (`chunk`), with `reach` further points on each side. The
start of a chunk is fixed on the grid, so results are bit-identical for all block lengths. The cost per point does not
depend on the width for the exponential filter and the moving average, and grows with the logarithm of the width for
the others.
"""

from abc import ABC, abstractmethod
from functools import lru_cache
from math import ceil

import numpy as np
import scipy

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel

_TAIL = 1e-12  # weight at which a kernel is truncated
_EDGES = 256  # number of frequencies at which the ripple of a band is checked
_CHUNK = 256  # grid points filtered at a time, unless the kernel is longer


class QFilter(ABC):
    """Base class of the zero-phase filters on the grid of the memory.

    Args:
        reach: grid points used on each side of a point.
        cycle: grid points in a cycle of the memory.

    Attributes:
        reach: as given.
        chunk: grid points that `smooth` computes at a time.
        ratio: ratio of the recursions of `Exponential`, which kernels compute themselves; negative for other filters.

    Raises:
        InputError: the filter is wider than the cycle allows.
    """

    stateless = True  #: stages with equal parameters share it, and no run changes it
    ratio = -1.0

    def __init__(self, reach: int, cycle: int) -> None:
        if 2 * reach >= cycle:
            raise InputError(
                f"Q filter reaches {reach} grid points to each side; allowed: less than half the cycle of {cycle} "
                "points"
            )
        self.reach = reach
        # At least as long as the reach, so that the margins cost at most twice as much as the points.
        self.chunk = min(max(_CHUNK, reach), cycle - reach)

    @abstractmethod
    def smooth(self, points: Array, smoothed: Array) -> None:
        """Filter ``points``, shape (chunk + 2·reach,), into ``smoothed``, shape (chunk,)."""

    @abstractmethod
    def response(self, radians: Array) -> Array:
        """Compute the real frequency response at ``radians`` per grid point, shape (n,)."""


@kernel
def two_sided(ratio: float, reach: int, points: Array, scratch: Array, smoothed: Array) -> None:
    """Run the forward and backward recursions of `Exponential` in one loop; ``scratch`` is as long as ``points``."""
    gain = (1.0 - ratio) / (1.0 + ratio)
    last = points.size - 1
    forward = backward = 0.0
    for k in range(points.size - reach):
        forward = ratio * forward + points[k]
        # The backward sum excludes the point itself, which the forward sum includes.
        scratch[last - k] = backward
        backward = ratio * backward + points[last - k]
        if k >= reach:
            smoothed[k - reach] = forward
    for k in range(smoothed.size):
        smoothed[k] = gain * (smoothed[k] + ratio * scratch[k + reach])


class Exponential(QFilter):
    """Two-sided exponential filter, the Q of papers 000 and 001: 1/(1 + (ω·width)²) in the limit of a fine grid.

    Args:
        width: κ, angle constant in grid points.
        cycle: grid points in a cycle.
    """

    def __init__(self, width: float, cycle: int) -> None:
        self._square = width**2
        self.ratio = 2.0 * self._square / (1.0 + 2.0 * self._square + np.sqrt(1.0 + 4.0 * self._square))
        super().__init__(ceil(np.log(_TAIL) / np.log(self.ratio)) if self.ratio > 0.0 else 0, cycle)

    def smooth(self, points: Array, smoothed: Array) -> None:
        """Filter ``points`` by a forward and a backward recursion."""
        two_sided(self.ratio, self.reach, points, np.empty_like(points), smoothed)

    def response(self, radians: Array) -> Array:
        """Compute the real frequency response at ``radians`` per grid point, shape (n,)."""
        return np.asarray(1.0 / (1.0 + 4.0 * self._square * np.sin(radians / 2.0) ** 2))


@kernel
def _running_mean(reach: int, end: float, points: Array, smoothed: Array) -> None:
    scale = 1.0 / (2 * reach - 1 + 2.0 * end)
    total = 0.0
    for k in range(1, 2 * reach):
        total += points[k]
    for k in range(smoothed.size):
        if k:
            total += points[k + 2 * reach - 1] - points[k]
        smoothed[k] = scale * (total + end * (points[k] + points[k + 2 * reach]))


class MovingAverage(QFilter):
    """Moving average over the angle; the two end points are weighted by their fractions inside the window.

    Args:
        width: κ in grid points; the window extends √6·κ grid angles in each direction.
        cycle: grid points in a cycle.
    """

    def __init__(self, width: float, cycle: int) -> None:
        side = max(np.sqrt(6.0) * width - 0.5, 0.0)  # beyond the middle point's half-width
        super().__init__(ceil(side), cycle)
        self._end = float(side - (self.reach - 1)) if self.reach else 0.0

    def smooth(self, points: Array, smoothed: Array) -> None:
        """Filter ``points`` by a running sum."""
        if self.reach:
            _running_mean(self.reach, self._end, points, smoothed)
        else:
            smoothed[:] = points

    def response(self, radians: Array) -> Array:
        """Compute the real frequency response at ``radians`` per grid point, shape (n,)."""
        if not self.reach:
            return np.ones_like(radians)
        inner = 2 * self.reach - 1
        # Sum of cosines over the whole points (Dirichlet kernel), with its limit where ν is a multiple of 2π.
        half = np.sin(radians / 2.0)
        small = np.abs(half) < 1e-9
        whole = np.where(small, inner, np.sin(inner * radians / 2.0) / np.where(small, 1.0, half))
        ends = 2.0 * self._end * np.cos(self.reach * radians)
        return np.asarray((whole + ends) / (inner + 2.0 * self._end))


class Weights(QFilter):
    """Filter with any symmetric kernel, computed by fast Fourier transforms of a fixed length.

    Args:
        weights: q_0, q_±1, ...; normalised so that Q(0) = 1.
        cycle: grid points in a cycle.
    """

    def __init__(self, weights: Array, cycle: int) -> None:
        super().__init__(weights.size - 1, cycle)
        weights = weights / (weights[0] + 2.0 * weights[1:].sum())
        self._length = scipy.fft.next_fast_len(self.chunk + 2 * self.reach, real=True)
        circle = np.zeros(self._length)
        circle[: weights.size] = weights
        circle[self._length - self.reach :] = weights[:0:-1]
        self._spectrum = scipy.fft.rfft(circle).real
        self._weights = weights

    def smooth(self, points: Array, smoothed: Array) -> None:
        """Filter ``points`` by Fourier transforms of a fixed length."""
        spectrum = scipy.fft.rfft(points, self._length)
        spectrum *= self._spectrum
        smoothed[:] = scipy.fft.irfft(spectrum, self._length)[self.reach : self.reach + self.chunk]

    def response(self, radians: Array) -> Array:
        """Compute the real frequency response at ``radians`` per grid point, shape (n,)."""
        return _response(self._weights.tobytes(), radians.tobytes())


@lru_cache(maxsize=64)
def _response(weights: bytes, radians: bytes) -> Array:
    """Return the response of a symmetric kernel, cached: each speed and lead of a check asks for the same one."""
    # cos(jν) by Horner's rule for Chebyshev polynomials: memory does not grow with the kernel.
    series = np.frombuffer(weights) * np.append(1.0, np.full(len(weights) // 8 - 1, 2.0))
    found = np.asarray(np.polynomial.chebyshev.chebval(np.cos(np.frombuffer(radians)), series))
    found.setflags(write=False)
    return found


class Gaussian(Weights):
    """Gaussian filter Q = exp(-(κν)²).

    Args:
        width: κ in grid points.
        cycle: grid points in a cycle.
    """

    def __init__(self, width: float, cycle: int) -> None:
        # Capped, since a kernel longer than the cycle is rejected below and need not be computed.
        reach = min(ceil(2.0 * width * np.sqrt(-np.log(_TAIL))), cycle)
        super().__init__(np.exp(-((np.arange(reach + 1) / max(2.0 * width, _TAIL)) ** 2)), cycle)


class LowPass(Weights):
    """Zero-phase FIR low-pass, designed with a Kaiser window.

    Args:
        passed: end of the pass band [rad per grid point].
        stopped: start of the stop band [rad per grid point].
        ripple: largest deviation from 1 in the pass band and from 0 in the stop band [1].
        cycle: grid points in a cycle.

    Raises:
        InputError: the band limits are not in increasing order between 0 and the Nyquist limit π.
    """

    def __init__(self, passed: float, stopped: float, ripple: float, cycle: int) -> None:
        if not 0.0 < passed < stopped <= np.pi:
            raise InputError(
                f"FIR Q filter: pass band to {passed:.4g}, stop band from {stopped:.4g} rad per grid point; allowed: "
                f"0 < pass < stop <= {np.pi:.4g}"
            )
        taps, beta = scipy.signal.kaiserord(-20.0 * np.log10(ripple / 2.0), (stopped - passed) / np.pi)
        bands = np.concatenate((np.linspace(0.0, passed, _EDGES), np.linspace(stopped, np.pi, _EDGES)))
        wanted = np.repeat([1.0, 0.0], _EDGES)
        taps = min(taps | 1, 2 * cycle + 1)  # odd, for a middle point; a kernel that is far too long is rejected below
        while True:
            taper = scipy.signal.firwin(taps, (passed + stopped) / 2.0, window=("kaiser", beta), fs=2.0 * np.pi)
            super().__init__(np.asarray(taper[taps // 2 :]), cycle)
            if np.abs(self.response(bands) - wanted).max() <= ripple:
                break
            taps += 2  # for a wide transition, Kaiser's formula is a point or two short


_EXACT, _CLOSE = 1e-9, 1e-6  # tolerances of Q(0), and of the difference between response and smoothing
_WAVES = 7


def check(q: QFilter) -> None:
    """Check that the smoothing of a filter agrees with its frequency response.

    Raises:
        InputError: response and smoothing disagree, or Q(0) is not 1.
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
    # Sum of sinusoids of all frequencies, each with its own phase: only a linear zero-phase filter gives this result.
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
