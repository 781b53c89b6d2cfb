# SPDX-License-Identifier: Apache-2.0
"""The topics of a stage: queues and tracks of what it reads, blocks and sparse messages of what it publishes."""

from abc import abstractmethod
from bisect import bisect_left
from collections.abc import Collection, Sequence
from functools import partial

from lathe_rc import messages
from lathe_rc.cell.block import Framer, Pool
from lathe_rc.cell.delay_buffer import DelayBuffer, longest_delays
from lathe_rc.cell.parameters import explain_overflow
from lathe_rc.cell.stage import Input, Sparse, Stage, compile_kernels
from lathe_rc.cell.stages import STAGES
from lathe_rc.cell.wire import Encoder
from lathe_rc.errors import LatheError
from lathe_rc.messages import Samples, Signals
from lathe_rc.nodes.cell_node import CellNode
from lathe_rc.nodes.exchange import Run
from lathe_rc.nodes.ports import BlockQueue, message_class, signal_qos

_TOGETHER = 2  # parts of the window: so much is computed in one go, and members still work side by side
_OUTSIDE_PERIOD = 0.1  # [s] between looks at who reads what in other processes


class StageTopics(CellNode):
    """A node with a stage, as far as it takes in blocks and publishes them.

    Attributes:
        stage: what it runs, once configured.
        blocks: computed so far.
        samples: computed so far.
        together: blocks that are computed in one go, at most.
        dense: fully qualified topic of each output.
    """

    stage: Stage

    def configure_part(self) -> None:
        """Build the stage and compile its kernels: the first block then takes no longer than the next."""
        with explain_overflow({self.get_name(): self.table}):
            self.stage = STAGES[self.kind](self.get_name(), self.table)
        compile_kernels(self.stage)
        self.blocks = 0
        self.samples = 0
        self._started = False
        self._framer = Framer(self.table.run_id, self.full_name, self.table.step_ns)
        self._encoders = [
            (
                self.topic(port.topic),
                Encoder(port.type, self.table.run_id, self.full_name, self.table.step_ns),
            )
            for port in self.stage.outputs
        ]
        self.dense = [topic for topic, _ in self._encoders]
        for _, encoder in self._encoders:
            encoder.prepare(self.table.block_size)
        most = min(self.table.window // _TOGETHER, messages.MAX_BLOCK // self.table.block_size)
        self.together, self._size = max(most, 1), self.table.block_size
        self._pools = [Pool(port.type) for port in self.stage.outputs]
        self._sparse_topics = {topic: self.topic(topic) for topic in self.stage.sparse_topics}
        self._queues: dict[str, BlockQueue] = {}
        self._tracks: dict[str, DelayBuffer] = {}
        ports = self.ports()
        for topic, port in ports:
            delays = longest_delays(p for other, p in ports if other == topic)
            self._queues[topic] = BlockQueue(topic, port.type, self.table, sorted(delays))
            self._tracks[topic] = DelayBuffer(port.type, delays, self.together * self.table.block_size)
        self._wire()

    def ports(self) -> list[tuple[str, Input]]:
        """Fully qualified topic of each input, and the input."""
        return [(self.topic(port.topic), port) for port in self.stage.inputs]

    def _wire(self, without: Collection[str] = ()) -> None:
        """Put queues and tracks in the order in which they are read; nothing waits for the topics ``without``."""
        ports = self.ports()
        self._inputs = [(self._queues[topic], self._tracks[topic], port.delay) for topic, port in ports]
        self._delayed = [port for port in self._inputs if port[2] and port[0].topic not in without]
        waits = [(topic, port.delay) for topic, port in ports if topic not in without]
        self._feedback = [self._queues[topic] for topic in dict.fromkeys(t for t, delay in waits if delay)]
        self._forward = [self._queues[topic] for topic in dict.fromkeys(t for t, delay in waits if not delay)]

    def activate_part(self) -> None:
        """Make publishers and subscriptions."""
        for topic, msgtype, _ in self.publications():
            self.outlets[topic] = self.create_publisher(message_class(msgtype), topic, signal_qos(self.table))
        for topic, queue in self._queues.items():
            queue.inside = self.exchange.has(topic)
            self.listen(topic, queue.type, partial(self._take_in, queue), queue.take)
        self._outside, self._outside_due = set(self.outlets), 0.0
        # Computed in this process for readers to share, and nothing of their past is wanted: no need to copy.
        self._shared = [q for topic, q in self._queues.items() if q.inside and not self._tracks[topic].delay]

    def tick(self, now: float) -> None:
        """See `CellNode`."""
        super().tick(now)
        # To ask for every message would cost as much as a small stage. Once ready, the cell's own readers are there.
        if self._ready and now >= self._outside_due:
            self._outside_due = now + _OUTSIDE_PERIOD
            self._outside = {topic for topic, outlet in self.outlets.items() if outlet.get_subscription_count()}

    def relative_topics(self) -> list[str]:
        """See `CellNode`."""
        inputs, outputs = ([port.topic for port in self.stage.inputs], [port.topic for port in self.stage.outputs])
        return [*inputs, *outputs, *self.stage.sparse_topics]

    def publications(self) -> list[tuple[str, str, bool]]:
        """See `CellNode`."""
        if not hasattr(self, "stage"):
            return []
        dense = [(self.topic(port.topic), port.type, False) for port in self.stage.outputs]
        return dense + [(self.topic(topic), kind, True) for topic, kind in self.stage.sparse_topics.items()]

    def subscriptions_wanted(self) -> list[str]:
        """See `CellNode`."""
        return list(self._queues) if hasattr(self, "stage") else []

    def _take_in(self, queue: BlockQueue, data: bytes) -> None:
        queue.add(data)

    def members_changed(self) -> None:
        """Learn whose blocks to accept, before the first of them."""
        peers = self.master.members if self.master else list(self.members)
        for name in peers:
            member = self.members.get(name)
            for topic in member.publishes if member else ():
                queue = self._queues.get(topic)
                if queue and (queue.open or queue.source not in peers):
                    self._expect(queue, name)

    def _expect(self, queue: BlockQueue, source: str) -> None:
        """Accept a member's blocks: in a cell from the first on; alone, with a run, from whichever comes first."""
        if self.master is None:
            if self.table.run_id and not queue.source:
                queue.expect(source, None)
            return
        if self._started:
            raise LatheError(f"{queue.topic}: {queue.source} was heard before the cell of {source}; start anew")
        queue.expect(source)
        queue.repeats = self.restarts(source)

    def statistics(self) -> dict[str, object]:
        """See `CellNode`."""
        waiting = {f"waiting for {topic}": not queue.blocks for topic, queue in self._queues.items()}
        return {"blocks": self.blocks, "samples": self.samples, "lost blocks": self.lost, **waiting}

    @property
    def lost(self) -> int:
        """Blocks that never came, in a free-running cell."""
        return sum(queue.lost for queue in self._queues.values())

    @staticmethod
    def _load(queue: BlockQueue, track: DelayBuffer, until: int) -> None:
        """Move queued blocks into the topic's track until it reaches sample ``until``, as far as they have come."""
        while track.end < until and queue.blocks:
            block = queue.blocks.popleft()
            try:
                # Who computes a block in this process has checked it.
                block.copy_to(track.extend(block.samples), check=not queue.inside)
            except ValueError as error:
                raise LatheError(f"{queue.topic}: {error}") from None

    def _join(self, first: int) -> None:
        self._started = True
        self.samples = first
        for track in self._tracks.values():
            track.restart(first)

    def _goes_out(self, topic: str) -> bool:
        """Whether to publish: unless all who read the topic are in this process."""
        return topic in self._outside or not self.exchange.read(topic)

    def _publish(self, said: Sequence[Sparse], memory: Sequence[tuple[Signals, Samples | None]], *, last: bool) -> None:
        samples = next(iter(memory[0][0].values())).size
        before, found = self._framer.companions, []
        for sparse in said:
            found.append(sparse.index)
            framed = self._framer.sparse(sparse)
            topic, data = self._sparse_topics[sparse.topic], messages.encode(sparse.type, framed)
            if self._goes_out(topic):
                self.outlets[topic].publish(data)
            self.exchange.hand_over(topic, data)
            if sparse.type == messages.LEARNING:
                values = {key: float(value) for key, value in sparse.values.items()}
                self.reporter("cycle", self.get_name(), sample=sparse.index, **values)
        companions = [before + len(found)]
        if samples > self._size:
            ends = range(self.samples + self._size, self.samples + samples, self._size)
            companions = [*(before + bisect_left(found, end) for end in ends), *companions]
        for (topic, encoder), (signals, whole) in zip(self._encoders, memory, strict=True):
            block = encoder.block(self.samples, signals, whole, last=last, companions=companions[-1])
            try:
                block.check()
            except ValueError as error:
                raise LatheError(f"{topic}: {error}") from None
            run = Run(block, companions)
            if self._goes_out(topic):
                for each in run.blocks(self._size):
                    first, end, count = each.first_index, each.last, each.companions
                    self.outlets[topic].publish(encoder.encode(first, each.signals, last=end, companions=count)[1])
            self.exchange.hand_over(topic, run)
        self.blocks += len(companions)
        self.samples += samples
        self.progressed(self.blocks, self.samples, last=last)
        if last:
            self.ended()

    @abstractmethod
    def ended(self) -> None:
        """The last block has been computed."""
