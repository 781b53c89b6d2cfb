# SPDX-License-Identifier: Apache-2.0
"""Slow drift of a drive: its gain and the frequencies of its modes change linearly with time, up to an end.

    s(t) = min(t, T),   g(t) = g·(1 + γ·s(t)),   ωj(t) = ωj·(1 + μ·s(t))

t counts from sample 0. A body that a constant loss heats warms by a first-order lag, so a thermal drift (ISO 230-3) is
linear at first. The gain multiplies the command where it enters the drive: at the edge it is older by the delay τ, γ·τ
of itself. A mode keeps its damping ratio and participations, so its static deflection by command and force stays, and
its state is continuous. The matrices of a sample change at every `EVERY`-th one, linearly between those of drives whose
modes are at most `_APART` apart. Half-way between two drives that adds (ωj·h·`_APART`)²/(8·ζj·ωj·h) to the damping,
relative to it (step h): 0.01 % for a mode of 1600 Hz with ζ = 0.02 at 64 kHz.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.jit import inlined, kernel

EVERY = 64  #: samples from one change of the matrices to the next, counted from sample 0
_FARTHEST = 0.5  # largest relative motion of the modes
_APART = 0.01  # largest relative distance of the frequencies of a mode between two of the drives


class DriftTable(NamedTuple):
    """Drift of a drive for kernels.

    Attributes:
        gain: γ [1/s].
        end: T [s].
        step: sampling step [s].
        drives: matrices of the drives along the drift side by side, shape (k, m, columns); k = 0: they stay.
    """

    gain: float
    end: float
    step: float
    drives: Array


class DriftState(NamedTuple):
    """State of a drifting drive at a time [s]: factors of its gain and of the frequencies of its modes."""

    time: float
    gain: float
    modes: float


@dataclass(frozen=True)
class Drift:
    """Drift of the gain and of the frequencies of the modes.

    Attributes:
        gain, modes: γ, μ, relative changes per time [1/s].
        end: T [s].

    Raises:
        InputError: the gain would vanish or change its sign, modes would move too far, or there is no end.
    """

    gain: float = 0.0
    modes: float = 0.0
    end: float = 0.0

    def __post_init__(self) -> None:
        if (self.gain or self.modes) and not self.end:
            raise InputError("a drift without an end; allowed: a drift_time above 0")
        if self.gain * self.end <= -1.0:
            raise InputError(f"a gain that drifts to {1.0 + self.gain * self.end:g} of its start; allowed: above 0")
        if abs(self.modes) * self.end > _FARTHEST:
            raise InputError(
                f"modes that move by {abs(self.modes) * self.end:.0%}; allowed: by {_FARTHEST:.0%} or less"
            )

    def states(self) -> list[DriftState]:
        """Return states along the drift at equal distances, the start first; it alone without a drift."""
        parts = max(math.ceil(abs(self.modes) * self.end / _APART), 1) if self.gain or self.modes else 0
        times = [self.end * k / max(parts, 1) for k in range(parts + 1)]
        return [DriftState(time, 1.0 + self.gain * time, 1.0 + self.modes * time) for time in times]

    def table(self, drives: list[Array], step: float) -> DriftTable:
        """Return the table for kernels.

        Args:
            drives: matrices of the drive in each of `states`, side by side, shape (m, columns); their gain is that of
                the start.
            step: sampling step [s].
        """
        moves = np.array(drives) if self.modes else np.empty((0, 0, 0))
        return DriftTable(self.gain, self.end, step, moves)


NONE = Drift()


@inlined
def gained(drift: DriftTable, n: int, command: float) -> float:
    """Return the command of sample ``n`` times g(t)/g."""
    if drift.gain == 0.0:
        return command
    return command * (1.0 + drift.gain * min(n * drift.step, drift.end))


@inlined
def due(drift: DriftTable, first: int, k: int) -> bool:
    """Return whether the matrices change at sample ``first`` + ``k``, where ``first`` begins a block."""
    return drift.drives.shape[0] > 0 and (k == 0 or (first + k) % EVERY == 0)


@kernel
def move(drift: DriftTable, n: int, column: int, matrix: Array) -> None:
    """Fill a matrix of sample ``n``, shape (m, l), from the columns that begin at ``column``.

    It is that in the middle of the `EVERY` samples that ``n`` is among, so a block may begin anywhere.
    """
    last = drift.drives.shape[0] - 1
    place = min((n - n % EVERY + EVERY // 2) * drift.step / drift.end, 1.0) * last
    left = min(int(place), last - 1)
    part = place - left
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            before, behind = drift.drives[left, i, column + j], drift.drives[left + 1, i, column + j]
            matrix[i, j] = (1.0 - part) * before + part * behind
