# SPDX-License-Identifier: Apache-2.0
"""A disturbance that repeats with the angle, learned from revolution to revolution (repetitive control).

For each grid point of the angle the memory holds a value and how that changes with the speed, F̂ = v + s·(Ω/Ω0 - 1), a
Kalman filter for each point: what follows the cut with a lag lies at another angle when the spindle turns faster. What
is learned passes a zero-phase filter S over the angle; what S does not pass leaks away, a tenth in a revolution.

Source: spec/robust.md; learning over the position for non-circular cutting: Nakano, 1996.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.control.interpolation import read
from lathe_rc.errors import InputError
from lathe_rc.jit import inlined, kernel

Array = npt.NDArray[np.float64]

_TURN = 2.0 * np.pi
_TAIL = 5.0  # standard deviations at which S is cut off
_HALF = float(np.sqrt(-2.0 * np.log(1.0 - np.sqrt(0.5))))  # where the twiced Gaussian is 1/2, for a deviation of 1
_UNKNOWN = 1e4  # variance of a value before anything was learned, over that of a measurement
_SLOPE = 1e2  # the same of its change with the relative speed
_SLOPE_DRIFT = 1e-2  # part of that by which it may have changed in a revolution
LEAK = 0.1  #: part of what S does not pass that a revolution takes out of the memory
_SETTLED = 8  # revolutions that are learned before the change with the speed is


class MemoryTable(NamedTuple):
    """The model of the disturbance over the angle.

    Attributes:
        nominal: speed Ω0 [rad/s].
        learns, drift: whether the memory is used, and by how much a value drifts in a revolution, as variance.
        follows_speed: whether how a value changes with the speed is learned.
        value, slope: by grid point, shape (n,) [m].
        spread: their covariance, shape (3, n).
        fresh, speeds: what the newest revolution says beyond the memory [m], and at which relative speed, shape (n,).
        smoothing: S by grid point, shape (odd,).
    """

    nominal: float
    learns: bool
    drift: float
    follows_speed: bool
    value: Array
    slope: Array
    spread: Array
    fresh: Array
    speeds: Array
    smoothing: Array


def smoothing(waves: float, points: int) -> Array:
    """S over the angle: a Gaussian, twiced, so that 1 - S is the square of 1 minus the Gaussian; shape (odd,).

    Args:
        waves: per revolution at which S is 1/2.
        points: of the grid per revolution.

    Raises:
        InputError: it is wider than a revolution.
    """
    deviation = _HALF * points / (_TURN * waves)
    reach = int(np.ceil(_TAIL * deviation))
    widest = (points - 1) // 4
    if reach > widest:
        raise InputError(
            f"{waves:g} waves per revolution: the filter is wider than a revolution; allowed: "
            f"{np.ceil(_TAIL * deviation * waves / widest):.0f} waves or more"
        )
    gauss = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation) ** 2)
    gauss /= gauss.sum()
    twiced = -np.convolve(gauss, gauss)
    twiced[reach : 3 * reach + 1] += 2.0 * gauss
    return np.asarray(twiced)


def empty_memory(nominal: float, gain: float, waves: float, points: int, *, follows_speed: bool) -> MemoryTable:
    """Memory without any knowledge; arguments as of `lathe_rc.control.disturbance.disturbance`."""
    spread = np.zeros((3, points))
    spread[0] = _UNKNOWN
    return MemoryTable(
        nominal=nominal,
        learns=gain > 0.0,
        drift=gain**2 / (1.0 - gain),
        follows_speed=follows_speed,
        value=np.zeros(points),
        slope=np.zeros(points),
        spread=spread,
        fresh=np.zeros(points),
        speeds=np.zeros(points),
        smoothing=smoothing(waves, points),
    )


def forget_all(m: MemoryTable) -> None:
    """Forget all that was learned."""
    for array in (m.value, m.slope, m.fresh, m.spread):
        array[:] = 0.0
    m.spread[0] = _UNKNOWN


@kernel
def expected(m: MemoryTable, angle: float, speed: float) -> float:
    """The memory's prediction at an angle [rad] and a speed [rad/s], in metres of the command."""
    if not m.learns:
        return 0.0
    place = angle * (m.value.size / _TURN)
    i = int(np.floor(place))
    value = read(m.value, i, place - i)
    if m.follows_speed:
        value += (speed / m.nominal - 1.0) * read(m.slope, i, place - i)
    return value


@inlined
def revolution_ended(m: MemoryTable, revolutions: int) -> None:
    """End a revolution, after so many in all."""
    # Before, the values themselves change from revolution to revolution, which would be taken for the speed's work.
    if revolutions == _SETTLED and m.follows_speed:
        m.spread[2] = _SLOPE


@inlined
def learn(m: MemoryTable, centre: int) -> None:
    """Update the Kalman filter of a grid point; the variance of a measurement is 1."""
    points, reach = m.value.size, m.smoothing.size // 2
    found = smooth = 0.0
    for k in range(m.smoothing.size):
        i = (centre - reach + k) & (points - 1)
        found += m.smoothing[k] * m.fresh[i]
        smooth += m.smoothing[k] * m.value[i]
    j = centre & (points - 1)
    faster = m.speeds[j]
    p0, p1, p2 = m.spread[0, j] + m.drift, m.spread[1, j], m.spread[2, j]
    if p2 > 0.0:  # 0: it is not learned, or not yet
        p2 = min(p2 + _SLOPE_DRIFT * _SLOPE, _SLOPE)
    g0, g1 = p0 + p1 * faster, p1 + p2 * faster
    total = g0 + g1 * faster + 1.0
    m.value[j] += g0 / total * found + LEAK * (smooth - m.value[j])
    m.slope[j] += g1 / total * found
    m.spread[0, j], m.spread[1, j], m.spread[2, j] = p0 - g0 * g0 / total, p1 - g0 * g1 / total, p2 - g1 * g1 / total
