# SPDX-License-Identifier: Apache-2.0
"""Timeline of a run in the panel: extremes of its signals in every revolution, and marks of its events.

The extremes are taken from all samples where these are computed, received or read, not from the snapshots of a page.
"""

import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from typing import Any

import numpy as np

from lathe_live.panel_topics import Topics
from lathe_live.pyramid import MOST_CELLS, Pyramid
from lathe_live.rerun_revolutions import steps_of
from lathe_rc import event_log, messages
from lathe_rc.arrays import Array
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.events import FAULT, FREE, LIMITED, REPAIR, SET, parse
from lathe_rc.errors import InputError
from lathe_rc.messages import Signals
from lathe_rc.safety.state_machine import State

MOST_MARKS = 2**13  #: marks of a run; when it has more, neighbours of a kind are merged
_MOST_CELLS = 4096  # in an answer
_SHOWN_MARKS = 200  # places of marks in an answer
_LARGEST = 1e300  # in place of infinity, which JSON does not know
_UM = 1e6
_RPM = 60.0 / (2.0 * np.pi)
_KINDS = {FAULT: "fault", REPAIR: "fault", SET: "parameter", LIMITED: "limit", FREE: "limit"}  # by verb of an event
_SAMPLE, _STATE, _FORCE, _SPEED = "sample", "state", "force", "speed"  # lanes
_ERROR, _OUT = "error", "out"  # form error with the tool in the part, and after a retraction
_FOLLOWING = "following "  # before the name of a drive


@dataclass(frozen=True)
class Mark:
    """Event on the timeline.

    Attributes:
        turn: spindle angle [revolution].
        sample: its sample.
        kind: ``alarm``, ``state`` (of the supervisor, without an alarm), ``fault``, ``command``, ``parameter``,
            ``limit`` (of a command) or ``lost`` (samples).
        text: description of the event.
        count: number of events of this kind that the mark stands for; the others are later.
    """

    turn: float
    sample: int
    kind: str
    text: str
    count: int = 1


def _merged(marks: Sequence[Mark]) -> Mark:
    return replace(marks[0], count=sum(mark.count for mark in marks))


def _kind(message: Sparse) -> str:
    if message.type == messages.SAFETY_STATUS:
        return "alarm" if message.values["limit"] else "state"
    return _KINDS.get(parse(str(message.values["action"])).verb, "command")


def _text(message: Sparse) -> str:
    return f"{message.topic.strip('/')}: {event_log.text(message)}"


class Timeline:
    """Timeline of one run after the other. The methods may be called by any thread.

    Args:
        topics: topics of the cell.
    """

    def __init__(self, topics: Topics) -> None:
        self._lock = threading.Lock()
        self.begin(topics)

    def begin(self, topics: Topics) -> None:
        """Begin with another run of another cell."""
        with self._lock:
            self._topics, self._lanes = topics, _lanes(topics)
            self._clear()

    def learn(self, topics: Topics) -> None:
        """Go on with further topics of the cell."""
        with self._lock:
            new = [lane for lane in _lanes(topics) if lane not in self._lanes]
            self._topics, self._lanes = topics, [*self._lanes, *new]
            self._pyramid.extend(len(new))

    def clear(self) -> None:
        """Begin with another run of the same cell."""
        with self._lock:
            self._clear()

    def _clear(self) -> None:
        self._pyramid, self._marks = Pyramid(len(self._lanes)), list[Mark]()
        self._begin: int | None = None  # first sample with an angle
        self._end, self._turn = 0, 0.0  # sample after the newest one, and its angle [revolution]
        self._state = np.nan  # of the supervisor

    def chunk(
        self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]], sound: int
    ) -> None:
        """Take consecutive samples, unless they have been taken already.

        Args:
            first: index of the first sample.
            samples: number of samples.
            dense: signals by fully qualified topic; topics may be missing.
            sparse: messages by topic.
            sound: number of samples with a form error.

        Raises:
            LatheError: the angle of the spindle decreases, or increases faster than any spindle.
        """
        with self._lock:
            if samples and first + samples <= self._end:
                return
            told = sorted((m for found in sparse.values() for m in found), key=lambda message: message.index)
            told = [message for message in told if message.type in event_log.LOGGED]
            encoder = dense.get(self._topics.encoder)
            turns = encoder["angle_true"] / (2.0 * np.pi) if encoder else np.empty(0)
            states = self._states(first, samples, dense.get(self._topics.safety), told)
            if turns.size:
                steps_of(turns, first)  # raises
                values = {_SAMPLE: np.arange(first, first + samples, dtype=np.float64), _STATE: states}
                self._put(turns, values | self._measured(dense, states[:sound]))
                self._turn, self._begin = float(turns[-1]), first if self._begin is None else self._begin
            self._end = max(self._end, first + samples)
            for message in told:
                inside = 0 <= message.index - first < turns.size
                turn = float(turns[message.index - first]) if inside else self._turn_of(message.index)
                self._mark(message.index, turn, _kind(message), _text(message))

    def _measured(self, dense: Mapping[str, Signals], states: Array) -> dict[str, Array]:
        """Return the signals of a chunk by lane, in the units of the page; ``states``: where the form is measured."""
        topics, found = self._topics, dict[str, Array]()
        if states.size and (tool := dense.get(topics.tool)):
            error, out = tool["error"][: states.size] * _UM, states >= State.RETRACTING
            found |= {_ERROR: np.where(out, np.nan, error), _OUT: np.where(out, error, np.nan)}
        if cut := dense.get(topics.cut):
            found[_FORCE] = cut["measured_force"]
        for name, (command, state) in topics.followed.items():
            if {command, state} <= dense.keys():
                found[f"{_FOLLOWING}{name}"] = (dense[command]["position"] - dense[state]["position"]) * _UM
        if encoder := dense.get(topics.encoder):
            found[_SPEED] = encoder["speed"] * _RPM
        return found

    def _states(self, first: int, samples: int, safety: Signals | None, told: Sequence[Sparse]) -> Array:
        """Return the state of the supervisor at each sample; NaN: not heard."""
        found = np.full(samples, self._state)
        for message in told:
            if message.type == messages.SAFETY_STATUS:
                self._state = float(message.values["state"])
                found[max(message.index - first, 0) :] = self._state
        return safety["state"].astype(np.float64) if safety else found

    def _put(self, turns: Array, values: Mapping[str, Array]) -> None:
        """Merge the extremes of a chunk's revolutions."""
        numbers = np.floor(turns)
        begins = np.append(0, np.flatnonzero(np.diff(numbers)) + 1)
        bands = np.full((2, begins.size, len(self._lanes)), np.nan)
        for column, lane in enumerate(self._lanes):
            if (signal := values.get(lane)) is not None:
                there = begins[: np.searchsorted(begins, signal.size)]
                for band, extreme in zip(bands, (np.fmin, np.fmax), strict=True):
                    band[: there.size, column] = extreme.reduceat(signal, there)
        self._pyramid.put(int(numbers[0]), *bands)

    def mark(self, sample: int, kind: str, text: str) -> None:
        """Mark an event that no message tells."""
        with self._lock:
            self._mark(sample, self._turn_of(sample), kind, text)

    def _mark(self, sample: int, turn: float, kind: str, text: str) -> None:
        if self._begin is not None and sample < self._begin:
            text = f"before the samples received: {text}"
        self._marks.append(Mark(turn, sample, kind, text[:300]))
        if len(self._marks) > MOST_MARKS:
            ordered = sorted(self._marks, key=lambda mark: (mark.kind, mark.turn))
            found = [list(of_kind) for _, of_kind in groupby(ordered, key=lambda mark: mark.kind)]
            self._marks = [_merged(marks[k : k + 2]) for marks in found for k in range(0, len(marks), 2)]

    def _turn_of(self, sample: int) -> float:
        """Return the angle [revolution] at a sample, or that of the nearest known one."""
        if sample >= self._end or self._pyramid.first is None:
            return self._turn
        found = self._pyramid.bands(self._pyramid.first, int(self._turn), _MOST_CELLS)
        place = self._lanes.index(_SAMPLE)
        known = np.isfinite(found.low[:, place])
        turns = found.first + found.every * np.arange(known.size)
        return float(np.interp(sample, found.low[known, place], turns[known]))

    def last_of(self, turn: int) -> int | None:
        """Return the last sample of a revolution, or of several that are merged; None: not received."""
        with self._lock:
            found = self._pyramid.bands(turn, turn, 1).high
            last = found[0, self._lanes.index(_SAMPLE)] if found.size else np.nan
        return None if np.isnan(last) else int(last)

    # ---- readers ------------------------------------------------------------------------------------

    def shown(self, first: float | None, last: float | None, cells: int) -> dict[str, Any]:
        """Return bands and marks as JSON data.

        Args:
            first: begin of the range [revolution]; None: that of the run.
            last: its end; None: the newest angle.
            cells: largest number of cells, from 1 to 4096.

        Returns:
            ``whole``: first and newest angle [revolution]; ``first`` and ``every`` as `Bands`; ``bands``: smallest and
            largest values by lane, None in a gap; ``marks``: the first of each kind in one of 200 equal parts.
        """
        if not 1 <= cells <= _MOST_CELLS:
            raise InputError(f"cells = {cells}; allowed: from 1 to {_MOST_CELLS}")
        with self._lock:
            whole = [float(self._pyramid.first or 0), self._turn]
            begin, end = (given if given is not None else own for given, own in zip((first, last), whole, strict=True))
            begin, end = (min(max(place, whole[0]), whole[1]) for place in (begin, end))
            bands = self._pyramid.bands(int(begin), int(end), cells)
            marks = [mark for mark in self._marks if begin <= mark.turn <= end + 1.0]
        width = max(end - begin, 1.0) / _SHOWN_MARKS
        marks.sort(key=lambda mark: (mark.kind, mark.turn))
        grouped = groupby(marks, key=lambda mark: (mark.kind, int((mark.turn - begin) / width)))
        lows, highs = (list(map(_plain, side.T, self._lanes)) for side in (bands.low, bands.high))
        return {
            "whole": whole,
            "first": bands.first,
            "every": bands.every,
            "bands": {lane: sides for lane, *sides in zip(self._lanes, lows, highs, strict=True)},
            "marks": [asdict(_merged(list(found))) for _, found in grouped],
        }

    def extreme(self, first: float, last: float, lane: str) -> dict[str, Any]:
        """Return the revolution in which a signal is farthest from its usual value.

        Args:
            first: begin of the range [revolution].
            last: its end.
            lane: the signal.

        Returns:
            ``first`` and ``every`` as `Bands`, of one cell; ``values``: its smallest and largest values by lane.

        Raises:
            InputError: no such signal, or no revolution in this range.
        """
        with self._lock:
            if lane not in self._lanes:
                raise InputError(f"lane = {lane:.80}; allowed: {', '.join(self._lanes)}")
            found = self._pyramid.bands(int(first), int(last), MOST_CELLS)
            column, place = self._lanes.index(lane), self._lanes.index(_SAMPLE)
        received = np.isfinite(found.low[:, place])
        if not received.any():
            raise InputError(f"revolutions {first:.0f} to {last:.0f}; allowed: received ones")
        low, high = found.low[:, column], found.high[:, column]
        known = received & np.isfinite(low)
        usual = np.median((low + high)[known] / 2.0) if known.any() else 0.0
        size = np.where(known, np.maximum(high - usual, usual - low), np.where(received, -1.0, -2.0))
        k = int(size.argmax())
        values = {
            lane: _plain(np.array([found.low[k, j], found.high[k, j]]), lane) for j, lane in enumerate(self._lanes)
        }
        return {"first": found.first + found.every * k, "every": found.every, "values": values}


def _lanes(topics: Topics) -> list[str]:
    """Return the signals of a cell on the timeline."""
    if not topics.encoder:
        return []
    force, error = [_FORCE] if topics.cut else [], [_ERROR, _OUT] if topics.tool else []
    return [_SAMPLE, _STATE, *error, *force, *(f"{_FOLLOWING}{drive}" for drive in topics.followed), _SPEED]


def _plain(values: Array, lane: str) -> list[float | None]:
    """Return numbers of a lane as JSON data; None for NaN."""
    digits = 16 if lane == _SAMPLE else 7
    limited = np.clip(values, -_LARGEST, _LARGEST).tolist()
    return [None if math.isnan(value) else float(f"{value:.{digits}g}") for value in limited]
