# SPDX-License-Identifier: Apache-2.0
"""Kinds of faults of devices and lines, and their effects on signals.

A fault is written ``TARGET KIND NAME=VALUE ...``, like ``coarse/state.measured_position wrong scale=1.1``. The target
is ``TOPIC.FIELD`` of a port, ``TOPIC`` if the fault concerns several fields, or the broken device itself.

A fault changes samples one by one, starting at its first sample, and depends only on the samples since then and the
seed, so results are bit-identical for all block lengths. Times are in s, all other values in the unit of the signal.
"""

import math
import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError, shown
from lathe_rc.messages import Signals

_TURN = 2.0 * np.pi
_LARGEST = 1e100  # far larger than any physical value, with finite products
_LONGEST = 200  # largest number of characters of a fault, to fit into an event
_VALUE = re.compile(r"(\w+)=(\S+)")


@dataclass(frozen=True)
class Value:
    """Numeric parameter of a kind of fault.

    Attributes:
        doc: description of the parameter.
        unit: unit of the parameter; "" for the unit of the signal.
        default: default value; None for a required parameter.
        low: lower limit.
        above: whether ``low`` itself is excluded.
        below: upper limit, itself excluded.
    """

    doc: str
    unit: str = ""
    default: float | None = None
    low: float = -math.inf
    above: bool = False
    below: float = math.inf

    def takes(self, value: float) -> bool:
        """Return whether ``value`` is within the allowed range."""
        return abs(value) <= _LARGEST and (value > self.low if self.above else value >= self.low) and value < self.below


@dataclass(frozen=True)
class Kind:
    """Kind of fault with its parameters and possible targets.

    Attributes:
        doc: effect on the signal.
        values: parameters by name.
        what: kind of target: ``field``: any field of a port; ``encoder``: angle, speed and index pulse together;
            ``cut``: the cutting process itself.
        whole: whether integer fields can have the fault as well.
    """

    doc: str
    values: Mapping[str, Value]
    what: str = "field"
    whole: bool = False


_LATEST = 10.0  # upper limit of a delay [s], since the delayed samples are stored
KINDS: Mapping[str, Kind] = {
    "off": Kind("0, as from an unpowered device", {}, whole=True),
    "stuck": Kind("the first sample is held", {}, whole=True),
    "garbage": Kind(
        "random numbers, uniform between ± the amplitude", {"amplitude": Value("largest magnitude", low=0.0)}
    ),
    "wrong": Kind(
        "scale · signal + offset",
        {"scale": Value("factor", "1", 1.0), "offset": Value("added constant", "", 0.0)},
    ),
    "slow": Kind("passes a first-order lag", {"time": Value("time constant", "s", low=0.0, above=True)}),
    "delayed": Kind(
        "delayed; the first sample is held until then",
        {"time": Value("delay", "s", low=0.0, above=True, below=_LATEST)},
    ),
    "intermittent": Kind(
        "0 in intervals of random length, as with a loose contact; begins with an interval with signal",
        {
            "good": Value("mean length of the intervals with signal", "s", low=0.0, above=True),
            "off": Value("mean length of the intervals without signal", "s", low=0.0, above=True),
        },
    ),
    "noisy": Kind("white noise is added", {"rms": Value("RMS of the noise", low=0.0)}),
    "missed_index": Kind("no index pulses", {}, what="encoder"),
    "lost_counts": Kind(
        "the measured angle loses counts, immediately and after every whole revolution from then on",
        {"angle": Value("angle lost each time", "rad", low=0.0, above=True)},
        what="encoder",
    ),
    "reversed": Kind("the measured angle runs backwards, as with tracks A and B swapped", {}, what="encoder"),
    "tool_broken": Kind("the edge is shorter", {"length": Value("length broken off", "m", low=0.0)}, what="cut"),
    "hard_spot": Kind(
        "harder material in a part of each revolution",
        {
            "factor": Value("multiplier of the specific force", "1", low=0.0),
            "start": Value("start angle", "rad", 0.0),
            "width": Value("angular width", "rad", math.pi, low=0.0, above=True, below=_TURN),
        },
        what="cut",
    ),
}


@dataclass(frozen=True)
class Fault:
    """Fault requested for a target.

    Attributes:
        target: ``TOPIC.FIELD``, ``TOPIC`` or device that is faulty.
        kind: kind of fault, a key of `KINDS`.
        values: all parameters of the kind, by name.
    """

    target: str
    kind: str
    values: Mapping[str, float]

    @property
    def text(self) -> str:
        """Fault in the form ``TARGET KIND NAME=VALUE ...``."""
        given = [f"{name}={value!r}" for name, value in self.values.items()]
        return " ".join([self.target, self.kind, *given])


def parse(text: str, whose: str, *, what: str = "fault") -> Fault:
    """Parse a fault in the form ``TARGET KIND NAME=VALUE ...``.

    Args:
        text: fault to parse.
        whose: name of the node for error messages.
        what: name of the request for error messages.

    Raises:
        InputError: the kind or a parameter is unknown, or a parameter is missing, duplicate or out of range.
    """
    if len(text) > _LONGEST:
        raise InputError(f"{whose}: a {what} of {len(text)} characters; allowed: up to {_LONGEST}")
    target, _, rest = text.strip().partition(" ")
    name, _, rest = rest.strip().partition(" ")
    kind = KINDS.get(name)
    if kind is None:
        known = ", ".join(KINDS)
        raise InputError(f"{whose}: {what} {text!r}; allowed: TARGET KIND NAME=VALUE ..., KIND one of {known}")
    given: dict[str, float] = {}
    for part in rest.split():
        match = _VALUE.fullmatch(part)
        key = match[1] if match else part
        try:
            number = float(match[2]) if match else math.nan
        except ValueError:
            number = math.nan
        if key not in kind.values or key in given or not kind.values[key].takes(number):
            raise InputError(f"{whose}: {what} {text!r}: {shown(part)}; allowed: {_allowed(kind)}")
        given[key] = number
    missing = [key for key, value in kind.values.items() if value.default is None and key not in given]
    if missing:
        raise InputError(f"{whose}: {what} {text!r}: no {missing[0]}; allowed: {_allowed(kind)}")
    # In the order of the table, so that equal faults have equal strings.
    values = {key: given.get(key, value.default or 0.0) for key, value in kind.values.items()}
    return Fault(target, name, values)


def _allowed(kind: Kind) -> str:
    """Describe the allowed parameters of a kind for error messages."""
    words = []
    for name, value in kind.values.items():
        low = "" if value.low == -math.inf else f" {'above' if value.above else 'from'} {value.low:g}"
        high = (
            f" up to {_LARGEST:g}{'' if low else ' in size'}"
            if value.below == math.inf
            else f" below {value.below:.4g}"
        )
        words.append(f"{name}= a number{low}{high}{f' [{value.unit}]' if value.unit not in ('', '1') else ''}")
    return "each once: " + ", ".join(words) if words else "no values"


# ---- effects on samples -------------------------------------------------------------------------------------


@dataclass(init=False, eq=False)  # a class of data, so that checkpoints keep it
class Disturbance:
    """Effect of a fault on the samples of a port, during the fault and after its end.

    Args:
        fault: fault with its parameters.
        seed: seed of the cell.
        step: sampling step [s].
        whose: name of the node, for an independent random sequence.
    """

    def __init__(self, fault: Fault, *, seed: int, step: float, whose: str) -> None:
        self._field, self._step = fault.target.rpartition(".")[2], step
        self._values = dict(fault.values)
        # Not hash(), whose result differs between processes.
        entropy = [seed, zlib.crc32(f"{whose} {fault.text}".encode())]
        self._random = np.random.default_rng(np.random.SeedSequence(entropy))

    def during(self, signals: Signals) -> None:
        """Change samples in place during the fault; called in sample order with arrays of shape (n,), n above 0."""
        self.change(signals[self._field])

    def change(self, signal: Array) -> None:
        """Change the samples of the faulty field in place; kinds with several fields override `during` instead."""
        raise NotImplementedError

    def after(self, signals: Signals) -> None:
        """Change samples in place after the end of the fault; no change by default."""


class _Off(Disturbance):
    def change(self, signal: Array) -> None:
        signal[:] = 0


class _Stuck(Disturbance):
    _kept: float | None = None

    def change(self, signal: Array) -> None:
        if self._kept is None:
            self._kept = signal[0]
        signal[:] = self._kept


class _Garbage(Disturbance):
    def change(self, signal: Array) -> None:
        amplitude = self._values["amplitude"]
        signal[:] = self._random.uniform(-amplitude, amplitude, signal.size)


class _Wrong(Disturbance):
    def change(self, signal: Array) -> None:
        signal *= self._values["scale"]
        signal += self._values["offset"]


class _Slow(Disturbance):
    _state: Array | None = None

    def change(self, signal: Array) -> None:
        pole = math.exp(-self._step / self._values["time"])
        if self._state is None:  # at rest at the first sample, so that there is no jump
            self._state = np.array([pole * signal[0]])
        signal[:], self._state = scipy.signal.lfilter([1.0 - pole], [1.0, -pole], signal, zi=self._state)


class _Delayed(Disturbance):
    _line: Array | None = None

    def change(self, signal: Array) -> None:
        if self._line is None:
            self._line = np.full(max(1, round(self._values["time"] / self._step)), signal[0])
        whole = np.concatenate((self._line, signal))
        signal[:], self._line = whole[: signal.size], whole[signal.size :]


class _Intermittent(Disturbance):
    _dead, _left = True, 0  # whether the contact is open, and number of samples until it changes

    def change(self, signal: Array) -> None:
        place = 0
        while place < signal.size:
            if not self._left:
                self._dead = not self._dead
                mean = self._values["off" if self._dead else "good"] / self._step
                # Rounded up: an interval without samples could make the loop endless.
                self._left = math.ceil(self._random.exponential(mean))
            stop = min(place + self._left, signal.size)
            if self._dead:
                signal[place:stop] = 0
            self._left -= stop - place
            place = stop


class _Noisy(Disturbance):
    def change(self, signal: Array) -> None:
        signal += self._values["rms"] * self._random.standard_normal(signal.size)


class _MissedIndex(Disturbance):
    def during(self, signals: Signals) -> None:
        signals["index_pulse"][:] = 0


class _LostCounts(Disturbance):
    _start: float | None = None
    _lost = 0.0

    def during(self, signals: Signals) -> None:
        angle = signals["angle"]
        if self._start is None:
            self._start = float(angle[0])
        lost = self._values["angle"] * (np.floor((angle - self._start) / _TURN) + 1.0)
        self._lost = float(lost[-1])
        angle -= lost

    def after(self, signals: Signals) -> None:
        signals["angle"] -= self._lost


class _Reversed(Disturbance):
    _start: float | None = None
    _turned = 0.0

    def during(self, signals: Signals) -> None:
        angle = signals["angle"]
        if self._start is None:
            self._start = float(angle[0])
        self._turned = float(angle[-1]) - self._start
        angle[:] = 2.0 * self._start - angle
        signals["speed"] *= -1.0

    def after(self, signals: Signals) -> None:
        signals["angle"] -= 2.0 * self._turned


#: effects of the faults at ports, by kind; the cutting process implements the faults of the cut
DISTURBANCES: Mapping[str, type[Disturbance]] = {
    "off": _Off,
    "stuck": _Stuck,
    "garbage": _Garbage,
    "wrong": _Wrong,
    "slow": _Slow,
    "delayed": _Delayed,
    "intermittent": _Intermittent,
    "noisy": _Noisy,
    "missed_index": _MissedIndex,
    "lost_counts": _LostCounts,
    "reversed": _Reversed,
}


def prepare() -> None:
    """Import the SciPy module used by faults in advance, since an import at the first fault would stall a run."""
    scipy.signal.lfilter([1.0], [1.0], np.zeros(1))
