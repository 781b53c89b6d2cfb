# SPDX-License-Identifier: Apache-2.0
"""Events and faults of a stage as listed in a scenario: action and time of each."""

import math
import re
from dataclasses import dataclass
from typing import NamedTuple

from lathe_rc.cell.parameters import NodeParameters
from lathe_rc.errors import InputError

FAULT, REPAIR = "fault", "repair"  #: verbs of the events that all stages know: fault FAULT, repair FAULT or TARGET
SET = "set"  #: verb of an event that changes a parameter of a stage: set PARAM VALUE
SAFE = "safe"  #: event that only a host may ask for: members of the cell are lost
LIMITED, FREE = "limited", "free"  #: events: a sample of a command is clipped; none has been clipped for a while
OUT_OF_REACH = "out of reach"  #: event: a takeover could not begin at the command's position
NOTHING_TO_REPAIR = "nothing to repair"  #: event of a repair of what is not broken

_EVENT = re.compile(r"\s*(revolution|second|sample)\s+([0-9.eE+-]+)(?:\s+to\s+([0-9.eE+-]+))?\s*:\s*(\S.*?)\s*")
_MOST_SAMPLES = 2**53  # largest exact integer of a double


class Action(NamedTuple):
    """Action of an event, parsed.

    Attributes:
        verb: `FAULT`, `REPAIR`, `SET`, or of any other action the text before a colon.
        target: faulty signal or device, or the parameter to set; empty for other verbs.
        values: the rest.
    """

    verb: str
    target: str
    values: str

    @property
    def fault(self) -> str:
        """Fault of a `FAULT` or `REPAIR`, see `lathe_rc.safety.faults.parse`."""
        return f"{self.target} {self.values}".rstrip()


def parse(action: str) -> Action:
    """Parse the action of an event, as listed in a scenario, requested from a node, or recorded."""
    verb, _, rest = action.partition(" ")
    if verb in (FAULT, REPAIR, SET):
        target, _, values = rest.strip().partition(" ")
        return Action(verb, target, values)
    kind, _, values = action.partition(":")
    return Action(kind, "", values)


@dataclass(frozen=True)
class Trigger:
    """Trigger: the time at which an event takes effect."""

    kind: str  # revolution, second or sample
    value: float
    action: str
    parameter: str  # parameter that lists the trigger: events or faults
    ends: bool = False  # end of a fault

    @property
    def text(self) -> str:
        """Text of the trigger as written in a scenario."""
        return f"{self.kind} {self.value:.15g}: {self.action}"

    def sample(self, rate: int) -> int:
        """Return the sample of a trigger that does not depend on the angle; ``rate`` in Hz."""
        if self.kind == "sample":
            return math.ceil(self.value)
        # The factor keeps 0.1 s · 64000 from becoming sample 6401.
        return math.ceil(self.value * rate * (1 - 1e-12))


def triggers(node: str, table: NodeParameters) -> list[Trigger]:
    """Return the triggers of the events and faults of a node; a fault with an end has two.

    Raises:
        InputError: a trigger is invalid, or a fault ends before it begins.
    """
    found = [_trigger(node, table, "events", text) for text in table.events]
    return found + [trigger for text in table.faults for trigger in _begin_and_end(node, table, text)]


def _trigger(node: str, table: NodeParameters, what: str, text: str, *, ends: bool = False) -> Trigger:
    match = _EVENT.fullmatch(text)
    try:
        trigger = Trigger(match[1], float(match[2]), match[4], what, ends) if match and not match[3] else None
    except ValueError:
        trigger = None
    per_unit = table.sample_rate if trigger and trigger.kind == "second" else 1
    if trigger is None or not 0 <= trigger.value * per_unit < _MOST_SAMPLES:
        raise InputError(
            f"{node}.{what} = {text!r}; allowed: 'revolution R: ACTION', 'second T: ACTION' or "
            f"'sample N: ACTION', before sample {_MOST_SAMPLES}"
        )
    return trigger


def _begin_and_end(node: str, table: NodeParameters, text: str) -> list[Trigger]:
    match = _EVENT.fullmatch(text)
    if match is None:
        raise InputError(
            f"{node}.faults = {text!r}; allowed: 'revolution R to S: FAULT', 'second ...', 'sample ...'; "
            "without 'to' it stays"
        )
    begin = _trigger(node, table, "faults", f"{match[1]} {match[2]}: {FAULT} {match[4]}")
    if not match[3]:
        return [begin]
    end = _trigger(node, table, "faults", f"{match[1]} {match[3]}: {REPAIR} {match[4]}", ends=True)
    if end.value <= begin.value:
        raise InputError(f"{node}.faults = {text!r} ends before it begins; allowed: an end after {match[2]}")
    return [begin, end]
