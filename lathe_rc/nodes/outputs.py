# SPDX-License-Identifier: Apache-2.0
"""Output of a stage: blocks and messages at chosen samples, published over DDS and to readers in the same process."""

from bisect import bisect_left
from collections.abc import Sequence

from lathe_rc import messages
from lathe_rc.blocks.block import Framer, Pool
from lathe_rc.blocks.ports import Sparse
from lathe_rc.blocks.wire import Encoder
from lathe_rc.cell.stage import Stage
from lathe_rc.errors import LatheError
from lathe_rc.extensions import is_ours
from lathe_rc.messages import Samples, Signals
from lathe_rc.nodes.cell_node import CellNode
from lathe_rc.nodes.ports import message_class, signal_qos
from lathe_rc.protocol.exchange import JoinedBlocks

_OUTSIDE_PERIOD = 0.02  # [s] between checks for readers in other processes

Memory = tuple[Signals, Samples | None]  #: arrays of one output, and the record array that they are views of


class Outputs:
    """Publishers of a stage's blocks and of its messages at chosen samples.

    Args:
        node: node that owns the publishers.
        stage: stage that computes the blocks.

    Attributes:
        topics: fully qualified topic of each output.
        framer: counts the messages at chosen samples.
        unsound: members of the cell were lost, so that results of cycles may rest on held samples.
    """

    def __init__(self, node: CellNode, stage: Stage) -> None:
        self._node, self._size = node, node.table.block_size
        self.unsound = False
        self.framer = Framer(node.table.run_id, node.full_name, node.table.step_ns)
        self.topics = [node.topic(port.topic) for port in stage.outputs]
        self._encoders = [
            Encoder(port.type, node.table.run_id, node.full_name, node.table.step_ns) for port in stage.outputs
        ]
        for encoder in self._encoders:
            encoder.prepare(self._size)
        others = not is_ours(type(stage).__module__)
        self._pools = [Pool(port.type, blank=others) for port in stage.outputs]
        self._sparse_topics = {topic: node.topic(topic) for topic in stage.sparse_topics}
        self.publications = [
            *((topic, port.type, False) for topic, port in zip(self.topics, stage.outputs, strict=True)),
            *((self._sparse_topics[topic], kind, True) for topic, kind in stage.sparse_topics.items()),
        ]
        self._outside: set[str] = set()  # topics that are read in other processes
        self._outside_due = 0.0

    def activate(self) -> None:
        """Create the publishers."""
        node = self._node
        for topic, msgtype, _ in self.publications:
            node.outlets[topic] = node.create_publisher(message_class(msgtype), topic, signal_qos(node.table))
        self._outside = set(node.outlets)

    def tick(self, now: float) -> None:
        """Check for readers in other processes; a check per message would cost as much as a small stage."""
        if self._node.protocol.ready and now >= self._outside_due:  # the cell's own readers are matched
            self._outside_due = now + _OUTSIDE_PERIOD
            outlets = self._node.outlets.items()
            self._outside = {topic for topic, outlet in outlets if outlet.get_subscription_count()}

    def memory(self, samples: int) -> list[Memory]:
        """Return arrays for the next samples of all outputs."""
        return [pool.take(samples) for pool in self._pools]

    def _goes_out(self, topic: str) -> bool:
        """Return True if a topic has to be published over DDS: not all of its readers are in this process."""
        return topic in self._outside or not self._node.exchange.read(topic)

    def publish(self, first: int, said: Sequence[Sparse], memory: Sequence[Memory], *, last: bool) -> int:
        """Publish consecutive blocks together, with their messages at chosen samples.

        Args:
            first: index of their first sample.
            said: messages at chosen samples, in order of samples.
            memory: arrays of each output, as returned by `memory`.
            last: the run ends with these blocks.

        Returns:
            The number of blocks.

        Raises:
            LatheError: a number is not finite.
        """
        node = self._node
        samples = next(iter(memory[0][0].values())).size
        before, indices = self.framer.companions, []
        for sparse in said:
            indices.append(sparse.index)
            topic, data = self._sparse_topics[sparse.topic], messages.encode(sparse.type, self.framer.sparse(sparse))
            if self._goes_out(topic):
                node.outlets[topic].publish(data)
            node.exchange.hand_over(topic, data)
            if sparse.type == messages.LEARNING and not self.unsound:
                values = {key: float(value) for key, value in sparse.values.items()}
                node.reporter("cycle", node.get_name(), sample=sparse.index, **values)
        companions = [before + len(indices)]
        if samples > self._size:
            ends = range(first + self._size, first + samples, self._size)
            companions = [*(before + bisect_left(indices, end) for end in ends), *companions]
        for topic, encoder, (signals, whole) in zip(self.topics, self._encoders, memory, strict=True):
            block = encoder.block(first, signals, whole, last=last, companions=companions[-1])
            try:
                block.check()
            except ValueError as error:
                raise LatheError(f"{topic}: {error}") from None
            run = JoinedBlocks(block, companions)
            if self._goes_out(topic):
                for each in run.blocks(self._size):
                    start, end, count = each.first_index, each.last, each.companions
                    node.outlets[topic].publish(encoder.encode(start, each.signals, last=end, companions=count)[1])
            node.exchange.hand_over(topic, run)
        return len(companions)
