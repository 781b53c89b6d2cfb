# SPDX-License-Identifier: Apache-2.0
"""Blocks that a stage reads: a queue of what has come of each topic, and a buffer of what it may still look back at."""

from collections.abc import Collection, Sequence

from lathe_rc.cell.delay_buffer import DelayBuffer, longest_delays
from lathe_rc.cell.parameters import NodeParameters
from lathe_rc.cell.stage import Input
from lathe_rc.errors import LatheError
from lathe_rc.messages import Signals
from lathe_rc.nodes.block_queue import BlockQueue


class Inputs:
    """Inputs of a stage.

    Args:
        ports: fully qualified topic of each input, and the input.
        parameters: of the node.
        together: blocks that are computed in one go, at most.

    Attributes:
        ports: see the arguments.
        queues: by topic.
        forward: queues of the inputs whose block k is needed for block k of the outputs; the others are feedback.
        reach: sample up to which the stage may go where no input holds it back; None: any.
    """

    def __init__(self, ports: Sequence[tuple[str, Input]], parameters: NodeParameters, together: int) -> None:
        self.ports = ports
        self._size, self._window = parameters.block_size, parameters.window
        self.queues: dict[str, BlockQueue] = {}
        self.buffers: dict[str, DelayBuffer] = {}
        for topic, port in ports:
            delays = longest_delays(p for other, p in ports if other == topic)
            self.queues[topic] = BlockQueue(topic, port.type, parameters, sorted(delays))
            self.buffers[topic] = DelayBuffer(port.type, delays, together * self._size)
        self._shared: list[BlockQueue] = []
        self.reach: int | None = None
        self.wire()

    def wire(self, without: Collection[str] = ()) -> None:
        """Put queues and buffers in the order in which they are read; nothing waits for the topics ``without``."""
        self._inputs = [(self.queues[topic], self.buffers[topic], port.delay) for topic, port in self.ports]
        self._delayed = [port for port in self._inputs if port[2] and port[0].topic not in without]
        waits = [(topic, port.delay) for topic, port in self.ports if topic not in without]
        self._feedback = [self.queues[topic] for topic in dict.fromkeys(t for t, delay in waits if delay)]
        self.forward = [self.queues[topic] for topic in dict.fromkeys(t for t, delay in waits if not delay)]

    def share(self) -> None:
        """Read without a copy what is computed in this process, where nothing of its past is wanted."""
        self._shared = [queue for topic, queue in self.queues.items() if queue.inside and not self.buffers[topic].delay]

    def first(self) -> int | None:
        """Sample with which the first blocks begin; None until every forward input has one.

        Raises:
            LatheError: they do not begin with the same sample.
        """
        if not all(queue.blocks for queue in self.forward):
            return None
        places = [queue.blocks[0].first_index for queue in self.forward]
        self._check_cut(places, "begin")
        return places[0]

    def begin(self, first: int) -> None:
        """The first sample to be computed is this."""
        for buffer in self.buffers.values():
            buffer.restart(first)

    def ready(self, first: int, blocks: int, at_once: int, *, in_cell: bool) -> tuple[int, bool] | None:
        """Samples that can be computed in one go, and whether the run ends with them; None while an input is missing.

        Args:
            first: next sample.
            blocks: computed so far.
            at_once: blocks to compute, at most.
            in_cell: a time master leads.
        """
        end, ended = first + at_once * self._size, False
        for queue in self.forward:
            end = min(end, queue.end)
            ended = ended or queue.ended
        if end <= first:
            return None
        for queue in self._feedback:
            # It may not be needed for a long time yet, but what piles up unread DDS gives up some day.
            if in_cell and self._window and queue.received + self._window < blocks:
                return None
        if self.reach is not None:
            end = min(end, self.reach)
        for queue, buffer, delay in self._delayed:
            _load(queue, buffer, end - delay)
            end = min(end, buffer.end + delay)
        last = ended and self._ends_with(end)
        samples = end - first
        if not last:
            samples -= samples % self._size
        return (samples, last) if samples > 0 else None

    def _ends_with(self, end: int) -> bool:
        """Whether the run ends before sample ``end``.

        Raises:
            LatheError: it ends with another sample for another input.
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
        """The next samples of all inputs, which are there."""
        taken = {queue.topic: queue.pop(samples) for queue in self._shared}
        return [
            taken[queue.topic] if queue.topic in taken else self._view(place, first, samples)
            for place, (queue, _, _) in enumerate(self._inputs)
        ]

    def take(self, place: int, first: int, samples: int) -> Signals:
        """The next samples of one input, with all that has to come before them."""
        queue, buffer, delay = self._inputs[place]
        _load(queue, buffer, first + samples - delay)
        return buffer.view(first - delay, samples)

    def _view(self, place: int, first: int, samples: int) -> Signals:
        queue, buffer, delay = self._inputs[place]
        if not delay:
            _load(queue, buffer, first + samples)
        return buffer.view(first - delay, samples)

    # ---- in a chain ---------------------------------------------------------------------------------

    def join_chain(self, inside: Collection[str]) -> None:
        """Leave the topics ``inside`` of a chain to it."""
        self.wire(inside)
        self._shared = []

    def pass_over(self, inside: Collection[str], first: int) -> None:
        """Put the blocks that came ``inside`` of a chain where they would be had the stage computed alone."""
        for topic in self.buffers.keys() & inside:
            queue, buffer = self.queues[topic], self.buffers[topic]
            if buffer.delay:
                _load(queue, buffer, first)
            else:
                for _ in queue.until(first):
                    pass

    def part(self, inside: Collection[str], first: int) -> None:
        """Read everything alone from now on."""
        for topic in self.buffers.keys() & inside:
            if not self.buffers[topic].delay:
                self.buffers[topic].restart(first)
        self.wire()


def _load(queue: BlockQueue, buffer: DelayBuffer, until: int) -> None:
    """Move queued blocks into the topic's buffer until it reaches sample ``until``, as far as they have come."""
    while buffer.end < until and queue.blocks:
        block = queue.blocks.popleft()
        try:
            # The publisher of a block in this process has checked it.
            block.copy_to(buffer.extend(block.samples), check=not queue.inside)
        except ValueError as error:
            raise LatheError(f"{queue.topic}: {error}") from None
