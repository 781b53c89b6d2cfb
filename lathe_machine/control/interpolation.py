# SPDX-License-Identifier: Apache-2.0
"""Interpolation in a grid or a table: values and derivatives."""

from functools import lru_cache

import numpy as np

from lathe_rc.arrays import Array, Complex
from lathe_rc.jit import inlined, kernel


@inlined
def linear(places: Array, values: Array, place: float) -> float:
    """Interpolate linearly between increasing ``places``, with constant values beyond the ends; both of shape (n,)."""
    last = places.size - 1
    if not place > places[0]:  # NaN must return here; below, it would index beyond the table
        return float(values[0])
    if place >= places[last]:
        return float(values[last])
    i = np.searchsorted(places, place, side="right") - 1
    return float(values[i] + (values[i + 1] - values[i]) * (place - places[i]) / (places[i + 1] - places[i]))


@kernel
def cubic(before: float, left: float, right: float, after: float, u: float) -> float:
    """Evaluate the Lagrange cubic through four equidistant points at ``u`` in [0, 1] between the middle two."""
    c1 = right - before / 3.0 - left / 2.0 - after / 6.0
    c2 = (before + right) / 2.0 - left
    c3 = (after - before) / 6.0 + (left - right) / 2.0
    return left + u * (c1 + u * (c2 + u * c3))


@kernel
def read(ring: Array, i: int, u: float) -> float:
    """Interpolate a ring of 2**k points at ``i`` + ``u`` by a cubic through the points i-1 to i+2."""
    mask = ring.size - 1
    return cubic(ring[(i - 1) & mask], ring[i & mask], ring[(i + 1) & mask], ring[(i + 2) & mask], u)


@kernel
def read_along(ring: Array, per_radian: float, back: int, angle: Array, lead: Array, tile: Array, value: Array) -> None:
    """Fill ``value`` by interpolating a ring ``back`` points before ``angle`` + ``lead`` [rad], shape (n,).

    ``tile``, shape (5 or more, m), is scratch: points are fetched m at a time, so that the interpolation vectorises.
    """
    mask = np.uint64(ring.size - 1)  # unsigned, to avoid the check for negative indices
    one, two = np.uint64(1), np.uint64(2)
    for start in range(0, value.size, tile.shape[1]):
        size = min(tile.shape[1], value.size - start)
        for j in range(size):
            place = (angle[start + j] + lead[start + j]) * per_radian - back
            left = np.floor(place)
            i = np.uint64(np.int64(left))
            tile[0, j], tile[1, j] = ring[(i - one) & mask], ring[i & mask]
            tile[2, j], tile[3, j] = ring[(i + one) & mask], ring[(i + two) & mask]
            tile[4, j] = place - left
        for j in range(size):
            value[start + j] = cubic(tile[0, j], tile[1, j], tile[2, j], tile[3, j], tile[4, j])


@kernel
def read_derivatives(ring: Array, i: int, u: float) -> tuple[float, float, float]:
    """Interpolate value and first two derivatives [1/point, 1/point²] of a ring at ``i`` + ``u`` (points i-3 to i+4).

    The derivatives are fourth-order central differences at the grid points, interpolated like the value.
    """
    mask = ring.size - 1
    a, b, c, d = ring[(i - 3) & mask], ring[(i - 2) & mask], ring[(i - 1) & mask], ring[i & mask]
    e, f, g, h = ring[(i + 1) & mask], ring[(i + 2) & mask], ring[(i + 3) & mask], ring[(i + 4) & mask]
    first = cubic((a - e) + 8.0 * (d - b), (b - f) + 8.0 * (e - c), (c - g) + 8.0 * (f - d), (d - h) + 8.0 * (g - e), u)
    second = cubic(
        16.0 * (b + d) - (a + e) - 30.0 * c,
        16.0 * (c + e) - (b + f) - 30.0 * d,
        16.0 * (d + f) - (c + g) - 30.0 * e,
        16.0 * (e + g) - (d + h) - 30.0 * f,
        u,
    )
    return cubic(c, d, e, f, u), first / 12.0, second / 12.0


# Gauss points between two grid points, their weights, and the weights and distances of the four grid points there.
_U = (np.polynomial.legendre.leggauss(8)[0] + 1.0) / 2.0
_WEIGHT = np.polynomial.legendre.leggauss(8)[1] / 2.0
_TAPS = np.stack(
    (
        -_U * (1 - _U) * (2 - _U) / 6,
        (1 - _U * _U) * (2 - _U) / 2,
        _U * (1 + _U) * (2 - _U) / 2,
        -_U * (1 - _U * _U) / 6,
    )
)
_DISTANCE = np.arange(-1, 3)[:, None] - _U


def cubic_response(radians: Array) -> Array:
    """Compute the frequency response of `read` at ``radians`` per point, averaged over the positions between points.

    The interpolator also generates images at multiples of the sampling rate minus this frequency, which the drive
    attenuates; they are neglected here. The result has shape (n,).
    """
    return _cubic_response(np.asarray(radians, np.float64).tobytes())


@lru_cache(maxsize=256)
def _cubic_response(content: bytes) -> Array:
    """Compute `cubic_response` from the bytes of ``radians``, cached because similar loops share frequencies."""
    radians = np.frombuffer(content)
    phase = np.cos(_DISTANCE[None] * radians[:, None, None])
    return np.asarray((phase * _TAPS * _WEIGHT).sum(axis=(1, 2)))


def derivative_responses(radians: Array) -> tuple[Array, Complex, Array]:
    """Compute the frequency responses of all results of `read_derivatives` at ``radians`` per point, shape (n,)."""
    value = cubic_response(radians)
    first = 1j * (8.0 * np.sin(radians) - np.sin(2.0 * radians)) / 6.0
    second = (16.0 * np.cos(radians) - np.cos(2.0 * radians) - 15.0) / 6.0
    return value, np.asarray(first * value, dtype=np.complex128), second * value
