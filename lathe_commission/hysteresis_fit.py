# SPDX-License-Identifier: Apache-2.0
"""Identification of a Prandtl-Ishlinskii hysteresis from a measured loop.

The output of a play depends only on its threshold and the input, so for given thresholds the displacement is linear in
the weights,

    y = y0 + p0·u + Σ p_i·F_i(u),    p0, p_i >= 0,

and the weights follow from bounded least squares. The initial states of the plays are unknown; the fit begins where
the input has passed through its full range for the first time, after which the state of every play is determined.

The loop must be quasi-static, because the lag during fast motion would be mistaken for hysteresis.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from lathe_machine.plants.hysteresis import THRESHOLDS, PrandtlIshlinskii, check_thresholds, plays
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError, at_most
from lathe_rc.signals.measurement_file import MeasuredQuantities

_WHOLE = 0.95  # fraction of the range that counts as the full range
_LEAST = 1e-9  # a slope below this cannot be inverted


@dataclass(frozen=True)
class HysteresisLoop:
    """Measured hysteresis loop.

    Args:
        command: displacement commanded by the voltage [m], shape (n,).
        displacement: measured displacement [m], shape (n,).

    Raises:
        InputError: the arrays are empty, of different length, or not finite.
    """

    command: Array
    displacement: Array

    def __post_init__(self) -> None:
        command, displacement = self.command, self.displacement
        if command.size != displacement.size or not command.size:
            raise InputError(
                f"hysteresis loop: {command.size} commands and {displacement.size} displacements; give as many of "
                "each, at least one"
            )
        if not (np.all(np.isfinite(command)) and np.all(np.isfinite(displacement))):
            raise InputError("hysteresis loop: not all numbers are finite; remove those that are not")


@dataclass(frozen=True)
class HysteresisFit:
    """Result of a hysteresis fit, relative to the half-stroke.

    Attributes:
        model: hysteresis model.
        offset: offset of the displacement [m].
        residual: RMS of the residual, relative to that of the displacement about its mean.
    """

    model: PrandtlIshlinskii
    offset: float
    residual: float


def identify(loop: HysteresisLoop, stroke: float, thresholds: Array = THRESHOLDS) -> HysteresisFit:
    """Fit the weights of a Prandtl-Ishlinskii model to a measured loop.

    Args:
        loop: measurement of one and a half loops or more.
        stroke: half-stroke of the drive [m].
        thresholds: thresholds of the plays, relative to the half-stroke, increasing, shape (n,).

    Raises:
        InputError: the thresholds are not increasing, or the loop does not return, does not move a play, has too few
            points or no slope.
    """
    check_thresholds(thresholds)
    command = loop.command / stroke
    low, high = command.min(), command.max()
    whole = _WHOLE * (high - low)
    start = int(np.argmax(np.maximum.accumulate(command) - np.minimum.accumulate(command) >= whole))
    command, displacement = command[start:], loop.displacement[start:] / stroke
    if np.ptp(command) < whole or high == low:
        raise InputError(
            f"hysteresis loop: the command does not go through its range of {(high - low) * stroke * 1e6:.4g} µm and "
            "back again; record one and a half loops or more"
        )
    # A play reverses after the input has reversed by twice its threshold.
    idle = thresholds[2.0 * thresholds >= whole]
    if idle.size:
        raise InputError(
            f"hysteresis loop: a range of {(high - low) * stroke * 1e6:.4g} µm does not take a play of "
            f"{idle[0] * stroke * 1e6:.4g} µm to each side along; allowed: a wider loop, a smaller stroke, or "
            f"thresholds below {at_most(whole / 2.0, 4)} of the stroke"
        )
    side = 1.0 if command[0] > (low + high) / 2.0 else -1.0
    known = plays(thresholds, command[0] - side * thresholds, command)
    columns = np.column_stack((np.ones_like(command), command, known))
    unknown = columns.shape[1]
    if np.linalg.matrix_rank(columns) < unknown:
        raise InputError(
            f"hysteresis loop: its {command.size} points do not determine {unknown} unknowns; record more points or "
            "give fewer thresholds"
        )
    bounds = np.append(-np.inf, np.zeros(thresholds.size + 1))
    fit = scipy.optimize.lsq_linear(columns, displacement, (bounds, np.inf), method="bvls")
    offset, proportional, weights = fit.x[0], fit.x[1], fit.x[2:]
    if proportional < _LEAST:
        raise InputError(
            f"hysteresis loop: proportional part {proportional:.3g}; allowed: above 0 (does the displacement rise "
            "with the command?)"
        )
    left = displacement - columns @ fit.x
    residual = float(np.sqrt(np.mean(left**2)) / np.std(displacement))
    return HysteresisFit(PrandtlIshlinskii(thresholds, weights, float(proportional)), float(offset) * stroke, residual)


def of_measurement(measurement: MeasuredQuantities) -> HysteresisLoop:
    """Return the loop in a measurement: ``command`` and ``displacement``, in order of time.

    Raises:
        InputError: a quantity is missing, or contains a non-finite value.
    """
    return HysteresisLoop(*measurement.read("command", "displacement"))


def from_signals(
    dense: Mapping[str, Mapping[str, Array]], command: str = "/fine/command", state: str = "/fine/state"
) -> HysteresisLoop:
    """Extract a hysteresis loop from the signals of a recorded run.

    Args:
        dense: signals of a `lathe_rc.cell.recording.Recording`, as returned by `lathe_rc.bag.reader.read_bag`.
        command: topic of the drive's command; the linearisation of the drive must be off.
        state: topic of the drive's state.

    Raises:
        InputError: a topic is missing.
    """
    for topic in (command, state):
        if topic not in dense:
            raise InputError(f"{topic} is not in the recording; there are {', '.join(sorted(dense)) or 'no topics'}")
    return HysteresisLoop(dense[command]["position"], dense[state]["measured_position"])
