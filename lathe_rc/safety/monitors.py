# SPDX-License-Identifier: Apache-2.0
"""What is watched: signals against thresholds, sample by sample, whatever the blocks.

One kernel goes through the samples for all monitors of a `Lookout`: a row of a table says which rule reads which
signals and where its memory is. A rule first asks whether there is anything in a stretch of samples, which the compiler
makes vectors of, and takes them one by one only where there is. A monitor that is no rule of the table has its own
`Monitor.watch`.
"""

from abc import ABC, abstractmethod
from collections import deque
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
_STRETCH = 256  # samples


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
        return self.alarm(inputs, table.places[0])

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
    """Whether a value is beyond its limits, or not a number; most limits are to both sides, which is one comparison."""
    value -= offset
    return not abs(value) <= high if low == -high else not low <= value <= high


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


@inlined
def _how_many_differ(after: Array, before: Array, limit: float) -> int:
    count = 0
    for k in range(after.size):
        count += _differ(after[k], before[k], limit)
    return count


@kernel
def _changing(signal: Array, memory: Array) -> int:
    """First sample that differs by more than the limit from the one a window before, or -1.

    The memory: limit, by how much it differs, and the samples of a window up to now.
    """
    limit, past, size = memory[0], memory[2:], signal.size
    window = past.size
    count = _how_many_differ(signal[:window], past, limit) + _how_many_differ(signal[window:], signal, limit)
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
    past[kept:] = signal[size - window + kept :]
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
def _next(pulse: Pulses, begin: int) -> int:
    """The first index pulse from a sample on; the end if there is none."""
    for start in range(begin, pulse.size, _STRETCH):
        piece, some = pulse[start : start + _STRETCH], np.uint8(0)
        for k in range(piece.size):
            some |= piece[k]
        for k in range(piece.size if some else 0):
            if piece[k]:
                return start + k
    return pulse.size


@inlined
def _off(since: float, limit: float) -> bool:
    """Whether no angle since an index pulse can be this, to the limit."""
    return since > _TURN + limit or since < -limit


@kernel
def _first_off(angle: Array, last: float, limit: float) -> int:
    """First sample that no angle since an index pulse can be, or -1."""
    count = 0
    for k in range(angle.size):
        count += _off(angle[k] - last, limit)
    for k in range(angle.size if count else 0):
        if _off(angle[k] - last, limit):
            return k
    return -1


@kernel
def _index(angle: Array, pulse: Pulses, memory: Array) -> int:
    """First sample that does not fit the pulses, or -1.

    The memory: limit, angle of the last pulse, what was found, whether there was a pulse: before, the first angle
    stands for one that may come early.
    """
    limit, begin = memory[0], 0
    if angle.size and np.isnan(memory[1]):
        memory[1] = angle[0]
    while begin < angle.size:
        at = _next(pulse, begin)
        last = memory[1]
        found = _first_off(angle[begin : at + 1], last, limit)
        if found >= 0:
            found += begin
        elif at < angle.size and memory[3] > 0.0 and angle[at] - last < _TURN - limit:
            found = at
        if found >= 0:
            memory[2] = abs(angle[found] - last - _TURN)
            return found
        if at < angle.size:
            memory[1], memory[3] = angle[at], 1.0
        begin = at + 1
    return -1


class IndexPulses(Ruled):
    """One revolution of the measured angle from index pulse to index pulse, and never backwards."""

    def __init__(self, limit: float, reaction: Reaction, *, encoder: int) -> None:
        signal, memory = (encoder, "angle"), (limit, np.nan, np.nan, 0.0)
        super().__init__("index_pulses", "encoder", limit, reaction, rule=_INDEX, signal=signal, memory=memory)

    def alarm(self, inputs: Sequence[Signals], place: int) -> Alarm | None:
        """See `Ruled`."""
        return Alarm(place, float(self.memory[2])) if place >= 0 else None

    def reset(self) -> None:
        """See `Monitor`."""
        super().reset()
        self.memory[1:] = np.nan, np.nan, 0.0


_SUMS = 128  # of squares, each of every 128th error: one would wait for itself, these are vectors


@inlined
def _add(error: Array, memory: Array) -> None:
    """Add the squares of more errors of the same revolution, see `_growing`; the same whatever the blocks."""
    sums = memory[7:]
    start = int(memory[3]) % sums.size
    head = min(sums.size - start, error.size)
    for k in range(head):
        sums[start + k] += error[k] * error[k]
    for first in range(head, error.size, sums.size):
        row = error[first : first + sums.size]
        for k in range(row.size):
            sums[k] += row[k] * row[k]
    memory[3] += error.size


@inlined
def _grown(memory: Array) -> bool:
    """End a revolution, see `_growing`, and begin the next; whether its error has grown once too often."""
    limit, floor, needed, state, sums = memory[0], memory[1], memory[2], memory[3:7], memory[7:]
    rms = np.sqrt(np.sum(sums) / state[0])
    before = state[1]
    state[2] = state[2] + 1.0 if rms > limit * before and rms > floor else 0.0
    state[0], state[1] = 0.0, rms
    sums[:] = 0.0
    if state[2] < needed:
        return False
    state[3] = rms / before
    return True


@kernel
def _growing(pulse: Pulses, error: Array, memory: Array) -> int:
    """First sample at which the RMS error has grown often enough, or -1.

    The memory: limit, floor, revolutions needed; samples of the revolution, below 0 before the first index pulse; RMS
    of the one before, how many have grown, by how much; sums of squares.
    """
    begin, at = 0, _next(pulse, 0)
    while True:
        if memory[3] >= 0.0:
            _add(error[begin:at], memory)
        if at == pulse.size:
            return -1
        if memory[3] < 0.0:
            memory[3] = 0.0
        elif _grown(memory):
            return at
        begin, at = at, _next(pulse, at + 1)


_UNKNOWN = (-1.0, np.nan, 0.0, np.nan, *[0.0] * _SUMS)  # what is known of the growth at first


class Growth(Ruled):
    """The RMS error grows from revolution to revolution, which begin at index pulses.

    Args:
        limit: factor from one to the next.
        reaction: what it asks for.
        tool: place of the input.
        cycles: so many times in a row.
        floor: RMS error below which it does not count [m].
    """

    def __init__(self, limit: float, reaction: Reaction, *, tool: int, cycles: int, floor: float) -> None:
        super().__init__(
            "error_growth",
            "tool",
            limit,
            reaction,
            rule=_GROWTH,
            signal=(tool, "measured_error"),
            memory=(limit, floor, cycles, *_UNKNOWN),
        )

    def alarm(self, inputs: Sequence[Signals], place: int) -> Alarm | None:
        """See `Ruled`."""
        return Alarm(place, float(self.memory[6])) if place >= 0 else None

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
def _walk(signals: tuple[Array, ...], pulse: Pulses, rows: Places, memory: Array) -> int:
    """Fill in where each rule finds something, or -1, and say how many do.

    Args:
        signals: all that are watched, each shape (n,).
        pulse: index pulses of the encoder, shape (n,).
        rows: rule, its two signals, the second or -1, begin and end of its memory, and the place that is filled in;
            shape (rows, 6).
        memory: of all of them.
    """
    found = 0
    for row in range(rows.shape[0]):
        rule, own, second = rows[row, 0], memory[rows[row, 3] : rows[row, 4]], rows[row, 2]
        signal = signals[rows[row, 1]]
        other = signals[second] if second >= 0 else signal[:0]
        if rule == _THRESHOLD:
            place = _any_beyond(signal, other, own)
        elif rule == _RATE:
            place = _changing(signal, own)
        elif rule == _INDEX:
            place = _index(signal, pulse, own)
        else:
            place = _growing(pulse, signal, own)
        rows[row, 5] = place
        found += place >= 0
    return found


class Table:
    """The rules of some monitors.

    Args:
        monitors: their memory becomes part of the table's.
    """

    def __init__(self, monitors: Sequence[Ruled]) -> None:
        self._signals = list(
            dict.fromkeys(place for monitor in monitors for place in (monitor.signal, monitor.other) if place)
        )
        self._memory = np.concatenate([np.empty(0), *(monitor.memory for monitor in monitors)])
        self._rows = np.zeros((len(monitors), 6), np.int64)
        self._known = deque[tuple[Sequence[Signals], tuple[tuple[Array, ...], Pulses]]](maxlen=4)
        end = 0
        for row, monitor in zip(self._rows, monitors, strict=True):
            begin, end = end, end + monitor.memory.size
            other = self._signals.index(monitor.other) if monitor.other else -1
            row[:] = monitor.rule, self._signals.index(monitor.signal), other, begin, end, -1
            monitor.memory = self._memory[begin:end]

    @property
    def places(self) -> list[int]:
        """What each rule has found in the last block: a sample, or −1."""
        found: list[int] = self._rows[:, 5].tolist()
        return found

    def walk(self, inputs: Sequence[Signals]) -> int:
        """How many rules find something in the next samples."""
        return _walk(*self._gathered(inputs), self._rows, self._memory)

    def _gathered(self, inputs: Sequence[Signals]) -> tuple[tuple[Array, ...], Pulses]:
        """What is watched; the offline host hands out the same few inputs again and again, so they are kept."""
        for known, gathered in self._known:
            if known is inputs:
                return gathered
        gathered = tuple([inputs[place][name] for place, name in self._signals]), inputs[0]["index_pulse"]
        self._known.append((inputs, gathered))
        return gathered


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
        places = dict(zip(map(id, self._ruled), self._table.places, strict=True))
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
