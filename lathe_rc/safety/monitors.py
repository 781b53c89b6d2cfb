# SPDX-License-Identifier: Apache-2.0
"""What is watched: signals against thresholds, sample by sample, whatever the blocks.

A kernel first asks whether there is anything in a stretch of samples, which the compiler makes vectors of, and goes
through the samples one by one only where there is.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lathe_rc.cell.messages import Signals
from lathe_rc.jit import inlined, kernel
from lathe_rc.safety.state_machine import Reaction

Array = npt.NDArray[np.float64]
Places = npt.NDArray[np.int64]

_TURN = 2.0 * np.pi
_STRETCH = 128  # samples


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

    @property
    def settled(self) -> bool:
        """Whether samples within a threshold could change nothing; never for what is more than one."""
        return False

    def look(self, inputs: Sequence[Signals]) -> Alarm | None:
        """Look at the next samples; the first alarm among them."""
        if self.raised:
            self.pass_over(inputs)
            return None
        found = self.watch(inputs)
        self.raised = found is not None
        return found

    @abstractmethod
    def watch(self, inputs: Sequence[Signals]) -> Alarm | None:
        """See `look`; an alarm is the last until a reset."""

    def pass_over(self, inputs: Sequence[Signals]) -> None:
        """Take note of samples from an alarm to a reset."""

    def reset(self) -> None:
        """Watch as from the first sample."""
        self.raised = False


class Patience:
    """Some revolutions, from the first sample or a reset on, in which nothing is wrong yet.

    Args:
        revolutions: of the encoder, the first input.
    """

    def __init__(self, revolutions: float) -> None:
        self._turn = revolutions * _TURN
        self._until: float | None = None

    @property
    def over(self) -> bool:
        """Whether nothing is forgiven any more."""
        return not self._turn or self._until == -np.inf

    def left(self, inputs: Sequence[Signals]) -> int:
        """How many samples of the block are still forgiven."""
        if self.over:
            return 0
        angle = inputs[0]["angle"]
        if self._until is None:
            if not angle.size:
                return 0
            self._until = float(angle[0]) + self._turn
        over = angle >= self._until
        begin = int(np.argmax(over)) if over.any() else angle.size
        if begin < angle.size:
            self._until = -np.inf  # an angle that turns back changes nothing
        return begin

    def renew(self) -> None:
        """Forgive anew from the next sample on."""
        self._until = None


@inlined
def _beyond(signal: Array, other: Array, k: int, offset: float, low: float, high: float) -> bool:
    """Whether signal - other - offset of a sample is beyond its limits, or not a number; an empty other is 0."""
    return not low <= signal[k] - (other[k] if other.size else 0.0) - offset <= high


@kernel
def _count_beyond(signals: tuple[Array, ...], places: Places, bands: Array, counts: Places) -> int:
    """Fill in how many samples are beyond the limits of each threshold, and say of how many thresholds there are any.

    Args:
        signals: all that some threshold watches, each shape (n,), or empty for "no other".
        places: signal and other of each threshold, shape (thresholds, 2).
        bands: its offset, low and high, shape (thresholds, 3).
        counts: filled in.
    """
    found = 0
    for row in range(counts.size):
        signal, other = signals[places[row, 0]], signals[places[row, 1]]
        offset, low, high = bands[row, 0], bands[row, 1], bands[row, 2]
        count = 0
        for k in range(signal.size):
            count += _beyond(signal, other, k, offset, low, high)
        counts[row] = count
        found += count > 0
    return found


@kernel
def _lasting(signal: Array, other: Array, band: Array, needed: int, run: int) -> tuple[int, int]:
    """First sample at which ``needed`` in a row were beyond the limits, or -1, and how many were up to the last."""
    for k in range(signal.size):
        run = run + 1 if _beyond(signal, other, k, band[0], band[1], band[2]) else 0
        if run >= needed:
            return k, run
    return -1, run


_NOTHING = np.empty(0)


class Threshold(Monitor):
    """|signal - other - offset| beyond the limit for some samples in a row.

    Args:
        name, subject, limit, reaction: see `Monitor`.
        signal: place of the input and field.
        other: the same of what is subtracted; None: nothing.
        offset: subtracted as well.
        samples: how many; 1: at once.
        after: revolutions of the encoder, the first input, until it watches.

    Attributes:
        signal, other: as given.
        band: the offset, and between which limits it is well.
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
        self.signal, self.other, self._samples = signal, other, samples
        self.band = np.array([offset, -limit, limit])
        self._patience, self._run = Patience(after), 0

    @property
    def settled(self) -> bool:
        """See `Monitor`."""
        return self.raised or (not self._run and self._patience.over)

    def watch(self, inputs: Sequence[Signals]) -> Alarm | None:
        """See `Monitor`."""
        signal = inputs[self.signal[0]][self.signal[1]]
        other = _NOTHING if self.other is None else inputs[self.other[0]][self.other[1]]
        begin = self._patience.left(inputs)
        signal, other = signal[begin:], other[begin:]
        place, self._run = _lasting(signal, other, self.band, self._samples, self._run)
        if place < 0:
            return None
        return Alarm(begin + place, self._told(float(signal[place] - (other[place] if other.size else 0.0))))

    def _told(self, value: float) -> float:
        """What an alarm says of what is beyond the limit."""
        return abs(value - float(self.band[0]))

    def reset(self) -> None:
        """See `Monitor`."""
        super().reset()
        self._patience.renew()
        self._run = 0


class Below(Threshold):
    """A signal below the limit for some samples in a row; nothing is subtracted from it."""

    def __init__(
        self,
        name: str,
        subject: str,
        limit: float,
        reaction: Reaction,
        *,
        signal: tuple[int, str],
        samples: int = 1,
        after: float = 0.0,
    ) -> None:
        super().__init__(name, subject, limit, reaction, signal=signal, samples=samples, after=after)
        self.band[:] = 0.0, limit, np.inf

    def _told(self, value: float) -> float:
        """See `Threshold`."""
        return value


@inlined
def _differ(after: float, before: float, limit: float) -> bool:
    return not abs(after - before) <= limit


@kernel
def _changing(signal: Array, past: Array, limit: float) -> tuple[int, float]:
    """First sample that differs by more than the limit from the one a window before, or -1, and by how much.

    The past, shape (window,), becomes the one of the next samples.
    """
    size, window = signal.size, past.size
    late, early = signal[window:], signal[: max(size - window, 0)]
    count = 0
    for k in range(min(size, window)):
        count += _differ(signal[k], past[k], limit)
    for k in range(late.size):
        count += _differ(late[k], early[k], limit)
    place, change = -1, 0.0
    if count:
        for k in range(size):
            before = past[k] if k < window else signal[k - window]
            if _differ(signal[k], before, limit):
                place, change = k, abs(signal[k] - before)
                break
    kept = max(window - size, 0)
    for k in range(kept):
        past[k] = past[k + size]
    for k in range(kept, window):
        past[k] = signal[size - window + k]
    return place, change


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
        place, change = _changing(signal, self._past, self.limit * self._span)
        return Alarm(place, change / self._span) if place >= 0 else None

    def pass_over(self, inputs: Sequence[Signals]) -> None:
        """See `Monitor`; what was before a reset counts after it."""
        self.watch(inputs)


@inlined
def _off(since: float, limit: float) -> bool:
    """Whether no angle since an index pulse can be this, to the limit; nothing is known before the first pulse: NaN."""
    return since > _TURN + limit or since < -limit


@kernel
def _index(angle: Array, pulse: npt.NDArray[np.uint8], limit: float, state: Array) -> int:
    """First sample that does not fit the pulses, or -1; the state: angle of the last pulse, what was found."""
    for start in range(0, angle.size, _STRETCH):
        angles, pulses, last = angle[start : start + _STRETCH], pulse[start : start + _STRETCH], state[0]
        count = 0
        for k in range(pulses.size):
            count += pulses[k] > 0
        for k in range(angles.size):
            count += _off(angles[k] - last, limit)
        if not count:
            continue
        for k in range(angles.size):
            since = angles[k] - state[0]
            if _off(since, limit) or (pulses[k] > 0 and since < _TURN - limit):
                state[1] = abs(since - _TURN)
                return start + k
            if pulses[k] > 0:
                state[0] = angles[k]
    return -1


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


@inlined
def _add_squares(total: float, values: Array) -> float:
    for k in range(values.size):
        total += values[k] * values[k]
    return total


@kernel
def _growing(angle: Array, error: Array, floor: float, limit: float, needed: int, state: Array) -> int:
    """First sample at which the RMS error has grown ``needed`` revolutions in a row, or -1.

    The state: revolution, sum of squares, samples, RMS of the one before, how many have grown, by how much.
    """
    for start in range(0, angle.size, _STRETCH):
        angles, errors = angle[start : start + _STRETCH], error[start : start + _STRETCH]
        count = 0
        for k in range(angles.size):
            count += np.floor(angles[k] / _TURN) != state[0]
        total, first = state[1], 0
        for k in range(angles.size if count else 0):
            turn = np.floor(angles[k] / _TURN)
            if turn != state[0]:
                total = _add_squares(total, errors[first:k])
                samples = state[2] + (k - first)
                rms = np.sqrt(total / samples) if samples > 0.0 else np.nan
                grown = rms > limit * state[3] and rms > floor
                state[4] = state[4] + 1.0 if grown else 0.0
                if grown and state[4] >= needed:
                    state[5] = rms / state[3]
                    return start + k
                state[0], state[2], state[3], total, first = turn, 0.0, rms, 0.0, k
        state[1] = _add_squares(total, errors[first:])
        state[2] += angles.size - first
    return -1


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


class Lookout:
    """Looks at a block with all monitors; what stays within its thresholds costs one pass over the samples.

    Args:
        monitors: in the order in which alarms at the same sample are told.
    """

    def __init__(self, monitors: Sequence[Monitor]) -> None:
        self._monitors = monitors
        self._thresholds = [monitor for monitor in monitors if isinstance(monitor, Threshold)]
        self._others = [monitor for monitor in monitors if not isinstance(monitor, Threshold)]
        watched = [place for threshold in self._thresholds for place in (threshold.signal, threshold.other)]
        self._signals = list(dict.fromkeys(place for place in watched if place))
        places = [len(self._signals) if place is None else self._signals.index(place) for place in watched]
        self._places = np.array(places, np.int64).reshape(-1, 2)
        self._bands = np.array([threshold.band for threshold in self._thresholds]).reshape(-1, 3)
        self._counts = np.zeros(len(self._thresholds), np.int64)
        self._settled = False  # all thresholds are

    def look(self, inputs: Sequence[Signals]) -> list[tuple[Monitor, Alarm]]:
        """Alarms of the next samples, by sample."""
        signals = (*[inputs[place][name] for place, name in self._signals], _NOTHING)
        looking: Sequence[Monitor] = self._others
        if _count_beyond(signals, self._places, self._bands, self._counts) or not self._settled:
            near = {id(monitor) for monitor, count in zip(self._thresholds, self._counts, strict=True) if count}
            looking = [monitor for monitor in self._monitors if id(monitor) in near or not monitor.settled]
        found = [(monitor, alarm) for monitor in looking if (alarm := monitor.look(inputs))]
        if looking is not self._others:
            self._settled = all(threshold.settled for threshold in self._thresholds)
        return sorted(found, key=lambda one: one[1].place) if found else found

    def reset(self) -> None:
        """Watch as from the first sample."""
        self._settled = False
        for monitor in self._monitors:
            monitor.reset()
