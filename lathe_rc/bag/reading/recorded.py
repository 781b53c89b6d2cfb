# SPDX-License-Identifier: Apache-2.0
"""Dense topics of a bag under the topic names of a cell, validated as they are read; some may be missing."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile

import numpy as np

from lathe_rc import messages
from lathe_rc.bag import provenance
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.bag.reading.stream import check_next
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.soundness import refuse_faults
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.messages import Samples, Signals


@dataclass(frozen=True)
class Spindle:
    """Range and length of a recorded spindle motion.

    Attributes:
        topic: topic of the encoder in the bag.
        samples: number of samples recorded.
        has_truth: whether the true angle was recorded; otherwise the measured angle is used.
        speed: lowest and highest speed [rad/s].
        turns: angle of the complete revolutions before sample 0 [rad].
    """

    topic: str
    samples: int
    has_truth: bool
    speed: tuple[float, float]
    turns: float

    @property
    def angle(self) -> str:
        """Name of the field that contains the workpiece angle."""
        return "angle_true" if self.has_truth else "angle"


class Recorded:
    """Recorded topics of a bag, looked up by a cell's relative topics.

    Args:
        source: the open bag.
        names: the bag's topics by the cell's relative topics, where they differ by more than a leading slash.

    Attributes:
        source: see the arguments.
        path: path of the bag.
        namespace: namespace of the recorded cell; empty if the cell had none.

    Raises:
        InputError: ``names`` refers to a topic that the bag does not have.
    """

    def __init__(self, source: BagSource, names: Mapping[str, str]) -> None:
        self.path, self.namespace = source.path, provenance.namespace(source.about)
        self.source, self._names = source, dict(names)
        for name, topic in names.items():
            if topic not in source.topics:
                raise InputError(f"--topic {name}={topic}: {self.path} has no such topic; it has {self.holdings()}")

    def holdings(self) -> str:
        """Return the dense topics of the bag as readable text."""
        found = {t: said for t, said in self.source.topics.items() if said.type in messages.block_types()}
        told = [f"{topic} ({said.type.rpartition('/')[2]})" for topic, said in sorted(found.items()) if said.count]
        return ", ".join(told) or "no topic with blocks of lathe_rc_msgs"

    def check_names(self, known: Sequence[str]) -> None:
        """Reject topic names that the cell does not have.

        Raises:
            InputError: one of `names` is not among ``known``.
        """
        for name, topic in self._names.items():
            if name not in known:
                raise InputError(f"--topic {name}={topic}: the cell has no {name}; allowed: {', '.join(sorted(known))}")

    def find(self, name: str, msgtype: str) -> str | None:
        """Return the bag's topic for a relative topic of the cell; None if the bag has no messages on that topic.

        Raises:
            InputError: the topic has another type.
        """
        topic = self._names.get(name, self.namespace + messages.full(name))
        said = self.source.topics.get(topic)
        if said is None or not said.count:
            return None
        if said.type != msgtype:
            raise InputError(f"{self.path}: {topic} is {said.type}; allowed: {msgtype} (--topic {name}=/TOPIC)")
        return topic

    def lacks(self, name: str, msgtype: str) -> str:
        """Describe a missing topic, listing the bag's topics of the same type."""
        others = [t for t, said in sorted(self.source.topics.items()) if said.type == msgtype and said.count]
        options = " or ".join(f"--topic {name}={topic}" for topic in others or ["/TOPIC"])
        return f"{msgtype.rpartition('/')[2]} on {messages.full(name)} (or {options})"

    def pieces(self, topic: str, fields: Sequence[str]) -> Iterator[tuple[int, Signals]]:
        """Yield the first sample and the requested fields of each block, as arrays of shape (n,).

        Raises:
            LatheError: samples are missing or repeated, the step changes, or a number is not finite.
        """
        end, step_ns = 0, 0
        for block in self.source.blocks(topic):
            where = f"{self.path}: {topic}"
            check_next(where, block, end, step_ns)
            if not block.step_ns:
                raise LatheError(f"{where}: the step is 0 ns at sample {end}")
            for name in fields:
                wrong = np.flatnonzero(~np.isfinite(block.signals[name]))
                if wrong.size:
                    value, place = block.signals[name][wrong[0]], end + wrong[0]
                    raise LatheError(f"{where}: {name} = {value} at sample {place}; allowed: finite numbers")
            yield end, {name: block.signals[name] for name in fields}
            end, step_ns = end + block.samples, block.step_ns
        if not end:
            raise LatheError(f"{self.path}: {topic} has no block, though the bag counts some")

    def whole(self, fields: Sequence[tuple[str, str]], most: int | None = None) -> list[Samples]:
        """Return the samples of some topics and fields, all or at most the first ``most``, shape (n,) each.

        The arrays end together: a run that was stopped may lack the last blocks of one topic.

        Raises:
            InputError: a signal has a fault.
            LatheError: see `pieces`.
        """
        self.refuse_faults(fields)
        arrays = []
        for topic, field in fields:
            pieces = self.pieces(topic, [field])
            found = [signals[field] for _, signals in takewhile(lambda p: most is None or p[0] < most, pieces)]
            arrays.append(np.concatenate(found)[:most])
        common = min(array.size for array in arrays)
        return [array[:common] for array in arrays]

    def refuse_faults(self, fields: Sequence[tuple[str, str]]) -> None:
        """Refuse signals, by topic and field, that have a fault according to the events in the bag.

        Raises:
            InputError: a signal has a fault.
        """
        events: dict[str, list[Sparse]] = {}
        topics = {topic for topic, said in self.source.topics.items() if said.type == messages.EVENT}
        for topic, _, data in self.source.messages(topics) if topics else ():
            try:
                values = messages.values_of(messages.EVENT, data)
            except ValueError as error:
                raise LatheError(f"{self.path}: {topic}: {shown(error)}") from None
            events.setdefault(topic, []).append(Sparse(topic, messages.EVENT, values["sample_index"], values))
        refuse_faults([f"{topic}.{field}" for topic, field in fields], events, self.path)

    def length(self, topic: str, field: str) -> int:
        """Return the number of samples of a topic, after validating all of them.

        Raises:
            LatheError: see `pieces`.
        """
        return sum(signals[field].size for _, signals in self.pieces(topic, [field]))

    def spindle(self, name: str) -> Spindle:
        """Return the range and length of the recorded spindle motion, after validating all samples.

        Args:
            name: the encoder's relative topic in the cell.

        Raises:
            InputError: the bag has no encoder topic.
            LatheError: see `pieces`; or the angle decreases or jumps.
        """
        topic = self.find(name, messages.ENCODER)
        if topic is None:
            raise InputError(
                f"{self.path}: no encoder, and a re-simulation needs the recorded spindle: "
                f"{self.lacks(name, messages.ENCODER)}; the bag has {self.holdings()}"
            )
        fields = ["angle", "speed", "angle_true", "speed_true"]
        # The topic is read twice, since hours of spindle motion would take gigabytes of memory.
        has_truth = any(np.any(signals["angle_true"]) for _, signals in self.pieces(topic, fields))
        angle, speed = ("angle_true", "speed_true") if has_truth else ("angle", "speed")
        low, high, last, samples = np.inf, -np.inf, np.nan, 0
        start = 0.0
        for first, signals in self.pieces(topic, fields):
            if not first:
                start = last = float(signals[angle][0])
            advance = np.diff(signals[angle], prepend=last)
            wrong = np.flatnonzero((advance < 0.0) | (advance > np.pi))
            if wrong.size:
                raise LatheError(
                    f"{self.path}: {topic}: {angle} goes by {advance[wrong[0]]:.4g} rad at sample {first + wrong[0]}; "
                    "allowed: 0 up to half a turn: a spindle that turns one way, its angle unwrapped"
                )
            low, high = min(low, float(signals[speed].min())), max(high, float(signals[speed].max()))
            last, samples = float(signals[angle][-1]), first + signals[angle].size
        turns = 2.0 * np.pi * np.floor(start / (2.0 * np.pi))
        return Spindle(topic, samples, has_truth, (low, high), float(turns))
