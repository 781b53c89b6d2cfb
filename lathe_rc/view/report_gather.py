# SPDX-License-Identifier: Apache-2.0
"""Data of a report, gathered in one pass over the bag.

Memory use grows by some 32 bytes per revolution, and by 8 bytes per report of the time master.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lathe_rc import event_log, messages
from lathe_rc.bag import provenance
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.bag.reading.storage import Batch
from lathe_rc.bag.reading.stream import Feeder, first_of
from lathe_rc.bag.snapshot import span_of
from lathe_rc.blocks.ports import Sparse
from lathe_rc.blocks.wire import Decoder
from lathe_rc.cell.judged import Judged
from lathe_rc.cell.parameters import Value
from lathe_rc.errors import InputError, LatheError
from lathe_rc.event_log import LOGGED, LogEntry
from lathe_rc.judge import part
from lathe_rc.judge.loops import loops, watches
from lathe_rc.messages import Samples, Signals
from lathe_rc.view.report_form import FormByRevolution
from lathe_rc.view.report_host import TYPES as HOST_TYPES
from lathe_rc.view.report_host import Host
from lathe_rc.view.report_series import Envelope
from lathe_rc.view.report_servo import Servo

_MOST_OF_A_TYPE = 4  # largest number of topics of a type that have figures
_MOST_EVENTS = 100
_PIECE = 65536  # samples per chunk
#: Fields plotted over time, and fields plotted over cycles, by message type.
_CURVES = ((messages.ENCODER, "speed_true"), (messages.CUT, "force"), (messages.CUT, "wear"))
_CYCLES = ((messages.LEARNING, "rms_error"), (messages.PERIODIC, "max_error"))


@dataclass
class Tally:
    """Message counts of a topic.

    Attributes:
        type: message type.
        count, size: number of messages, and their total size [B].
        first_ns, last_ns: first and last log time [ns].
        open_end: the topic has no block that is marked as the last of the run.
    """

    type: str
    count: int = 0
    size: int = 0
    first_ns: int = 0
    last_ns: int = 0
    open_end: bool = False

    def add(self, found: Batch) -> None:
        """Add messages of the topic, at least one."""
        self.first_ns = self.first_ns if self.count else int(found.places[0, 1])
        self.count, self.last_ns = self.count + len(found), int(found.places[-1, 1])
        self.size += int((found.places[:, 3] - found.places[:, 2]).sum())

    @property
    def rate(self) -> float:
        """Return the number of messages per simulated second; NaN for a time span of zero."""
        span = self.last_ns - self.first_ns
        return (self.count - 1) / (span * 1e-9) if span > 0 else np.nan


@dataclass
class EventKind:
    """Events of a topic with the same text up to a colon, or an alarm's with the same monitor and subject.

    Attributes:
        topic, text: topic and text of the first event.
        alarm: the event is a supervisor's, and the cell is not in its nominal state.
        first, last: samples of the first and the last event.
        count: number of events.
    """

    topic: str
    text: str
    alarm: bool
    first: int
    last: int = 0
    count: int = 0


class Curves:
    """Plotted signals and cycles of a bag; a sink (see `lathe_rc.cell.engine.Sink`).

    Attributes:
        signals: envelope by topic and field.
        cycles: envelope of a controller's result in each cycle, by topic and field.
        events: the first events; ``event_count`` counts all.
        kinds: the first kinds of events, by topic and common text.
    """

    def __init__(self, types: Mapping[str, str]) -> None:
        self._types = types
        self.signals = {(topic, name): Envelope() for kind, name in _CURVES for topic in of_type(types, kind)}
        self.cycles = {(topic, name): Envelope() for kind, name in _CYCLES for topic in of_type(types, kind)}
        self.events: list[LogEntry] = []
        self.event_count = 0
        self.kinds: dict[tuple[str, str], EventKind] = {}

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Add consecutive samples and the messages among them."""
        for (topic, name), envelope in self.signals.items():
            envelope.add(dense[topic][name])
        for (topic, name), envelope in self.cycles.items():
            envelope.add(np.array([message.values[name] for message in sparse.get(topic, [])], dtype=float))
        for topic, found in sparse.items():
            for event in found if self._types[topic] in LOGGED else ():
                self.event_count += 1
                text, alarm = event_log.text(event), bool(event.values.get("state"))
                if len(self.events) < _MOST_EVENTS:
                    self.events.append(LogEntry(event.index, topic, text))
                # For an alarm: monitor and subject, which precede the finding.
                key = topic, " ".join(text.split()[:2]) if alarm else text.partition(":")[0]
                if key not in self.kinds and len(self.kinds) < _MOST_EVENTS:
                    self.kinds[key] = EventKind(topic, text, alarm, event.index)
                if kind := self.kinds.get(key):
                    kind.last = event.index
                    kind.count += 1


def of_type(types: Mapping[str, str], kind: str) -> list[str]:
    """Return the first topics of a message type."""
    return [topic for topic, given in sorted(types.items()) if given == kind][:_MOST_OF_A_TYPE]


@dataclass
class Gathered:
    """Data of a bag for its report.

    Attributes:
        about: metadata of the bag.
        topics: message counts by topic.
        samples: number of samples of every dense topic.
        step_ns: sampling step [ns].
        run_id: identity of the run.
        forms: form error of each tool.
        servos: force and position loops.
        curves: signals and cycles.
        host: data of the host topics.
        stopped: reason why the bag was not read to its end; empty if it was.
        nodes: unchecked values of the bag's scenario by node and parameter; empty without a scenario.
        unjudged: reason why the scenario, and thus the tolerance, is unknown; empty if the scenario is known.
    """

    about: Mapping[str, str]
    topics: dict[str, Tally]
    forms: list[FormByRevolution]
    curves: Curves
    servos: list[Servo] = field(default_factory=list)
    host: Host = field(default_factory=Host)
    samples: int = 0
    step_ns: int = 0
    run_id: str = ""
    stopped: str = ""
    nodes: Mapping[str, Mapping[str, Value]] = field(default_factory=dict)
    unjudged: str = ""

    @property
    def complete(self) -> bool:
        """Return True if the whole bag was read and each dense topic ends with the run, or with the snapshot."""
        dense = [tally for tally in self.topics.values() if tally.type in messages.block_types()]
        snapshot = span_of(self.about)
        ends = 0 < snapshot[1] == self.samples if snapshot else not any(tally.open_end for tally in dense)
        return bool(dense) and not self.stopped and ends

    @property
    def is_lossy(self) -> bool:
        """Return True if reading stopped, or if the recording of a cell is incomplete."""
        return bool(self.stopped) or (self.samples > 0 and not self.complete)

    @property
    def doubt(self) -> str:
        """Reason why the run cannot be judged to its end, or held samples are in it; empty without one."""
        lost = (
            f"{name} lost {count} blocks, and held the sample before" for name, count in self.host.lost_blocks.items()
        )
        return self.stopped or "; ".join(lost)

    def has(self, kind: str) -> bool:
        """Return True if the bag has messages of a type."""
        return any(tally.count for tally in self.topics.values() if tally.type == kind)

    @property
    def missing(self) -> str:
        """Name the topics that the bag lacks: encoder, tool or both."""
        kinds = {tally.type for tally in self.topics.values()}
        named = {"encoder": messages.ENCODER, "tool": messages.TOOL}
        return f"the bag has no {' and no '.join(name for name, kind in named.items() if kind not in kinds)}"

    @property
    def seconds(self) -> float:
        """Return the simulated time [s]."""
        return self.samples * self.step_ns * 1e-9

    def at(self, place: Samples) -> Samples:
        """Return the times of samples since sample 0 [s]."""
        return place * (self.step_ns * 1e-9)


def gather(path: Path) -> Gathered:
    """Gather the data of a bag in one pass.

    Raises:
        InputError: not a bag.
    """
    with BagSource(path) as source:
        types = {topic: found.type for topic, found in source.topics.items()}
        nodes, declared, unjudged = {}, dict[str, Judged](), ""
        try:
            nodes = provenance.values_of(source.about)
            declared = provenance.judged(source.about)
        except InputError as error:
            unjudged = str(error)
        nose, doubt = part.nose_radius(declared), provenance.doubt_of(source.about)
        forms = [
            FormByRevolution(encoder, tool, part.Tolerances.of(declared, tool, doubt), nose, types)
            for encoder in of_type(types, messages.ENCODER)[:1]
            for tool in of_type(types, messages.TOOL)
        ]
        tallies = {topic: Tally(kind) for topic, kind in sorted(types.items())}
        servos = [Servo(watch) for watch in watches(loops(declared), types)]
        gathered = Gathered(source.about, tallies, forms, Curves(types), servos, nodes=nodes, unjudged=unjudged)
        first = first_of(source)
        feeder = Feeder(types, [*forms, *servos, gathered.curves], _PIECE, first, source.loss)
        try:
            _feed(source, feeder, gathered)
        except LatheError as error:
            gathered.stopped = str(error)
        for form in forms:
            form.finish()
        gathered.samples, gathered.step_ns, gathered.run_id = feeder.first - first, feeder.step_ns, feeder.run_id
    return gathered


def _feed(source: BagSource, feeder: Feeder, gathered: Gathered) -> None:
    """Count every message, and pass it to the feeder or to the host data."""
    newest: dict[str, bytes] = {}
    host = {topic for topic, tally in gathered.topics.items() if tally.type in HOST_TYPES}
    for batch in source.batches():
        for topic in dict.fromkeys(batch.topics.values()):
            if found := batch.only({topic}):
                gathered.topics[topic].add(found)
                begin, end = found.places[-1, 2:].tolist()
                newest[topic] = found.whole[begin:end]
        for topic, _, data in batch.only(host):
            gathered.host.add(gathered.topics[topic].type, data)
        feeder.add(batch)
    left = feeder.finish()
    if left:
        gathered.stopped = f"some topics have {left} samples more than others"
    if source.loss:
        gathered.stopped = str(source.loss)
    for topic, tally in gathered.topics.items():
        if tally.type in messages.block_types():
            tally.open_end = topic not in newest or not Decoder(tally.type).decode(newest[topic]).last
