# SPDX-License-Identifier: Apache-2.0
"""What is watched: signals against thresholds, each by a rule of `lathe_rc.safety.rules`."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lathe_rc.cell.messages import Signals
from lathe_rc.safety.rules import (
    GROWTH,
    INDEX,
    RATE,
    SUMS,
    THRESHOLD,
    TURN,
    Array,
    Places,
    Pulses,
    clear,
    lasting,
    located,
    walk,
)
from lathe_rc.safety.state_machine import Reaction


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
    """Watches signals by one of the `rules`; raises one alarm, and no other before it is reset.

    Args:
        name: of the monitor.
        subject: what it watches.
        limit: threshold.
        reaction: what it asks for.
        rule: which.
        signal: place of the input and field.
        other: the same of a second signal; None: there is none.
        memory: what the rule knows, its limits among it; its `Lookout` has it from then on.

    Attributes:
        name, subject, limit, reaction, rule, signal, other, memory: as given.
        raised: whether it has raised its alarm.
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
        self.name, self.subject, self.limit, self.reaction = name, subject, limit, reaction
        self.rule, self.signal, self.other = rule, signal, other
        self.memory = np.array(memory, np.float64)
        self.raised = False

    @property
    def settled(self) -> bool:
        """Whether `alarm` has nothing to do where the rule finds nothing."""
        return True

    @abstractmethod
    def alarm(self, inputs: Sequence[Signals], place: int) -> Alarm | None:
        """The alarm where the rule has found something; place −1: it has not."""

    def reset(self) -> None:
        """Watch as from the first sample."""
        self.raised = False


class Patience:
    """Some revolutions, from the first sample or a reset on, in which nothing is wrong yet.

    Args:
        revolutions: of the encoder, the first input.
    """

    def __init__(self, revolutions: float) -> None:
        self._turn = revolutions * TURN
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
        super().__init__(name, subject, limit, reaction, rule=THRESHOLD, signal=signal, other=other, memory=memory)
        self._patience, self._run = Patience(after), 0

    @property
    def settled(self) -> bool:
        """See `Monitor`."""
        return not self._run and self._patience.over

    def alarm(self, inputs: Sequence[Signals], place: int) -> Alarm | None:
        """See `Monitor`."""
        signal = inputs[self.signal[0]][self.signal[1]]
        other = _NOTHING if self.other is None else inputs[self.other[0]][self.other[1]]
        begin = self._patience.left(inputs)
        signal, other = signal[begin:], other[begin:]
        place, self._run = lasting(signal, other, self.memory, self._run)
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
        self._span = window * step
        memory = np.concatenate(((limit * self._span, np.nan), np.full(window, before)))
        super().__init__(name, subject, limit, reaction, rule=RATE, signal=signal, memory=memory)

    def alarm(self, inputs: Sequence[Signals], place: int) -> Alarm | None:
        """See `Monitor`."""
        return Alarm(place, float(self.memory[1]) / self._span) if place >= 0 else None


class IndexPulses(Monitor):
    """One revolution of the measured angle from index pulse to index pulse, and never backwards."""

    def __init__(self, limit: float, reaction: Reaction, *, encoder: int) -> None:
        signal, memory = (encoder, "angle"), (limit, np.nan, np.nan, 0.0)
        super().__init__("index_pulses", "encoder", limit, reaction, rule=INDEX, signal=signal, memory=memory)

    def alarm(self, inputs: Sequence[Signals], place: int) -> Alarm | None:
        """See `Monitor`."""
        return Alarm(place, float(self.memory[2])) if place >= 0 else None

    def reset(self) -> None:
        """See `Monitor`."""
        super().reset()
        self.memory[1:] = np.nan, np.nan, 0.0


_UNKNOWN = (-1.0, np.nan, 0.0, np.nan, *[0.0] * SUMS)  # what is known of the growth at first


class Growth(Monitor):
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
            rule=GROWTH,
            signal=(tool, "measured_error"),
            memory=(limit, floor, cycles, *_UNKNOWN),
        )

    def alarm(self, inputs: Sequence[Signals], place: int) -> Alarm | None:
        """See `Monitor`."""
        return Alarm(place, float(self.memory[6])) if place >= 0 else None

    def reset(self) -> None:
        """See `Monitor`."""
        super().reset()
        self.memory[3:] = _UNKNOWN


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
        place, self._run = clear(position, self._beyond, self._samples, self._run)
        return place if place >= 0 else None


class Lookout:
    """All monitors of a cell; the first input is the encoder.

    Args:
        monitors: in the order in which alarms at the same sample are told; their memory becomes part of the lookout's.
    """

    def __init__(self, monitors: Sequence[Monitor]) -> None:
        self._monitors = monitors
        self._signals = list(
            dict.fromkeys(place for monitor in monitors for place in (monitor.signal, monitor.other) if place)
        )
        self._memory = np.concatenate([np.empty(0), *(monitor.memory for monitor in monitors)])
        self._plan = np.zeros((len(monitors), 5), np.int64)
        self._places = np.zeros(len(monitors), np.int64)
        self._known = deque[tuple[Sequence[Signals], tuple[Array, ...], Pulses, Places]](maxlen=4)
        self._settled = False  # all monitors
        end = 0
        for row, monitor in zip(self._plan, monitors, strict=True):
            begin, end = end, end + monitor.memory.size
            other = self._signals.index(monitor.other) if monitor.other else -1
            row[:] = monitor.rule, self._signals.index(monitor.signal), other, begin, end
            monitor.memory = self._memory[begin:end]

    def look(self, inputs: Sequence[Signals]) -> list[tuple[Monitor, Alarm]]:
        """Alarms of the next samples, by sample."""
        if not self._monitors:
            return []
        if not walk(*self._located(inputs), self._memory, self._places) and self._settled:
            return []
        found = []
        for monitor, place in zip(self._monitors, self._places.tolist(), strict=True):
            if monitor.raised or (place < 0 and monitor.settled):
                continue
            alarm = monitor.alarm(inputs, place)
            if alarm:
                monitor.raised = True
                found.append((monitor, alarm))
        self._settled = all(monitor.raised or monitor.settled for monitor in self._monitors)
        return sorted(found, key=lambda one: one[1].place)

    def _located(self, inputs: Sequence[Signals]) -> tuple[Pulses, Places]:
        """Index pulses and plan; the offline host hands out the same few inputs again and again, so they are kept."""
        for known, _, pulse, plan in self._known:
            if known is inputs:
                return pulse, plan
        signals = tuple([np.ascontiguousarray(inputs[place][name]) for place, name in self._signals])
        pulse, plan = inputs[0]["index_pulse"], self._plan.copy()
        located(signals, pulse.size, plan)
        self._known.append((inputs, signals, pulse, plan))
        return pulse, plan

    def reset(self) -> None:
        """Watch as from the first sample."""
        self._settled = False
        for monitor in self._monitors:
            monitor.reset()
