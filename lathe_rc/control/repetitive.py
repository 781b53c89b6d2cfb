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

from lathe_rc.control.correction import Correction, CorrectionLaw, invariant
from lathe_rc.control.interpolation import cubic, read, read_along, read_derivatives
from lathe_rc.control.lead import Preview
from lathe_rc.control.q_filter import QFilter, two_sided
from lathe_rc.errors import LatheError
from lathe_rc.jit import kernel

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

_TURN = 2.0 * np.pi
LEARNING_DELAY = 3  #: samples from a measured error to its place in the memory: cubic interpolation looks ahead

# Places in the integer state: next grid point to learn, samples seen, cycles ended, first point of the smoothed
# chunk, grid point from which errors count, whether the sample at hand is half learned, whether a cycle ended in it,
# whether the memory was replaced since the last sample.
_NEXT, _SEEN, _CYCLE, _CHUNK, _FROM, _HALF, _ENDED, _REPLACED = 0, 1, 2, 3, 4, 5, 6, 7
# Places in the real state: sum of squares and largest error of the cycle at hand and of the last one, the newest
# four angles and errors, v and v' of Wk2, its last place and input, the lead-lag term's state and last input.
_SQUARES, _LARGEST, _CYCLE_SQUARES, _CYCLE_LARGEST, _ANGLES, _ERRORS, _INVARIANT, _PLACE, _INPUT, _LAG = (
    0, 1, 2, 3, 4, 8, 12, 14, 15, 16,
)  # fmt: skip
_REALS = 18
_NO_CHUNK = -(1 << 62)

_DONE, _CYCLE_ENDED, _AHEAD, _JUMPED, _SMOOTH = 0, 1, 2, 3, 4  # why the kernel stopped


@kernel
def _soft(u: float) -> float:
    """Rises smoothly from 0 at ``u`` = 0 to 1 at ``u`` = 1."""
    return 1.0 if u >= 1.0 else u * u * (3.0 - 2.0 * u)


@kernel
def _smooth_ahead(base: int, cycle: int, reach: int, ratio: float, memory: Array, scratch: Array, chunk: Array) -> None:
    """Fill ``chunk``, the grid points ``base`` on, with what Q makes of the cycle before; see `Exponential`."""
    mask = memory.size - 1
    for k in range(chunk.size + 2 * reach):
        scratch[0, k] = memory[(base - cycle - reach + k) & mask]
    two_sided(ratio, reach, scratch[0, : chunk.size + 2 * reach], scratch[1], chunk)


@kernel
def _command(
    law: int,
    per_radian: float,
    place: float,
    rate: float,
    bend: float,
    settings: Array,
    memory: Array,
    real: Array,
) -> float:
    """Set point of the drive for the memory at ``place`` [grid point]."""
    i = int(np.floor(place))
    u = place - i
    a1, a2 = settings[0], settings[1]
    if law in (2, 3):
        value, first, second = read_derivatives(memory, i, u)
        slope, bow = first * per_radian, second * per_radian**2
        turning = bend if law == 3 else 0.0
        return value + float(a1 * rate * slope + a2 * (rate**2 * bow + turning * slope))
    value = read(memory, i, u)
    if law == 0:
        return value
    before = real[_INPUT]
    real[_INPUT] = value
    if law == 1:
        # y = v + (T1 - T2)·dv/dt with T2·dv/dt + v = u, exact for u linear between samples.
        lag = float(settings[3] * real[_LAG] + settings[4] * before + settings[5] * value)
        real[_LAG] = lag
        return lag + float(settings[6]) * (value - lag)
    distance = 0.0 if np.isnan(real[_PLACE]) else (place - real[_PLACE]) / per_radian
    real[_PLACE] = place
    return invariant(value, before, distance, rate, bend, a1, a2, settings[2], real[_INVARIANT : _INVARIANT + 2])


@kernel
def _run(
    first: int,
    start: int,
    delay: int,
    grid: int,
    cycle: int,
    learning: int,
    gain: float,
    ramp: float,
    law: int,
    looks_ahead: int,
    ratio: float,
    reach: int,
    settings: Array,
    chunk: Array,
    scratch: Array,
    memory: Array,
    whole: Integers,
    real: Array,
    angle: Array,
    lead: Array,
    rate: Array,
    bend: Array,
    past_angle: Array,
    error: Array,
    command: Array,
) -> tuple[int, int]:
    """Step from sample ``start`` of the block until something has to be done outside; returns (reached, reason)."""
    per_radian = grid / _TURN
    mask = memory.size - 1
    if whole[_REPLACED] and start < angle.size:
        # Errors that are still on their way belong to the memory that was replaced.
        whole[_REPLACED] = 0
        whole[_FROM] = int(np.ceil(angle[start] * per_radian))
    if whole[_SEEN] == 0 and first + angle.size > delay and start < angle.size:
        k = max(start, delay - first)
        real[_ANGLES : _ANGLES + 4] = past_angle[k]
        real[_ERRORS : _ERRORS + 4] = error[k]
        whole[_NEXT] = int(np.ceil(past_angle[k] * per_radian))
        whole[_FROM] = max(whole[_FROM], whole[_NEXT])
    # What changes from sample to sample is kept in registers, and put back at the end.
    a0, a1, a2, a3 = real[_ANGLES], real[_ANGLES + 1], real[_ANGLES + 2], real[_ANGLES + 3]
    e0, e1, e2, e3 = real[_ERRORS], real[_ERRORS + 1], real[_ERRORS + 2], real[_ERRORS + 3]
    squares, largest = real[_SQUARES], real[_LARGEST]
    point, seen, half, base, learn_from = whole[_NEXT], whole[_SEEN], whole[_HALF], whole[_CHUNK], whole[_FROM]
    ended = whole[_ENDED]
    reached, reason = angle.size, _DONE
    for k in range(start, angle.size):
        if first + k >= delay:
            if half == 0:
                a0, a1, a2, a3 = a1, a2, a3, past_angle[k]
                e0, e1, e2, e3 = e1, e2, e3, error[k]
                seen += 1
            half = 0
            if abs(a3 - a2) > np.pi:
                reached, reason = k, _JUMPED
                break
            if a2 > a1:
                per_angle = 1.0 / (a2 - a1)
                while True:
                    place = point / per_radian
                    if place > a2:
                        break
                    y = memory[(point - cycle) & mask]
                    u = (place - a1) * per_angle
                    delta = cubic(e0, e1, e2, e3, u)
                    if learning:
                        if not 0 <= point - base < chunk.size:
                            if ratio < 0.0:
                                half, reached, reason = 1, k, _SMOOTH
                                break
                            base = point // chunk.size * chunk.size
                            _smooth_ahead(base, cycle, reach, ratio, memory, scratch, chunk)
                        y = chunk[point - base]
                        if point >= learn_from:
                            y += delta * (gain if ramp == 0.0 else gain * _soft((point - learn_from) / ramp))
                    memory[point & mask] = y
                    squares += delta * delta
                    largest = max(largest, abs(delta))
                    point += 1
                    if point % cycle == 0:
                        ended = 1
                        real[_CYCLE_SQUARES], real[_CYCLE_LARGEST] = squares, largest
                        squares = largest = 0.0
            if reason != _DONE:
                break
        if seen > 0 and np.floor((angle[k] + lead[k]) * per_radian - cycle) + looks_ahead >= point:
            reached, reason = k, _AHEAD
            break
        if ended:
            ended, reached, reason = 0, k + 1, _CYCLE_ENDED
            break
    real[_ANGLES], real[_ANGLES + 1], real[_ANGLES + 2], real[_ANGLES + 3] = a0, a1, a2, a3
    real[_ERRORS], real[_ERRORS + 1], real[_ERRORS + 2], real[_ERRORS + 3] = e0, e1, e2, e3
    real[_SQUARES], real[_LARGEST] = squares, largest
    whole[_NEXT], whole[_SEEN], whole[_HALF], whole[_CHUNK], whole[_ENDED] = (
        point, seen, half, base, ended,
    )  # fmt: skip
    if law == 0:
        read_along(memory, per_radian, cycle, angle[start:reached], lead[start:reached], command[start:reached])
    else:
        for k in range(start, reached):
            place = (angle[k] + lead[k]) * per_radian - cycle
            command[k] = _command(law, per_radian, place, rate[k], bend[k], settings, memory, real)
    return reached, reason


@dataclass(frozen=True)
class Cycle:
    """What one cycle achieved, over the grid points of the memory."""

    number: int  #: from 1
    sample_index: int  #: sample at which its last grid point was learned
    rms: float  #: of the measured error [m]
    largest: float  #: magnitude of the measured error [m]
    contraction: float  #: rms over that of the cycle before; NaN in the first
    learning: bool


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
        # A power of two, so that a mask wraps the index; it holds a cycle and what Q needs before it.
        self._memory = np.zeros(1 << (self._cycle + q.chunk + q.reach + 8).bit_length())
        self._chunk = np.empty(q.chunk)
        self._scratch = np.empty((2, q.chunk + 2 * q.reach))
        self._whole = np.zeros(8, dtype=np.int64)
        self._real = np.zeros(_REALS)
        self._real[_PLACE] = np.nan
        self._rms_before = np.nan
        self.learning, self.joined = True, np.isinf(join_below)
        self._join_below = join_below
        self.correction = correction
        self._smooth()  # compiles what the first chunk needs
        self._whole[_CHUNK] = _NO_CHUNK

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
        self._whole[_CHUNK] = _NO_CHUNK
        self._whole[_REPLACED] = 1

    def memory(self) -> Array:
        """The newest value at each grid point of the cycle [m], from angle 0 on, shape (cycle,)."""
        newest = np.arange(self._whole[_NEXT] - self._cycle, self._whole[_NEXT])
        points = np.empty(self._cycle)
        points[newest % self._cycle] = self._memory[newest & (self._memory.size - 1)]
        return points

    def remember(self, points: Array) -> None:
        """Replace what was learned by ``points`` as `memory` gives them; the channel counts as joined."""
        places = np.arange(self._memory.size) + self._whole[_NEXT] - self._memory.size
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
            LatheError: the spindle turned so fast that the memory would have been read where nothing is
                learned yet, or its angle jumped.
        """
        rates = self._correction.law is not CorrectionLaw.NONE
        lead, rate, bend = self._preview.block(first, speed, rates=rates)
        reached, reason = 0, _SMOOTH
        while reason in (_CYCLE_ENDED, _SMOOTH):
            reached, reason = _run(
                first, reached, self._delay, self._grid, self._cycle, self.learning and self.joined, self._gain,
                self._ramp, int(self._correction.law), self._correction.looks_ahead, self._q.ratio, self._q.reach,
                self._settings, self._chunk, self._scratch, self._memory, self._whole, self._real, angle, lead, rate, bend, past_angle, error, command,
            )  # fmt: skip
            if reason == _SMOOTH:
                self._smooth()
            elif reason == _CYCLE_ENDED:
                yield self._end_cycle(first + reached - 1)
        if reason == _AHEAD:
            raise LatheError(
                f"sample {first + reached}: the memory is read at {angle[reached]:.6g} rad before it is learned; "
                f"the spindle turns at {speed[reached]:.5g} rad/s: reduce its speed, the lead or the feedback delay"
            )
        if reason == _JUMPED:
            raise LatheError(f"sample {first + reached}: the spindle angle jumps to {past_angle[reached]:.6g} rad")

    def _smooth(self) -> None:
        """Apply Q to the cycle before, for the chunk of grid points that learning has come to."""
        size, reach = self._q.chunk, self._q.reach
        base = int(self._whole[_NEXT]) // size * size
        before = np.arange(base - self._cycle - reach, base - self._cycle + size + reach)
        self._q.smooth(self._memory[before & (self._memory.size - 1)], self._chunk)
        self._whole[_CHUNK] = base

    def _end_cycle(self, sample: int) -> Cycle:
        rms = float(np.sqrt(self._real[_CYCLE_SQUARES] / self._cycle))
        largest = float(self._real[_CYCLE_LARGEST])
        contraction = rms / self._rms_before if self._rms_before > 0.0 else np.nan
        self._whole[_CYCLE] += 1
        self._rms_before = rms
        cycle = Cycle(int(self._whole[_CYCLE]), sample, rms, largest, contraction, self.learning and self.joined)
        if not self.joined and largest <= self._join_below:
            self.joined = True
            self._whole[_FROM] = self._whole[_NEXT]
        return cycle


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
