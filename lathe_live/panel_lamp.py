# SPDX-License-Identifier: Apache-2.0
"""Lamp of the panel: state of the supervisor and faults in force, as last heard, and how long ago that was.

The state at the newest sample is that of the supervisor's blocks; its messages tell cause and time of a state. The lamp
does not assume what it has not heard: a supervisor that finds nothing sends no message, and so does one that has died.
"""

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from lathe_rc import event_log, messages
from lathe_rc.blocks.ports import Sparse
from lathe_rc.messages import Signals
from lathe_rc.safety.state_machine import State

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
        self.clear()

    def clear(self) -> None:
        """Begin with another run."""
        with self._lock:
            self._alarm: Alarm | None = None
            self._told = -1  # sample of the newest message
            self._state, self._reached = UNKNOWN, -1  # at the newest sample of the blocks
            self._conditions = event_log.Conditions()
            self._heard = time.monotonic()

    def hear(self, last: int, state: int) -> None:
        """Take the state at the last sample of a block of the supervisor."""
        with self._lock:
            if last > self._reached:
                self._state, self._reached = event_log.state_name(state), last
                self._heard = time.monotonic()

    def take(self, message: Sparse) -> None:
        """Take a message of a node; the messages of a topic arrive in order."""
        with self._lock:
            if message.type == messages.SAFETY_STATUS:
                self._alarm, self._told = Alarm.after(self._alarm, message), message.index
                self._heard = time.monotonic()
            elif message.type == messages.EVENT:
                self._conditions.take(message)

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Take consecutive samples, as a sink of the engine."""
        for message in sorted((each for found in sparse.values() for each in found), key=lambda each: each.index):
            self.take(message)
        for signals in dense.values():
            if "reaction" in signals:  # of a SafetyBlock
                self.hear(first + samples - 1, int(signals["state"][-1]))

    def now(self, *, supervised: bool) -> dict[str, Any]:
        """Return the state for the page: ``safety`` and ``faults``.

        Args:
            supervised: whether the cell has a supervisor; if it has none, ``safety`` is None until one is heard.
        """
        with self._lock:
            faults = [f"{node}: {fault}" for (node, _), found in self._conditions.faults.items() for fault in found]
            state = self._state if self._reached >= self._told else self._alarm.state if self._alarm else UNKNOWN
            if state == UNKNOWN and not supervised:
                return {"safety": None, "faults": faults}
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
            return {"safety": safety, "faults": faults}
