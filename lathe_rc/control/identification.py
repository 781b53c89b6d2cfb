# SPDX-License-Identifier: Apache-2.0
"""Identification of a drive while it runs, from its command u and its measured position x.

    u(t - τ) = x + a1·dx/dt + a2·d²x/dt²        a1 = 2ζ/ωn, a2 = 1/ωn², τ known

Both sides pass the same low-pass (λ/(p + λ))³, whose states give the filtered derivatives: nothing is
differentiated. Least squares over the cycles that have ended, older ones with a forgetting factor. One harmonic is
enough for both coefficients; the speed of the spindle may vary.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.jit import kernel

Array = npt.NDArray[np.float64]

_LOOK_BACK = 2  # samples of the command that a delay with a fraction needs
_LEAST_EXCITED = 1e-6  # determinant of the normal equations, 1 for independent regressors


class IdentifierTable(NamedTuple):
    """A `DriveIdentifier` for kernels.

    Attributes:
        delay, part: of the command against the position that is seen: whole samples, and the rest in samples.
        bandwidth: λ [rad/s].
        step: sampling step [s].
        commands: of the past; sample n stands at n modulo their number, a power of two [m].
        state: of the filters.
        sums: of the normal equations.
    """

    delay: int
    part: float
    bandwidth: float
    step: float
    commands: Array
    state: Array
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
    delay, part, bandwidth, step = identifier.delay, identifier.part, identifier.bandwidth, identifier.step
    commands, state, sums = identifier.commands, identifier.state, identifier.sums
    mask = commands.size - 1
    half = 0.5 * bandwidth * step  # bilinear rule
    keep, take = (1.0 - half) / (1.0 + half), half / (1.0 + half)
    u, x = state[:4], state[4:]
    for k in range(start, stop):
        n = first + k - delay
        if n < _LOOK_BACK:
            continue
        new_u = (1.0 - part) * commands[n & mask] + part * commands[(n - 1) & mask]
        new_x = position[k]
        for stage in range(4):
            old_u, old_x = u[stage], x[stage]
            u[stage], x[stage] = new_u, new_x
            if stage < 3:
                new_u = keep * u[stage + 1] + take * (new_u + old_u)
                new_x = keep * x[stage + 1] + take * (new_x + old_x)
        first_derivative = bandwidth * (x[2] - x[3])
        second_derivative = bandwidth**2 * (x[1] - 2.0 * x[2] + x[3])
        rest = u[3] - x[3]
        sums[0] += first_derivative * first_derivative
        sums[1] += first_derivative * second_derivative
        sums[2] += second_derivative * second_derivative
        sums[3] += first_derivative * rest
        sums[4] += second_derivative * rest
        sums[5] += rest * rest
        sums[6] += u[3] * u[3]


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
            bandwidth=bandwidth,
            step=step,
            commands=np.zeros(1 << (delay + block + _LOOK_BACK).bit_length()),
            state=np.zeros(8),
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
        # Relative to independent regressors: the units of the two differ by orders of magnitude.
        determinant = s11 * s22 - s12 * s12
        if determinant > _LEAST_EXCITED * s11 * s22 > 0.0:
            a1 = (s1 * s22 - s2 * s12) / determinant
            a2 = (s2 * s11 - s1 * s12) / determinant
            if a1 > 0.0 and a2 > 0.0 and command > 0.0:
                unexplained = max(rest - a1 * s1 - a2 * s2, 0.0)
                frequency = float(1.0 / np.sqrt(a2))
                found = Identified(frequency, float(a1 * frequency / 2.0), float(np.sqrt(unexplained / command)))
        self.table.sums[:] *= self._forgetting
        return found
