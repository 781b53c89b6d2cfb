# SPDX-License-Identifier: Apache-2.0
"""Re-simulation: the spindle turns as recorded in a bag, and everything downstream of it is computed again.

Without changes, the results are bit-identical to the recording. With another controller, the run shows how that
controller would have performed with the same spindle, disturbances and form.

For a bag without a scenario, one must be given: only the spindle motion is taken from the bag, everything else from the
scenario, optionally with the drive identified from the recorded command and position.
"""

import tempfile
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lathe_bagtools.resimulation import identify
from lathe_bagtools.resimulation.bag_spindle import asked_for, wire
from lathe_bagtools.resimulation.identify import IdentifiedDrive
from lathe_rc import messages
from lathe_rc.bag import check, provenance
from lathe_rc.bag.reading.recorded import Recorded
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.bag.reading.stream import From, feed, first_of
from lathe_rc.bag.snapshot import GONE_ON, span_of
from lathe_rc.bag.writing.record import OfflineRecorder, begin
from lathe_rc.bag.writing.writer import refuse_existing
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell import models, ros_yaml
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.engine import Engine, Sink
from lathe_rc.cell.parameters import SharedParameters
from lathe_rc.cell.recording import Digester, SparseTopic
from lathe_rc.cell.running_form import RunningForm
from lathe_rc.cell.scenario import TABLES, Scenario, kind_of
from lathe_rc.cell.time_master import START_FROM
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, UnpublishedError
from lathe_rc.messages import Samples, Signals
from lathe_rc.names import instead


@dataclass(frozen=True)
class Resimulation:
    """Result of a re-simulation.

    Attributes:
        scenario: the simulated scenario.
        changed: whether the scenario differs from that of the bag, or the bag has none.
        first: index of the first sample.
        turns_before: number of revolutions before the first one in ``rms``.
        samples: number of samples of the run.
        wall_s: wall time of the run [s].
        digest: digest of each signal topic.
        recorded: recorded digests of the bag's topics; empty if the recording is incomplete.
        rms: RMS form error of each revolution [m], shape (revolutions,); empty without a tool.
        recorded_rms: recorded RMS form error of each revolution [m].
        between_rms: RMS difference between the recorded and the re-simulated tool position for each revolution [m], if
            the recorded error is derived from these positions because the bag does not contain it; otherwise empty.
        positions: in the same case, topics and fields of the bag that give the recorded position; otherwise empty.
        drives: identified drives.
        warnings: changes of third-party classes since the bag was made and, for a changed cell, warnings of its check.
    """

    scenario: Scenario
    changed: bool
    first: int
    turns_before: int
    samples: int
    wall_s: float
    digest: Mapping[str, str]
    recorded: Mapping[str, str]
    rms: Samples = field(repr=False)
    recorded_rms: Samples = field(repr=False)
    between_rms: Samples = field(repr=False)
    positions: list[tuple[str, str]]
    drives: list[IdentifiedDrive]
    warnings: list[str]

    @property
    def different(self) -> list[str]:
        """Topics whose digests differ from the recorded ones."""
        return [topic for topic in sorted(self.recorded) if self.digest.get(topic) != self.recorded[topic]]

    @property
    def missing(self) -> list[str]:
        """Topics that were not recorded."""
        return sorted(self.digest.keys() - self.recorded.keys())

    @property
    def simulated_s(self) -> float:
        """Simulated time [s]."""
        return self.samples * self.scenario.shared.step


class _Digests:
    """Sink that computes the digests of a run or a bag, by fully qualified topic.

    Args:
        step_ns: sampling step [ns].
        sparse: topics with messages at chosen samples.
    """

    def __init__(self, step_ns: int, sparse: Iterable[str]) -> None:
        self._step_ns = step_ns
        self._digester = Digester()
        self._sparse = {messages.full(topic): SparseTopic() for topic in sparse}

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Add a chunk to the digests."""
        for topic, signals in dense.items():
            self._digester.dense(messages.full(topic), signals)
        for topic, found in sparse.items():
            for message in found:
                stamp = messages.START_NS + message.index * self._step_ns
                head = {"sample_index": message.index} if message.type.startswith(messages.PACKAGE) else {}
                self._sparse[messages.full(topic)].append(stamp, head | message.values)

    def result(self) -> dict[str, str]:
        return self._digester.result(self._sparse)


def with_controller(scenario: Scenario, file: Path) -> Scenario:
    """Replace the nodes that a parameter file contains; parameters shared by all nodes remain unchanged.

    Raises:
        InputError: the file contains a node that the scenario does not have, or a parameter is invalid.
    """
    shared = {name: getattr(scenario.shared, name) for name in SharedParameters.model_fields}
    nodes = dict(scenario.nodes)
    for name in ros_yaml.read(file):
        if name not in {"/**", *nodes}:
            raise InputError(f"{file}: no node {name!r} in the bag's scenario; {instead(name, nodes)}")
    stages = {name: table.stage for name, table in scenario.nodes.items()}
    for name, values in scenarios.read(file, stages=stages).items():
        if name == "/**":
            continue
        own = {key: value for key, value in values.items() if key not in SharedParameters.model_fields}
        stage = own.get("stage") or nodes[name].stage
        kind = kind_of(name, stage)
        nodes[name] = TABLES[kind].read(name, {**shared, "remap": nodes[name].remap, **own, "stage": stage})
    return Scenario(scenario.name, models.resolved(nodes))


def _refuse_part(source: BagSource, *, begun: bool) -> None:
    if loss := source.loss:
        raise InputError(
            f"{source.path}: nodes were lost on the way, {loss.why}; allowed: a bag of a run that nothing interrupted"
        )
    first = first_of(source)
    if first and not begun and GONE_ON not in source.about:
        what = "is a snapshot" if span_of(source.about) else "was recorded"
        raise InputError(
            f"{source.path} {what} from sample {first} on: the start of the run, from which controllers and "
            "drives have their state, is missing; allowed: a checkpoint (--from FILE), or a bag from sample 0 on "
            "(recorder.mode = both records the whole run beside the snapshots)"
        )


def resimulate(
    path: Path,
    overrides: Sequence[str] = (),
    *,
    scenario: Path | None = None,
    controller: Path | None = None,
    topics: Mapping[str, str] | None = None,
    identified: bool = False,
    parameters: Path | None = None,
    output: Path | None = None,
    start_from: Path | None = None,
) -> Resimulation:
    """Run the cell of a bag again with the recorded spindle.

    Args:
        path: path of the bag.
        overrides: parameters as ``NODE.PARAM=VALUE``; not for the spindle if the scenario is the bag's.
        scenario: parameter file that replaces the bag's scenario; None: the scenario of the bag.
        controller: parameter file whose nodes replace those of the scenario.
        topics: the bag's topics by the cell's relative topics, where they differ.
        identified: whether to identify the electrodynamic drives from the bag.
        parameters: file to which the parameters of the simulated scenario are written; None: no file.
        output: folder of a new bag for the result; must not exist yet; None: no bag.
        start_from: checkpoint of the run in the bag, from which the cell goes on; None: the start of the bag.

    Raises:
        InputError: the bag has no encoder, or it has no scenario and none is given; the changes are not possible; or a
            drive cannot be identified.
        LatheError: required samples are missing or not finite.
    """
    if output is not None:
        refuse_existing(output)
    with BagSource(path) as source, tempfile.TemporaryDirectory(prefix="lathe-resim-") as folder:
        _refuse_part(source, begun=start_from is not None)
        recorded = Recorded(source, topics or {})
        overrides = [*overrides, *_start(source, start_from, given=scenario is not None)]
        original = None if scenario is not None else _of_bag(recorded, Path(folder), overrides)
        if scenario is not None:
            chosen = scenarios.load(scenario, overrides)
        else:
            assert original is not None, "it is the other source of a scenario"
            _refuse_overrides(original, overrides)
            asked = [text for text in overrides if not _names(text, {START_FROM})]
            chosen = provenance.scenario_of(source.about, Path(folder), overrides) if asked else original
        if controller is not None:
            chosen = with_controller(chosen, controller)
        warnings = [*provenance.origin(source.about), *(provenance.changes(source.about, original) if original else [])]
        _refuse_events(chosen, original)
        drives = identify.drives(recorded, chosen) if identified else []
        chosen = identify.with_identified(chosen, drives)
        if parameters is not None:
            identify.write_parameters(parameters, chosen, drives)
        changed = original is None or chosen.nodes != original.nodes
        with _without_strangers(path, changed=changed):
            cell, compared, events = wire(chosen, original, recorded)
        warnings += cell.warnings if changed else []
        # Events are inserted at the samples at which they took effect, which depended on an operator or the spindle.
        for name, stage in cell.stages.items():
            for index, action in events.get(name, []):
                stage.replay(action, index)
        first = cell.first
        digests = _Digests(cell.master.shared.step_ns, cell.sparse)
        errors = RunningForm.of({name: said.type for name, said in cell.dense.items()})
        samples = cell.master.samples
        assert samples is not None, "a bag has an end"
        writer = begin(output, chosen) if output is not None else None
        all_sinks: list[Sink] = [digests, errors, *([compared] if compared else [])]
        if writer is not None:
            all_sinks.append(OfflineRecorder(cell, samples, writer, first=first))
        engine = Engine(cell)
        start = time.monotonic()
        try:
            engine.run(all_sinks)
        finally:
            if writer is not None:
                writer.close()
        digest = digests.result()
        wall = time.monotonic() - start
    found = _digests_from(path, cell) if original is not None else {}
    digest_of_bag = {topic.removeprefix(recorded.namespace): digest for topic, digest in found.items()}
    before = _errors_from(path, first) if changed and compared is None else errors
    return Resimulation(
        scenario=chosen,
        changed=changed,
        first=first,
        turns_before=errors.before,
        samples=samples - first,
        wall_s=wall,
        digest=digest,
        recorded=digest_of_bag,
        rms=errors.found().rms,
        recorded_rms=compared.recorded_rms() if compared else before.found().rms,
        between_rms=compared.between_rms() if compared else np.empty(0),
        positions=compared.topics if compared else [],
        drives=drives,
        warnings=warnings,
    )


def _of_bag(recorded: Recorded, folder: Path, overrides: Sequence[str]) -> Scenario:
    """Return the bag's scenario; ``overrides`` name the files that the bag does not contain.

    Raises:
        InputError: the bag has no scenario; the message states what the bag has and what is needed.
    """
    about = recorded.source.about
    if provenance.SCENARIO not in about:
        raise InputError(f"{recorded.path}: {asked_for(recorded)}")
    lacks = {name for name in provenance.named_files(about) if not name.endswith(scenarios.WRITTEN)}
    given = [text for text in overrides if _names(text, lacks | {START_FROM})]
    return provenance.scenario_of(about, folder, given)


@contextmanager
def _without_strangers(path: Path, *, changed: bool) -> Iterator[None]:
    """Explain that an unpublished topic was once published by a third-party node that is not part of the bag.

    Args:
        path: path of the bag.
        changed: whether the cell differs from the recorded one; if so, the error may have another cause.
    """
    try:
        yield
    except UnpublishedError as error:
        if changed:
            raise
        raise InputError(
            f"{path}: {str(error).partition(';')[0]}: a node that the bag knows by its topics alone did; allowed: "
            "--scenario FILE with a node of ours in its place (--identify finds its drive)"
        ) from None


def _names(override: str, parameters: Collection[str]) -> bool:
    """Return whether an override sets one of some parameters, given as NODE.PARAM or PARAM of any node."""
    name = override.partition("=")[0].strip()
    return name in parameters or name.rpartition(".")[2] in parameters


def _start(source: BagSource, path: Path | None, *, given: bool) -> list[str]:
    """Return the override that lets the cell of a bag go on from a checkpoint, if there is one.

    Raises:
        InputError: the bag has no scenario, or another one is given.
    """
    if path is None:
        return []
    nodes = provenance.values_of(source.about)
    master = next((name for name, values in nodes.items() if START_FROM in values), "")
    if given or not master:
        raise InputError(
            f"--from {path}: a checkpoint is one of the run in a bag; allowed: with the scenario of the bag"
        )
    return [f"{master}.{START_FROM}={path.absolute()}"]


_PAST = (
    "events and faults come from the bag, as they took effect; leave them as they are, or run the scenario with others"
)


def _refuse_overrides(original: Scenario, overrides: Sequence[str]) -> None:
    spindle = original.masters[0]
    for text in overrides:
        name = text.partition("=")[0].strip()
        if _names(text, {START_FROM}):
            continue
        if name.endswith((".events", ".faults")):
            raise InputError(f"--set {text!r}: {_PAST}")
        if name.partition(".")[0] == spindle or "." not in name:
            raise InputError(f"--set {text!r}: the spindle and what all nodes share come from the bag; set others")


def _refuse_events(chosen: Scenario, original: Scenario | None) -> None:
    """Reject events and faults that differ from the bag's; a node without any takes those of the bag."""
    if original is None:
        return
    for name, table in chosen.nodes.items():
        for what in ("events", "faults"):
            asked = getattr(table, what)
            if asked and asked != getattr(original.nodes[name], what):
                raise InputError(f"{name}.{what} = {asked}: {_PAST}")


def _digests_from(path: Path, cell: Cell) -> dict[str, str]:
    """Return the digests of a bag from the first sample of a cell on; empty if the recording is incomplete."""
    found = check.recorded(path) or check.check(path).digests
    with BagSource(path) as source:
        if not found or cell.first <= first_of(source):
            return found
        sparse = [topic for topic, said in source.topics.items() if said.type in messages.sparse_types()]
    rest = _Digests(cell.master.shared.step_ns, sparse)
    feed(path, [From(rest, cell.first)])
    return rest.result()


def _errors_from(path: Path, first: int) -> RunningForm:
    """Return the recorded form errors of a bag from a sample on."""
    with BagSource(path) as source:
        errors = RunningForm.of({name: said.type for name, said in source.topics.items()})
    feed(path, [From(errors, first)])
    return errors
