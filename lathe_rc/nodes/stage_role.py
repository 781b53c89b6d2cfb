# SPDX-License-Identifier: Apache-2.0
"""Role of a node with a stage: reads blocks in order, computes alone or in a chain, and publishes."""

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from lathe_rc_msgs.srv import Schedule

from lathe_rc import messages
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell import events
from lathe_rc.cell.ahead import uncompiled
from lathe_rc.cell.checkpoint import Checkpoint
from lathe_rc.cell.kinds import MASTERS, STAGES
from lathe_rc.cell.parameters import Value, explain_overflow
from lathe_rc.cell.stage import Stage, compile_kernels
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError, LossyRunError
from lathe_rc.messages import Signals
from lathe_rc.nodes.cell_node import CellNode, Role
from lathe_rc.nodes.outputs import Memory, Outputs
from lathe_rc.nodes.restart import Restart
from lathe_rc.protocol import Announcement, MemberProtocol
from lathe_rc.protocol.block_queue import BlockQueue, explain_losses
from lathe_rc.protocol.inputs import Inputs

if TYPE_CHECKING:
    from lathe_rc.nodes.chain import Chain

_TOGETHER = 2  # steps per window, so that members still work in parallel


class StageRole(Role):
    """Role of a cell node that computes a stage.

    Args:
        node: node that has this role.

    Attributes:
        node: see the arguments.
        stage: stage that the role computes.
        begun: checkpoint from which the stage goes on; None: it has not begun, or begins at sample 0.
        blocks, samples: number computed so far, samples including those before the checkpoint.
        together: largest number of blocks computed in one step.
        started: the first sample is known.
        chain: chain of the stage; None if it computes alone.
        angle: measured spindle angle of the newest sample [rad], of a stage with tunable parameters.
    """

    stage: Stage

    def __init__(self, node: CellNode) -> None:
        self.node = node
        with explain_overflow({node.get_name(): node.table}):
            self.stage = STAGES[node.kind](node.get_name(), node.table)
        self._compile()
        self.begun: Checkpoint | None = None
        self.blocks = self.samples = 0
        self.started, self.angle = False, 0.0
        self.chain: Chain | None = None
        self._shown = self.stage.parameters
        self.together = max(min(node.table.window // _TOGETHER, messages.MAX_BLOCK // node.table.block_size), 1)
        self.inputs = Inputs([(node.topic(port.topic), port) for port in self.stage.inputs], node.table, self.together)
        self.outputs = Outputs(node, self.stage)
        file = getattr(node.table, "restart_file", "")
        self.restart = Restart(self, file) if file else None

    # ---- membership ---------------------------------------------------------------------------------

    def protocol(self, own: Announcement) -> MemberProtocol:
        """Return the node's protocol object (implements `Role`)."""
        return MemberProtocol(own, self.node.table.window, masters=MASTERS)

    def publications(self) -> list[tuple[str, str, bool]]:
        """Return topic, message type and sparse flag of each output (implements `Role`)."""
        return self.outputs.publications

    def subscriptions(self) -> list[str]:
        """Return the topics of the stage's inputs (implements `Role`)."""
        return list(self.inputs.queues)

    def relative_topics(self) -> list[str]:
        """Return the stage's signal topics before remapping (implements `Role`)."""
        return self.stage.topics

    def activate(self) -> None:
        """Create publishers, subscriptions and the service that schedules events (implements `Role`)."""
        self.outputs.activate()
        for topic, queue in self.inputs.queues.items():
            queue.inside = self.node.exchange.has(topic)
            queue.run_end = lambda: self.node.protocol.end
            self.node.listen(topic, queue.type, queue.add, queue.take)
        self.inputs.share()
        self.node.exchange.stages.append(self)
        self.node.create_service(Schedule, "~/schedule", self._on_schedule)

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
        begun = self.node.begun()
        queue.expect(source, begun.sample if begun else 0)
        queue.repeats = self.node.protocol.restarts(source)

    def begin(self, *, joins: bool) -> None:
        """Prepare for block 0, or resume from a kept state in a running cell (implements `Role`).

        Raises:
            LatheError: the cell is running, and the node has no kept state to resume from; or the checkpoint is not one
                of this node.
        """
        if not joins:
            self.go_on()
        if self.restart is not None:
            self.restart.begin(joins=joins)
        elif joins:
            raise LatheError(
                f"{self.node.full_name}: the cell is running already, and this node cannot go on in mid-run"
            )

    def go_on(self) -> None:
        """Take the state of the stage from the checkpoint, if the run goes on from one.

        Raises:
            InputError: the checkpoint is not one of this node.
        """
        if self.begun is None and (begun := self.node.begun()) is not None:
            table = self.node.table.model_copy(update={"stage": self.node.kind})
            self.begun, self.samples = begun, begun.sample
            with explain_overflow({self.node.get_name(): table}):
                self.stage = begun.stage(self.node.get_name(), table)
            self._compile()

    def _compile(self) -> None:
        """Compile the stage, so that the first block takes no longer than the next."""
        if uncompiled([self.stage]):
            self.node.get_logger().info("compiles its step, once on this computer: usually 2 to 20 s")
        compile_kernels(self.stage)

    @property
    def past(self) -> dict[str, Signals]:
        """Return the samples before the checkpoint that delayed inputs need, by fully qualified topic and field."""
        past = self.begun.past if self.begun else {}
        return {f"{self.node.namespace}{topic}": signals for topic, signals in past.items()}

    def lose(self, lost: frozenset[str], first: int, end: int, *, again: bool) -> None:
        """Continue without lost members: the newest samples of their topics are held (implements `Role`)."""
        self.outputs.unsound = True
        if self.chain is not None:
            self.chain.leave()
        unlimited = self.inputs.lose(lost, end)
        if not again:
            self.become_safe(first)
        if unlimited:
            self._follow_the_master(first)
        self.node.due = True

    def become_safe(self, first: int) -> None:
        """Switch the stage to its safe state, starting at sample ``first``."""
        self.stage.lose(first)

    def _follow_the_master(self, first: int) -> None:
        """Read the spindle's blocks, which limit the stage from sample ``first`` on."""
        master = self.node.protocol.master
        assert master is not None, "it has declared the safe state"
        topic = next(topic for topic, sparse in zip(master.publishes, master.sparse, strict=True) if not sparse)
        pace = self.inputs.follow(topic, master.name, first)
        self.node.listen(topic, pace.type, pace.add, pace.take)

    def failed(self) -> None:
        """Dissolve the chain after a failure; its other stages go on alone (implements `Role`)."""
        if self.chain is not None:
            self.chain.leave()

    def clean_up(self) -> None:
        """Leave the chain and the exchange of the process (implements `Role`)."""
        self.failed()
        if self in self.node.exchange.stages:
            self.node.exchange.stages.remove(self)

    def tick(self, now: float) -> float:
        """Check for readers in other processes, and hold inputs that lose the last block (implements `Role`)."""
        self.outputs.tick(now)
        queues = self.inputs.queues.values()
        for queue in queues:
            queue.end_with(queues, now)
            self.node.due = self.node.due or queue.lossy
        return float("inf")

    def statistics(self) -> dict[str, object]:
        """Return blocks, samples, lost blocks and missing inputs for the diagnostics (implements `Role`)."""
        waiting = {f"waiting for {topic}": not queue.blocks for topic, queue in self.inputs.queues.items()}
        return {"blocks": self.blocks, "samples": self.samples, "lost blocks": self.lost, **waiting}

    @property
    def lost(self) -> int:
        """Return the number of blocks lost in a free-running cell."""
        return sum(queue.lost for queue in self.inputs.queues.values())

    # ---- events -------------------------------------------------------------------------------------

    def _on_schedule(self, request: Any, response: Any) -> Any:
        index = max(self.samples, int(request.not_before))
        try:
            self._accept_events(request.action)
            self.stage.schedule(request.action, index)
        except LatheError as error:
            response.message = str(error)
            return response
        self._keep_event(request.action, index)
        response.accepted, response.sample_index = True, index
        return response

    def _accept_events(self, *actions: str) -> None:
        """Check that events can be scheduled now, and that the cell still converges after those that set parameters.

        Raises:
            LatheError: the reason why not.
        """
        node, protocol = self.node, self.node.protocol
        if protocol.failure:
            raise protocol.failure
        if self.restart is not None and not protocol.ready:
            raise InputError(f"{node.full_name} is not ready yet; ask again")
        for action in actions:
            self.stage.check_action(action)
        if protocol.master is None or not any(events.parse(action).verb == events.SET for action in actions):
            return
        tuned = self.stage.tuned(*actions)
        cell = Cell(*node.announced(protocol.master.members))
        known = cell.stages[node.full_name.removeprefix(node.namespace)]
        values = {name: getattr(tuned.shared, name) for name in tuned.tunable}
        table = known.shared.model_copy(update={**values, "events": [], "faults": []})
        type(known)(known.name, table).check_cell(cell, cures=False)
        for warning in cell.warnings:
            node.get_logger().warning(warning)

    def _keep_event(self, action: str, place: float) -> None:
        if self.restart is not None and not self.node.protocol.over:
            self.node.attempt(self.restart.keep_event, action, place)

    @property
    def tunable(self) -> tuple[str, ...]:
        """Return the stage's parameters that may change in a run (implements `Role`)."""
        return self.stage.tunable

    def tune(self, values: Mapping[str, Value]) -> str:
        """Schedule changed parameters as events at the begin of the next cycle (implements `Role`).

        Raises:
            LatheError: the node computes no samples, or the cell would not converge.
        """
        node = self.node
        if not self.started or node.protocol.over:
            when = "has ended" if node.protocol.over else "has not begun"
            before = f"; 'ros2 lifecycle set {node.full_name} cleanup' lets parameters be set before it"
            raise InputError(f"{node.full_name}: the run {when}{'' if node.protocol.over else before}")
        actions = [f"{events.SET} {name} {value!r}" for name, value in values.items()]
        self._accept_events(*actions)
        cycle = int(getattr(self.stage.parameters, "cycle_revolutions", 1))
        revolution = float((self.angle // (2.0 * np.pi * cycle) + 1) * cycle)
        for action in actions:
            self.stage.schedule(action, revolution, "revolution")
            self._keep_event(action, revolution)
        return f"from revolution {revolution:g} on, as an event on {node.full_name}/events"

    # ---- data ---------------------------------------------------------------------------------------

    @property
    def computes(self) -> bool:
        """Return True if the node takes part in a running cell."""
        protocol = self.node.protocol
        return protocol.active and protocol.ready and not (protocol.failure or protocol.over)

    def work(self) -> None:
        """Compute every block whose inputs have arrived (implements `Role`)."""
        if self.node.protocol.master is not None and not self.node.protocol.ready:
            return  # blocks may wait in the queues until the node is ready
        if not self.started and any(queue.blocks for queue in self.inputs.forward):
            self.node.exchange.form(self, None)
        if self.chain is not None:
            self.chain.advance()
            return
        while not self.node.protocol.over and not self.node.protocol.failure and (ready := self.ready()):
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

    def start(self, first: int) -> None:
        """Begin the computation at sample ``first``."""
        self.started, self.samples = True, first
        self.inputs.begin(first, self.past)

    def compute(self, samples: int, *, last: bool) -> None:
        """Compute and publish some blocks in one step; the last block of the run may be shorter."""
        memory = self.outputs.memory(samples)
        inputs = self.inputs.read(self.samples, samples)
        if self.stage.tunable and self.stage.angle_input is not None:
            self.angle = float(inputs[self.stage.angle_input]["angle"][-1])
        said = self.stage.advance(self.samples, inputs, [signals for signals, _ in memory], last=last)
        self._publish(said, memory, samples, last=last)

    def _publish(self, said: Sequence[Sparse], memory: Sequence[Memory], samples: int, *, last: bool) -> None:
        self.blocks += self.outputs.publish(self.samples, said, memory, last=last)
        self.samples += samples
        if self.stage.parameters is not self._shown:
            self._shown = self.stage.parameters
            self.node.show_parameters(self._shown, self.stage.tunable)
        self.node.completed(self.blocks, self.samples, last=last)
        if last:
            self._complete()
        elif self.restart is not None and self.blocks >= self.restart.keep_at:
            self.restart.keep()

    def _complete(self) -> None:
        """Finish after the last block: report events that were not reached, and lost blocks."""
        if waiting := self.stage.waiting:
            self.node.get_logger().warning(f"not reached: {'; '.join(waiting)}")
            self.node.reporter("not_reached", self.node.get_name(), events=waiting)
        self.node.complete_part()
        if losses := explain_losses(self.node.full_name, self.inputs.queues.values()):
            raise LossyRunError(losses)

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

    def join(self, chain: "Chain", inside: Collection[str]) -> None:
        """Join a chain before block 0; the stages of the chain publish the topics ``inside``."""
        self.chain = chain
        self.inputs.join_chain(inside)
        self.start(self.samples)

    def lead(self) -> None:
        """As the first stage of a chain, let the chain compute as far as its inputs allow."""
        while self.chain is not None and (ready := self.chain.ready()):
            self.chain.compute(ready[0], last=ready[1])

    def publish_copies(self, sparse: list[Sparse], outputs: Sequence[Signals], *, last: bool) -> None:
        """Publish copies of the arrays that the chain has computed, since readers keep the published arrays."""
        samples = next(iter(outputs[0].values())).size
        memory = self.outputs.memory(samples)
        for (copies, _), signals in zip(memory, outputs, strict=True):
            for name, array in copies.items():
                array[:] = signals[name]
        copied = [copies for copies, _ in memory]
        sparse = self.stage.conclude(self.samples, self.samples + samples, sparse, copied, last=last)
        self._publish(sparse, memory, samples, last=last)

    def part(self, inside: Collection[str]) -> None:
        """Leave the chain and compute alone."""
        self.chain, self.node.due = None, True
        self.inputs.part(inside, self.samples)
