# SPDX-License-Identifier: Apache-2.0
"""A stage as the role of a node: it is fed in order, computes alone or in a chain, and publishes."""

from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any, Protocol

from lathe_rc_msgs.srv import Schedule

from lathe_rc import messages
from lathe_rc.cell.parameters import explain_overflow
from lathe_rc.cell.stage import Sparse, Stage, compile_kernels
from lathe_rc.cell.stages import MASTERS, STAGES
from lathe_rc.errors import InputError, LatheError, LossyRunError
from lathe_rc.messages import Signals
from lathe_rc.nodes.block_queue import BlockQueue
from lathe_rc.nodes.cell_node import CellNode
from lathe_rc.nodes.inputs import Inputs
from lathe_rc.nodes.outputs import Memory, Outputs
from lathe_rc.nodes.restart import Restart
from lathe_rc.protocol import Announcement, MemberProtocol
from lathe_rc.protocol.actions import Action

_TOGETHER = 2  # parts of the window: so much is computed in one go, and members still work side by side


class Chain(Protocol):
    """Stages that compute together, see `lathe_rc.nodes.chain.Chain`."""

    def advance(self) -> None:
        """Compute what the inputs from outside allow; the first of the stages says how far."""

    def ready(self) -> tuple[int, bool] | None:
        """Samples that all can compute, and whether the run ends with them; None while an input is missing."""

    def compute(self, samples: int, *, last: bool) -> None:
        """Let all compute so many samples, with which the run may end, and publish them."""

    def leave(self) -> None:
        """Let each stage go on alone, from where it stands."""


class StageRole:
    """See the module.

    Args:
        node: that it is the role of.

    Attributes:
        node: see the arguments.
        stage: that it computes.
        blocks, samples: computed so far.
        together: blocks that are computed in one go, at most.
        started: the first sample is known.
        chain: that it computes in; None: alone.
    """

    stage: Stage

    def __init__(self, node: CellNode) -> None:
        self.node = node
        with explain_overflow({node.get_name(): node.table}):
            self.stage = STAGES[node.kind](node.get_name(), node.table)
        compile_kernels(self.stage)  # the first block then takes no longer than the next
        self.blocks = self.samples = 0
        self.started = False
        self.chain: Chain | None = None
        self.together = max(min(node.table.window // _TOGETHER, messages.MAX_BLOCK // node.table.block_size), 1)
        self.inputs = Inputs([(node.topic(port.topic), port) for port in self.stage.inputs], node.table, self.together)
        self.outputs = Outputs(node, self.stage)
        file = getattr(node.table, "restart_file", "")
        self.restart = Restart(self, file) if file else None

    # ---- membership ---------------------------------------------------------------------------------

    def protocol(self, own: Announcement) -> MemberProtocol:
        """See `Role`."""
        return MemberProtocol(own, self.node.table.window, masters=MASTERS)

    def member_names(self) -> list[str]:
        """See `Role`."""
        return []

    def publications(self) -> list[tuple[str, str, bool]]:
        """See `Role`."""
        return self.outputs.publications

    def subscriptions(self) -> list[str]:
        """See `Role`."""
        return list(self.inputs.queues)

    def relative_topics(self) -> list[str]:
        """See `Role`."""
        inputs, outputs = ([port.topic for port in self.stage.inputs], [port.topic for port in self.stage.outputs])
        return [*inputs, *outputs, *self.stage.sparse_topics]

    def activate(self) -> None:
        """See `Role`; there is a service that schedules events."""
        self.outputs.activate()
        for topic, queue in self.inputs.queues.items():
            queue.inside = self.node.exchange.has(topic)
            self.node.listen(topic, queue.type, queue.add, queue.take)
        self.inputs.share()
        self.node.exchange.stages.append(self)
        self.node.create_service(Schedule, "~/schedule", self._on_schedule)

    def members_changed(self) -> None:
        """Learn whose blocks to accept, before the first of them."""
        protocol = self.node.protocol
        peers = protocol.master.members if protocol.master else tuple(protocol.members)
        for name in peers:
            member = protocol.members.get(name)
            for topic in member.publishes if member else ():
                queue = self.inputs.queues.get(topic)
                if queue and (queue.open or queue.source not in peers):
                    self._expect(queue, name)

    def _expect(self, queue: BlockQueue, source: str) -> None:
        """Accept a member's blocks: in a cell from the first on; alone, with a run, from the first to come."""
        if self.node.protocol.master is None:
            if self.node.table.run_id and not queue.source:
                queue.expect(source, None)
            return
        if self.started:
            raise LatheError(f"{queue.topic}: {queue.source} was heard before the cell of {source}; start anew")
        queue.expect(source)
        queue.repeats = self.node.protocol.restarts(source)

    def begin(self, *, joins: bool) -> None:
        """See `Role`.

        Raises:
            LatheError: the cell is running, and there is nothing to go on from.
        """
        if self.restart is not None:
            self.restart.begin(joins=joins)
        elif joins:
            raise LatheError(
                f"{self.node.full_name}: the cell is running already, and this node cannot go on in mid-run"
            )

    def perform(self, action: Action) -> None:
        """See `Role`."""

    def lose(self, lost: frozenset[str], first: int, end: int, *, again: bool) -> None:
        """See `Role`; the newest samples of lost members are held."""
        if self.chain is not None:
            self.chain.leave()
        for queue in self.inputs.queues.values():
            if queue.source in lost and queue.held_from is None:
                queue.hold_newest(end)
        if not again:
            self.become_safe(first)
        forward = self.inputs.forward
        if forward and all(queue.held_from is not None for queue in forward) and self.inputs.reach is None:
            self._follow_the_master(first)
        self.node.due = True

    def become_safe(self, first: int) -> None:
        """Be safe from a sample on."""
        self.stage.lose(first)

    def _follow_the_master(self, first: int) -> None:
        """Go no further than the spindle: a node that reads from lost members alone would run ahead to the end."""
        node, master = self.node, self.node.protocol.master
        assert master is not None, "it has declared the safe state"
        self.inputs.reach = first
        topic = next(topic for topic, sparse in zip(master.publishes, master.sparse, strict=True) if not sparse)
        pace = BlockQueue(topic, messages.ENCODER, node.table, [])
        pace.expect(master.name, first)
        pace.repeats = True

        def come(take: Callable[[Any], object], delivery: Any) -> None:
            take(delivery)
            pace.blocks.clear()
            self.inputs.reach = max(first, pace.end)

        node.listen(topic, messages.ENCODER, partial(come, pace.add), partial(come, pace.take))

    def failed(self) -> None:
        """See `Role`; the stages that it computes with go on alone."""
        if self.chain is not None:
            self.chain.leave()

    def finish(self) -> None:
        """See `Role`."""

    def clean_up(self) -> None:
        """See `Role`."""
        self.failed()
        if self in self.node.exchange.stages:
            self.node.exchange.stages.remove(self)

    def tick(self, now: float) -> float:
        """See `Role`."""
        self.outputs.tick(now)
        return float("inf")

    def statistics(self) -> dict[str, object]:
        """See `Role`."""
        waiting = {f"waiting for {topic}": not queue.blocks for topic, queue in self.inputs.queues.items()}
        return {"blocks": self.blocks, "samples": self.samples, "lost blocks": self.lost, **waiting}

    @property
    def lost(self) -> int:
        """Blocks that never came, in a free-running cell."""
        return sum(queue.lost for queue in self.inputs.queues.values())

    # ---- events -------------------------------------------------------------------------------------

    def _on_schedule(self, request: Any, response: Any) -> Any:
        node, index = self.node, max(self.samples, int(request.not_before))
        if (self.restart is not None and not node.protocol.ready) or node.protocol.failure:
            response.message = str(node.protocol.failure or f"{node.full_name} is not ready yet; ask again")
            return response
        try:
            self.stage.schedule(request.action, index)
        except InputError as error:
            response.message = str(error)
            return response
        if self.restart is not None and not node.protocol.over:
            node.attempt(partial(self.restart.keep_event, request.action, index))
        response.accepted, response.sample_index = True, index
        return response

    # ---- data ---------------------------------------------------------------------------------------

    @property
    def computes(self) -> bool:
        """Whether it takes part in a cell that runs."""
        protocol = self.node.protocol
        return protocol.active and protocol.ready and not (protocol.failure or protocol.over)

    def work(self) -> None:
        """See `Role`: compute every block whose inputs are there."""
        if self.node.protocol.master is not None and not self.node.protocol.ready:
            return  # blocks may wait there for a latecomer
        if not self.started and any(queue.blocks for queue in self.inputs.forward):
            self.node.exchange.form(self, None)
        if self.chain is not None:
            self.chain.advance()
            return
        while not self.node.protocol.over and not self.node.protocol.failure and (ready := self.ready()):
            samples, last = ready
            self.compute(samples, last=last)

    def ready(self) -> tuple[int, bool] | None:
        """Samples to compute in one go, and whether the run ends with them; None while an input is missing."""
        if not self.started:
            # Alone, a node may join a stream that is under way; in a cell it begins at 0.
            first = self.inputs.first() if self.inputs.forward else None
            if first is None:
                return None
            self.start(first)
        in_cell = self.node.protocol.master is not None
        return self.inputs.ready(self.samples, self.blocks, self.at_once(), in_cell=in_cell)

    def at_once(self) -> int:
        """Blocks to compute in one go, at most: up to the one after which the state is to be kept."""
        return self.together if self.restart is None else max(min(self.together, self.restart.keep_at - self.blocks), 1)

    def start(self, first: int) -> None:
        """The first sample to be computed is this."""
        self.started, self.samples = True, first
        self.inputs.begin(first)

    def compute(self, samples: int, *, last: bool) -> None:
        """Compute some blocks in one go, and publish each; the last one of the run may be shorter."""
        memory = self.outputs.memory(samples)
        inputs = self.inputs.read(self.samples, samples)
        said = self.stage.advance(self.samples, inputs, [signals for signals, _ in memory], last=last)
        self._publish(said, memory, samples, last=last)

    def _publish(self, said: Sequence[Sparse], memory: Sequence[Memory], samples: int, *, last: bool) -> None:
        self.blocks += self.outputs.publish(self.samples, said, memory, last=last)
        self.samples += samples
        self.node.completed(self.blocks, self.samples, last=last)
        if last:
            self._complete()
        elif self.restart is not None and self.blocks >= self.restart.keep_at:
            self.restart.keep()

    def _complete(self) -> None:
        """The last block has been computed."""
        if waiting := self.stage.waiting:
            self.node.get_logger().warning(f"not reached: {'; '.join(waiting)}")
            self.node.reporter("not_reached", self.node.get_name(), events=waiting)
        self.node.complete_part()
        if self.lost:
            raise LossyRunError(f"{self.node.full_name}: lost {self.lost} blocks of a free-running cell")

    # ---- in a chain ---------------------------------------------------------------------------------

    @property
    def may_join(self) -> bool:
        """Whether it can compute in a chain from now on."""
        return not self.started and self.restart is None and bool(self.node.table.window) and self.computes

    @property
    def cell(self) -> str:
        """Name of its time master; empty as long as it has none."""
        master = self.node.protocol.master
        return master.name if master is not None else ""

    def join(self, chain: Chain, inside: Collection[str]) -> None:
        """Compute in a chain from sample 0 on, whose stages publish the topics ``inside``."""
        self.chain = chain
        self.inputs.join_chain(inside)
        self.start(0)

    def lead(self) -> None:
        """As the first of a chain, let it compute what the inputs allow."""
        while self.chain is not None and (ready := self.chain.ready()):
            self.chain.compute(ready[0], last=ready[1])

    def publish_copies(self, sparse: list[Sparse], outputs: Sequence[Signals], *, last: bool) -> None:
        """Publish what the chain has computed: copies, for readers keep what they are given."""
        samples = next(iter(outputs[0].values())).size
        memory = self.outputs.memory(samples)
        for (copies, _), signals in zip(memory, outputs, strict=True):
            for name, array in copies.items():
                array[:] = signals[name]
        copied = [copies for copies, _ in memory]
        sparse = self.stage.conclude(self.samples, self.samples + samples, sparse, copied, last=last)
        self._publish(sparse, memory, samples, last=last)

    def part(self, inside: Collection[str]) -> None:
        """Compute alone from now on."""
        self.chain, self.node.due = None, True
        self.inputs.part(inside, self.samples)
