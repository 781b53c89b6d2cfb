# SPDX-License-Identifier: Apache-2.0
"""A stage as a ROS node."""

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from lathe_rc_msgs.srv import Schedule
from rclpy.publisher import Publisher

from lathe_rc.cell import messages
from lathe_rc.cell.framing import Framer
from lathe_rc.cell.messages import Signals
from lathe_rc.cell.stage import Stage, compile_kernels
from lathe_rc.cell.stages import STAGES
from lathe_rc.cell.track import Track
from lathe_rc.errors import InputError, LatheError, LossyRunError
from lathe_rc.nodes.ports import BlockQueue, signal_qos
from lathe_rc.nodes.shell import CellNode


def message_class(msgtype: str) -> Any:
    """The rclpy class of a message type."""
    package, kind, name = msgtype.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


class StageNode(CellNode):
    """Feeds a stage in order and publishes what it computes.

    Attributes:
        stage: what it runs, once configured.
        blocks: computed so far.
        samples: computed so far.
    """

    stage: Stage

    def configure_part(self) -> None:
        """Build the stage and compile its kernels: the first block then takes no longer than the next."""
        self.stage = STAGES[self.kind](self.get_name(), self.table)
        compile_kernels(self.stage)
        self.blocks = 0
        self.samples = 0
        self._started = False
        self._framer = Framer(self.table.run_id, self.full_name, self.table.step_ns)
        self._queues: dict[str, BlockQueue] = {}
        self._tracks: dict[str, Track] = {}
        self._read: list[tuple[str, str]] = []  # topic and field of everything that the stage reads
        block = max(self.table.block_size, 1)
        for port in self.stage.inputs:
            topic = self.topic(port.topic)
            self._read += [(topic, name) for name in port.fields if (topic, name) not in self._read]
            self._queues.setdefault(topic, BlockQueue(topic, port.type, self.table))
            delay = max(p.delay for p in self.stage.inputs if self.topic(p.topic) == topic)
            fields = {name for p in self.stage.inputs if self.topic(p.topic) == topic for name in p.fields}
            self._tracks[topic] = Track(port.type, sorted(fields), delay, block)
        self._topics = {port.topic: self.topic(port.topic) for port in self.stage.inputs}
        self._forward = list(dict.fromkeys(self.topic(p.topic) for p in self.stage.inputs if p.delay == 0))

    def activate_part(self) -> None:
        """Make publishers, subscriptions and the service that schedules events."""
        self._publishers_by_topic: dict[str, Publisher] = {
            topic: self.create_publisher(message_class(msgtype), topic, signal_qos(self.table))
            for topic, msgtype, _ in self.publications()
        }
        for topic, queue in self._queues.items():
            self.create_subscription(
                message_class(queue.type),
                topic,
                self.guarded(lambda data, queue=queue: self._on_block(queue, data)),
                signal_qos(self.table, topic),
                raw=True,
                event_callbacks=self.subscription_events(topic),
            )
        if self.stage.actions:
            self.create_service(Schedule, "~/schedule", self._on_schedule)

    def ports(self) -> list[Any]:
        """See `CellNode`."""
        return [*self.stage.inputs, *self.stage.outputs]

    def publications(self) -> list[tuple[str, str, bool]]:
        """See `CellNode`."""
        if not hasattr(self, "stage"):
            return []
        dense = [(self.topic(port.topic), port.type, False) for port in self.stage.outputs]
        return dense + [(self.topic(topic), kind, True) for topic, kind in self.stage.sparse_topics.items()]

    def subscriptions_wanted(self) -> list[str]:
        """See `CellNode`."""
        return list(self._queues) if hasattr(self, "stage") else []

    def members_changed(self) -> None:
        """Learn whose blocks to accept, before the first of them."""
        if self.master is None:
            return
        for name in self.master.members:
            member = self.members.get(name)
            for topic in member.publishes if member else ():
                queue = self._queues.get(topic)
                if queue and not queue.source:
                    queue.expect(name)

    def statistics(self) -> dict[str, object]:
        """See `CellNode`."""
        waiting = {f"waiting for {topic}": not queue.blocks for topic, queue in self._queues.items()}
        return {"blocks": self.blocks, "samples": self.samples, "lost blocks": self.lost, **waiting}

    @property
    def lost(self) -> int:
        """Blocks that never came, in a free-running cell."""
        return sum(queue.lost for queue in self._queues.values())

    # ---- events -------------------------------------------------------------------------------------

    def _on_schedule(self, request: Any, response: Any) -> Any:
        index = max(self.samples, int(request.not_before))
        try:
            self.stage.schedule(request.action, index)
        except InputError as error:
            response.message = str(error)
            return response
        response.accepted, response.sample_index = True, index
        return response

    # ---- data ---------------------------------------------------------------------------------------

    def _on_block(self, queue: BlockQueue, data: bytes) -> None:
        if self.done:
            return
        message = queue.add(data)
        for topic, name in self._read:
            if topic == queue.topic and not np.isfinite(getattr(message, name)).all():
                raise LatheError(
                    f"{topic}: {message.block.source} sends a {name} that is not finite in the block from sample "
                    f"{message.block.first_index}"
                )
        self.advance()

    def _load(self, topic: str, until: int) -> bool:
        """Move queued blocks into the topic's track until it reaches sample ``until``; False if they do not."""
        queue, track = self._queues[topic], self._tracks[topic]
        while track.end < until and queue.blocks:
            message = queue.blocks.popleft()
            samples = getattr(message, next(iter(messages.sample_fields(queue.type)))).size
            for name, array in track.extend(samples).items():
                array[:] = getattr(message, name)
        return track.end >= until

    def _next(self) -> tuple[int, bool] | None:
        """Length of the next block and whether it is the last; None while an input is missing."""
        found = []
        for topic in self._forward:
            queue = self._queues[topic]
            if not queue.blocks:
                return None
            message = queue.blocks[0]
            samples = getattr(message, next(iter(messages.sample_fields(queue.type)))).size
            found.append((message.block.first_index, samples, bool(message.block.last)))
        if not self._started:
            # Alone, a node may join a stream that is under way; in a cell it begins at 0.
            self._join(found[0][0])
        if any(block != found[0] for block in found) or found[0][0] != self.samples:
            raise LatheError(f"inputs are not cut into the same blocks: {dict(zip(self._forward, found, strict=True))}")
        _, samples, last = found[0]
        for port in self.stage.inputs:
            if port.delay and not self._load(self.topic(port.topic), self.samples + samples - port.delay):
                return None
        return samples, last

    def _join(self, first: int) -> None:
        self._started = True
        self.samples = first
        for track in self._tracks.values():
            track.restart(first)

    def advance(self) -> None:
        """Compute every block whose inputs are there."""
        while not self.done and not self.failure:
            ready = self._next()
            if ready is None:
                return
            samples, last = ready
            for topic in self._forward:
                self._load(topic, self.samples + samples)
            inputs = [
                self._tracks[self.topic(port.topic)].view(self.samples - port.delay, samples)
                for port in self.stage.inputs
            ]
            self.compute(samples, inputs, last=last)

    def compute(self, samples: int, inputs: Sequence[Signals], *, last: bool) -> None:
        """Compute and publish one block."""
        outputs = [messages.allocate(port.type, samples) for port in self.stage.outputs]
        for sparse in self.stage.advance(self.samples, inputs, outputs):
            framed = self._framer.sparse(sparse)
            self._publish(sparse.topic, messages.encode(sparse.type, framed))
            if sparse.type == messages.LEARNING:
                values = {key: float(value) for key, value in sparse.values.items()}
                self.reporter("cycle", self.get_name(), sample=sparse.index, **values)
        for port, signals in zip(self.stage.outputs, outputs, strict=True):
            framed = self._framer.block(port.type, self.samples, signals, last=last)
            self._publish(port.topic, messages.encode(port.type, framed))
        self.blocks += 1
        self.samples += samples
        self.progressed(self.blocks, self.samples, last=last)
        if last:
            self.ended()

    def _publish(self, relative: str, data: bytes) -> None:
        self._publishers_by_topic[self.topic(relative)].publish(data)

    def ended(self) -> None:
        """The last block has been computed."""
        self.end(list(self._publishers_by_topic.values()))
        if self.lost:
            self.fail(LossyRunError(f"{self.full_name}: lost {self.lost} blocks of a free-running cell"))

