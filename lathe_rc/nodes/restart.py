# SPDX-License-Identifier: Apache-2.0
"""Restart of a node in mid-run: it keeps its state in a file, and another process goes on from there.

The newest blocks of a process may be lost with it: DDS sends nothing again for the dead. No reader is more than a
window behind, so the state in the file is at least a window old, and the new process sends the blocks since then once
more. Nor is it older than two windows: suppliers, which may be a window ahead, keep three and some more.
"""

from collections import deque
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from lathe_rc.cell import state_file
from lathe_rc.cell.block import Block
from lathe_rc.cell.host_topics import signal_depth
from lathe_rc.cell.stage import Sparse
from lathe_rc.cell.stages import MASTERS
from lathe_rc.errors import InputError, LatheError
from lathe_rc.messages import Samples, Signals
from lathe_rc.nodes.ports import BlockQueue
from lathe_rc.nodes.stage_topics import StageTopics

_EARLY = 4  # times the blocks in flight are kept until it is known where to go on


class Restartable(StageTopics):
    """A node that may go on in place of another process, if it has a ``restart_file``."""

    def configure_part(self) -> None:
        """See `StageTopics`."""
        super().configure_part()
        self._restart_file = getattr(self.table, "restart_file", "")
        self._keep_at = 0
        # The newest states: after how many blocks, the state, and events that were asked for since.
        self._states: deque[tuple[int, bytes, list[tuple[str, int]]]] = deque()
        if self._restart_file and not self.table.window:
            raise InputError(f"{self.get_name()}.restart_file with window = 0: nobody waits for a restart; allowed: ''")

    def activate_part(self) -> None:
        """See `StageTopics`."""
        # Who may go on in place of another process does not know yet where: what comes until then is looked at later.
        self._waits = bool(self._restart_file)
        self._early: deque[tuple[BlockQueue, bytes]] = deque(
            maxlen=_EARLY * signal_depth(self.table) * len(self._queues)
        )
        super().activate_part()

    def _take_in(self, queue: BlockQueue, data: bytes) -> None:
        if self._waits:
            self._early.append((queue, data))
        else:
            super()._take_in(queue, data)

    def members_changed(self) -> None:
        """See `StageTopics`."""
        if self._waits and any(m.stage in MASTERS and not m.members for m in self.members.values()):
            self._waits = False  # alone with a spindle, it joins where it can
        if not self._waits:
            super().members_changed()

    def matched(self) -> bool:
        """See `CellNode`; a node that may join in mid-run must know whether the cell is running."""
        return (self._cell is not None or not self._restart_file) and super().matched()

    def begin(self, *, joins: bool) -> None:
        """See `CellNode`.

        Raises:
            LatheError: the cell is running, and there is nothing to go on from.
        """
        if not self._restart_file:
            if joins:
                raise LatheError(
                    f"{self.full_name}: the cell is running already, and this node cannot go on in mid-run"
                )
            return
        if joins:
            self._resume()
        self._waits = False
        self.members_changed()
        while self._early:
            self.guarded(partial(self._take_in, self._early[0][0]))(self._early.popleft()[1])
        self._keep()
        self.due = True

    def at_once(self) -> int:
        """Blocks to compute in one go, at most: up to the one after which the state is to be kept."""
        return max(min(self.together, self._keep_at - self.blocks), 1) if self._restart_file else self.together

    def _keep(self) -> None:
        """Keep the state, and write the one of a window ago."""
        self._keep_at = self.blocks + self.table.window
        self._states.append((self.blocks, state_file.dump(self._kept()), []))
        while len(self._states) > 1 and self._states[1][0] <= self.blocks - self.table.window:
            self._states.popleft()
        self._write()

    def keep_event(self, action: str, index: int) -> None:
        """Let another process know of an event that this one was asked for; nothing without a ``restart_file``."""
        for _, _, events in self._states:
            events.append((action, index))
        if self._states:
            self._write()

    def _write(self) -> None:
        _, state, events = self._states[0]
        state_file.save(Path(self._restart_file), state, state_file.dump({"events": events}))

    def _kept(self) -> dict[str, object]:
        """All that the next block depends on, and of which start of the cell it is."""
        assert self.master is not None, "it has announced all members"
        return {
            "of": (self.full_name, self.table.run_id, self.master.host, self.master.pid),
            "blocks": self.blocks,
            "samples": self.samples,
            "companions": self._framer.companions,
            "stage": self.stage,
            "events": [],
            "tracks": self._tracks,
            "queues": {topic: queue.state() for topic, queue in self._queues.items()},
        }

    def _resume(self) -> None:
        """Go on from what another process has kept."""
        fresh = self._kept()
        state = state_file.load(Path(self._restart_file), self.table, fresh, Block)
        if state["of"] != fresh["of"]:
            raise LatheError(f"{self._restart_file}: the state of another node or run; expected {fresh['of']}")
        self.blocks, self.samples, self._started = state["blocks"], state["samples"], True
        self._reported_blocks, self._framer.companions = self.blocks, state["companions"]
        self.stage, self._tracks = state["stage"], state["tracks"]
        for action, index in state["events"]:
            self.stage.schedule(action, index)
        assert self.master is not None, "it has announced all members"
        sources = {topic: name for name in self.master.members for topic in self.members[name].publishes}
        for topic, queue in self._queues.items():
            queue.resume(sources[topic], state["queues"][topic])
        self._wire()
        self.get_logger().info(f"goes on from block {self.blocks}")
        self.reporter("resumed", self.get_name(), blocks=self.blocks, sample=self.samples)

    def _publish(self, said: Sequence[Sparse], memory: Sequence[tuple[Signals, Samples | None]], *, last: bool) -> None:
        super()._publish(said, memory, last=last)
        if self._restart_file and not last and self.blocks >= self._keep_at:
            self._keep()
