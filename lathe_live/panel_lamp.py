# SPDX-License-Identifier: Apache-2.0
"""Lamp of the panel: state of the supervisor and faults in force, as last heard, and how long ago that was.

The state at the newest sample is that of the supervisor's blocks; its messages tell cause and time of a state. The lamp
does not assume what it has not heard: a supervisor that finds nothing sends no message, and so does one that has died.
"""

import threading
import time
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from lathe_machine.safety import next_step
from lathe_rc import event_log, messages
from lathe_rc.blocks.ports import Sparse
from lathe_rc.messages import Signals
from lathe_rc.safety.state_machine import RESET, Reaction, State

OUT = (State.RETRACTING.name.lower(), State.SAFE.name.lower())  #: states in which the tool is out of the part
UNKNOWN = "unknown"  #: state before the supervisor was heard
_LATE = 3.0  # [s] without a sign of the supervisor from which on the lamp is late


@dataclass(frozen=True)
class Alarm:
    """State of a supervisor, as its messages tell it.

    Attributes:
        state: name of the state.
        since: sample at which it began.
        cause: message that led to the state; that of a retraction stays when the tool is out.
        newest: newest message.
    """

    state: str
    since: int
    cause: str
    newest: str

    @classmethod
    def after(cls, before: "Alarm | None", message: Sparse) -> "Alarm":
        """Return the state after a further message."""
        state, newest = event_log.supervisor_state(message), event_log.text(message)
        if before and before.state == state:
            return cls(state, before.since, before.cause, newest)
        goes_on = before and before.state in OUT and state in OUT
        return cls(state, message.index, before.cause if before and goes_on else event_log.cause(message), newest)


class Lamp:
    """State of a supervisor and faults in force; a sink of the engine. Its methods may be called by any thread.

    Args:
        live: whether the supervisor runs elsewhere, so that the lamp can be late.
    """

    def __init__(self, *, live: bool = False) -> None:
        self._live, self._lock = live, threading.Lock()
        self._lasting = {*vars(self), "_lasting"}  # attributes that are no `state` of a run
        self.clear()

    def clear(self) -> None:
        """Begin with another run."""
        with self._lock:
            self._alarm: Alarm | None = None
            self._told = -1  # sample of the newest message
            self._state, self._reached = UNKNOWN, -1  # at the newest sample of the blocks
            self._reaction = 0  # as last heard
            self._alarms: list[tuple[int, str]] = []  # sample and monitor, since the last reset up to the retraction
            self._cleared: dict[str, int] = {}  # sample at which a controller last cleared its memory
            self._conditions = event_log.Conditions()
            self._heard = time.monotonic()

    def state(self) -> Mapping[str, Any]:
        """Return the state so far, for `resume`; it goes on changing."""
        return {name: value for name, value in vars(self).items() if name not in self._lasting}

    def resume(self, state: Mapping[str, Any]) -> None:
        """Go on from a copy of a state."""
        with self._lock:
            vars(self).update(state)

    def hear(self, last: int, state: int, reaction: int) -> None:
        """Take state and reaction at the last sample of a block of the supervisor."""
        with self._lock:
            if last > self._reached:
                self._state, self._reached, self._reaction = event_log.state_name(state), last, reaction
                self._heard = time.monotonic()

    def take(self, message: Sparse) -> None:
        """Take a message of a node; the messages of a topic arrive in order."""
        with self._lock:
            if message.type == messages.SAFETY_STATUS:
                self._raise(str(message.values["monitor"]), message.index)
                self._alarm, self._told = Alarm.after(self._alarm, message), message.index
                if self._told > self._reached:
                    self._reaction = int(message.values["reaction"])
                self._heard = time.monotonic()
            elif message.type == messages.EVENT:
                self._conditions.take(message)
                if message.values["action"] == "clear":
                    self._cleared[message.topic.removesuffix("/events").rpartition("/")[2]] = message.index

    def _raise(self, monitor: str, index: int) -> None:
        """Note an alarm, unless the tool is out already: it would be a consequence of the retraction."""
        if monitor == RESET:
            self._alarms.clear()
        elif not (self._alarm and self._alarm.state in OUT):
            self._alarms.append((index, monitor))

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Take consecutive samples, as a sink of the engine."""
        for message in sorted((each for found in sparse.values() for each in found), key=lambda each: each.index):
            self.take(message)
        for signals in dense.values():
            if "reaction" in signals:  # of a SafetyBlock
                self.hear(first + samples - 1, int(signals["state"][-1]), int(signals["reaction"][-1]))

    def now(self, *, supervised: bool, memories: Collection[str] = ()) -> dict[str, Any]:
        """Return the state for the page: ``safety``, ``faults``, and ``next``, the steps of the operator by event.

        Args:
            supervised: whether the cell has a supervisor; if it has none, ``safety`` is None until one is heard.
            memories: learning controllers whose memories can be cleared.
        """
        with self._lock:
            faults = [f"{node}: {fault}" for (node, _), found in self._conditions.faults.items() for fault in found]
            state = self._state if self._reached >= self._told else self._alarm.state if self._alarm else UNKNOWN
            if state == UNKNOWN and not supervised:
                return {"safety": None, "faults": faults, "next": {}}
            age = time.monotonic() - self._heard if self._live else 0.0
            told = self._alarm if self._alarm and self._alarm.state == state else None
            safety = {
                "state": state,
                "since": told.since if told else None,
                "cause": told.cause if told else "",
                "alarm": self._alarm.newest if self._alarm else "",
                "age": round(age, 1),
                "late": state != UNKNOWN and age > _LATE,
            }
            return {"safety": safety, "faults": faults, "next": self._next(state, faults, memories)}

    def _next(self, state: str, faults: list[str], memories: Collection[str]) -> dict[str, Any]:
        """Return the next steps by event; none in an unknown state."""
        if state.upper() not in State.__members__ or self._reaction not in {*Reaction}:
            return {}
        place, reaction = State[state.upper()], Reaction(self._reaction)
        since = min((index for index, _ in self._alarms), default=0)
        full = [name for name in memories if self._cleared.get(name, -1) < since]
        reset = next_step.reset(place, reaction, [monitor for _, monitor in self._alarms], faults, full)
        return {"retract": asdict(next_step.retraction(place)), "reset": asdict(reset)}
