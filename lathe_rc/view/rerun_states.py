# SPDX-License-Identifier: Apache-2.0
"""States over time, as bands: of the supervisor, of faults, of commands at their limits."""

from lathe_rc import messages
from lathe_rc.cell.stage import Sparse
from lathe_rc.cell.stages.command_limits import FREE, LIMITED
from lathe_rc.messages import full
from lathe_rc.safety.state_machine import State

ROOT = "states"  #: where the bands are in the view
COLOURS = {
    State.NOMINAL.name.lower(): 0x2E7D4FFF,
    State.DEGRADED.name.lower(): 0xB8860BFF,
    State.RETRACTING.name.lower(): 0xD2622AFF,
    State.SAFE.name.lower(): 0xB3262EFF,
}  #: of the supervisor's states
_FAULT, _REPAIR = "fault ", "repair "  # how the events of faults begin


def supervisor(topic: str) -> str:
    """Where the band of a supervisor is, by the topic of its status."""
    return f"{ROOT}/cell{full(topic).removesuffix('/status')}"


def band(message: Sparse) -> tuple[str, str] | None:
    """Which band changes with a message, and to what; an empty text ends a band. None: no band does."""
    topic = full(message.topic)
    if message.type == messages.SAFETY_STATUS:
        states = {int(state): state.name.lower() for state in State}
        return supervisor(topic), states.get(message.values["state"], "?")
    action, node = str(message.values["action"]), f"{ROOT}{topic.removesuffix('/events')}"
    if action.startswith(_FAULT):
        return f"{node}/fault", action.removeprefix(_FAULT)
    if action.startswith(_REPAIR):
        return f"{node}/fault", ""
    kind = action.partition(":")[0]
    if kind in (LIMITED, FREE):
        return f"{node}/limits", LIMITED if kind == LIMITED else ""
    return None
