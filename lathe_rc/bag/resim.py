# SPDX-License-Identifier: Apache-2.0
"""Re-simulation: what the spindle did is taken from a bag, everything behind it computes again.

With nothing changed every bit must come out as it was recorded. With another controller the run shows what that
controller would have made of the same spindle, disturbances and form.
"""

import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

from lathe_rc.bag import check, story
from lathe_rc.bag.record import OfflineRecorder, begin
from lathe_rc.bag.source import Source
from lathe_rc.bag.stream import Tape, feed
from lathe_rc.bag.writer import refuse_existing
from lathe_rc.cell import messages, ros_yaml
from lathe_rc.cell.engine import Engine, Sink
from lathe_rc.cell.messages import Samples, Signals
from lathe_rc.cell.parameters import SharedParameters
from lathe_rc.cell.recording import Digester, SparseTopic
from lathe_rc.cell.scenario import TABLES, Scenario, kind_of
from lathe_rc.cell.stage import Sparse
from lathe_rc.cell.stages.spindle_encoder import SpindleEncoder
from lathe_rc.cell.wiring import Cell, remapped
from lathe_rc.errors import InputError, LatheError
from lathe_rc.part import ErrorsByRevolution


@dataclass(frozen=True)
class Resimulation:
    """What a re-simulation gave.

    Attributes:
        scenario: what ran.
        changed: whether it is another than that of the bag.
        samples: length of the run.
        wall_s: it took [s].
        digest: of each signal topic.
        recorded: the same of the bag; empty if the recording is not complete.
        rms: form error by revolution [m], shape (revolutions,); empty without a tool.
        recorded_rms: the same of the bag.
    """

    scenario: Scenario
    changed: bool
    samples: int
    wall_s: float
    digest: Mapping[str, str]
    recorded: Mapping[str, str]
    rms: Samples = field(repr=False)
    recorded_rms: Samples = field(repr=False)

    @property
    def different(self) -> list[str]:
        """Topics that are not as they were recorded."""
        topics = sorted({*self.digest, *self.recorded})
        return [topic for topic in topics if self.digest.get(topic) != self.recorded.get(topic)]

    @property
    def simulated_s(self) -> float:
        """Simulated time [s]."""
        return self.samples * self.scenario.shared.step


class _PlayedSpindle(SpindleEncoder):
    """The spindle as it was recorded."""

    def __init__(self, made: SpindleEncoder, tape: Tape, samples: int) -> None:
        super().__init__(made.name, made.parameters)
        self._tape, self.samples = tape, samples

    def process(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> list[Sparse]:
        """See `Stage`."""
        (signals,) = outputs
        for name, array in self._tape.take(next(iter(signals.values())).size).items():
            signals[name][:] = array
        return []


class _Digests:
    """Digests of an offline run, its topics made fully qualified; a sink."""

    def __init__(self, cell: Cell) -> None:
        self._step_ns = cell.master.shared.step_ns
        self._digester = Digester()
        self._sparse = {f"/{topic}": SparseTopic() for topic in cell.sparse}

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """See `lathe_rc.cell.engine.Sink`."""
        for topic, signals in dense.items():
            self._digester.dense(f"/{topic}", signals)
        for topic, found in sparse.items():
            for message in found:
                stamp = messages.START_NS + message.index * self._step_ns
                head = {"sample_index": message.index} if message.type.startswith(messages.PACKAGE) else {}
                self._sparse[f"/{topic}"].append(stamp, head | message.values)

    def result(self) -> dict[str, str]:
        return self._digester.result(self._sparse)


def with_controller(scenario: Scenario, file: Path) -> Scenario:
    """Replace the nodes that a parameter file names; what all nodes share stays as it was.

    Raises:
        InputError: a node that the scenario has not, or a parameter that is refused.
    """
    shared = {name: getattr(scenario.shared, name) for name in SharedParameters.model_fields}
    nodes = dict(scenario.nodes)
    for name, values in ros_yaml.read(file).items():
        if name == "/**":
            continue
        if name not in nodes:
            raise InputError(f"{file}: no node {name!r} in the bag's scenario; allowed: {', '.join(nodes)}")
        own = {key: value for key, value in values.items() if key not in SharedParameters.model_fields}
        stage = own.get("stage") or nodes[name].stage
        kind = kind_of(name, {"stage": stage})
        nodes[name] = TABLES[kind].read(name, {**shared, "remap": nodes[name].remap, **own, "stage": stage})
    return Scenario(scenario.name, nodes)


def resimulate(
    path: Path,
    overrides: Sequence[str] = (),
    *,
    controller: Path | None = None,
    output: Path | None = None,
) -> Resimulation:
    """Run the cell of a bag again behind its recorded spindle.

    Args:
        path: the bag.
        overrides: ``NODE.PARAM=VALUE``; not of the spindle.
        controller: parameter file whose nodes replace those of the bag.
        output: folder of a bag to write the result to; must not exist; None: none is written.

    Raises:
        InputError: the bag has no scenario or no encoder, the changes cannot work.
        LatheError: samples of the encoder are missing.
    """
    if output is not None:
        refuse_existing(output)
    with Source(path) as source, tempfile.TemporaryDirectory(prefix="lathe-resim-") as folder:
        original = story.scenario_of(source.about, Path(folder))
        spindle = original.of_kind(SpindleEncoder.kind)[0]
        for text in overrides:
            if text.partition(".")[0].strip() == spindle or "." not in text.partition("=")[0]:
                raise InputError(f"--set {text!r}: the spindle and what all nodes share come from the bag; set others")
        scenario = story.scenario_of(source.about, Path(folder), overrides) if overrides else original
        if controller is not None:
            scenario = with_controller(scenario, controller)
        changed = scenario.nodes != original.nodes
        events = _events(source)
        nodes = {name: table.model_copy(update={"events": []}) for name, table in scenario.nodes.items()}
        cell = Cell(nodes)
        topic = f"/{remapped(cell.master.shared, 'encoder')}"
        samples = _samples(source, topic)
        cell.stages[spindle] = _PlayedSpindle(cell.master, Tape(path, topic), samples)
        cell.check()
        for name, stage in cell.stages.items():
            for index, action in events.get(name, []):
                stage.schedule(action, index)
        digests = _Digests(cell)
        errors = ErrorsByRevolution({f"/{name}": said.type for name, said in cell.dense.items()})
        writer = begin(output, scenario) if output is not None else None
        all_sinks: list[Sink] = [digests, errors]
        if writer is not None:
            all_sinks.append(OfflineRecorder(cell, samples, writer))
        engine = Engine(cell)
        start = time.monotonic()
        try:
            engine.run(all_sinks)
        finally:
            if writer is not None:
                writer.close()
        wall = time.monotonic() - start
    recorded = recorded_digests(path)
    before = errors
    if changed:
        before = ErrorsByRevolution({name: said.type for name, said in source.topics.items()})
        feed(path, [before])
    return Resimulation(
        scenario=scenario,
        changed=changed,
        samples=samples,
        wall_s=wall,
        digest=digests.result(),
        recorded=recorded,
        rms=errors.rms(),
        recorded_rms=before.rms(),
    )


def recorded_digests(path: Path) -> dict[str, str]:
    """Digests of a bag: those that were recorded, or made now from all of it; empty if it is not complete."""
    return check.recorded(path) or check.check(path).digests


def _samples(source: Source, topic: str) -> int:
    """Samples of a dense topic: its last block says."""
    if topic not in source.topics or source.topics[topic].type != messages.ENCODER:
        raise InputError(f"{source.path}: no encoder on {topic}; a re-simulation needs the recorded spindle")
    step_ns = next((block.step_ns for block in islice(source.blocks(topic), 1)), 0)
    if not step_ns:
        raise InputError(f"{source.path}: {topic} has no block")
    *_, last = source.blocks(topic, start_ns=source.last_ns - 2 * messages.MAX_BLOCK * step_ns)
    return last.first_index + last.samples


def _events(source: Source) -> dict[str, list[tuple[int, str]]]:
    """Sample and action of the events of each node, as they took effect."""
    topics = {topic for topic, said in source.topics.items() if said.type == messages.EVENT}
    found: dict[str, list[tuple[int, str]]] = {}
    for topic, _, data in source.messages(topics):
        try:
            event = messages.decode(messages.EVENT, data)
        except ValueError as error:
            raise LatheError(f"{source.path}: {topic}: {error}") from None
        found.setdefault(event.source.strip("/").rpartition("/")[2], []).append((int(event.sample_index), event.action))
    return found
