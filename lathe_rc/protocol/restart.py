# SPDX-License-Identifier: Apache-2.0
"""Restart of a member in mid-run, without I/O: it stores its state, and another process of it resumes from there."""

from abc import abstractmethod
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Protocol

from lathe_rc.errors import InputError
from lathe_rc.protocol.kept_states import KeptStates

if TYPE_CHECKING:
    from lathe_rc.protocol.stage_run import StageRun


class Store(Protocol):
    """Place of a state that outlives the process.

    Attributes:
        name: name of the place, for messages.
    """

    name: str

    @abstractmethod
    def write(self, state: Any) -> None:
        """Replace the state."""

    @abstractmethod
    def read(self, restore: Callable[[Any], object]) -> None:
        """Pass the stored state to a function."""


class Resumable(Protocol):
    """State of a stage beside its inputs."""

    def feedback_delays(self) -> Iterable[int]:
        """Return the delays of the readers of its topics [block]."""

    def state(self) -> dict[str, Any]:
        """Return the state that the next block depends on."""

    def restore(self, state: dict[str, Any]) -> None:
        """Resume from a `state`; its key ``events`` holds what `Restart.keep_event` has added since."""


class Restart:
    """State of a stage that another process can resume from.

    Args:
        run: run of the stage.
        stage: the stage's own state.
        store: place of the state.
    """

    def __init__(self, run: "StageRun", stage: Resumable, store: Store) -> None:
        self._run, self._stage, self._store, self._node = run, stage, store, run.node
        self._kept: KeptStates[dict[str, Any]] = KeptStates(run.node.table.window)  # with the events scheduled since

    @property
    def keep_at(self) -> int:
        """Return the number of blocks after which the state is stored next."""
        return self._kept.keep_at

    def begin(self, *, joins: bool) -> None:
        """Begin at block 0, or resume from the state of another process."""
        self._kept.begin(self._stage.feedback_delays())
        if joins:
            self._store.read(self._restore)
        self.keep()

    def keep(self) -> None:
        """Keep the current state in memory, and store one that no reader has passed."""
        self._store.write(self._kept.keep(self._run.blocks, self._state()))

    def keep_event(self, action: str, place: float) -> None:
        """Append a scheduled event to the stored state, for a process that resumes.

        Args:
            action: the event.
            place: sample at which it takes effect, an int; or number of revolutions, a float.
        """
        for state in (states := self._kept.states):
            state["events"].append((action, place))
        if states:
            self._store.write(states[0])

    @property
    def _of(self) -> list[Any]:
        """Return the node and the session of the cell to which the state belongs."""
        master = self._node.protocol.master
        assert master is not None, "it has announced all members"
        return [self._node.full_name, self._node.table.run_id, master.host, master.pid]

    def _state(self) -> dict[str, Any]:
        """Return the state that the next block depends on."""
        own = {"of": self._of, "blocks": self._run.blocks, "samples": self._run.samples, "events": []}
        return own | self._stage.state() | self._run.inputs.state()

    def _restore(self, state: Any) -> None:
        """Resume from the state of another process.

        Raises:
            InputError: it is the state of another node or run.
        """
        run, protocol = self._run, self._node.protocol
        if state["of"] != self._of:
            raise InputError(f"{self._store.name}: the state of another node or run; expected {self._of}")
        self._stage.restore(state)
        run.blocks, run.samples, run.started = state["blocks"], state["samples"], True
        protocol.resumed(run.blocks, run.samples)
        assert protocol.master is not None, "it has announced all members"
        sources = {topic: name for name in protocol.master.members for topic in protocol.members[name].publishes}
        run.inputs.go_on(sources, state)
