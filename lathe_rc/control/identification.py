# SPDX-License-Identifier: Apache-2.0
"""Identification of a drive while it runs, from its command u and its measured position x.

Least squares (`lathe_rc.control.drive_regression`, with λ for ω) over the cycles that have ended, older ones with a
forgetting factor. One harmonic is enough for both coefficients; the speed of the spindle may vary.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.control.drive_regression import (
    STAGES,
    LowPass,
    add_products,
    coefficients,
    derivatives,
    excited,
    low_pass,
    pass_through,
)
from lathe_rc.jit import kernel

Array = npt.NDArray[np.float64]

_LOOK_BACK = 2  # samples of the command that a delay with a fraction needs


class IdentifierTable(NamedTuple):
    """A `DriveIdentifier` for kernels.

    Attributes:
        delay, part: of the command against the position that is seen: whole samples, and the rest in samples.
        commands: of the past; sample n stands at n modulo their number, a power of two [m].
        low: low-pass of both sides.
        sums: of the normal equations.
    """

    delay: int
    part: float
    commands: Array
    low: LowPass
    sums: Array


@kernel
def command_sent(identifier: IdentifierTable, first: int, start: int, stop: int, command: Array) -> None:
    """Remember the set points ``start`` to ``stop`` of a block that begins at sample ``first`` [m]."""
    mask = identifier.commands.size - 1
    for k in range(start, stop):
        identifier.commands[(first + k) & mask] = command[k]


@kernel
def accumulate(identifier: IdentifierTable, first: int, start: int, stop: int, position: Array) -> None:
    """Filter and sum the measured positions ``start`` to ``stop`` of a block that begins at sample ``first`` [m]."""
    delay, part, low = identifier.delay, identifier.part, identifier.low
    commands, sums = identifier.commands, identifier.sums
    mask = commands.size - 1
    for k in range(start, stop):
        n = first + k - delay
        if n < _LOOK_BACK:
            continue
        pass_through(
            low.command, (1.0 - part) * commands[n & mask] + part * commands[(n - 1) & mask], low.keep, low.take
        )
        pass_through(low.position, position[k], low.keep, low.take)
        first_derivative, second_derivative = derivatives(low.position, low.bandwidth)
        u = low.command[STAGES]
        rest = u - low.position[STAGES]
        add_products(sums, 0, first_derivative, second_derivative, rest)
        sums[5] += rest * rest
        sums[6] += u * u


@dataclass(frozen=True)
class Identified:
    """A drive model from measurements.

    Attributes:
        natural_frequency: ωn [rad/s].
        damping: ζ.
        residual: RMS of what the model does not explain over the RMS of the command.
    """

    natural_frequency: float
    damping: float
    residual: float


class DriveIdentifier:
    """Fits ωn and ζ of a second-order drive behind a known delay.

    Args:
        model_delay: τ [s].
        feedback_delay: samples until a measured position is visible.
        bandwidth: λ of the filters [rad/s]: above the profile's harmonics, below the noise.
        forgetting: weight of a cycle when the next one ends, 0 up to 1.
        step: sampling step [s].
        block: longest block [sample].

    Attributes:
        table: for `accumulate` and `command_sent`.
    """

    def __init__(
        self,
        *,
        model_delay: float,
        feedback_delay: int,
        bandwidth: float,
        forgetting: float,
        step: float,
        block: int,
    ) -> None:
        whole = int(np.floor(model_delay / step + 1e-9))
        delay = feedback_delay + whole
        self._forgetting = forgetting
        self.table = IdentifierTable(
            delay=delay,
            part=max(model_delay / step - whole, 0.0),
            commands=np.zeros(1 << (delay + block + _LOOK_BACK).bit_length()),
            low=low_pass(bandwidth, step),
            sums=np.zeros(7),
        )

    def block(self, first: int, start: int, stop: int, position: Array) -> None:
        """Take the measured positions ``start`` to ``stop`` of a block that begins at sample ``first`` [m]."""
        accumulate(self.table, first, start, stop, position)

    def commanded(self, first: int, command: Array) -> None:
        """Remember the set points of a block [m], once all of it is known."""
        command_sent(self.table, first, 0, command.size, command)

    def fit(self) -> Identified | None:
        """The estimate from the measurements so far, None while there are too few; older ones weigh less each time."""
        s11, s12, s22, s1, s2, rest, command = self.table.sums
        found = None
        if excited(s11, s12, s22):
            a1, a2 = coefficients(s11, s12, s22, s1, s2)
            if a1 > 0.0 and a2 > 0.0 and command > 0.0:
                unexplained = max(rest - a1 * s1 - a2 * s2, 0.0)
                frequency = float(1.0 / np.sqrt(a2))
                found = Identified(frequency, float(a1 * frequency / 2.0), float(np.sqrt(unexplained / command)))
        self.table.sums[:] *= self._forgetting
        return found
