# SPDX-License-Identifier: Apache-2.0
"""Role of a node with a stage: reads blocks in order, computes alone or in a chain, and publishes."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from lathe_rc_msgs.srv import Schedule

from lathe_rc import messages
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell import events
from lathe_rc.cell.ahead import uncompiled
from lathe_rc.cell.changes import Restoring, changes
from lathe_rc.cell.checkpoint import Checkpoint
from lathe_rc.cell.kinds import STAGES
from lathe_rc.cell.parameters import Value, explain_overflow, remapped
from lathe_rc.cell.scenario import new_stage
from lathe_rc.cell.stage import Stage, compile_kernels
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError
from lathe_rc.messages import Signals
from lathe_rc.nodes.cell_node import CellNode, Role
from lathe_rc.nodes.outputs import Memory, Outputs
from lathe_rc.nodes.state_file import StateFile
from lathe_rc.protocol import Announcement, MemberProtocol
from lathe_rc.protocol.block_queue import BlockQueue
from lathe_rc.protocol.inputs import Inputs
from lathe_rc.protocol.restart import Restart
from lathe_rc.protocol.stage_run import StageRun

_TOGETHER = 2  # steps per window, so that members still work in parallel


class StageRole(StageRun, Role):
    """Role of a cell node that computes a stage.

    Args:
        node: node that has this role.

    Attributes:
        node: see the arguments.
        stage: stage that the role computes.
        begun: checkpoint from which the stage goes on; None: it has not begun, or begins at sample 0.
        angle: measured spindle angle of the newest sample [rad], of a stage with tunable parameters.
    """

    node: CellNode
    stage: Stage

    def __init__(self, node: CellNode) -> None:
        self.node = node
        with explain_overflow({node.get_name(): node.table}):
            self.stage = STAGES[node.kind](node.get_name(), node.table)
        self._compile()
        self.begun: Checkpoint | None = None
        self.angle = 0.0
        self._shown = self.stage.parameters
        self.together = max(min(node.table.window // _TOGETHER, messages.MAX_BLOCK // node.table.block_size), 1)
        self.inputs = Inputs([(node.topic(port.topic), port) for port in self.stage.inputs], node.table, self.together)
        self.outputs = Outputs(node, self.stage)
        self.restart = None
        if file := getattr(node.table, "restart_file", ""):
            if not node.table.window:
                name = f"{node.get_name()}.restart_file"
                raise InputError(f"{name} with window = 0: nobody waits for a restart; allowed: ''")
            self._start = new_stage(node.get_name(), node.table)
            self.restart = Restart(self, self, StateFile(file))

    # ---- membership ---------------------------------------------------------------------------------

    def protocol(self, own: Announcement) -> MemberProtocol:
        """Return the node's protocol object (implements `Role`)."""
        return MemberProtocol(own, self.node.table.window)

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
        self.listen_to_inputs()
        self.node.create_service(Schedule, "~/schedule", self._on_schedule)

    def listen(self, queue: BlockQueue) -> None:
        """Subscribe a queue to its topic, over DDS or inside this process (implements `StageRun`)."""
        self.node.listen(queue.topic, queue.type, queue.add, queue.take)

    def prepare(self) -> None:
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
        """Continue without lost members; results of cycles are unsound from now on (extends `StageRun`)."""
        self.outputs.unsound = True
        super().lose(lost, first, end, again=again)

    def become_safe(self, first: int) -> None:
        """Switch the stage to its safe state, starting at sample ``first``."""
        self.stage.lose(first)

    def clean_up(self) -> None:
        """Leave the chain and the exchange of the process (implements `Role`)."""
        self.failed()
        if self in self.node.exchange.stages:
            self.node.exchange.stages.remove(self)

    def tick(self, now: float) -> float:
        """Check for readers in other processes, and hold inputs that lose the last block (implements `Role`)."""
        self.outputs.tick(now)
        self.hold_quiet_inputs(now)
        return float("inf")

    def statistics(self) -> dict[str, object]:
        """Return blocks, samples, lost blocks and missing inputs for the diagnostics (implements `Role`)."""
        waiting = {f"waiting for {topic}": not queue.blocks for topic, queue in self.inputs.queues.items()}
        return {"blocks": self.blocks, "samples": self.samples, "lost blocks": self.lost, **waiting}

    @property
    def lost(self) -> int:
        """Return the number of blocks lost in a free-running cell."""
        return sum(queue.lost for queue in self.inputs.queues.values())

    # ---- restart ------------------------------------------------------------------------------------

    def feedback_delays(self) -> Iterable[int]:
        """Return the delays of the readers of the stage's topics [block] (implements `Resumable`)."""
        master, table = self.node.protocol.master, self.node.table
        assert master is not None, "it has announced all members"
        cell = Cell(*self.node.announced(master.members))
        inputs = [port for out in self.stage.outputs for port in cell.inputs(remapped(table, out.topic))]
        return [-(-port.delay // table.block_size) for port in inputs]

    def state(self) -> dict[str, Any]:
        """Return the state of stage and outputs (implements `Resumable`)."""
        return {"companions": self.outputs.framer.companions, "stage": changes(self.stage, self._start)}

    def restore(self, state: dict[str, Any]) -> None:
        """Resume from the `state` of another process (implements `Resumable`)."""
        Restoring().restore(state["stage"], self.stage)
        self.outputs.framer.companions = state["companions"]
        for action, place in state["events"]:
            self.stage.schedule(action, place, "sample" if isinstance(place, int) else "revolution")

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

    def compute(self, samples: int, *, last: bool) -> None:
        """Compute and publish some blocks in one step; the last block of the run may be shorter."""
        memory = self.outputs.memory(samples)
        inputs = self.inputs.read(self.samples, samples)
        if self.stage.tunable and self.stage.angle_input is not None:
            self.angle = float(inputs[self.stage.angle_input]["angle"][-1])
        said = self.stage.advance(self.samples, inputs, [signals for signals, _ in memory], last=last)
        self._publish(said, memory, samples, last=last)

    def _publish(self, said: Sequence[Sparse], memory: Sequence[Memory], samples: int, *, last: bool) -> None:
        blocks = self.outputs.publish(self.samples, said, memory, last=last)
        if self.stage.parameters is not self._shown:
            self._shown = self.stage.parameters
            self.node.show_parameters(self._shown, self.stage.tunable)
        self.computed(blocks, samples, last=last)

    def last_computed(self) -> None:
        """Report events that were not reached."""
        if waiting := self.stage.waiting:
            self.node.get_logger().warning(f"not reached: {'; '.join(waiting)}")
            self.node.reporter("not_reached", self.node.get_name(), events=waiting)

    # ---- in a chain ---------------------------------------------------------------------------------

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
