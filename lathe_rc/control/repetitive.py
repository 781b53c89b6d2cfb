# SPDX-License-Identifier: Apache-2.0
"""The P-integrator in the angle domain: repetitive control whose memory is indexed by spindle angle.

    M(φ) = Q·M(φ - θ) + γ·δ(φ)          what is learned (paper 001, Fig. 2; γ = 1 in the papers)
    A(φ) = M(φ - θ + lead)              what the drive is told (paper 000, eq. 21 as reads of one memory)

θ is the cycle angle. The lead answers the delay of the drive: T0·Ω(t) in the angle domain (paper 000,
eq. 20) or the constant angle T0·Ω0. Q is a zero-phase smoothing filter over the angle with Q(0) = 1.
"""

from dataclasses import dataclass
from enum import IntEnum
from math import ceil

import numpy as np
import numpy.typing as npt

from lathe_rc.errors import InputError, LatheError
from lathe_rc.jit import kernel

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

_TURN = 2.0 * np.pi
_TAIL = 1e-12  # weight at which the kernel of Q is cut off
_LONGEST = 1 << 25  # grid points: half the longest cycle that there can be
LEARNING_DELAY = 3  #: samples from a measured error to its place in the memory: cubic interpolation looks ahead


class LeadLaw(IntEnum):
    """How far ahead of the spindle the memory is read."""

    CONSTANT_ANGLE = 0
    VARIABLE = 1


def exponential_q(width: float, grid_angle: float) -> Array:
    """Weights q_0, q_1, ... of the two-sided exponential Q on the angle grid, for lags 0, ±1, ...

    Its response is 1/(1 + 4κ²·sin²(ν/2)) for ν radians per grid point and κ = width/grid_angle: the form
    1/(1 + (ω·width)²) of paper 001 with the second difference for the second derivative.

    Args:
        width: angle constant of the kernel [rad]: its time constant times the nominal speed; 0 for Q = 1.
        grid_angle: angle between grid points [rad].

    Raises:
        InputError: the kernel is far longer than any cycle.
    """
    square = (width / grid_angle) ** 2
    ratio = 2.0 * square / (1.0 + 2.0 * square + np.sqrt(1.0 + 4.0 * square))
    if ratio < _TAIL:
        return np.ones(1)
    reach = ceil(np.log(_TAIL) / np.log(ratio))
    if reach > _LONGEST:
        raise InputError(f"Q filter reaches {reach} grid points to each side; make it narrower or the grid coarser")
    weights = (1.0 - ratio) / (1.0 + ratio) * ratio ** np.arange(reach + 1)
    weights[0] = 1.0 - 2.0 * weights[1:].sum()  # so that Q(0) = 1 after the cut
    return np.asarray(weights)


@kernel
def cubic(before: float, left: float, right: float, after: float, u: float) -> float:
    """Lagrange cubic through four equidistant points at ``u`` in [0, 1] between the middle two."""
    c1 = right - before / 3.0 - left / 2.0 - after / 6.0
    c2 = (before + right) / 2.0 - left
    c3 = (after - before) / 6.0 + (left - right) / 2.0
    return left + u * (c1 + u * (c2 + u * c3))


# Places in the integer state, the real state and the settings of the kernel.
_NEXT, _SEEN, _CYCLE = 0, 1, 2
_SQUARES, _LARGEST, _ANGLES, _ERRORS, _CYCLE_SQUARES, _CYCLE_LARGEST = 0, 1, 2, 6, 10, 11

_DONE, _CYCLE_ENDED, _AHEAD, _JUMPED = 0, 1, 2, 3


@kernel
def _run(
    first: int,
    start: int,
    stop: int,
    delay: int,
    grid: int,
    cycle: int,
    learning: int,
    gain: float,
    q: Array,
    variable: int,
    lead_time: float,
    nominal: float,
    memory: Array,
    whole: Integers,
    real: Array,
    angle: Array,
    speed: Array,
    past_angle: Array,
    error: Array,
    command: Array,
) -> tuple[int, int]:
    """Step from sample ``start`` of the block until ``stop`` or the end of a cycle; returns (reached, reason)."""
    mask = memory.size - 1
    per_radian = grid / _TURN
    angles, errors = real[_ANGLES : _ANGLES + 4], real[_ERRORS : _ERRORS + 4]
    for k in range(start, stop):
        ended = False
        if first + k >= delay:
            new_angle, new_error = past_angle[k], error[k]
            if whole[_SEEN] == 0:
                angles[:] = new_angle
                errors[:] = new_error
                whole[_NEXT] = int(np.ceil(new_angle * per_radian))
            else:
                angles[0], angles[1], angles[2], angles[3] = angles[1], angles[2], angles[3], new_angle
                errors[0], errors[1], errors[2], errors[3] = errors[1], errors[2], errors[3], new_error
            whole[_SEEN] += 1
            if abs(angles[3] - angles[2]) > np.pi:
                return k, _JUMPED
            if angles[2] > angles[1]:
                rate = 1.0 / (angles[2] - angles[1])
                while whole[_NEXT] / per_radian <= angles[2]:
                    g = whole[_NEXT]
                    u = (g / per_radian - angles[1]) * rate
                    delta = cubic(errors[0], errors[1], errors[2], errors[3], u)
                    y = memory[(g - cycle) & mask]
                    if learning:
                        smooth = q[0] * y
                        for j in range(1, q.size):
                            smooth += q[j] * (memory[(g - cycle - j) & mask] + memory[(g - cycle + j) & mask])
                        y = smooth + gain * delta
                    memory[g & mask] = y
                    real[_SQUARES] += delta * delta
                    real[_LARGEST] = max(real[_LARGEST], abs(delta))
                    whole[_NEXT] = g + 1
                    if (g + 1) % cycle == 0:
                        ended = True
                        real[_CYCLE_SQUARES], real[_CYCLE_LARGEST] = real[_SQUARES], real[_LARGEST]
                        real[_SQUARES] = real[_LARGEST] = 0.0
        lead = lead_time * (speed[k] if variable else nominal)
        place = (angle[k] + lead) * per_radian - cycle
        i = int(np.floor(place))
        if whole[_SEEN] > 0 and i + 2 >= whole[_NEXT]:
            return k, _AHEAD
        command[k] = cubic(
            memory[(i - 1) & mask],
            memory[i & mask],
            memory[(i + 1) & mask],
            memory[(i + 2) & mask],
            place - i,
        )
        if ended:
            return k + 1, _CYCLE_ENDED
    return stop, _DONE


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
        q: weights of the zero-phase Q, see `exponential_q`.
        gain: learning gain γ.
        lead_law: constant or variable lead angle.
        lead_time: T0 [s].
        nominal: nominal spindle speed Ω0 [rad/s].
        delay: samples until a measured error is visible.

    Raises:
        InputError: Q is wider than the memory can hold.

    Attributes:
        learning: False holds the memory as it is.
    """

    def __init__(
        self,
        *,
        grid: int,
        revolutions: int,
        q: Array,
        gain: float,
        lead_law: LeadLaw,
        lead_time: float,
        nominal: float,
        delay: int,
    ) -> None:
        self._grid, self._cycle, self._q, self._gain = grid, grid * revolutions, q, gain
        if 2 * q.size > self._cycle:
            raise InputError(
                f"Q filter reaches {q.size - 1} grid points to each side; allowed: less than half the cycle of "
                f"{self._cycle} points (make it narrower)"
            )
        self._variable, self._lead_time, self._nominal = lead_law is LeadLaw.VARIABLE, lead_time, nominal
        self._delay = delay
        # A power of two, so that a mask wraps the index; it holds a cycle and what Q needs before it.
        self._memory = np.zeros(1 << (self._cycle + q.size + 8).bit_length())
        self._whole = np.zeros(3, dtype=np.int64)
        self._real = np.zeros(12)
        self._rms_before = np.nan
        self.learning = True

    def clear(self) -> None:
        """Forget everything that was learned."""
        self._memory[:] = 0.0

    def block(
        self,
        first: int,
        *,
        angle: Array,
        speed: Array,
        past_angle: Array,
        error: Array,
        command: Array,
    ) -> list[Cycle]:
        """Step through a block; all arrays have the shape (n,).

        Args:
            first: index of the first sample.
            angle: measured spindle angle [rad].
            speed: measured spindle speed [rad/s].
            past_angle: the measured angle ``delay`` samples earlier [rad]; ignored before sample ``delay``.
            error: the measured error of that earlier sample [m]; ignored before sample ``delay``.
            command: filled with the set point of the drive [m].

        Returns:
            The cycles that ended in this block.

        Raises:
            LatheError: the spindle turned so fast that the memory would have been read where nothing is
                learned yet, or its angle jumped.
        """
        cycles = []
        reached, reason = 0, _CYCLE_ENDED
        while reason == _CYCLE_ENDED:
            reached, reason = _run(
                first, reached, angle.size, self._delay, self._grid, self._cycle, self.learning, self._gain, self._q,
                self._variable, self._lead_time, self._nominal, self._memory, self._whole, self._real,
                angle, speed, past_angle, error, command,
            )  # fmt: skip
            if reason == _CYCLE_ENDED:
                cycles.append(self._end_cycle(first + reached - 1))
        if reason == _AHEAD:
            raise LatheError(
                f"sample {first + reached}: the memory is read at {angle[reached]:.6g} rad before it is learned; "
                f"the spindle turns at {speed[reached]:.5g} rad/s: reduce its speed, the lead or the feedback delay"
            )
        if reason == _JUMPED:
            raise LatheError(f"sample {first + reached}: the spindle angle jumps to {past_angle[reached]:.6g} rad")
        return cycles

    def _end_cycle(self, sample: int) -> Cycle:
        rms = float(np.sqrt(self._real[_CYCLE_SQUARES] / self._cycle))
        contraction = rms / self._rms_before if self._rms_before > 0.0 else np.nan
        self._whole[_CYCLE] += 1
        self._rms_before = rms
        largest = float(self._real[_CYCLE_LARGEST])
        return Cycle(int(self._whole[_CYCLE]), sample, rms, largest, contraction, self.learning)


def largest_feedback_delay(*, grid: int, revolutions: int, lead: float, speed: float, late: float, step: float) -> int:
    """Longest feedback delay [sample] at which the memory is never read before it is learned.

    The newest point in the memory when sample n is commanded was measured D + 3 samples before (the cubic
    interpolation of the error looks two samples ahead); the read reaches two grid points beyond
    φ - θ + lead. So (D + 3)·Ω·step <= θ - lead - late - 3 grid angles. The Q filter needs no more: it is applied when a
    point is learned, to points a cycle older.

    Args:
        grid: memory points per revolution.
        revolutions: revolutions in a cycle.
        lead: largest lead angle [rad].
        speed: largest spindle speed [rad/s].
        late: what the measured angle may be late [rad], one count of the encoder.
        step: sampling step [s].
    """
    free = _TURN * revolutions - lead - late - 3 * _TURN / grid
    return int(np.floor(free / (speed * step))) - LEARNING_DELAY
