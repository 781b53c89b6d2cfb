# SPDX-License-Identifier: Apache-2.0
"""Inputs of a stage: a queue of received blocks per topic, and a buffer for the samples that delayed inputs read."""

from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from lathe_rc import messages
from lathe_rc.blocks.delay_buffer import DelayBuffer, longest_delays, past_of
from lathe_rc.blocks.ports import Input
from lathe_rc.errors import LatheError
from lathe_rc.messages import Signals
from lathe_rc.protocol.block_queue import BlockQueue

if TYPE_CHECKING:
    from lathe_rc.cell.parameters import NodeParameters


class Inputs:
    """Inputs of a stage, with their queues and buffers.

    Args:
        ports: fully qualified topic and port of each input.
        parameters: parameters of the node.
        together: largest number of blocks computed in one step.

    Attributes:
        ports: see the arguments.
        queues: block queue of each topic.
        forward: queues of the inputs whose block k is needed for block k of the outputs; all other inputs are feedback.
        pace: blocks of the time master that limit the stage if no input does; None: they do not.
    """

    def __init__(self, ports: Sequence[tuple[str, Input]], parameters: "NodeParameters", together: int) -> None:
        self.ports = ports
        self._parameters, self._size, self._window = parameters, parameters.block_size, parameters.window
        self.queues: dict[str, BlockQueue] = {}
        self.buffers: dict[str, DelayBuffer] = {}
        for topic, port in ports:
            delays = longest_delays(p for other, p in ports if other == topic)
            self.queues[topic] = BlockQueue(topic, port.type, parameters, sorted(delays))
            self.buffers[topic] = DelayBuffer(port.type, delays, together * self._size)
        self._shared: list[BlockQueue] = []
        self.pace: BlockQueue | None = None
        self.wire()

    def wire(self, without: Collection[str] = ()) -> None:
        """Arrange queues and buffers in reading order; the topics ``without`` do not delay the computation."""
        self._inputs = [(self.queues[topic], self.buffers[topic], port.delay) for topic, port in self.ports]
        self._delayed = [port for port in self._inputs if port[2] and port[0].topic not in without]
        waits = [(topic, port.delay) for topic, port in self.ports if topic not in without]
        self._feedback = [self.queues[topic] for topic in dict.fromkeys(t for t, delay in waits if delay)]
        self.forward = [self.queues[topic] for topic in dict.fromkeys(t for t, delay in waits if not delay)]

    def share(self) -> None:
        """Enable reading without a copy from topics of this process whose past samples are not needed."""
        self._shared = [queue for topic, queue in self.queues.items() if queue.inside and not self.buffers[topic].delay]

    def first(self) -> int | None:
        """Return the sample at which the inputs begin; None until every forward input has a block.

        Raises:
            LatheError: the inputs do not begin with the same sample.
        """
        if not all(queue.blocks for queue in self.forward):
            return None
        places = [queue.blocks[0].first_index for queue in self.forward]
        self._check_cut(places, "begin")
        return places[0]

    def begin(self, first: int, past: Mapping[str, Signals] = MappingProxyType({})) -> None:
        """Reset the buffers to begin at sample ``first``.

        Args:
            first: sample index.
            past: the newest samples before it, by fully qualified topic and field.

        Raises:
            InputError: an input is read later than the past samples reach.
        """
        for topic, buffer in self.buffers.items():
            buffer.restart(first, past.get(topic, {}))
            for port in [port for other, port in self.ports if other == topic and port.delay and past]:
                for name in port.fields:
                    past_of(past.get(topic, {}), topic, name, port.delay, first)

    def ready(self, first: int, blocks: int, at_once: int, *, in_cell: bool) -> tuple[int, bool] | None:
        """Return the number of computable samples and whether the run ends there; None while an input is missing.

        Args:
            first: next sample.
            blocks: number of blocks computed so far.
            at_once: largest number of blocks to compute.
            in_cell: a time master leads the run.
        """
        end, ended = first + at_once * self._size, False
        for queue in self.forward:
            end = min(end, queue.end)
            ended = ended or queue.ended
        if end <= first:
            return None
        for queue in self._feedback:
            # The block may be needed much later, but unread messages would pile up until DDS drops them.
            if in_cell and self._window and queue.received + self._window < blocks:
                return None
        if self.pace is not None:
            self.pace.blocks.clear()
            end = min(end, self.pace.end)
        for queue, buffer, delay in self._delayed:
            _load(queue, buffer, end - delay)
            end = min(end, buffer.end + delay)
        last = ended and self._ends_with(end)
        samples = end - first
        if not last:
            samples -= samples % self._size
        return (samples, last) if samples > 0 else None

    def _ends_with(self, end: int) -> bool:
        """Return True if the run ends before sample ``end``.

        Raises:
            LatheError: the inputs do not end with the same sample.
        """
        ends = [queue.end for queue in self.forward]
        if max(ends) > min(queue.end for queue in self.forward if queue.ended):
            self._check_cut(ends, "end")
        return all(queue.ended and queue.end == end for queue in self.forward)

    def _check_cut(self, places: Sequence[int], what: str) -> None:
        if len(set(places)) > 1:
            where = ", ".join(f"{queue.topic} {place}" for queue, place in zip(self.forward, places, strict=True))
            raise LatheError(f"inputs do not {what} with the same sample: {where}")

    def read(self, first: int, samples: int) -> list[Signals]:
        """Return the next samples of all inputs; they must have arrived."""
        taken = {queue.topic: queue.pop(samples) for queue in self._shared}
        return [
            taken[queue.topic] if queue.topic in taken else self.take(place, first, samples)
            for place, (queue, _, _) in enumerate(self._inputs)
        ]

    def take(self, place: int, first: int, samples: int) -> Signals:
        """Return the next samples of one input, after loading all earlier ones into its buffer."""
        queue, buffer, delay = self._inputs[place]
        _load(queue, buffer, first + samples - delay)
        return buffer.view(first - delay, samples)

    def lose(self, lost: Collection[str], end: int) -> bool:
        """Hold the newest samples of lost sources up to ``end``; return True if no input limits the stage any more.

        The stage then has to `follow` the time master: it would compute up to the end at once.
        """
        for queue in self.queues.values():
            if queue.source in lost and queue.held_from is None:
                queue.hold_newest(end)
        return bool(self.forward) and all(queue.held_from is not None for queue in self.forward) and self.pace is None

    def follow(self, topic: str, master: str, first: int) -> BlockQueue:
        """Limit the stage to the time master's blocks; return the queue that takes those after sample ``first``.

        Earlier ones may be missing, since newer ones replace them while a late reader receives them.
        """
        self.pace = BlockQueue(topic, messages.ENCODER, self._parameters, [])
        self.pace.expect(master, None)
        self.pace.end, self.pace.repeats = first, True
        return self.pace

    # ---- restart ------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Return the state of buffers and queues for a restart."""
        return {
            "past": {topic: (buffer.end, buffer.past()) for topic, buffer in self.buffers.items()},
            "queues": {topic: queue.state() for topic, queue in self.queues.items()},
        }

    def go_on(self, sources: Mapping[str, str], state: Mapping[str, Any]) -> None:
        """Resume from the `state` of another process; ``sources`` has the publisher of each topic."""
        for topic, (end, past) in state["past"].items():
            self.buffers[topic].restart(end, past)
        for topic, queue in self.queues.items():
            queue.go_on(sources[topic], state["queues"][topic])
        self.wire()

    # ---- in a chain ---------------------------------------------------------------------------------

    def join_chain(self, inside: Collection[str]) -> None:
        """Join a chain, which supplies the topics ``inside``."""
        self.wire(inside)
        self._shared = []

    def pass_over(self, inside: Collection[str], first: int) -> None:
        """Load or drop queued blocks of the chain's topics ``inside`` up to ``first``, as a stage alone would do."""
        for topic in self.buffers.keys() & inside:
            queue, buffer = self.queues[topic], self.buffers[topic]
            if buffer.delay:
                _load(queue, buffer, first)
            else:
                for _ in queue.until(first):
                    pass

    def part(self, inside: Collection[str], first: int) -> None:
        """Leave a chain and read all inputs from the stage's own queues, starting at ``first``."""
        for topic in self.buffers.keys() & inside:
            if not self.buffers[topic].delay:
                self.buffers[topic].restart(first)
        self.wire()


def _load(queue: BlockQueue, buffer: DelayBuffer, until: int) -> None:
    """Move queued blocks into the topic's buffer up to sample ``until``, as far as blocks have arrived."""
    while buffer.end < until and queue.blocks:
        block = queue.blocks.popleft()
        for name, array in buffer.extend(block.samples).items():
            array[:] = block.signals[name]
