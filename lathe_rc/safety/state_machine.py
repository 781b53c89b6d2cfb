# SPDX-License-Identifier: Apache-2.0
"""State machine of the cell: states, reactions and transitions."""

from collections.abc import Iterator
from enum import IntEnum


class State(IntEnum):
    """Safety state of the cell."""

    NOMINAL = 0
    DEGRADED = 1
    RETRACTING = 2
    SAFE = 3


class Reaction(IntEnum):
    """Reaction to an alarm; of several reactions, the one with the highest number prevails."""

    NONE = 0
    WARN = 1
    FREEZE = 2
    FALL_BACK = 3
    HOLD = 4
    RETRACT = 5
    STOP = 6


MEANING = {
    Reaction.NONE: "no effect",
    Reaction.WARN: "the alarm is published and recorded",
    Reaction.FREEZE: "the controllers stop learning and continue with what they have learned",
    Reaction.FALL_BACK: "the controllers stop learning; if so configured, their lead is that of the nominal speed",
    Reaction.HOLD: "the tool commands are held; the feeds stop",
    Reaction.RETRACT: "the tool moves out of the part along a bounded profile; the feeds stop",
    Reaction.STOP: "like retract, but only a new run ends it",
}

RETRACTED, RESET = "retracted", "reset"  #: other causes of transitions: end of the retraction, reset by the operator


def after(state: State, cause: Reaction | str) -> State | None:
    """Return the next state of the cell after a cause.

    Args:
        state: current state.
        cause: reaction requested by a monitor, `RETRACTED` or `RESET`.

    Returns:
        The next state, or None if the cause is not valid in the current state.
    """
    if cause == RETRACTED:
        return State.SAFE if state is State.RETRACTING else None
    if cause == RESET:
        return None if state is State.RETRACTING else State.NOMINAL
    if cause in (Reaction.RETRACT, Reaction.STOP):
        return State.RETRACTING if state in (State.NOMINAL, State.DEGRADED) else state
    if cause in (Reaction.FREEZE, Reaction.FALL_BACK, Reaction.HOLD):
        return State.DEGRADED if state is State.NOMINAL else state
    return state


def table() -> Iterator[tuple[str, ...]]:
    """Yield the rows of the documented transition table: cause, then the next state for each state, "" for none."""
    for cause in (*Reaction, RETRACTED, RESET):
        if cause is not Reaction.NONE:
            found = [after(state, cause) for state in State]
            name = cause.name.lower() if isinstance(cause, Reaction) else cause
            yield name, *("" if to is None else to.name.lower() for to in found)
