# SPDX-License-Identifier: Apache-2.0
"""The P-integrator: repetitive control whose memory is indexed by an angle.

    M(φ) = Q·M(φ - θ) + γ·δ(φ)          what is learned (paper 001, Fig. 2; γ = 1 in the papers)
    A(φ) = (1/W0)·M(φ - θ + lead)       what the drive is told (paper 000, eq. 21 as reads of one memory)

θ is the cycle angle. With the spindle's angle for φ this is Fig. 1b of paper 000; with Ω0·t for φ the cycle is
the fixed time θ/Ω0, its Fig. 1a. The lead (`lead`), the zero-phase Q (`q_filter`) and 1/W0 (`correction`) have
modules of their own.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lathe_rc.control.angle_memory import (
    AHEAD,
    BEHIND,
    CHUNK,
    CYCLE_ENDED,
    CYCLE_LARGEST,
    CYCLE_SQUARES,
    DONE,
    FROM,
    INTEGERS,
    JUMPED,
    NEXT,
    NO_CHUNK,
    PIECE,
    PLACE,
    REALS,
    REPLACED,
    ROOM,
    SMOOTH,
    step,
)
from lathe_rc.control.correction import Correction, CorrectionLaw
from lathe_rc.control.lead import Preview
from lathe_rc.control.q_filter import QFilter
from lathe_rc.errors import LatheError

Array = npt.NDArray[np.float64]

_TURN = 2.0 * np.pi
LEARNING_DELAY = 3  #: samples from a measured error to its place in the memory: cubic interpolation looks ahead


@dataclass(frozen=True)
class Cycle:
    """What one cycle achieved, over the grid points of the memory."""

    number: int  #: from 1
    sample_index: int  #: sample at which its last grid point was learned
    rms: float  #: of the measured error [m]
    largest: float  #: magnitude of the measured error [m]
    contraction: float  #: rms over that of the cycle before; NaN in the first
    learning: bool


class AngleLostError(LatheError):
    """The memory cannot be read at the angle that was measured.

    Attributes:
        reached: samples of the block that were computed before.
    """

    def __init__(self, message: str, reached: int) -> None:
        super().__init__(message)
        self.reached = reached


class RepetitiveController:
    """Self-learning controller of one channel.

    Args:
        grid: memory points per revolution.
        revolutions: revolutions in a cycle: θ = 2π·revolutions.
        q: zero-phase Q over a cycle.
        gain: learning gain γ.
        soft_start: revolutions over which the gain rises from 0 when learning begins; 0: at once.
        preview: lead law.
        correction: 1/W0.
        nominal: nominal spindle speed Ω0 [rad/s].
        delay: samples until a measured error is visible.
        join_below: largest error of a cycle [m] with which the channel begins to learn; inf: at once.
        step: sampling step [s].

    Attributes:
        learning: False holds the memory as it is.
        joined: False as long as the error before the channel is beyond ``join_below``.
        correction: may be replaced by one of the same law between two blocks or at the end of a cycle.
    """

    def __init__(
        self,
        *,
        grid: int,
        revolutions: int,
        q: QFilter,
        gain: float,
        soft_start: float,
        preview: Preview,
        correction: Correction,
        nominal: float,
        delay: int,
        join_below: float,
        step: float,
    ) -> None:
        self._grid, self._cycle, self._q, self._gain = grid, grid * revolutions, q, gain
        self._ramp = soft_start * grid
        self._preview, self._nominal, self._delay, self._step = preview, nominal, delay, step
        self._memory = np.zeros(memory_size(self._cycle, q))
        self._chunk = np.empty(q.chunk)
        self._scratch = np.empty((2, q.chunk + 2 * q.reach))
        self._windows = np.empty((2, 3))
        self._sample, self._work = np.empty(PIECE, dtype=np.int64), np.empty((7, PIECE + 1))
        self._whole = np.zeros(INTEGERS, dtype=np.int64)
        self._real = np.zeros(REALS)
        self._real[PLACE] = np.nan
        self._cycles = 0
        self._rms_before = np.nan
        self.learning, self.joined = True, np.isinf(join_below)
        self._join_below = join_below
        self.correction = correction
        self._smooth()  # compiles what the first chunk needs
        self._whole[CHUNK] = NO_CHUNK

    @property
    def correction(self) -> Correction:
        """The correction 1/W0."""
        return self._correction

    @correction.setter
    def correction(self, correction: Correction) -> None:
        self._correction = correction
        settings = np.zeros(7)
        settings[:2] = correction.inverse
        settings[2] = self._nominal
        if correction.law is CorrectionLaw.LEAD_LAG:
            decay = np.exp(-self._step / correction.lag)
            rest = (1.0 - decay) * correction.lag / self._step
            settings[3:] = decay, rest - decay, 1.0 - rest, correction.lead / correction.lag
        self._settings = settings

    def clear(self) -> None:
        """Forget everything that was learned; learning begins anew, softly if so asked."""
        self._memory[:] = 0.0
        self._replaced()

    def _replaced(self) -> None:
        self._whole[CHUNK] = NO_CHUNK
        self._whole[REPLACED] = 1

    def memory(self) -> Array:
        """The newest value at each grid point of the cycle [m], from angle 0 on, shape (cycle,)."""
        newest = np.arange(self._whole[NEXT] - self._cycle, self._whole[NEXT])
        points = np.empty(self._cycle)
        points[newest % self._cycle] = self._memory[newest & (self._memory.size - 1)]
        return points

    def remember(self, points: Array) -> None:
        """Replace what was learned by ``points`` as `memory` gives them; the channel counts as joined."""
        places = np.arange(self._memory.size) + self._whole[NEXT] - self._memory.size
        self._memory[places & (self._memory.size - 1)] = points[places % self._cycle]
        self._replaced()
        self.joined = True

    def block(
        self,
        first: int,
        *,
        angle: Array,
        speed: Array,
        past_angle: Array,
        error: Array,
        command: Array,
    ) -> Iterator[Cycle]:
        """Step through a block; all arrays have the shape (n,).

        Args:
            first: index of the first sample.
            angle: measured spindle angle [rad].
            speed: measured spindle speed [rad/s].
            past_angle: the measured angle ``delay`` samples earlier [rad]; ignored before sample ``delay``.
            error: the measured error of that earlier sample [m]; ignored before sample ``delay``.
            command: filled with the set point of the drive [m].

        Yields:
            The cycles that end in this block; the block goes on after each.

        Raises:
            AngleLostError: the spindle turned so fast that the memory would have been read where nothing is
                learned yet, or so far back that it is no longer kept, or its angle jumped.
        """
        rates = self._correction.law is not CorrectionLaw.NONE
        lead, rate, bend = self._preview.block(first, speed, rates=rates)
        if self._windows.shape[1] < angle.size + 3:
            self._windows = np.empty((2, angle.size + 3))
        reached, reason, begins = 0, SMOOTH, True
        while reason in (CYCLE_ENDED, SMOOTH) or (reason == DONE and reached < angle.size):
            reached, reason = step(
                first, reached, begins, self._delay, self._grid, self._cycle, self._correction.looks_ahead,
                self.learning and self.joined, self._gain, self._ramp, self._q.ratio, self._q.reach,
                int(self._correction.law), self._settings, angle, lead, rate, bend, past_angle, error, self._windows,
                self._sample, self._work, self._chunk, self._scratch, self._memory, self._whole, self._real, command,
            )  # fmt: skip
            begins = False
            if reason == SMOOTH:
                self._smooth()
            elif reason == CYCLE_ENDED:
                yield self._end_cycle(first + reached - 1)
        if reason == AHEAD:
            raise AngleLostError(
                f"sample {first + reached}: the memory is read at {angle[reached]:.6g} rad before it is learned; "
                f"the spindle turns at {speed[reached]:.5g} rad/s: reduce its speed, the lead or the feedback delay",
                reached,
            )
        if reason == BEHIND:
            raise AngleLostError(
                f"sample {first + reached}: at {angle[reached]:.6g} rad the memory is no longer kept; the spindle has "
                "turned back, or its angle is wrong",
                reached,
            )
        if reason == JUMPED:
            raise AngleLostError(
                f"sample {first + reached}: the spindle angle jumps to {past_angle[reached]:.6g} rad", reached
            )

    def _smooth(self) -> None:
        """Apply Q to the cycle before, for the chunk of grid points that learning has come to."""
        size, reach = self._q.chunk, self._q.reach
        base = int(self._whole[NEXT]) // size * size
        before = np.arange(base - self._cycle - reach, base - self._cycle + size + reach)
        self._q.smooth(self._memory[before & (self._memory.size - 1)], self._chunk)
        self._whole[CHUNK] = base

    def _end_cycle(self, sample: int) -> Cycle:
        rms = float(np.sqrt(self._real[CYCLE_SQUARES] / self._cycle))
        largest = float(self._real[CYCLE_LARGEST])
        contraction = rms / self._rms_before if self._rms_before > 0.0 else np.nan
        self._cycles += 1
        self._rms_before = rms
        cycle = Cycle(self._cycles, sample, rms, largest, contraction, self.learning and self.joined)
        if not self.joined and largest <= self._join_below:
            self.joined = True
            self._whole[FROM] = self._whole[NEXT]
        return cycle


def memory_size(cycle: int, q: QFilter) -> int:
    """Grid points that the memory of a ``cycle`` holds: with what Q needs before it, a power of two for the index."""
    return 1 << (cycle + q.chunk + q.reach + ROOM).bit_length()


def largest_feedback_delay(
    *, grid: int, revolutions: int, lead: float, speed: float, late: float, looks_ahead: int, step: float
) -> int:
    """Longest feedback delay [sample] at which the memory is never read before it is learned.

    The newest point in the memory when sample n is commanded was measured D + 3 samples before (the cubic
    interpolation of the error looks two samples ahead); the read reaches some grid points beyond
    φ - θ + lead. So (D + 3)·Ω·step <= θ - lead - late - (looks_ahead + 1) grid angles. The Q filter needs no more: it
    is applied when a point is learned, to points a cycle older.

    Args:
        grid: memory points per revolution.
        revolutions: revolutions in a cycle.
        lead: largest lead angle [rad].
        speed: largest spindle speed [rad/s].
        late: what the measured angle may be late [rad], one count of the encoder.
        looks_ahead: grid points after its place that a read looks at.
        step: sampling step [s].
    """
    free = _TURN * revolutions - lead - late - (looks_ahead + 1) * _TURN / grid
    return int(np.floor(free / (speed * step))) - LEARNING_DELAY
