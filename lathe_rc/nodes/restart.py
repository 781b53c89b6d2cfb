# SPDX-License-Identifier: Apache-2.0
"""Restart of a node in mid-run: the node stores its state in a file, and a new process resumes from it.

The newest blocks of a process may be lost when it dies, since DDS then repeats no message. No reader is more than one
window and its feedback delay behind, so the state in the file is at least that old, and the new process sends the
blocks since then again. The state is at most another window old: publishers, which may be one window ahead, keep a
little more than three.
"""

from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING

from lathe_rc.cell import state_file
from lathe_rc.cell.block import Block
from lathe_rc.cell.events import Trigger
from lathe_rc.cell.parameters import remapped
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError

if TYPE_CHECKING:
    from lathe_rc.nodes.stage_role import StageRole


class Restart:
    """State of a stage in a file.

    Args:
        role: role of the stage.
        file: path of the state file.

    Attributes:
        keep_at: number of blocks after which the state is stored next.

    Raises:
        InputError: the cell has no window.
    """

    def __init__(self, role: "StageRole", file: str) -> None:
        self._role, self._file, self._node = role, file, role.node
        self._window = role.node.table.window
        if not self._window:
            raise InputError(
                f"{role.node.get_name()}.restart_file with window = 0: nobody waits for a restart; allowed: ''"
            )
        self.keep_at = 0
        self._behind = self._window  # blocks that a reader may be behind
        # The newest states: number of blocks, state, and events scheduled since.
        self._states: deque[tuple[int, bytes, list[tuple[str, float]]]] = deque()

    def begin(self, *, joins: bool) -> None:
        """Begin at block 0, or resume from the state of another process."""
        protocol, published = self._node.protocol, self._role.stage.outputs
        assert protocol.master is not None, "it has announced all members"
        cell = Cell(*self._node.announced(protocol.master.members))
        delays = [port.delay for out in published for port in cell.inputs(remapped(self._node.table, out.topic))]
        self._behind = self._window + -(-max(delays, default=0) // self._node.table.block_size)
        if joins:
            self._resume()
        self.keep()

    def keep(self) -> None:
        """Keep the current state in memory, and write one that no reader has passed to the file."""
        blocks = self._role.blocks
        self.keep_at = blocks + self._window
        self._states.append((blocks, state_file.dump(self._kept()), []))
        while len(self._states) > 1 and self._states[1][0] <= blocks - self._behind:
            self._states.popleft()
        self._write()

    def keep_event(self, action: str, place: float) -> None:
        """Append a scheduled event to the state file, for a process that resumes.

        Args:
            action: the event.
            place: sample at which it takes effect, an int; or number of revolutions, a float.
        """
        for _, _, events in self._states:
            events.append((action, place))
        if self._states:
            self._write()

    def _write(self) -> None:
        _, state, events = self._states[0]
        state_file.save(Path(self._file), state, state_file.dump({"events": events}))

    def _kept(self) -> dict[str, object]:
        """Return the state that the next block depends on, with the session of the cell."""
        role, master = self._role, self._node.protocol.master
        assert master is not None, "it has announced all members"
        return {
            "of": (self._node.full_name, self._node.table.run_id, master.host, master.pid),
            "blocks": role.blocks,
            "samples": role.samples,
            "companions": role.outputs.framer.companions,
            "stage": role.stage,
            "events": [],
            "tracks": role.inputs.buffers,
            "queues": {topic: queue.state() for topic, queue in role.inputs.queues.items()},
        }

    def _resume(self) -> None:
        """Resume from the state of another process."""
        role, fresh, protocol = self._role, self._kept(), self._node.protocol
        state = state_file.load(Path(self._file), self._node.table, fresh, Block, Trigger)
        if state["of"] != fresh["of"]:
            raise LatheError(f"{self._file}: the state of another node or run; expected {fresh['of']}")
        role.blocks, role.samples, role.started = state["blocks"], state["samples"], True
        protocol.resumed(role.blocks)
        role.outputs.framer.companions = state["companions"]
        role.stage, role.inputs.buffers = state["stage"], state["tracks"]
        for action, place in state["events"]:
            schedule = role.stage.schedule if isinstance(place, int) else role.stage.schedule_at_revolution
            schedule(action, place)
        assert protocol.master is not None, "it has announced all members"
        sources = {topic: name for name in protocol.master.members for topic in protocol.members[name].publishes}
        for topic, queue in role.inputs.queues.items():
            queue.go_on(sources[topic], state["queues"][topic])
        role.inputs.wire()
        self._node.get_logger().info(f"goes on from block {role.blocks}")
        self._node.reporter("resumed", self._node.get_name(), blocks=role.blocks, sample=role.samples)
