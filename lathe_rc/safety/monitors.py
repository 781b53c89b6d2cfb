# SPDX-License-Identifier: Apache-2.0
"""What is watched: signals against thresholds, sample by sample, whatever the blocks.

One kernel goes through the samples for all monitors of a `Lookout`: a row of a table says which rule reads which
signals and where its memory is. A rule first asks whether there is anything in a stretch of samples, which the compiler
makes vectors of, and takes them one by one only where there is. A monitor that is no rule of the table has its own
`Monitor.watch`.
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
Pulses = npt.NDArray[np.uint8]

_THRESHOLD, _RATE, _INDEX, _GROWTH = range(4)  # rules of the table
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


class Ruled(Monitor):
    """A monitor whose rule is one of the table.

    Args:
        name, subject, limit, reaction: see `Monitor`.
        rule: which.
        signal: place of the input and field.
        other: the same of a second signal; None: there is none.
        memory: what the rule knows, its limits among it; the table has it from then on.

    Attributes:
        rule, signal, other, memory: as given.
    """

    def __init__(
        self,
        name: str,
        subject: str,
        limit: float,
        reaction: Reaction,
        *,
        rule: int,
        signal: tuple[int, str],
        other: tuple[int, str] | None = None,
        memory: Sequence[float] | Array,
    ) -> None:
        super().__init__(name, subject, limit, reaction)
        self.rule, self.signal, self.other = rule, signal, other
        self.memory = np.array(memory, np.float64)

    @property
    def settled(self) -> bool:
        """Whether `alarm` has nothing to do where the rule finds nothing."""
        return True

    def watch(self, inputs: Sequence[Signals]) -> Alarm | None:
        """See `Monitor`; alone."""
        table = Table([self])
        table.walk(inputs)
        return self.alarm(inputs, int(table.places[0]))

    @abstractmethod
    def alarm(self, inputs: Sequence[Signals], place: int) -> Alarm | None:
        """The alarm where the rule has found something; place −1: it has not."""


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
def _beyond(value: float, offset: float, low: float, high: float) -> bool:
    """Whether a value is beyond its limits, or not a number."""
    return not low <= value - offset <= high


@kernel
def _any_beyond(signal: Array, other: Array, memory: Array) -> int:
    """0 if so many samples in a row may be beyond here or from the last one on, or -1.

    The memory: offset, lower and upper limit, how many. Where n are needed, every n-th one and the last tell: n in a
    row cannot pass between them, if the sample before the first was not beyond.
    """
    offset, low, high, needed = memory[0], memory[1], memory[2], int(memory[3])
    count = 0
    if needed > 1:
        for k in range(needed - 1, signal.size, needed):
            count += _beyond(signal[k] - (other[k] if other.size else 0.0), offset, low, high)
        if signal.size:
            count += _beyond(signal[-1] - (other[-1] if other.size else 0.0), offset, low, high)
    elif other.size:
        for k in range(signal.size):
            count += _beyond(signal[k] - other[k], offset, low, high)
    else:
        for k in range(signal.size):
            count += _beyond(signal[k], offset, low, high)
    return 0 if count else -1


@kernel
def _lasting(signal: Array, other: Array, memory: Array, run: int) -> tuple[int, int]:
    """First sample at which enough in a row were beyond, or -1, and how many were up to it or the last."""
    for k in range(signal.size):
        value = signal[k] - (other[k] if other.size else 0.0)
        run = run + 1 if _beyond(value, memory[0], memory[1], memory[2]) else 0
        if run >= memory[3]:
            return k, run
    return -1, run


_NOTHING = np.empty(0)


class Threshold(Ruled):
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
        memory = (offset, -limit, limit, samples)
        super().__init__(name, subject, limit, reaction, rule=_THRESHOLD, signal=signal, other=other, memory=memory)
        self._patience, self._run = Patience(after), 0

    @property
    def settled(self) -> bool:
        """See `Ruled`."""
        return not self._run and self._patience.over

    def alarm(self, inputs: Sequence[Signals], place: int) -> Alarm | None:
        """See `Ruled`."""
        signal = inputs[self.signal[0]][self.signal[1]]
        other = _NOTHING if self.other is None else inputs[self.other[0]][self.other[1]]
        begin = self._patience.left(inputs)
        signal, other = signal[begin:], other[begin:]
        place, self._run = _lasting(signal, other, self.memory, self._run)
        if place < 0:
            return None
        return Alarm(begin + place, self._told(float(signal[place] - (other[place] if other.size else 0.0))))

    def _told(self, value: float) -> float:
        """What an alarm says of what is beyond the limit."""
        return abs(value - float(self.memory[0]))

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
        self.memory[:3] = 0.0, limit, np.inf

    def _told(self, value: float) -> float:
        """See `Threshold`."""
        return value


@inlined
def _differ(after: float, before: float, limit: float) -> bool:
    return not abs(after - before) <= limit


@kernel
def _changing(signal: Array, memory: Array) -> int:
    """First sample that differs by more than the limit from the one a window before, or -1.

    The memory: limit, by how much it differs, and the samples of a window up to now.
    """
    limit, past, size = memory[0], memory[2:], signal.size
    window = past.size
    late, early = signal[window:], signal[: max(size - window, 0)]
    count = 0
    for k in range(min(size, window)):
        count += _differ(signal[k], past[k], limit)
    for k in range(late.size):
        count += _differ(late[k], early[k], limit)
    found = -1
    for k in range(size if count else 0):
        before = past[k] if k < window else signal[k - window]
        if _differ(signal[k], before, limit):
            found = k
            memory[1] = abs(signal[k] - before)
            break
    kept = max(window - size, 0)
    for k in range(kept):
        past[k] = past[k + size]
    for k in range(kept, window):
        past[k] = signal[size - window + k]
    return found


class Rate(Ruled):
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
        self._span = window * step
        memory = np.concatenate(((limit * self._span, np.nan), np.full(window, before)))
        super().__init__(name, subject, limit, reaction, rule=_RATE, signal=signal, memory=memory)

    def alarm(self, inputs: Sequence[Signals], place: int) -> Alarm | None:
        """See `Ruled`."""
        return Alarm(place, float(self.memory[1]) / self._span) if place >= 0 else None


@inlined
def _off(since: float, limit: float) -> bool:
    """Whether no angle since an index pulse can be this, to the limit; nothing is known before the first pulse: NaN."""
    return since > _TURN + limit or since < -limit


@kernel
def _index(angle: Array, pulse: Pulses, memory: Array) -> int:
    """First sample that does not fit the pulses, or -1; the memory: limit, angle of the last pulse, what was found."""
    limit = memory[0]
    for start in range(0, angle.size, _STRETCH):
        angles, pulses, last = angle[start : start + _STRETCH], pulse[start : start + _STRETCH], memory[1]
        count = 0
        for k in range(pulses.size):
            count += pulses[k] > 0
        for k in range(angles.size):
            count += _off(angles[k] - last, limit)
        if not count:
            continue
        for k in range(angles.size):
            since = angles[k] - last
            if _off(since, limit) or (pulses[k] > 0 and since < _TURN - limit):
                memory[1], memory[2] = last, abs(since - _TURN)
                return start + k
            if pulses[k] > 0:
                last = angles[k]
        memory[1] = last
    return -1


class IndexPulses(Ruled):
    """One revolution of the measured angle from index pulse to index pulse, and never backwards."""

    def __init__(self, limit: float, reaction: Reaction, *, encoder: int) -> None:
        signal, memory = (encoder, "angle"), (limit, np.nan, np.nan)
        super().__init__("index_pulses", "encoder", limit, reaction, rule=_INDEX, signal=signal, memory=memory)

    def alarm(self, inputs: Sequence[Signals], place: int) -> Alarm | None:
        """See `Ruled`."""
        return Alarm(place, float(self.memory[2])) if place >= 0 else None

    def reset(self) -> None:
        """See `Monitor`."""
        super().reset()
        self.memory[1:] = np.nan


_SUMS = 32  # of squares, each of every 32nd error: one would wait for itself, these are vectors
_NEAR = 1e-9  # of a revolution: so close to its ends its number is not taken for known


@inlined
def _surely(turn: float) -> tuple[float, float]:
    """Angles between which the revolution is this one, without a division."""
    return (turn + _NEAR) * _TURN, (turn + 1.0 - _NEAR) * _TURN


@inlined
def _add(error: Array, memory: Array) -> None:
    """Add the squares of more errors of the same revolution, see `_growing`; the same whatever the blocks."""
    sums = memory[8:]
    start = int(memory[4]) % sums.size
    head = min(sums.size - start, error.size)
    for k in range(head):
        sums[start + k] += error[k] * error[k]
    for first in range(head, error.size, sums.size):
        row = error[first : first + sums.size]
        for k in range(row.size):
            sums[k] += row[k] * row[k]
    memory[4] += error.size


@kernel
def _turning(angle: Array, error: Array, memory: Array) -> int:
    """See `_growing`, for samples among which a revolution may begin."""
    limit, floor, needed, state, sums = memory[0], memory[1], memory[2], memory[3:8], memory[8:]
    first, low, high = 0, *_surely(state[0])
    for k in range(angle.size):
        if low <= angle[k] <= high:
            continue
        turn = np.floor(angle[k] / _TURN)
        if turn != state[0]:
            _add(error[first:k], memory)
            rms = np.sqrt(np.sum(sums) / state[1]) if state[1] > 0.0 else np.nan
            grown = rms > limit * state[2] and rms > floor
            state[3] = state[3] + 1.0 if grown else 0.0
            if grown and state[3] >= needed:
                state[4] = rms / state[2]
                return k
            state[0], state[1], state[2], first = turn, 0.0, rms, k
            low, high = _surely(turn)
            sums[:] = 0.0
    _add(error[first:], memory)
    return -1


@kernel
def _growing(angle: Array, error: Array, memory: Array) -> int:
    """First sample at which the RMS error has grown often enough, or -1.

    The memory: limit, floor, revolutions needed; revolution, samples, RMS of the one before, how many have grown, by
    how much; sums of squares.
    """
    begin = 0  # of what is not in the sums
    for start in range(0, angle.size, _STRETCH):
        angles = angle[start : start + _STRETCH]
        low, high = _surely(memory[3])
        count = 0
        for k in range(angles.size):
            count += _beyond(angles[k], 0.0, low, high)
        if count:
            _add(error[begin:start], memory)
            begin = start + angles.size
            found = _turning(angles, error[start:begin], memory)
            if found >= 0:
                return start + found
    _add(error[begin:], memory)
    return -1


_UNKNOWN = (0.0, 0.0, np.nan, 0.0, np.nan, *[0.0] * _SUMS)  # what is known of the growth at first


class Growth(Ruled):
    """The RMS error grows from revolution to revolution.

    Args:
        limit: factor from one to the next.
        reaction: what it asks for.
        encoder, tool: places of the inputs.
        cycles: so many times in a row.
        floor: RMS error below which it does not count [m].
    """

    def __init__(self, limit: float, reaction: Reaction, *, encoder: int, tool: int, cycles: int, floor: float) -> None:
        super().__init__(
            "error_growth",
            "tool",
            limit,
            reaction,
            rule=_GROWTH,
            signal=(encoder, "angle"),
            other=(tool, "measured_error"),
            memory=(limit, floor, cycles, *_UNKNOWN),
        )

    def alarm(self, inputs: Sequence[Signals], place: int) -> Alarm | None:
        """See `Ruled`."""
        return Alarm(place, float(self.memory[7])) if place >= 0 else None

    def reset(self) -> None:
        """See `Monitor`."""
        super().reset()
        self.memory[3:] = _UNKNOWN


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


@kernel
def _walk(signals: tuple[Array, ...], pulse: Pulses, rows: Places, memory: Array, places: Places) -> int:
    """Fill in where each rule finds something, or -1, and say how many do.

    Args:
        signals: all that are watched, each shape (n,); the last is empty, for "no other".
        pulse: index pulses of the encoder, shape (n,).
        rows: rule, its two signals, begin and end of its memory, shape (rows, 5).
        memory: of all of them.
        places: filled in, shape (rows,).
    """
    found = 0
    for row in range(places.size):
        rule, own = rows[row, 0], memory[rows[row, 3] : rows[row, 4]]
        signal, other = signals[rows[row, 1]], signals[rows[row, 2]]
        if rule == _THRESHOLD:
            place = _any_beyond(signal, other, own)
        elif rule == _RATE:
            place = _changing(signal, own)
        elif rule == _INDEX:
            place = _index(signal, pulse, own)
        else:
            place = _growing(signal, other, own)
        places[row] = place
        found += place >= 0
    return found


class Table:
    """The rules of some monitors.

    Args:
        monitors: their memory becomes part of the table's.

    Attributes:
        places: what each rule has found in the last block: a sample, or −1.
    """

    def __init__(self, monitors: Sequence[Ruled]) -> None:
        self._signals = list(
            dict.fromkeys(place for monitor in monitors for place in (monitor.signal, monitor.other) if place)
        )
        self._memory = np.concatenate([np.empty(0), *(monitor.memory for monitor in monitors)])
        self._rows = np.zeros((len(monitors), 5), np.int64)
        self.places = np.zeros(len(monitors), np.int64)
        end = 0
        for row, monitor in zip(self._rows, monitors, strict=True):
            begin, end = end, end + monitor.memory.size
            other = self._signals.index(monitor.other) if monitor.other else len(self._signals)
            row[:] = monitor.rule, self._signals.index(monitor.signal), other, begin, end
            monitor.memory = self._memory[begin:end]

    def walk(self, inputs: Sequence[Signals]) -> int:
        """How many rules find something in the next samples."""
        signals = (*[inputs[place][name] for place, name in self._signals], _NOTHING)
        return _walk(signals, inputs[0]["index_pulse"], self._rows, self._memory, self.places)


class Lookout:
    """All monitors of a cell; the first input is the encoder.

    Args:
        monitors: in the order in which alarms at the same sample are told.
    """

    def __init__(self, monitors: Sequence[Monitor]) -> None:
        self._monitors = monitors
        self._ruled = [monitor for monitor in monitors if isinstance(monitor, Ruled)]
        self._table = Table(self._ruled)
        self._free = len(self._ruled) < len(monitors)  # some watch by themselves
        self._settled = False  # all that are ruled

    def look(self, inputs: Sequence[Signals]) -> list[tuple[Monitor, Alarm]]:
        """Alarms of the next samples, by sample."""
        if not self._table.walk(inputs) and self._settled and not self._free:
            return []
        places = dict(zip(map(id, self._ruled), self._table.places.tolist(), strict=True))
        found = []
        for monitor in self._monitors:
            if not isinstance(monitor, Ruled):
                alarm = monitor.look(inputs)
            elif not monitor.raised and (places[id(monitor)] >= 0 or not monitor.settled):
                alarm = monitor.alarm(inputs, places[id(monitor)])
                monitor.raised = alarm is not None
            else:
                alarm = None
            if alarm:
                found.append((monitor, alarm))
        self._settled = all(monitor.raised or monitor.settled for monitor in self._ruled)
        return sorted(found, key=lambda one: one[1].place)

    def reset(self) -> None:
        """Watch as from the first sample."""
        self._settled = False
        for monitor in self._monitors:
            monitor.reset()
