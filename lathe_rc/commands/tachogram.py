# SPDX-License-Identifier: Apache-2.0
"""Conversion of a recorded spindle speed into a tachogram for a speed law."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lathe_rc import messages
from lathe_rc.bag.reading.recorded import Recorded
from lathe_rc.bag.reading.source import Source
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


def make(bag: Path, output: Path, tolerance: float, topic: str = "") -> Made:
    """Write a recorded spindle speed to a CSV file, with as few rows as linear interpolation within a tolerance needs.

    Args:
        bag: path of the recording.
        output: path of the CSV file; an existing file is replaced.
        tolerance: largest deviation of the line segments from the recorded speed [1/min].
        topic: topic of the encoder; empty for the bag's only encoder.

    Raises:
        InputError: the path is not a bag, the bag has no encoder or several, or the output is not writable.
        LatheError: samples are missing or not finite, or the spindle reverses its direction.
    """
    with Source(bag) as source:
        recorded = Recorded(source, {"encoder": _chosen(source, topic)})
        spindle = recorded.spindle("encoder")
        field = "speed_true" if spindle.has_truth else "speed"
        recorded.refuse_faults([(spindle.topic, field)])
        step = source.step_ns(spindle.topic) * 1e-9

        def pieces() -> Iterator[tuple[Samples, Samples]]:
            for first, signals in recorded.pieces(spindle.topic, [field]):
                speed = signals[field] * _RPM
                yield step * np.arange(first, first + speed.size), speed

        low, high = spindle.speed
        if low < 0.0 or high == 0.0:
            raise InputError(
                f"{bag}: {spindle.topic}: {field} from {low * _RPM:.4g} to {high * _RPM:.4g} rpm; allowed: a spindle "
                "that turns, and forward"
            )
        thinner = tachogram.Thinner(tolerance)
        still, stands_from = 0, None
        for time, speed in pieces():
            thinner.add(time, speed)
            stands = speed == 0.0
            still += int(np.count_nonzero(stands))
            if stands_from is None and still:
                stands_from = float(time[np.argmax(stands)])
        time, rpm = thinner.finish()
        largest = max(float(np.abs(np.interp(t, time, rpm) - speed).max()) for t, speed in pieces())
    tachogram.write(output, time, rpm, f"{field} of {spindle.topic} in {bag.name}, within {tolerance:g} rpm")
    return Made(time.size, spindle.samples, largest, field, still * step, stands_from)


def _chosen(source: Source, topic: str) -> str:
    """Return the topic of the encoder."""
    found = sorted(t for t, said in source.topics.items() if said.type == messages.ENCODER and said.count)
    if topic and topic not in found:
        raise InputError(f"--topic {topic}: {source.path} has no such encoder; allowed: {', '.join(found) or 'none'}")
    if not topic and len(found) != 1:
        raise InputError(
            f"{source.path}: {len(found)} encoders ({', '.join(found) or 'none'}); allowed: one, or --topic TOPIC"
        )
    return topic or found[0]
