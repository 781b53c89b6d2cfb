# SPDX-License-Identifier: Apache-2.0
"""Cell driven by a bag's recorded spindle, and comparison of the recorded and re-simulated tool positions."""

from collections import deque
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_machine.signals.encoder import EncoderSamples
from lathe_machine.stages.tool.tool import Tool
from lathe_rc import messages
from lathe_rc.arrays import put
from lathe_rc.bag.reading.recorded import Recorded, Spindle
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.bag.reading.stream import SampleReader, first_of
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.events import Trigger
from lathe_rc.cell.parameters import remapped
from lathe_rc.cell.running_form import RunningForm
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.soundness import Soundness
from lathe_rc.cell.stage import DONE, Fields, Reached
from lathe_rc.cell.time_master import TimeMaster
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples, Signals


class Memory(NamedTuple):
    """State of the step function.

    Attributes:
        span: first recorded sample, and the sample after the last one.
        recorded: recorded samples, starting at element 0.
    """

    span: npt.NDArray[np.int64]
    recorded: EncoderSamples


@kernel
def step(memory: Memory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Copy the recorded samples of a block to the outputs."""
    block, recorded = EncoderSamples(*outputs), memory.recorded
    at, n = first - memory.span[0], block.angle.size
    put(block.angle, recorded.angle[at : at + n])
    put(block.speed, recorded.speed[at : at + n])
    put(block.index_pulse, recorded.index_pulse[at : at + n])
    put(block.angle_true, recorded.angle_true[at : at + n])
    put(block.speed_true, recorded.speed_true[at : at + n])
    return n, DONE


class _RecordedSpindle(TimeMaster):
    """Time master that replays the recorded spindle motion."""

    step = staticmethod(step)

    def __init__(
        self, made: TimeMaster, reader: SampleReader, first: int, samples: int, said: Spindle | None = None
    ) -> None:
        super().__init__(made.name, made.parameters)
        self._made, self.law = made, made.law
        self._reader, self.samples, self._said = reader, samples, said
        self.place_triggers()
        self.declare(outputs=made.outputs, tells=made.tells)  # its events are in the recording
        self._ready = messages.allocate(messages.ENCODER, messages.MAX_BLOCK)
        self._span = np.full(2, first)

    def speed_range(self) -> tuple[float, float]:
        """Return the speed range of the bag's own scenario or, with another scenario, the recorded range [rad/s].

        If the recorded spindle stands still, the lowest speed is the scenario's, because the checks need a moving
        spindle.
        """
        made = self._made.speed_range()
        if self._said is None:
            return made
        low, high = self._said.speed
        return (low if low > 0.0 else min(made[0], high)), high

    def largest_acceleration(self) -> float:
        """Return the largest acceleration of the scenario's law [rad/s²]."""
        return self._made.largest_acceleration()

    def sample_at(self, angle: float) -> int:
        """Return the sample at a given angle according to the scenario's law."""
        return self._made.sample_at(angle)

    @property
    def memory(self) -> Memory:
        """Current state of the step function."""
        return Memory(self._span, EncoderSamples(**self._ready))

    def prepare(self, first: int, samples: int) -> None:
        """Read the samples of the next block before it is computed.

        Raises:
            LatheError: the recording has fewer samples, or some are missing.
        """
        # Samples that were read ahead are moved to the front, so that the kernel sees one contiguous array.
        begin, end = self._span.tolist()
        if first + samples <= end:
            return
        left = end - first
        for array in self._ready.values():
            array[:left] = array[first - begin : end - begin].copy()
        self._span[:] = first, end
        signals = {name: array[left:samples] for name, array in self._ready.items()}
        self._reader.take_into(signals)
        self._span[1] = first + samples
        if self._said and not self._said.has_truth:
            signals["angle_true"][:], signals["speed_true"][:] = signals["angle"], signals["speed"]
        if self._said:
            signals["angle"] -= self._said.turns
            signals["angle_true"] -= self._said.turns

    def replay(self, action: str, index: int) -> None:
        """Schedule a recorded event at its sample."""
        self._triggers.append(Trigger("sample", index, action, "events"))

    def act(self, action: str, index: int) -> None:
        """Ignore the action: encoder faults are already in the recording."""


def _positions(recorded: Recorded, tool: Tool) -> list[tuple[str, str]]:
    """Return the topics and fields of a bag whose sum is the tool position; empty if any of them is missing.

    These are the tool's own topic, or the measured positions of the drives that move it.
    """
    own = recorded.find(remapped(tool.shared, tool.outputs[0].topic), messages.TOOL)
    if own is not None:
        return [(own, "displacement")]
    names = [remapped(tool.shared, f"{drive}/state") for drive in tool.parameters.drives]
    topics = [recorded.find(name, messages.STATE) for name in names]
    return [(topic, "measured_position") for topic in topics if topic is not None] if all(topics) else []


class Comparison:
    """Comparison of the recorded and re-simulated tool positions for each revolution; a sink.

    The recorded form error is computed as in the re-simulation, but with the recorded position instead of the simulated
    one; the desired form, the cross slide and the deflection are the same.

    Args:
        recorded: recorded topics of the bag.
        cell: the running cell.
        tool: tool of the cell.
        topics: result of `_positions`.

    Attributes:
        topics: as passed in.
    """

    def __init__(self, recorded: Recorded, cell: Cell, tool: Tool, topics: list[tuple[str, str]]) -> None:
        self.topics = topics
        self._encoder = remapped(cell.master.shared, "encoder")
        self._tool = remapped(tool.shared, tool.outputs[0].topic)
        self._readers = [(SampleReader(recorded.source, topic, cell.first), field) for topic, field in topics]
        self._recorded, self._between = RunningForm("", "", Soundness(())), RunningForm("", "", Soundness(()))

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Add the errors of a chunk."""
        tool, encoder = dense[self._tool], dense[self._encoder]
        between: Samples = tool["displacement"] - sum(reader.take(samples)[field] for reader, field in self._readers)
        for form, error in ((self._recorded, tool["error"] + between), (self._between, between)):
            form.add(first, encoder["angle_true"], {"error": error})

    def recorded_rms(self) -> Samples:
        """Return the RMS form error of the recorded position for each revolution [m], shape (revolutions,)."""
        return self._recorded.found().rms

    def between_rms(self) -> Samples:
        """Return the RMS difference between the two positions for each revolution [m], shape (revolutions,)."""
        return self._between.found().rms


Events = dict[str, list[tuple[int, str]]]  #: sample and action of each event, by node


def wire(chosen: Scenario, original: Scenario | None, recorded: Recorded) -> tuple[Cell, Comparison | None, Events]:
    """Build and check a cell with the recorded spindle.

    Args:
        chosen: scenario to run.
        original: scenario of the bag; None if ``chosen`` replaces it.
        recorded: recorded topics of the bag.

    Returns:
        The cell; the comparison of its tool position with the recorded one, if the bag has that position but not the
        form error; and the bag's events, at the samples at which they took effect. A scenario other than the bag's
        keeps its own events.

    Raises:
        InputError: the bag has no encoder, its step differs from the scenario's, or the pre-start checks fail.
        LatheError: required samples are missing or not finite.
    """
    nodes, source = dict(chosen.nodes), recorded.source
    if original is not None:
        nodes = {name: table.model_copy(update={"events": [], "faults": []}) for name, table in nodes.items()}
    cell = Cell(nodes)
    master = cell.master
    recorded.check_names([*cell.dense])
    name = remapped(master.shared, "encoder")
    tool = next((stage for stage in cell.stages.values() if isinstance(stage, Tool)), None)
    topics = _positions(recorded, tool) if tool else []
    spindle = None if original is not None else recorded.spindle(name)
    topic = spindle.topic if spindle else recorded.find(name, messages.ENCODER) or messages.full(name)
    samples = spindle.samples if spindle else _samples(source, topic)
    if original is not None and any(kind == "displacement" for _, kind in topics):
        topics = []  # the bag has the recorded error, too
    samples = min([samples, *(recorded.length(of, kind) for of, kind in topics)])
    for of in (topic, *(of for of, _ in topics)):
        step_ns = source.step_ns(of)
        if step_ns != master.shared.step_ns:
            raise InputError(
                f"{source.path}: {of} has a step of {step_ns} ns, the scenario one of {master.shared.step_ns} ns; "
                f"allowed: sample_rate = {1e9 / step_ns:.10g} Hz under /**"
            )
    if not (begin := first_of(source)) <= (first := cell.first) < samples:
        raise InputError(
            f"{source.path} has samples {begin} to {samples - 1}, and the cell would begin at {first}; allowed: a "
            "checkpoint in the bag (--from FILE)"
        )
    cell.replace(_RecordedSpindle(master, SampleReader(source, topic, first), first, samples, spindle))
    cell.check()
    compared = Comparison(recorded, cell, tool, topics) if tool and topics else None
    return cell, compared, _events(source, first) if original is not None else {}


def asked_for(recorded: Recorded, *, identified: bool = False) -> str:
    """Describe in one line which signals a bag without a scenario has, which are missing, and which options help.

    Args:
        recorded: recorded topics of the bag.
        identified: whether the drive has been identified.
    """
    encoder = recorded.find("encoder", messages.ENCODER)
    missing = ["drives, controllers and the form of the part (--scenario FILE)"]
    if encoder is None:
        missing.insert(0, f"the spindle: {recorded.lacks('encoder', messages.ENCODER)}")
    state = recorded.find("coarse/state", messages.STATE) or recorded.find("tool", messages.TOOL)
    if state is None:
        missing.append(f"to compare with, the tool's position: {recorded.lacks('coarse/state', messages.STATE)}")
    elif recorded.find("coarse/command", messages.COMMAND) is None:
        missing.append(f"to identify the drive, its command: {recorded.lacks('coarse/command', messages.COMMAND)}")
    elif not identified:
        missing.append("the drive's model (--identify finds it)")
    return f"the bag holds no scenario; it has {recorded.holdings()}; missing: {'; '.join(missing)}"


def _samples(source: BagSource, topic: str) -> int:
    """Return the number of samples of a dense topic, from its last block."""
    if topic not in source.topics or source.topics[topic].type != messages.ENCODER:
        raise InputError(f"{source.path}: no encoder on {topic}; a re-simulation needs the recorded spindle")
    step_ns = source.step_ns(topic)
    if not step_ns:
        raise InputError(f"{source.path}: {topic} has no block")
    # Log times may come from another clock; in that case all blocks are read.
    late = source.last_ns - 2 * messages.MAX_BLOCK * step_ns
    (last,) = deque(source.blocks(topic, start_ns=late), 1) or deque(source.blocks(topic), 1)
    return last.first_index + last.samples


def _events(source: BagSource, first: int) -> dict[str, list[tuple[int, str]]]:
    """Return the events of each node from sample ``first`` on: the sample at which each took effect, and its action."""
    topics = {topic for topic, said in source.topics.items() if said.type == messages.EVENT}
    found: dict[str, list[tuple[int, str]]] = {}
    for topic, _, data in source.messages(topics):
        try:
            event = messages.decode(messages.EVENT, data)
        except ValueError as error:
            raise LatheError(f"{source.path}: {topic}: {error}") from None
        if event.sample_index >= first:
            name = event.source.strip("/").rpartition("/")[2]
            found.setdefault(name, []).append((int(event.sample_index), event.action))
    return found
