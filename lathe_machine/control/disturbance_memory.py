# SPDX-License-Identifier: Apache-2.0
"""Memory of a disturbance that repeats with the angle, learned from revolution to revolution (repetitive control).

For each grid point of the angle, a Kalman filter estimates a value and its slope with respect to the speed,
F̂ = v + s·(Ω/Ω0 - 1), since an effect that lags the cut shifts to another angle at a higher speed. The learned values
pass a zero-phase filter S over the angle; the components that S removes decay by 10 % per revolution.

Source: spec/robust.md; learning over the position for non-circular cutting: Nakano, 1996.
"""

from typing import Any, NamedTuple

import numpy as np

from lathe_machine.control.interpolation import read
from lathe_rc.arrays import Array, Complex
from lathe_rc.errors import InputError
from lathe_rc.jit import inlined, kernel

_TURN = 2.0 * np.pi
_TAIL = 5.0  # distance at which S is truncated [standard deviations]
_HALF = float(np.sqrt(-2.0 * np.log(1.0 - np.sqrt(0.5))))  # where the twiced Gaussian is 1/2, for a deviation of 1
_UNKNOWN = 1e4  # initial variance of a value, relative to that of a measurement
_SLOPE = 1e2  # initial variance of its slope with respect to the relative speed
_SLOPE_DRIFT = 1e-2  # increase of the slope's variance per revolution, relative to its initial value
LEAK = 0.1  #: decay per revolution of the components that S does not pass
_SETTLED = 8  # number of revolutions learned before the slope is learned


class MemoryTable(NamedTuple):
    """Model of the disturbance over the angle, for kernels.

    Attributes:
        nominal: nominal speed Ω0 [rad/s].
        learns, drift: whether the memory is used, and the increase of a value's variance per revolution.
        follows_speed: whether the slope with respect to the speed is learned.
        value, slope: value and slope by grid point, shape (n,) [m].
        spread: covariance of value and slope, shape (3, n).
        fresh, speeds: deviation from the memory measured in the latest revolution [m], and the relative speed there,
            shape (n,).
        smoothing: weights of S by grid point, shape (odd,).
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
    """Compute the weights of S over the angle: a twiced Gaussian, 1 - S = (1 - Gaussian)², shape (odd,).

    Args:
        waves: waves per revolution at which S is 1/2.
        points: grid points per revolution.

    Raises:
        InputError: the filter is wider than a revolution.
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


def smoothing_response(waves: float, points: int, at: Array) -> Array:
    """Compute the response of S, arguments as for `smoothing`, ``at`` waves per revolution, shape (n,)."""
    taps = smoothing(waves, points)
    places = np.arange(taps.size) - taps.size // 2
    return np.asarray(np.cos(2 * np.pi / points * np.outer(at, places)) @ taps)


def loop_response(
    smooth: Array,
    waves: Array,
    speed: float,
    *,
    points_per_revolution: int,
    learning_gain: float,
    learning_bandwidth: float,
    observer_bandwidth: float,
    late: float,
) -> tuple[Array, Complex, Complex]:
    """Return the parts of the factor of a revolution, kept - learned·(1 + E)/(1 + E·L), with E the error of the model.

    Args:
        smooth: response of the filter S, shape (n,).
        waves: waves per revolution, shape (n,).
        speed: speed of the spindle [rad/s].
        points_per_revolution: points of the memory.
        learning_gain: part of what a revolution brings that the memory takes up.
        learning_bandwidth: bandwidth of what is learned [rad/s].
        observer_bandwidth: bandwidth of the observer [rad/s]; 0: none.
        late: delay of the drive and of the measured position [s].

    Returns:
        What a revolution keeps of the memory, what it learns with an exact model, and the response L of the observer
        with its delay, 0 without an observer; shape (n,) each.
    """
    p = 1j * waves * speed
    stages = 1.0 + p / learning_bandwidth
    learned = learning_gain * smooth * np.exp(3.0 * p / learning_bandwidth) / stages**3
    learned *= np.exp(1j * np.pi * waves / points_per_revolution)  # from cell centres, read at their edges
    low = np.zeros_like(p)
    if observer_bandwidth:
        low += np.exp(-p * late) / (1.0 + p / observer_bandwidth) ** 3
    return 1.0 - LEAK * (1.0 - smooth), learned, low


def empty_memory(nominal: float, gain: float, waves: float, points: int, *, follows_speed: bool) -> MemoryTable:
    """Create an empty memory; arguments as for `lathe_machine.control.disturbance.disturbance`."""
    spread = np.zeros((3, points))
    spread[0] = _UNKNOWN
    return MemoryTable(
        nominal=nominal,
        **_of_gain(gain),
        follows_speed=follows_speed,
        value=np.zeros(points),
        slope=np.zeros(points),
        spread=spread,
        fresh=np.zeros(points),
        speeds=np.zeros(points),
        smoothing=smoothing(waves, points),
    )


def _of_gain(gain: float) -> dict[str, Any]:
    """Return the members of a memory that a stationary gain of its Kalman filters determines."""
    return {"learns": gain > 0.0, "drift": gain**2 / (1.0 - gain)}


def with_gain(m: MemoryTable, gain: float) -> MemoryTable:
    """Return a memory with another stationary gain, below 1, that shares what has been learned."""
    return m._replace(**_of_gain(gain))


def forget_all(m: MemoryTable) -> None:
    """Reset a disturbance memory to its empty state."""
    for array in (m.value, m.slope, m.fresh, m.spread):
        array[:] = 0.0
    m.spread[0] = _UNKNOWN


@kernel
def expected(m: MemoryTable, angle: float, speed: float) -> float:
    """Predict the disturbance at an angle [rad] and a speed [rad/s], in metres of the command."""
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
    """End a revolution; after the eighth, begin to learn the slope with respect to the speed."""
    # In earlier revolutions the values themselves still change, which would be attributed to the speed.
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
    if p2 > 0.0:  # 0: the slope is not learned, or not yet
        p2 = min(p2 + _SLOPE_DRIFT * _SLOPE, _SLOPE)
    g0, g1 = p0 + p1 * faster, p1 + p2 * faster
    total = g0 + g1 * faster + 1.0
    m.value[j] += g0 / total * found + LEAK * (smooth - m.value[j])
    m.slope[j] += g1 / total * found
    m.spread[0, j], m.spread[1, j], m.spread[2, j] = p0 - g0 * g0 / total, p1 - g0 * g1 / total, p2 - g1 * g1 / total
