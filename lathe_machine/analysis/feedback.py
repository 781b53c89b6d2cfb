# SPDX-License-Identifier: Apache-2.0
"""Margin of a law that feeds the position back without a cycle, from the loop's characteristic function.

The loop with the open-loop response L = F/D has the characteristic function D + F, where F is proportional to the
response of the drive, and D and F are bounded and have no unstable poles. It is stable if the phase of D + F makes no
net turn from 0 to the Nyquist frequency (Nyquist's criterion, which needs no assumption on the poles of L). An error Δ
of the drive at one frequency moves the loop to the stability limit if D + (1 + Δ)·F = 0 there, so the smallest one is

    min |D + F|/|F| = min 1/|T|,    T = L/(1 + L)

(Skogestad, Postlethwaite, Multivariable Feedback Control, ch. 7.5: robust stability with multiplicative uncertainty).
"""

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from lathe_rc.analysis.cycle_factors import DriveMargin
from lathe_rc.analysis.resonance_grid import NO_POLES, Grid, with_images
from lathe_rc.arrays import Array, Complex

Characteristic = Callable[[Array], tuple[Complex, Complex]]  #: D and F at frequencies [rad/s]

_LOW, _COARSE = 1e-4, 4001  # lowest frequency over the speed, and points from there on
_ORDERS, _NEAR, _CLOSEST = 64, 24, 1e-5  # waves per revolution around each of which the grid is finer, on either side
_TURN, _ROUNDS = 0.5, 12  # [rad] largest turn of D + F between two frequencies, and rounds of halving to get there


def smallest_errors(own: Complex, fed: Complex) -> Array:
    """Return the smallest relative errors of the drive that bring D + F to 0, shape (n,); inf where F is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(fed == 0.0, np.inf, np.abs(own + fed) / np.abs(fed)))


def feedback_margin(
    characteristic: Characteristic, speed: float, step: float, points: Array, poles: Complex = NO_POLES
) -> DriveMargin:
    """Compute the smallest relative error of the drive with which a feedback loop is unstable; 0 if it is already.

    Args:
        characteristic: D and F at frequencies [rad/s], shape (n,) each.
        speed: speed of the spindle [rad/s].
        step: sampling step [s].
        points: further frequencies to be evaluated, up to the Nyquist frequency [rad/s], shape (k,).
        poles: those of the drive [rad/s].
    """
    frequency = np.union1d(_grid(speed, step), points)
    frequency = Grid.uneven(frequency).resolving(with_images(poles, step, np.pi / step)).points
    own, fed = characteristic(frequency)
    for _ in range(_ROUNDS):
        whole = own + fed
        turns = np.angle(whole[1:] / whole[:-1])
        coarse = np.flatnonzero(np.abs(turns) > _TURN)
        if not coarse.size:
            break
        halves = 0.5 * (frequency[coarse] + frequency[coarse + 1])
        frequency = np.insert(frequency, coarse + 1, halves)
        own, fed = (np.insert(a, coarse + 1, b) for a, b in zip((own, fed), characteristic(halves), strict=True))
    found = smallest_errors(own, fed)
    if not abs(turns.sum()) < 0.5 * np.pi:
        return DriveMargin(0.0, float(frequency[np.argmin(found)] / speed), speed)
    near = Grid.uneven(frequency).near_peaks(-found)
    fine = smallest_errors(*characteristic(near))
    k = int(np.argmin(fine))
    return DriveMargin(float(fine[k]), float(near[k] / speed), speed)


@lru_cache(maxsize=16)
def _grid(speed: float, step: float) -> Array:
    """Return frequencies [rad/s], finer around whole waves per revolution, where laws over the angle resonate."""
    offsets = np.geomspace(_CLOSEST, 0.5, _NEAR)
    waves = np.arange(_ORDERS + 1)[:, None] + np.concatenate((-offsets, offsets))
    even = np.geomspace(_LOW * speed, np.pi / step, _COARSE)
    around = speed * waves[(waves > _LOW) & (waves * speed < even[-1])]
    grid = np.union1d(even, around)
    grid.setflags(write=False)
    return grid
