# SPDX-License-Identifier: Apache-2.0
"""Linear models of a feed drive, as transfer functions from the command to the motor's position.

fourth_order   K/(p⁴ + a4·p³ + a3·p² + a2·p + a1)                (paper 002, eq. 1)
dc_screw       k·(1 + Tz·p)/(p·(1 + T_1·p)·(1 + T_2·p)·…)        (paper 004: W2; the screw of W1)
sampled        K/(p·(1 + T1·p)) behind a zero-order hold         (paper 003, eq. 2)
"""

from functools import lru_cache

import numpy as np

from lathe_machine.transfer import TransferFunction
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError

APPROXIMATE_LAGS = (0.17, 0.22)  #: lags of W1, 11.79/((0.17p+1)(0.22p+1)) [s] (paper 004)
FULL_LAGS = (0.11304, 0.2679, 0.01659, 0.01659)  #: lags of the W1 that fits the step data in paper 004 [s]


def fourth_order(
    gain: float = 19.0, a1: float = 21.5, a2: float = 48.0, a3: float = 46.9, a4: float = 10.2
) -> TransferFunction:
    """Return the drive model K/(p⁴ + a4·p³ + a3·p² + a2·p + a1); by default the nominal drive of paper 002.

    In the state matrix of eq. 3, these coefficients have the opposite sign to the printed ones.
    """
    return TransferFunction((gain,), (1.0, a4, a3, a2, a1))


@lru_cache(maxsize=64)
def dc_screw(velocity_gain: float, lags: tuple[float, ...], zero: float = 0.0) -> TransferFunction:
    """Return the model of a motor with a screw, k·(1 + Tz·p)/(p·(1 + T_1·p)·…), cached: models repeat in a sweep.

    The zero cancels a lag that another part of the model includes: together with the lag of the cutting process, a
    drive with the lags of W1 has the response W1 from the command to the force.

    Args:
        velocity_gain: k [m/s per unit of the command].
        lags: T_i [s], at least one, or at least two with a zero.
        zero: Tz [s]; 0 for no zero.

    Raises:
        InputError: a lag is not positive.
    """
    if not all(lag > 0.0 for lag in lags):
        raise InputError(f"lags of the feed drive = {list(lags)} s; allowed: above 0 (leave out what is not there)")
    bottom = np.array([1.0, 0.0])
    for lag in lags:
        bottom = np.polymul(bottom, [lag, 1.0])
    return TransferFunction((velocity_gain * zero, velocity_gain), tuple(bottom))


def sampled(gain: float = 6.25, lag: float = 0.08) -> TransferFunction:
    """Return the model K/(p·(1 + T1·p)), by default the drive of paper 003; the `FeedDrive`'s ``divisor`` is its hold.

    Args:
        gain: K [1/s], for a command in the unit of the position.
        lag: T1 [s].
    """
    return dc_screw(gain, (lag,))


def realise(model: TransferFunction) -> tuple[Array, Array]:
    """Return the matrices a and b of a model, with position and speed as the first states.

    The other states are the higher derivatives, each without the immediate effect of the command (observability form);
    a zero may cancel a lag.
    """
    top, bottom = (np.trim_zeros(np.array(part), "f") for part in (model.numerator, model.denominator))
    order = bottom.size - 1
    if bottom.size - top.size < 2:
        raise InputError(
            f"feed drive {model} of degrees {top.size - 1} over {order}; allowed: a numerator lower by two or more, "
            "since a speed cannot jump (add a lag, or leave out the zero)"
        )
    a = np.diag(np.ones(order - 1), 1)
    a[-1] = -bottom[:0:-1] / bottom[0]
    # Markov parameters: the quotient as a series in 1/p, by long division.
    padded = np.concatenate((np.zeros(bottom.size - top.size), top, np.zeros(order)))
    markov, _ = np.polydiv(padded / bottom[0], bottom / bottom[0])
    return a, markov[1:]


def settles(model: TransferFunction) -> tuple[float, bool]:
    """Return the steady position or speed for a command of 1, or 0 if there is neither, and whether it is a speed."""
    integrates = model.denominator[-1] == 0.0
    divisor = model.denominator[-2 if integrates else -1]
    return (abs(model.numerator[-1] / divisor) if divisor else 0.0), integrates
