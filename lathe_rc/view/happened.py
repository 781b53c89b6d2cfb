# SPDX-License-Identifier: Apache-2.0
"""What happened at a sample, in words: events, and what the supervisor says."""

from lathe_rc.cell import messages
from lathe_rc.cell.stage import Sparse
from lathe_rc.safety.state_machine import Reaction, State

_STATES, _REACTIONS = {int(s): s.name.lower() for s in State}, {int(r): r.name.lower() for r in Reaction}

HAPPENED = (messages.EVENT, messages.SAFETY_STATUS)  #: types of messages that say so


def text(message: Sparse) -> str:
    """One line for a message of these types; nothing in it is trusted."""
    values = message.values
    if message.type == messages.EVENT:
        return str(values["action"])
    state, reaction = _STATES.get(values["state"], "?"), _REACTIONS.get(values["reaction"], "?")
    found = f" {values['value']:.4g}, limit {values['limit']:.4g}" if values["limit"] else ""
    return f"{values['monitor']} {values['subject']}{found}: {state}, {reaction}"
