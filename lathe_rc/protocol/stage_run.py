# SPDX-License-Identifier: Apache-2.0
"""Way of a stage through a run, without I/O: which samples it may compute, alone or in a chain, and from which on."""

from abc import abstractmethod
from collections.abc import Collection, Mapping
from typing import Any

from lathe_rc.errors import LatheError, LossyRunError
from lathe_rc.messages import Signals
from lathe_rc.protocol.block_queue import BlockQueue, explain_losses
from lathe_rc.protocol.inputs import Inputs
from lathe_rc.protocol.member_host import MemberHost, Work
from lathe_rc.protocol.restart import Restart


class StageRun(Work):
    """Base class of the roles of stages, real or simulated.

    Attributes:
        node: host of the member.
        inputs: queues and buffers of the inputs.
        together: largest number of blocks computed in one step.
        blocks, samples: number computed so far, samples including those before the checkpoint.
        started: the first sample is known.
        chain: chain of the stage (see `lathe_rc.nodes.chain`); None if it computes alone.
        restart: keeps the states from which another process can resume; None: none can.
    """

    node: MemberHost
    inputs: Inputs
    together: int
    restart: Restart | None
    chain: Any = None
    blocks = samples = 0
    started = False

    # ---- what a stage provides ----------------------------------------------------------------------

    @abstractmethod
    def compute(self, samples: int, *, last: bool) -> None:
        """Compute and publish some blocks in one step, and pass them to `computed`."""

    @abstractmethod
    def listen(self, queue: BlockQueue) -> None:
        """Subscribe a queue to its topic."""

    @property
    def past(self) -> Mapping[str, Signals]:
        """Return the samples before the run that delayed inputs need, by fully qualified topic and field."""
        return {}

    def prepare(self) -> None:
        """Prepare the stage for block 0."""

    def become_safe(self, first: int) -> None:
        """Switch the stage to its safe state, starting at sample ``first``."""

    def last_computed(self) -> None:
        """Report what remains open after the last block."""

    # ---- membership ---------------------------------------------------------------------------------

    def listen_to_inputs(self) -> None:
        """Subscribe the queues of the inputs, and let the stage join a chain."""
        for topic, queue in self.inputs.queues.items():
            queue.inside = self.node.exchange.has(topic)
            queue.run_end = lambda: self.node.protocol.end
            self.listen(queue)
        self.inputs.share()
        self.node.exchange.stages.append(self)

    def members_changed(self) -> None:
        """Set the expected source of each input from the members' announcements, before its first block."""
        protocol = self.node.protocol
        peers = protocol.names
        for name in peers:
            member = protocol.members.get(name)
            for topic in member.publishes if member else ():
                queue = self.inputs.queues.get(topic)
                if queue and (queue.open or queue.source not in peers):
                    self._expect(queue, name)

    def _expect(self, queue: BlockQueue, source: str) -> None:
        """Set a queue's source: in a cell from block 0 on; without a cell, from the first block that arrives."""
        if self.node.protocol.master is None:
            if self.node.table.run_id and not queue.source:
                queue.expect(source, None)
            return
        if self.started:
            raise LatheError(f"{queue.topic}: {queue.source} was heard before the cell of {source}; start anew")
        queue.expect(source, self.node.first_sample())
        queue.repeats = self.node.protocol.restarts(source)

    def begin(self, *, joins: bool) -> None:
        """Prepare for block 0, or resume from a kept state in a running cell (implements `Work`).

        Raises:
            LatheError: the cell is running, and the node has no kept state to resume from; or the checkpoint is not one
                of this node.
        """
        if not joins:
            self.prepare()
        if self.restart is not None:
            if not joins:
                self.start(self.samples)  # the first state is kept before the first block has arrived
            self.restart.begin(joins=joins)
        elif joins:
            raise LatheError(
                f"{self.node.full_name}: the cell is running already, and this node cannot go on in mid-run"
            )

    def lose(self, lost: frozenset[str], first: int, end: int, *, again: bool) -> None:
        """Continue without lost members: the newest samples of their topics are held (implements `Work`)."""
        if self.chain is not None:
            self.chain.leave()
        unlimited = self.inputs.lose(lost, end)
        if not again:
            self.become_safe(first)
        if unlimited:
            self._follow_the_master()
        self.node.due = True

    def _follow_the_master(self) -> None:
        """Read the spindle's blocks, which limit the stage from now on."""
        master = self.node.protocol.master
        assert master is not None, "it has declared the safe state"
        topic = next(topic for topic, sparse in zip(master.publishes, master.sparse, strict=True) if not sparse)
        self.listen(self.inputs.follow(topic, master.name, self.samples))

    def failed(self) -> None:
        """Dissolve the chain after a failure; its other stages go on alone (implements `Work`)."""
        if self.chain is not None:
            self.chain.leave()

    # ---- blocks -------------------------------------------------------------------------------------

    @property
    def computes(self) -> bool:
        """Return True if the node takes part in a running cell."""
        protocol = self.node.protocol
        return protocol.active and protocol.ready and not (protocol.failure or protocol.over)

    def work(self) -> None:
        """Compute every block whose inputs have arrived (implements `Work`)."""
        protocol = self.node.protocol
        if protocol.master is not None and not protocol.ready:
            return  # blocks may wait in the queues until the node is ready
        if not self.started and any(queue.blocks for queue in self.inputs.forward):
            self.node.exchange.form(self, None)
        if self.chain is not None:
            self.chain.advance()
            return
        while not protocol.over and not protocol.failure and (ready := self.ready()):
            samples, last = ready
            self.compute(samples, last=last)

    def ready(self) -> tuple[int, bool] | None:
        """Return the number of computable samples and whether the run ends there; None while an input is missing."""
        if not self.started:
            # Alone, a node may join a stream that is under way; in a cell it begins at block 0.
            first = self.inputs.first() if self.inputs.forward else None
            if first is None:
                return None
            self.start(first)
        in_cell = self.node.protocol.master is not None
        return self.inputs.ready(self.samples, self.blocks, self.at_once(), in_cell=in_cell)

    def at_once(self) -> int:
        """Return the largest number of blocks for one step: the step ends where the state has to be kept."""
        return self.together if self.restart is None else max(min(self.together, self.restart.keep_at - self.blocks), 1)

    def hold_quiet_inputs(self, now: float) -> None:
        """Hold inputs from devices that have lost the last block, until the last one is computed."""
        if self.node.protocol.over:
            return
        queues = self.inputs.queues.values()
        for queue in queues:
            queue.end_with(queues, now)
            self.node.due = self.node.due or queue.lossy

    def start(self, first: int) -> None:
        """Begin the computation at sample ``first``."""
        self.started, self.samples = True, first
        self.inputs.begin(first, self.past)

    def computed(self, blocks: int, samples: int, *, last: bool) -> None:
        """Count computed and published blocks, and report them; after the last block, complete the run.

        Raises:
            LossyRunError: blocks of a free-running cell were lost.
        """
        self.blocks += blocks
        self.samples += samples
        self.node.completed(self.blocks, self.samples, last=last)
        if last:
            self.last_computed()
            self.node.complete_part()
            if losses := explain_losses(self.node.full_name, self.inputs.queues.values()):
                raise LossyRunError(losses)
        elif self.restart is not None and self.blocks >= self.restart.keep_at:
            self.restart.keep()

    # ---- in a chain ---------------------------------------------------------------------------------

    @property
    def may_join(self) -> bool:
        """Return True if the stage can still join a chain."""
        return not self.started and self.restart is None and bool(self.node.table.window) and self.computes

    @property
    def cell(self) -> str:
        """Return the name of the time master; empty as long as none is known."""
        master = self.node.protocol.master
        return master.name if master is not None else ""

    def join(self, chain: Any, inside: Collection[str]) -> None:
        """Join a chain before block 0; the stages of the chain publish the topics ``inside``."""
        self.chain = chain
        self.inputs.join_chain(inside)
        self.start(self.samples)

    def lead(self) -> None:
        """As the first stage of a chain, let the chain compute as far as its inputs allow."""
        while self.chain is not None and (ready := self.chain.ready()):
            self.chain.compute(ready[0], last=ready[1])

    def part(self, inside: Collection[str]) -> None:
        """Leave the chain and compute alone."""
        self.chain, self.node.due = None, True
        self.inputs.part(inside, self.samples)
