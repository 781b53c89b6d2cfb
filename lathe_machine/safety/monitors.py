# SPDX-License-Identifier: Apache-2.0
"""Monitors that check signals, either by a rule of `lathe_machine.safety.rules` or in plain Python."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lathe_machine.safety.rules import GROWTH, INDEX, RATE, SUMS, THRESHOLD, TURN, MonitorTable, clear
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.extensions import code_of_others
from lathe_rc.safety.state_machine import Reaction

Place = tuple[int, str]  # index of an input, and name of its field

_LONGEST_NAME = 64  # largest length of a monitor's name [B], set by SafetyStatus.msg
_NOTHING = np.empty(0)


@dataclass(frozen=True)
class Alarm:
    """Alarm raised by a monitor, with the sample and the value that caused it.

    Attributes:
        place: index of the sample in the block.
        value: measured value, in the unit of the limit.
    """

    place: int
    value: float


@dataclass(eq=False)
class Watcher:
    """Base class of the monitors; a monitor raises at most one alarm between two resets.

    Attributes:
        name: name of the monitor.
        subject: monitored signal or property.
        limit: threshold.
        reaction: reaction requested with an alarm.
    """

    name: str
    subject: str
    limit: float
    reaction: Reaction

    def reset(self) -> None:
        """Reset the monitor to its initial state."""


class Rule(NamedTuple):
    """Monitoring rule with its limits, created by `threshold`, `below`, `rate`, `index_pulses` and `growth`.

    Attributes:
        number: number of the rule in `lathe_machine.safety.rules`.
        start: initial state of the rule, including its limits.
        unit: divisor of the rule's value; the quotient has the unit of the limit.
        restarts: False if the rule also uses samples from before a reset.
    """

    number: int
    start: Sequence[float]
    unit: float = 1.0
    restarts: bool = True


def threshold(limit: float, *, offset: float = 0.0, samples: int = 1, after: float = 0.0) -> Rule:
    """Create a rule for |signal - other - offset| above a limit for a number of consecutive samples.

    Args:
        limit: limit of the magnitude.
        offset: offset subtracted from the signal.
        samples: number of consecutive samples; 1 for an immediate alarm.
        after: revolutions of the encoder (the first input) before monitoring begins.
    """
    return Rule(THRESHOLD, (offset, -limit, limit, samples, 0.0, after * TURN, np.nan))


def below(limit: float, *, samples: int = 1, after: float = 0.0) -> Rule:
    """Create a rule for a signal below a limit for a number of consecutive samples; arguments as for `threshold`."""
    return Rule(THRESHOLD, (0.0, limit, np.inf, samples, 0.0, after * TURN, np.nan))


def rate(limit: float, *, window: int, step: float, before: float) -> Rule:
    """Create a rule for the rate of change of a signal over a window of samples.

    Args:
        limit: limit of the rate [unit of the signal/s].
        window: number of samples in the window.
        step: sampling step [s].
        before: value of the signal before the first sample.
    """
    seconds = window * step
    return Rule(RATE, (limit * seconds, np.nan, *[before] * window), unit=seconds, restarts=False)


def index_pulses(limit: float) -> Rule:
    """Create a rule for an angle that reverses, or does not advance by one revolution between two index pulses."""
    return Rule(INDEX, (limit, np.nan, np.nan, 0.0))


def growth(limit: float, *, cycles: int, floor: float) -> Rule:
    """Create a rule for an RMS error that grows from revolution to revolution; revolutions begin at index pulses.

    Args:
        limit: limit of the growth factor per revolution.
        cycles: number of consecutive revolutions with growth above the limit.
        floor: RMS error below which growth is ignored [m].
    """
    return Rule(GROWTH, (limit, floor, cycles, -1.0, np.nan, 0.0, np.nan, *[0.0] * SUMS))


@dataclass(eq=False, kw_only=True)
class Monitor(Watcher):
    """Monitor that checks signals by a rule.

    Attributes:
        rule: rule with its limits.
        signal: input and field of the signal.
        other: input and field of a second signal; None for none.
        memory: current state of the rule.
    """

    rule: Rule
    signal: Place
    other: Place | None = None

    def __post_init__(self) -> None:
        # The `Lookout` replaces this array by a view of the kernel's array, which contains the states of all rules.
        self.memory: Array = np.array(self.rule.start, np.float64)

    def reset(self) -> None:
        """Reset the state of the rule, unless the rule also uses samples from before a reset."""
        if self.rule.restarts:
            self.memory[:] = self.rule.start


class PlainMonitor(ABC):
    """Base class of monitors in plain Python, which check signals chunk by chunk.

    A new instance is created at each reset. The result must not depend on the boundaries of the chunks, so the monitor
    must store any past samples that it needs.

    Args:
        limit: threshold, published with the alarm.
        step: sampling step [s].

    Attributes:
        limit, step: as given.
    """

    def __init__(self, limit: float, step: float) -> None:
        self.limit, self.step = limit, step

    @abstractmethod
    def find(self, first: int, signal: Array, other: Array) -> Alarm | None:
        """Find the first alarm in a chunk; not called again after an alarm until a reset.

        Args:
            first: index of the chunk's first sample in the run.
            signal: monitored signal, shape (n,); read-only.
            other: second signal, shape (n,); shape (0,) if there is none.
        """


class Plain(Watcher):
    """Adapter of a `PlainMonitor` to the signals of a cell.

    Args:
        name, subject, limit, reaction: attributes of `Watcher`.
        signals: input and field of one or two signals.
        make: factory of the monitor.

    Raises:
        InputError: the name is too long, or the monitor cannot be created.
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
        """Find the first alarm in a chunk that begins at sample ``first``; None if there is none.

        Args:
            first: index of the chunk's first sample in the run.
            inputs: arrays of shape (n,) by field, for each input.

        Raises:
            InputError: the monitor raises an exception or returns an invalid sample.
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
        """Replace the monitor by a new instance."""
        with code_of_others(f"monitor {self.name}"):
            self._monitor = self._make()


def _read_only(signal: Array) -> Array:
    """Return a read-only view of a signal for third-party code."""
    view: Array = signal.view()
    view.flags.writeable = False
    return view


class Clearance:
    """Detector for a tool that has left the part.

    Args:
        beyond: smallest measured position of the drive at which the tool is out of the part [m].
        samples: number of consecutive samples required.

    Attributes:
        memory: state for `lathe_machine.safety.rules.clear`: both arguments, and the number of consecutive samples.
    """

    def __init__(self, beyond: float, samples: int) -> None:
        self.memory = np.array([beyond, samples, 0.0])

    def begin(self) -> None:
        """Restart the detection at the next sample."""
        self.memory[2] = 0.0

    def first(self, position: Array) -> int | None:
        """Find the first sample at which the tool is out of the part; None if there is none."""
        place, self.memory[2] = clear(position, self.memory)
        return place if place >= 0 else None


class Lookout:
    """Set of all rule-based monitors of a cell; the first input is the encoder.

    Args:
        monitors: monitors in the order of their alarms at the same sample; their states move into one shared array.
        numbers: signal numbers for the kernel, by input and field.

    Attributes:
        watch: monitors for `lathe_machine.safety.rules.walk`.
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
        self.watch = MonitorTable(plan, memory, np.zeros(count, np.int64), np.full(count, -1), np.zeros(count))

    def found(self) -> list[tuple[Monitor, Alarm]]:
        """Return the alarms of the last call of `lathe_machine.safety.rules.walk`, in sample order."""
        found = []
        places, values = self.watch.places.tolist(), self.watch.values.tolist()
        for number, (monitor, place, value) in enumerate(zip(self._monitors, places, values, strict=True)):
            if place >= 0:
                self.watch.raised[number] = 1
                found.append((monitor, Alarm(place, value / monitor.rule.unit)))
        return sorted(found, key=lambda one: one[1].place)

    def reset(self) -> None:
        """Reset all monitors, so that they can raise alarms again."""
        self.watch.raised[:] = 0
        for monitor in self._monitors:
            monitor.reset()
