# SPDX-License-Identifier: Apache-2.0
"""Human-readable event log of a run: node events and supervisor messages."""

from dataclasses import dataclass, field

from lathe_rc import messages
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.events import FAULT, FREE, LIMITED, REPAIR, parse
from lathe_rc.cell.recording import Recording
from lathe_rc.safety.state_machine import Reaction, State

_STATES, _REACTIONS = {int(s): s.name.lower() for s in State}, {int(r): r.name.lower() for r in Reaction}

#: Unit and factor for the values of each built-in monitor; third-party monitors define their own.
UNITS = {
    "speed": ("rad/s", 1.0),
    "acceleration": ("rad/s²", 1.0),
    "index_pulses": ("rad", 1.0),
    "effort": ("A or V", 1.0),
    "force": ("N", 1.0),
    "force_low": ("N", 1.0),
    **dict.fromkeys(("error", "following", "stroke", "slide"), ("µm", 1e6)),
}
_EFFORTS = {"coarse": "A", "fine": "V"}  # of the drives of these names, see ActuatorState.msg
LOGGED = (messages.EVENT, messages.SAFETY_STATUS)  #: message types of the event log


@dataclass(frozen=True)
class LogEntry:
    """Event at a sample.

    Attributes:
        sample: first sample of the event.
        topic: topic of the message.
        text: description of the event.
    """

    sample: int
    topic: str
    text: str


def entries(recording: Recording) -> list[LogEntry]:
    """Return the log entries of a run, in order."""
    topics = [topic for topic in recording.sparse if recording.types[topic] in LOGGED]
    said = [message for topic in topics for message in recording.messages(topic)]
    found = [LogEntry(message.index, message.topic, text(message)) for message in said]
    return sorted(found, key=lambda entry: entry.sample)


def text(message: Sparse) -> str:
    """Describe an event message in one line; its content is treated as untrusted."""
    values = message.values
    if message.type == messages.EVENT:
        return str(values["action"])
    state, reaction = _STATES.get(values["state"], "?"), _REACTIONS.get(values["reaction"], "?")
    return f"{cause(message)}: {state}, {reaction}"


def cause(message: Sparse) -> str:
    """Describe what a message of the supervisor is about, with value and limit."""
    values = message.values
    unit, scale = UNITS.get(values["monitor"], ("", 1.0))
    unit = _EFFORTS.get(values["subject"], unit) if values["monitor"] == "effort" else unit
    sizes = [f"{values[name] * scale:.4g} {unit}".rstrip() for name in ("value", "limit")]
    found = f"{sizes[0]}, limit {sizes[1]}" if values["limit"] else ""
    return " ".join(filter(None, [values["monitor"], values["subject"], found]))


def supervisor_state(message: Sparse) -> str:
    """Return the state in a message of the supervisor, in lower case."""
    return state_name(message.values["state"])


def state_name(state: int) -> str:
    """Return the name of a supervisor's state, in lower case."""
    return _STATES.get(state, "?")


@dataclass
class Conditions:
    """Faults and limits of a cell in effect, as the events of its nodes tell.

    Attributes:
        faults: faults in effect by node and target, oldest first.
        limited: nodes that limit the command now.
    """

    faults: dict[tuple[str, str], list[str]] = field(default_factory=dict)
    limited: set[str] = field(default_factory=set)

    def take(self, message: Sparse) -> tuple[str, str] | None:
        """Take an event of a node; return what it changes, ``NODE/fault/TARGET`` or ``NODE/limits``, and its condition.

        The condition is empty if there is no fault or limit any more; None: the event changes nothing.
        """
        node, event = message.topic.strip("/").removesuffix("/events"), parse(str(message.values["action"]))
        if event.verb in (FAULT, REPAIR):
            there = self.faults.setdefault((node, event.target), [])
            if event.verb == FAULT:
                there.append(event.fault)
            elif not event.values:  # all faults of the target
                there.clear()
            elif event.fault in there:
                there.remove(event.fault)
            return f"{node}/fault/{event.target}", ", ".join(there)
        if event.verb not in (LIMITED, FREE):
            return None
        (self.limited.add if event.verb == LIMITED else self.limited.discard)(node)
        return f"{node}/limits", LIMITED if event.verb == LIMITED else ""
