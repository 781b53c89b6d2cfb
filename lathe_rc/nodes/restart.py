# SPDX-License-Identifier: Apache-2.0
"""Restart of a node in mid-run: the node stores its state in a file, and a new process resumes from it."""

import os
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lathe_rc import data_file
from lathe_rc.cell.changes import Restoring, changes
from lathe_rc.cell.parameters import remapped
from lathe_rc.cell.scenario import new_stage
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError
from lathe_rc.protocol.kept_states import KeptStates

if TYPE_CHECKING:
    from lathe_rc.nodes.stage_role import StageRole

_KIND = "state"


class Restart:
    """State of a stage in a file.

    Args:
        role: role of the stage.
        file: path of the state file.

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
        self._start = new_stage(role.node.get_name(), role.node.table)
        self._kept: KeptStates[dict[str, Any]] = KeptStates(self._window)  # with the events scheduled since

    @property
    def keep_at(self) -> int:
        """Return the number of blocks after which the state is stored next."""
        return self._kept.keep_at

    def begin(self, *, joins: bool) -> None:
        """Begin at block 0, or resume from the state of another process."""
        protocol, published = self._node.protocol, self._role.stage.outputs
        assert protocol.master is not None, "it has announced all members"
        cell = Cell(*self._node.announced(protocol.master.members))
        table = self._node.table
        delays = [port.delay for out in published for port in cell.inputs(remapped(table, out.topic))]
        self._kept.begin(-(-delay // table.block_size) for delay in delays)
        if joins:
            self._resume()
        self.keep()

    def keep(self) -> None:
        """Keep the current state in memory, and write one that no reader has passed to the file."""
        self._write(self._kept.keep(self._role.blocks, self._state()))

    def keep_event(self, action: str, place: float) -> None:
        """Append a scheduled event to the state file, for a process that resumes.

        Args:
            action: the event.
            place: sample at which it takes effect, an int; or number of revolutions, a float.
        """
        for state in (states := self._kept.states):
            state["events"].append((action, place))
        if states:
            self._write(states[0])

    def _write(self, state: dict[str, Any]) -> None:
        """Replace the file atomically: a reader sees either state, even if this process is killed.

        Raises:
            LatheError: the file cannot be written.
        """
        path = Path(self._file)
        new = path.with_name(f"{path.name}.new")
        try:
            new.unlink(missing_ok=True)
            with open(new, "xb", opener=lambda name, flags: os.open(name, flags, 0o600)) as file:
                file.write(data_file.packed(_KIND, state, level=0))
            new.replace(path)
        except OSError as error:
            raise LatheError(f"{path}: the state cannot be kept ({error.strerror})") from None

    @property
    def _of(self) -> list[Any]:
        """Return the node and the session of the cell to which the state belongs."""
        master = self._node.protocol.master
        assert master is not None, "it has announced all members"
        return [self._node.full_name, self._node.table.run_id, master.host, master.pid]

    def _state(self) -> dict[str, Any]:
        """Return the state that the next block depends on."""
        role = self._role
        return {
            "of": self._of,
            "blocks": role.blocks,
            "samples": role.samples,
            "companions": role.outputs.framer.companions,
            "stage": changes(role.stage, self._start),
            "events": [],
            "past": {topic: (buffer.end, buffer.past()) for topic, buffer in role.inputs.buffers.items()},
            "queues": {topic: queue.state() for topic, queue in role.inputs.queues.items()},
        }

    def _resume(self) -> None:
        """Resume from the state of another process.

        Raises:
            LatheError: the file is no state of this node in this cell, or another user could have written it.
        """
        path = Path(self._file)
        try:
            about = path.stat()
        except OSError as error:
            raise LatheError(f"{path}: the state cannot be read ({error.strerror})") from None
        if about.st_uid != os.getuid() or about.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            raise LatheError(f"{path}: another user owns or may write this state; allowed: your own file, mode 600")
        data_file.read(path, _KIND, self._restore)
        role = self._role
        self._node.get_logger().info(f"goes on from block {role.blocks}")
        self._node.reporter("resumed", self._node.get_name(), blocks=role.blocks, sample=role.samples)

    def _restore(self, state: Any) -> None:
        role, protocol = self._role, self._node.protocol
        if state["of"] != self._of:
            raise InputError(f"{self._file}: the state of another node or run; expected {self._of}")
        Restoring().restore(state["stage"], role.stage)
        role.blocks, role.samples, role.started = state["blocks"], state["samples"], True
        protocol.resumed(role.blocks)
        role.outputs.framer.companions = state["companions"]
        for topic, (end, past) in state["past"].items():
            role.inputs.buffers[topic].restart(end, past)
        for action, place in state["events"]:
            role.stage.schedule(action, place, "sample" if isinstance(place, int) else "revolution")
        assert protocol.master is not None, "it has announced all members"
        sources = {topic: name for name in protocol.master.members for topic in protocol.members[name].publishes}
        for topic, queue in role.inputs.queues.items():
            queue.go_on(sources[topic], state["queues"][topic])
        role.inputs.wire()
