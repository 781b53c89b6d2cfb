# SPDX-License-Identifier: Apache-2.0
"""P-integrator: repetitive control whose memory is indexed by an angle.

    M(φ) = Q·M(φ - θ) + γ·δ(φ)          learned memory (paper 001, Fig. 2; γ = 1 in the papers)
    A(φ) = (1/W0)·M(φ - θ + lead)       set point of the drive (paper 000, eq. 21, as reads of a single memory)

With several weights wi, whose sum is 1, M(φ - iθ) weighted by wi replaces M(φ - θ) in both equations, so that random
parts of the error, which differ from cycle to cycle, act by √Σwi². Where Q - γZ is within the unit circle,
learning converges with any weights.

θ is the cycle angle. With the spindle angle as φ, this is Fig. 1b of paper 000; with Ω0·t as φ, the cycle is the
fixed time θ/Ω0, as in Fig. 1a. The lead (`lead`), the zero-phase Q (`q_filter`) and 1/W0 (`correction`) have
modules of their own.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from lathe_machine.control import angle_memory
from lathe_machine.control.angle_memory import AngleMemory
from lathe_machine.control.correction import Correction, CorrectionLaw
from lathe_machine.control.lead import Preview, look_ahead
from lathe_machine.control.q_filter import QFilter
from lathe_rc.arrays import Array
from lathe_rc.errors import LatheError

_TURN = 2.0 * np.pi
_LONGEST = 8192  # largest number of samples in a block
_ROOM = {"windows": (2, _LONGEST + 3), "ahead": (3, _LONGEST)}  # shapes of the table's scratch arrays for a block
LEARNING_DELAY = 3  #: samples until a measured error is in the memory, since cubic interpolation looks ahead


class Cycle(NamedTuple):
    """Result of one cycle of the memory, evaluated at its grid points."""

    number: int  #: number of the cycle, from 1
    sample_index: int  #: sample at which the last grid point of the cycle was learned
    rms: float  #: RMS of the measured error [m]
    largest: float  #: largest magnitude of the measured error [m]
    contraction: float  #: ratio of ``rms`` to that of the previous cycle; NaN in the first cycle
    learning: bool
    joined: bool = True  #: whether the channel learns from this cycle on


class AngleLostError(LatheError):
    """Error raised when the memory cannot be read at the measured angle.

    Attributes:
        reached: number of samples of the block computed before the error.
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
        soft_start: revolutions over which the gain rises from 0 when learning begins; 0 for an immediate start.
        preview: lead law.
        correction: 1/W0.
        nominal: nominal spindle speed Ω0 [rad/s].
        delay: number of samples until a measured error is available.
        join_below: largest error of a cycle [m] at which the channel begins to learn; inf for an immediate start.
        step: sampling step [s].
        weights: weights of the newest cycles, the newest first; only their ratios matter.

    Attributes:
        table: memory and law for `lathe_machine.control.angle_memory.advance`.
        preview: lead law.
        correction: 1/W0; may be replaced by a correction of the same law between two blocks or at the end of a cycle.
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
        weights: Sequence[float] = (1.0,),
    ) -> None:
        self._cycle, self._q, self._nominal, self._step = grid * revolutions, q, nominal, step
        self.preview = preview
        lead = preview.table.lead_time
        # The taps may read points of the cycle before, at up to twice the nominal speed.
        before = 2.0 * nominal * max(correction.span - lead, 0.0) * grid / _TURN if correction.span else 0.0
        back = angle_memory.BACK + math.ceil(before)
        self._spare = back + angle_memory.AROUND
        room: dict[str, Any] = {name: np.zeros(shape) for name, shape in _ROOM.items()}
        whole, real = np.zeros(angle_memory.INTEGERS, dtype=np.int64), np.zeros(angle_memory.REALS)
        whole[angle_memory.LEARNS], whole[angle_memory.JOINED] = 1, np.isinf(join_below)
        real[angle_memory.PLACE] = np.nan
        self.table = AngleMemory(
            delay=delay,
            grid=grid,
            cycle=self._cycle,
            gain=gain,
            ramp=soft_start * grid,
            join_below=join_below,
            law=int(correction.law),
            looks_ahead=correction.looks_ahead,
            back=back,
            oldest=1.0 - correction.span / lead if correction.span else 1.0,
            settings=np.zeros(7),
            taps=np.array(correction.taps),
            memory=self._room_for(q),
            weights=np.array(weights) / sum(weights),
            history=np.zeros(self._cycle * len(weights) if len(weights) > 1 else 1),
            **self._smoother(q),
            **room,
            sample=np.zeros(angle_memory.PIECE, dtype=np.int64),
            work=np.zeros((7, angle_memory.PIECE + 1)),
            whole=whole,
            real=real,
            log=np.zeros((angle_memory.LOG, 5)),
        )
        self._cycles = 0
        self._rms_before = np.nan
        self.correction = correction
        if q.ratio < 0.0:
            self.smooth()  # compiles the filter for the first chunk
        whole[angle_memory.CHUNK] = angle_memory.NO_CHUNK

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes that are state between two blocks, without scratch arrays."""
        nothing: dict[str, Any] = dict.fromkeys(_ROOM)
        table = self.table._replace(**nothing)
        return {**self.__dict__, "table": table}

    @property
    def learning(self) -> bool:
        """Whether the memory is updated; if not, it stays unchanged."""
        return bool(self.table.whole[angle_memory.LEARNS])

    @learning.setter
    def learning(self, on: bool) -> None:
        self.table.whole[angle_memory.LEARNS] = on

    @property
    def joined(self) -> bool:
        """Whether the channel has joined: the error of a cycle was at most ``join_below``, and learning may begin."""
        return bool(self.table.whole[angle_memory.JOINED])

    @property
    def correction(self) -> Correction:
        """Correction 1/W0 between the memory and the drive."""
        return self._correction

    @correction.setter
    def correction(self, correction: Correction) -> None:
        self._correction = correction
        settings = self.table.settings
        settings[:2] = correction.inverse
        settings[2] = self._nominal
        if correction.law is CorrectionLaw.FIR:
            settings[0] = correction.interval / self.preview.table.lead_time
        if correction.law is CorrectionLaw.LEAD_LAG:
            decay = np.exp(-self._step / correction.lag)
            rest = (1.0 - decay) * correction.lag / self._step
            settings[3:] = decay, rest - decay, 1.0 - rest, correction.lead / correction.lag

    def retune(self, q: QFilter, gain: float, preview: Preview) -> None:
        """Continue from the next sample on with another Q, gain and lead; the memory is kept.

        Args:
            q: zero-phase Q over a cycle, of the same grid.
            gain: learning gain γ.
            preview: lead law whose lead time and constant angle replace the current ones.
        """
        lead = preview.table
        self.preview.table = self.preview.table._replace(lead_time=lead.lead_time, constant=lead.constant)
        self._q = q
        table, end = self.table, int(self.table.whole[angle_memory.NEXT])
        memory = self._room_for(q)
        if memory.size > table.memory.size:
            # A wider Q reads points that are no longer kept: those one cycle later are the nearest to them.
            places = np.arange(end - memory.size, end)
            missing = np.maximum(end - table.memory.size - places, 0)
            kept = places + -(-missing // self._cycle) * self._cycle
            memory[places & (memory.size - 1)] = table.memory[kept & (table.memory.size - 1)]
        else:
            memory = table.memory
        self.table = table._replace(gain=gain, memory=memory, **self._smoother(q))
        table.whole[angle_memory.CHUNK] = angle_memory.NO_CHUNK

    def _room_for(self, q: QFilter) -> Array:
        """Return an empty memory, shape (n,), which includes the points of the previous cycle that Q needs.

        Its length is a power of two, for indices by a mask.
        """
        return np.zeros(1 << (self._cycle + q.chunk + q.reach + self._spare).bit_length())

    @staticmethod
    def _smoother(q: QFilter) -> dict[str, Any]:
        """Return the members of the table that belong to Q."""
        return {
            "ratio": q.ratio,
            "reach": q.reach,
            "chunk": np.zeros(q.chunk),
            "scratch": np.zeros((2, q.chunk + 2 * q.reach)),
        }

    def clear(self) -> None:
        """Clear the memory and restart learning, with ``join_below`` and the soft start if configured."""
        self.table.memory[:] = 0.0
        angle_memory.leave(self.table)
        self._replaced()

    def _replaced(self) -> None:
        """Invalidate smoothed points and delayed errors after a replacement of the memory."""
        self.table.whole[angle_memory.CHUNK] = angle_memory.NO_CHUNK
        self.table.whole[angle_memory.REPLACED] = 1

    def memory(self) -> Array:
        """Return the newest value at each grid point of the cycle [m], starting at angle 0, shape (cycle,)."""
        memory, end = self.table.memory, self.table.whole[angle_memory.NEXT]
        newest = np.arange(end - self._cycle, end)
        points = np.empty(self._cycle)
        points[newest % self._cycle] = memory[newest & (memory.size - 1)]
        return points

    def remember(self, points: Array) -> None:
        """Replace the learned memory by ``points``, in the order of `memory`; the channel counts as joined."""
        memory = self.table.memory
        places = np.arange(memory.size) + self.table.whole[angle_memory.NEXT] - memory.size
        memory[places & (memory.size - 1)] = points[places % self._cycle]
        self._replaced()
        self.table.whole[angle_memory.JOINED] = 1

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
        """Advance learning and command by a block of samples; all arrays have shape (n,).

        Args:
            first: index of the first sample.
            angle: measured spindle angle [rad].
            speed: measured spindle speed [rad/s].
            past_angle: the measured angle ``delay`` samples earlier [rad]; ignored before sample ``delay``.
            error: the measured error of that earlier sample [m]; ignored before sample ``delay``.
            command: output, the set point of the drive [m].

        Yields:
            The cycles that end in this block; computation of the block continues after each.

        Raises:
            AngleLostError: the spindle turned so fast that the memory would have been read at points not yet learned,
                or turned back to points already overwritten, or its angle jumped.
        """
        wanted = self._correction.law not in (CorrectionLaw.NONE, CorrectionLaw.FIR)
        n = angle.size
        if n > self.table.ahead.shape[1]:
            self.table = self.table._replace(windows=np.empty((2, n + 3)), ahead=np.empty((3, n)))
        table = self.table
        look_ahead(self.preview.table, first, wanted, speed, *table.ahead[:, :n])
        angle_memory.begin(table, first, angle, past_angle, error)
        table.whole[angle_memory.ASKS] = 1
        reached, reason = 0, angle_memory.SMOOTH
        while reason in (angle_memory.CYCLE_ENDED, angle_memory.SMOOTH):
            reached, reason = angle_memory.advance(table, first, reached, angle, command)
            if reason == angle_memory.SMOOTH:
                self.smooth()
            elif reason == angle_memory.CYCLE_ENDED:
                yield from self.ended()
        if reason != angle_memory.DONE:
            raise self.lost(reason, first, reached, angle, speed, past_angle)

    @staticmethod
    def lost(reason: int, first: int, reached: int, angle: Array, speed: Array, past_angle: Array) -> AngleLostError:
        """Create the error that explains why the memory cannot be read at sample ``reached`` of a block."""
        if reason == angle_memory.AHEAD:
            why = (
                f"the memory is read at {angle[reached]:.6g} rad before it is learned; the spindle turns at "
                f"{speed[reached]:.5g} rad/s: reduce its speed, the lead or the feedback delay"
            )
        elif reason == angle_memory.BEHIND:
            why = (
                f"at {angle[reached]:.6g} rad the memory is no longer kept; the spindle has turned back, or its angle "
                "is wrong"
            )
        else:
            why = f"the spindle angle jumps to {past_angle[reached]:.6g} rad"
        return AngleLostError(f"sample {first + reached}: {why}", reached)

    def smooth(self) -> None:
        """Apply Q to the previous cycle, for the chunk of grid points to be learned next."""
        table, size, reach = self.table, self._q.chunk, self._q.reach
        base = int(table.whole[angle_memory.NEXT]) // size * size
        before = np.arange(base - self._cycle - reach, base - self._cycle + size + reach)
        self._q.smooth(table.memory[before & (table.memory.size - 1)], table.chunk)
        table.whole[angle_memory.CHUNK] = base

    def ended(self) -> list[Cycle]:
        """Return the cycles completed since the last call."""
        if not self.table.whole[angle_memory.LOGGED]:
            return []
        logged = self.table.log[: self.table.whole[angle_memory.LOGGED]].tolist()
        self.table.whole[angle_memory.LOGGED] = 0
        return [self._cycle_of(*row) for row in logged]

    def _cycle_of(self, sample: float, squares: float, largest: float, learning: float, joined: float) -> Cycle:
        rms = math.sqrt(squares / self._cycle)
        contraction = rms / self._rms_before if self._rms_before > 0.0 else np.nan
        self._cycles += 1
        self._rms_before = rms
        return Cycle(self._cycles, int(sample), rms, largest, contraction, bool(learning), bool(joined))


def largest_feedback_delay(
    *, grid: int, revolutions: int, lead: float, speed: float, late: float, looks_ahead: int, step: float
) -> int:
    """Compute the longest feedback delay [sample] at which every memory point is learned before it is read.

    The newest point in the memory when sample n is commanded was measured D + 3 samples earlier (the cubic
    interpolation of the error looks two samples ahead); the read reaches some grid points beyond
    φ - θ + lead. Therefore (D + 3)·Ω·step <= θ - lead - late - (looks_ahead + 1) grid angles. The Q filter adds no
    delay: when a point is learned, Q is applied to points one cycle older.

    Args:
        grid: memory points per revolution.
        revolutions: revolutions in a cycle.
        lead: largest lead angle [rad].
        speed: largest spindle speed [rad/s].
        late: largest lag of the measured angle [rad], one count of the encoder.
        looks_ahead: number of grid points after its position that a read uses.
        step: sampling step [s].
    """
    free = _TURN * revolutions - lead - late - (looks_ahead + 1) * _TURN / grid
    return int(np.floor(free / (speed * step))) - LEARNING_DELAY
