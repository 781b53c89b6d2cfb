# SPDX-License-Identifier: Apache-2.0
"""What is watched: signals against thresholds, sample by sample, whatever the blocks."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lathe_rc.cell.messages import Signals
from lathe_rc.jit import kernel
from lathe_rc.safety.state_machine import Reaction

Array = npt.NDArray[np.float64]

_TURN = 2.0 * np.pi


@dataclass(frozen=True)
class Alarm:
    """A monitor that found something.

    Attributes:
        place: sample in the block.
        value: what it found, in the unit of the limit.
    """

    place: int
    value: float


class Monitor(ABC):
    """Watches something; raises one alarm, and no other before it is reset.

    Args:
        name: of the monitor.
        subject: what it watches.
        limit: threshold.
        reaction: what it asks for.
    """

    def __init__(self, name: str, subject: str, limit: float, reaction: Reaction) -> None:
        self.name, self.subject, self.limit, self.reaction = name, subject, limit, reaction
        self.raised = False

    def look(self, inputs: Sequence[Signals]) -> Alarm | None:
        """Look at the next samples; the first alarm among them."""
        found = self.watch(inputs)
        if found is None or self.raised:
            return None
        self.raised = True
        return found

    @abstractmethod
    def watch(self, inputs: Sequence[Signals]) -> Alarm | None:
        """See `look`; what is not asked for any more may come again."""

    def reset(self) -> None:
        """Watch as from the first sample."""
        self.raised = False


@kernel
def _beyond(signal: Array, other: Array, offset: float, limit: float) -> int:
    """How many samples of |signal - other - offset| are beyond the limit, or not a number."""
    count = 0
    if other.size == 0:
        for k in range(signal.size):
            count += not abs(signal[k] - offset) <= limit
    else:
        for k in range(signal.size):
            count += not abs(signal[k] - other[k] - offset) <= limit
    return count


@kernel
def _lasting(signal: Array, other: Array, offset: float, limit: float, needed: int, run: int) -> tuple[int, int]:
    """First sample at which ``needed`` in a row were beyond the limit, or -1, and how many were up to the last."""
    found = -1
    for k in range(signal.size):
        value = signal[k] - (other[k] if other.size else 0.0) - offset
        run = 0 if abs(value) <= limit else run + 1
        if run >= needed and found < 0:
            found = k
    return found, run


_NOTHING = np.empty(0)


class Patience:
    """Some revolutions, from the first sample or a reset on, in which nothing is wrong yet.

    Args:
        revolutions: of the encoder, the first input.
    """

    def __init__(self, revolutions: float) -> None:
        self._turn = revolutions * _TURN
        self._until: float | None = None

    def left(self, inputs: Sequence[Signals]) -> int:
        """How many samples of the block are still forgiven."""
        if not self._turn:
            return 0
        angle = inputs[0]["angle"]
        if self._until is None:
            if not angle.size:
                return 0
            self._until = float(angle[0]) + self._turn
        if self._until == -np.inf:
            return 0
        over = angle >= self._until
        begin = int(np.argmax(over)) if over.any() else angle.size
        if begin < angle.size:
            self._until = -np.inf  # an angle that turns back changes nothing
        return begin

    def renew(self) -> None:
        """Forgive anew from the next sample on."""
        self._until = None


class Threshold(Monitor):
    """|signal - other - offset| beyond the limit for some samples in a row.

    Args:
        name, subject, limit, reaction: see `Monitor`.
        signal: place of the input and field.
        other: the same of what is subtracted; None: nothing.
        offset: subtracted as well.
        samples: how many; 1: at once.
        after: revolutions of the encoder, the first input, until it watches.
    """

    def __init__(
        self,
        name: str,
        subject: str,
        limit: float,
        reaction: Reaction,
        *,
        signal: tuple[int, str],
        other: tuple[int, str] | None = None,
        offset: float = 0.0,
        samples: int = 1,
        after: float = 0.0,
    ) -> None:
        super().__init__(name, subject, limit, reaction)
        self._signal, self._other, self._offset, self._samples = signal, other, offset, samples
        self._patience, self._run = Patience(after), 0

    def watch(self, inputs: Sequence[Signals]) -> Alarm | None:
        """See `Monitor`."""
        signal = inputs[self._signal[0]][self._signal[1]]
        other = _NOTHING if self._other is None else inputs[self._other[0]][self._other[1]]
        begin = self._patience.left(inputs)
        signal, other = signal[begin:], other[begin:]
        if not _beyond(signal, other, self._offset, self.limit):
            self._run = 0
            return None
        place, self._run = _lasting(signal, other, self._offset, self.limit, self._samples, self._run)
        if place < 0:
            return None
        value = signal[place] - (other[place] if other.size else 0.0) - self._offset
        return Alarm(begin + place, abs(float(value)))

    def reset(self) -> None:
        """See `Monitor`."""
        super().reset()
        self._patience.renew()
        self._run = 0


class Rate(Monitor):
    """How fast a signal changes, over a window of samples.

    Args:
        name, subject, limit, reaction: see `Monitor`; the limit is a rate.
        signal: place of the input and field.
        window: over so many samples.
        step: sampling step [s].
        before: the signal before the first sample.
    """

    def __init__(
        self,
        name: str,
        subject: str,
        limit: float,
        reaction: Reaction,
        *,
        signal: tuple[int, str],
        window: int,
        step: float,
        before: float,
    ) -> None:
        super().__init__(name, subject, limit, reaction)
        self._signal, self._span = signal, window * step
        self._past = np.full(window, before)

    def watch(self, inputs: Sequence[Signals]) -> Alarm | None:
        """See `Monitor`."""
        signal = inputs[self._signal[0]][self._signal[1]]
        whole = np.concatenate((self._past, signal))
        past, self._past = whole[: signal.size], whole[signal.size :]
        limit = self.limit * self._span
        if not _beyond(signal, past, 0.0, limit):
            return None
        place, _ = _lasting(signal, past, 0.0, limit, 1, 0)
        return Alarm(place, abs(float(signal[place] - past[place])) / self._span)


@kernel
def _index(angle: Array, pulse: npt.NDArray[np.uint8], limit: float, state: Array) -> int:
    """First sample that does not fit the pulses, or -1; the state: angle of the last pulse, what was found."""
    found = -1
    for k in range(angle.size):
        since = angle[k] - state[0]
        # Nothing is known before the first pulse: a comparison with NaN is false.
        wrong = since > _TURN + limit or since < -limit or (pulse[k] > 0 and since < _TURN - limit)
        if wrong and found < 0:
            found = k
            state[1] = abs(since - _TURN)
        if pulse[k] > 0 or since > _TURN + limit:
            state[0] = angle[k]
    return found


class IndexPulses(Monitor):
    """One revolution of the measured angle from index pulse to index pulse, and never backwards."""

    def __init__(self, limit: float, reaction: Reaction, *, encoder: int) -> None:
        super().__init__("index_pulses", "encoder", limit, reaction)
        self._encoder, self._state = encoder, np.array([np.nan, np.nan])

    def watch(self, inputs: Sequence[Signals]) -> Alarm | None:
        """See `Monitor`."""
        encoder = inputs[self._encoder]
        place = _index(encoder["angle"], encoder["index_pulse"], self.limit, self._state)
        return Alarm(place, float(self._state[1])) if place >= 0 else None

    def reset(self) -> None:
        """See `Monitor`."""
        super().reset()
        self._state[:] = np.nan


@kernel
def _growing(angle: Array, error: Array, floor: float, limit: float, needed: int, state: Array) -> int:
    """First sample at which the RMS error has grown ``needed`` revolutions in a row, or -1.

    The state: revolution, sum of squares, samples, RMS of the one before, how many have grown, by how much.
    """
    found = -1
    for k in range(angle.size):
        turn = np.floor(angle[k] / _TURN)
        if turn != state[0]:
            rms = np.sqrt(state[1] / state[2]) if state[2] > 0.0 else np.nan
            grown = rms > limit * state[3] and rms > floor
            state[4] = state[4] + 1.0 if grown else 0.0
            if grown and state[4] >= needed and found < 0:
                found = k
                state[5] = rms / state[3]
            state[0], state[1], state[2], state[3] = turn, 0.0, 0.0, rms
        state[1] += error[k] * error[k]
        state[2] += 1.0
    return found


class Growth(Monitor):
    """The RMS error grows from revolution to revolution.

    Args:
        limit: factor from one to the next.
        reaction: what it asks for.
        encoder, tool: places of the inputs.
        cycles: so many times in a row.
        floor: RMS error below which it does not count [m].
    """

    def __init__(self, limit: float, reaction: Reaction, *, encoder: int, tool: int, cycles: int, floor: float) -> None:
        super().__init__("error_growth", "tool", limit, reaction)
        self._places, self._cycles, self._floor = (encoder, tool), cycles, floor
        self._state = np.array([0.0, 0.0, 0.0, np.nan, 0.0, np.nan])

    def watch(self, inputs: Sequence[Signals]) -> Alarm | None:
        """See `Monitor`."""
        angle, error = inputs[self._places[0]]["angle"], inputs[self._places[1]]["measured_error"]
        place = _growing(angle, error, self._floor, self.limit, self._cycles, self._state)
        return Alarm(place, float(self._state[5])) if place >= 0 else None

    def reset(self) -> None:
        """See `Monitor`."""
        super().reset()
        self._state[:] = 0.0, 0.0, 0.0, np.nan, 0.0, np.nan


@kernel
def _clear(position: Array, beyond: float, needed: int, run: int) -> tuple[int, int]:
    for k in range(position.size):
        run = run + 1 if position[k] >= beyond else 0
        if run >= needed:
            return k, run
    return -1, run


class Below(Threshold):
    """A signal below the limit for some samples in a row; nothing is subtracted from it."""

    def watch(self, inputs: Sequence[Signals]) -> Alarm | None:
        """See `Monitor`."""
        begin = self._patience.left(inputs)
        signal = inputs[self._signal[0]][self._signal[1]][begin:]
        place, self._run = _clear(-signal, -self.limit, self._samples, self._run)
        return Alarm(begin + place, float(signal[place])) if place >= 0 else None


class Clearance:
    """Whether the tool is out of the part.

    Args:
        beyond: measured position of the drive beyond which it is [m].
        samples: for so many in a row.
    """

    def __init__(self, beyond: float, samples: int) -> None:
        self._beyond, self._samples, self._run = beyond, samples, 0

    def begin(self) -> None:
        """Look from the next sample on."""
        self._run = 0

    def first(self, position: Array) -> int | None:
        """First sample at which it is."""
        place, self._run = _clear(position, self._beyond, self._samples, self._run)
        return place if place >= 0 else None
