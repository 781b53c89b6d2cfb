# SPDX-License-Identifier: Apache-2.0
"""Monitors: watch signals by a rule of `lathe_rc.safety.rules`, or in plain Python."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lathe_rc.errors import InputError
from lathe_rc.extensions import code_of_others
from lathe_rc.safety.rules import GROWTH, INDEX, RATE, SUMS, THRESHOLD, TURN, Array, Watch, clear
from lathe_rc.safety.state_machine import Reaction

Place = tuple[int, str]  # of an input, and its field

_LONGEST_NAME = 64  # of a monitor [B], as SafetyStatus.msg says
_NOTHING = np.empty(0)


@dataclass(frozen=True)
class Alarm:
    """Alarm of a monitor.

    Attributes:
        place: sample in the block.
        value: what it found, in the unit of the limit.
    """

    place: int
    value: float


@dataclass(eq=False)
class Watcher:
    """Base of the monitors, which raise one alarm, and no other before a reset.

    Attributes:
        name: of the monitor.
        subject: what it watches.
        limit: threshold.
        reaction: what it asks for.
    """

    name: str
    subject: str
    limit: float
    reaction: Reaction

    def reset(self) -> None:
        """Watch as from the first sample."""


class Rule(NamedTuple):
    """One of the `rules` with its limits; made by `threshold`, `below`, `rate`, `index_pulses` and `growth`.

    Attributes:
        number: of the rule.
        start: its memory before the first sample, the limits among it.
        unit: what the rule finds is divided by it; the quotient has the unit of the limit.
        restarts: False where the samples before a reset count after it as well.
    """

    number: int
    start: Sequence[float]
    unit: float = 1.0
    restarts: bool = True


def threshold(limit: float, *, offset: float = 0.0, samples: int = 1, after: float = 0.0) -> Rule:
    """Rule for |signal - other - offset| beyond the limit for some samples in a row.

    Args:
        limit: to both sides.
        offset: subtracted from the signal.
        samples: how many; 1: at once.
        after: revolutions of the encoder, the first input, until it watches.
    """
    return Rule(THRESHOLD, (offset, -limit, limit, samples, 0.0, after * TURN, np.nan))


def below(limit: float, *, samples: int = 1, after: float = 0.0) -> Rule:
    """Rule for a signal below the limit for some samples in a row; arguments as of `threshold`."""
    return Rule(THRESHOLD, (0.0, limit, np.inf, samples, 0.0, after * TURN, np.nan))


def rate(limit: float, *, window: int, step: float, before: float) -> Rule:
    """Rule for the change of a signal over a window of samples.

    Args:
        limit: rate of change [unit of the signal/s].
        window: over so many samples.
        step: sampling step [s].
        before: the signal before the first sample.
    """
    seconds = window * step
    return Rule(RATE, (limit * seconds, np.nan, *[before] * window), unit=seconds, restarts=False)


def index_pulses(limit: float) -> Rule:
    """Rule for one revolution of the measured angle from index pulse to index pulse, and never backwards."""
    return Rule(INDEX, (limit, np.nan, np.nan, 0.0))


def growth(limit: float, *, cycles: int, floor: float) -> Rule:
    """Rule for an RMS error that grows from revolution to revolution, which begin at index pulses.

    Args:
        limit: factor from one to the next.
        cycles: so many times in a row.
        floor: RMS error below which it does not count [m].
    """
    return Rule(GROWTH, (limit, floor, cycles, -1.0, np.nan, 0.0, np.nan, *[0.0] * SUMS))


@dataclass(eq=False, kw_only=True)
class Monitor(Watcher):
    """Watches by a rule.

    Attributes:
        rule: with its limits.
        signal: place of the input and its field.
        other: the same of a second signal; None: there is none.
        memory: what the rule knows now.
    """

    rule: Rule
    signal: Place
    other: Place | None = None

    def __post_init__(self) -> None:
        # The `Lookout` puts a view in its place: the kernel has one array for the memories of all rules.
        self.memory: Array = np.array(self.rule.start, np.float64)

    def reset(self) -> None:
        """Watch as from the first sample, but for samples that still count."""
        if self.rule.restarts:
            self.memory[:] = self.rule.start


class PlainMonitor(ABC):
    """A monitor in plain Python, which looks at pieces of signals, one after the other.

    It is made anew at a reset. What it finds must not depend on where pieces begin: what it needs of the samples
    before, it keeps.

    Args:
        limit: threshold, told with its alarm.
        step: sampling step [s].

    Attributes:
        limit, step: as given.
    """

    def __init__(self, limit: float, step: float) -> None:
        self.limit, self.step = limit, step

    @abstractmethod
    def find(self, first: int, signal: Array, other: Array) -> Alarm | None:
        """The first alarm in a piece; after one there are no further pieces until a reset.

        Args:
            first: index of the first sample of the piece in the run.
            signal: what it watches, shape (n,); not to be changed.
            other: a second signal, shape (n,); shape (0,) if there is none.
        """


class Plain(Watcher):
    """A `PlainMonitor` with its place in the cell.

    Args:
        name, subject, limit, reaction: see `Watcher`.
        signals: places of one input and field, or of two.
        make: of the monitor.

    Raises:
        InputError: it has too long a name, or cannot be made.
    """

    def __init__(
        self,
        name: str,
        subject: str,
        limit: float,
        reaction: Reaction,
        *,
        signals: Sequence[Place],
        make: Callable[[], PlainMonitor],
    ) -> None:
        if len(name.encode()) > _LONGEST_NAME:
            raise InputError(f"{name!r} is longer than messages carry; allowed: {_LONGEST_NAME} bytes (an entry point)")
        super().__init__(name, subject, limit, reaction)
        self._signals, self._make = signals, make
        self._monitor: PlainMonitor | None = None
        self.reset()

    def find(self, first: int, inputs: Sequence[Mapping[str, Array]]) -> Alarm | None:
        """The alarm in the samples ``first`` on, if there is one.

        Args:
            first: index of the first one.
            inputs: arrays of shape (n,) by field.

        Raises:
            InputError: the monitor goes wrong.
        """
        if self._monitor is None:
            return None
        signal, other = [*(_read_only(inputs[place][field]) for place, field in self._signals), _NOTHING][:2]
        with code_of_others(f"monitor {self.name} at sample {first}"):
            found = self._monitor.find(first, signal, other)
            if found is None:
                return None
            alarm = Alarm(int(found.place), float(found.value))
        if not 0 <= alarm.place < signal.size:
            raise InputError(
                f"monitor {self.name} at sample {first} finds something at place {alarm.place} of {signal.size}; "
                f"allowed: 0 to {signal.size - 1}"
            )
        self._monitor = None
        return alarm

    def reset(self) -> None:
        """Make the monitor anew."""
        with code_of_others(f"monitor {self.name}"):
            self._monitor = self._make()


def _read_only(signal: Array) -> Array:
    """View of a signal that third-party code cannot write to."""
    view: Array = signal.view()
    view.flags.writeable = False
    return view


class Clearance:
    """Condition that the tool is out of the part.

    Args:
        beyond: measured position of the drive beyond which it is [m].
        samples: for so many in a row.

    Attributes:
        memory: both, and how many in a row were up to the last sample, for `lathe_rc.safety.rules.clear`.
    """

    def __init__(self, beyond: float, samples: int) -> None:
        self.memory = np.array([beyond, samples, 0.0])

    def begin(self) -> None:
        """Look for it from the next sample on."""
        self.memory[2] = 0.0

    def first(self, position: Array) -> int | None:
        """First sample at which the tool is out; None: at none."""
        place, self.memory[2] = clear(position, self.memory)
        return place if place >= 0 else None


class Lookout:
    """All monitors of a cell; the first input is the encoder.

    Args:
        monitors: in the order in which alarms at the same sample are told; their memory becomes part of the lookout's.
        numbers: of the signals that they read, by input and field.

    Attributes:
        watch: for `lathe_rc.safety.rules.walk`.
    """

    def __init__(self, monitors: Sequence[Monitor], numbers: Mapping[Place, int]) -> None:
        self._monitors = monitors
        memory = np.concatenate([np.empty(0), *(monitor.memory for monitor in monitors)])
        plan, count, end = np.zeros((len(monitors), 5), np.int64), len(monitors), 0
        for row, monitor in zip(plan, monitors, strict=True):
            begin, end = end, end + monitor.memory.size
            other = numbers[monitor.other] if monitor.other else -1
            row[:] = monitor.rule.number, numbers[monitor.signal], other, begin, end
            monitor.memory = memory[begin:end]
        self.watch = Watch(plan, memory, np.zeros(count, np.int64), np.full(count, -1), np.zeros(count))

    def found(self) -> list[tuple[Monitor, Alarm]]:
        """Alarms of the samples through which `lathe_rc.safety.rules.walk` went last."""
        found = []
        places, values = self.watch.places.tolist(), self.watch.values.tolist()
        for number, (monitor, place, value) in enumerate(zip(self._monitors, places, values, strict=True)):
            if place >= 0:
                self.watch.raised[number] = 1
                found.append((monitor, Alarm(place, value / monitor.rule.unit)))
        return sorted(found, key=lambda one: one[1].place)

    def reset(self) -> None:
        """Watch as from the first sample."""
        self.watch.raised[:] = 0
        for monitor in self._monitors:
            monitor.reset()
