# SPDX-License-Identifier: Apache-2.0
"""Conversion of a recorded spindle speed into a tachogram for a speed law."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lathe_rc import messages
from lathe_rc.bag.reading.recorded import Recorded
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.commands import measured
from lathe_rc.errors import InputError
from lathe_rc.messages import Samples
from lathe_rc.signals import tachogram

_RPM = 30.0 / np.pi  # 1 rad/s in revolutions per minute


@dataclass(frozen=True)
class Made:
    """Description of a written tachogram file.

    Attributes:
        points: number of rows of the file.
        samples: number of samples of the recording.
        largest: largest deviation of the file's line segments from the recorded speed [1/min].
        field: encoder field from which the speed was taken.
        standstill: total time at speed 0 [s].
        stands_from: time of the first standstill since sample 0 [s]; None if the spindle turns throughout.
    """

    points: int
    samples: int
    largest: float
    field: str
    standstill: float
    stands_from: float | None


class _Speed(NamedTuple):
    """Recorded speed.

    Attributes:
        signal: name of the signal, as in error messages.
        field: name of its field.
        samples: number of samples.
        step: sampling step [s].
        pieces: yields the first sample of a piece and its speeds [1/min], shape (n,).
    """

    signal: str
    field: str
    samples: int
    step: float
    pieces: Callable[[], Iterator[tuple[int, Samples]]]


def make(bag: Path, output: Path, tolerance: float, topic: str = "", given: Sequence[str] = ()) -> Made:
    """Write a recorded spindle speed to a CSV file, with as few rows as linear interpolation within a tolerance needs.

    Args:
        bag: path of the recording.
        output: path of the CSV file; an existing file is replaced.
        tolerance: largest deviation of the line segments from the recorded speed [1/min].
        topic: topic of the encoder; empty for the bag's only encoder.
        given: ``speed=COLUMN[:UNIT]`` of a bag without an encoder (see `lathe_rc.commands.measured`).

    Raises:
        InputError: the path is not a bag, the bag has no encoder or several, or the output is not writable.
        LatheError: samples are missing or not finite, or the spindle reverses its direction.
    """
    if given and topic:
        raise InputError(f"--topic {topic} beside --column; allowed: one of them")
    if given:
        return _written(bag, _of_column(bag, given), output, tolerance)
    with BagSource(bag) as source:
        return _written(bag, _of_encoder(source, topic), output, tolerance)


def _of_encoder(source: BagSource, topic: str) -> _Speed:
    recorded = Recorded(source, {"encoder": _chosen(source, topic)})
    spindle = recorded.spindle("encoder")
    field = "speed_true" if spindle.has_truth else "speed"
    recorded.refuse_faults([(spindle.topic, field)])

    def pieces() -> Iterator[tuple[int, Samples]]:
        for first, signals in recorded.pieces(spindle.topic, [field]):
            yield first, signals[field] * _RPM

    step = source.step_ns(spindle.topic) * 1e-9
    return _Speed(f"{field} of {spindle.topic}", field, spindle.samples, step, pieces)


def _of_column(bag: Path, given: Sequence[str]) -> _Speed:
    found = measured.opened(bag, given)
    (speed,) = found.read("speed")
    name = found.column("speed")
    return _Speed(name, name, speed.size, found.clock(None, "speed").step, lambda: iter([(0, speed)]))


def _written(bag: Path, recorded: _Speed, output: Path, tolerance: float) -> Made:
    def pieces() -> Iterator[tuple[Samples, Samples]]:
        for first, speed in recorded.pieces():
            yield recorded.step * np.arange(first, first + speed.size), speed

    thinner = tachogram.Thinner(tolerance)
    low, high, still, stands_from = np.inf, 0.0, 0, None
    for time, speed in pieces():
        thinner.add(time, speed)
        stands = speed == 0.0
        still += int(np.count_nonzero(stands))
        if stands_from is None and still:
            stands_from = float(time[np.argmax(stands)])
        low, high = min(low, float(speed.min())), max(high, float(speed.max()))
    if low < 0.0 or high == 0.0:
        raise InputError(
            f"{bag}: {recorded.signal} from {low:.4g} to {high:.4g} rpm; allowed: a spindle that turns, and forward"
        )
    time, rpm = thinner.finish()
    largest = max(float(np.abs(np.interp(t, time, rpm) - speed).max()) for t, speed in pieces())
    tachogram.write(output, time, rpm, f"{recorded.signal} in {bag.name}, within {tolerance:g} rpm")
    return Made(time.size, recorded.samples, largest, recorded.field, still * recorded.step, stands_from)


def _chosen(source: BagSource, topic: str) -> str:
    """Return the topic of the encoder."""
    found = sorted(t for t, said in source.topics.items() if said.type == messages.ENCODER and said.count)
    if topic and topic not in found:
        raise InputError(f"--topic {topic}: {source.path} has no such encoder; allowed: {', '.join(found) or 'none'}")
    if not topic and not found:
        raise measured.opened(source.path, ()).lacking("an encoder, or speed")
    if not topic and len(found) != 1:
        raise InputError(f"{source.path}: {len(found)} encoders ({', '.join(found)}); allowed: one, or --topic TOPIC")
    return topic or found[0]
