# SPDX-License-Identifier: Apache-2.0
"""The states of the cell and what leads from one to another."""

from collections.abc import Iterator
from enum import IntEnum


class State(IntEnum):
    """State of the cell."""

    NOMINAL = 0
    DEGRADED = 1
    RETRACTING = 2
    SAFE = 3


class Reaction(IntEnum):
    """The reaction to an alarm; the higher one prevails."""

    NONE = 0
    WARN = 1
    FREEZE = 2
    FALL_BACK = 3
    HOLD = 4
    RETRACT = 5
    STOP = 6


MEANING = {
    Reaction.NONE: "nothing",
    Reaction.WARN: "the alarm is published and recorded",
    Reaction.FREEZE: "the controllers stop learning, and go on with what they have learned",
    Reaction.FALL_BACK: "the controllers stop learning; if so asked, they lead by the nominal speed",
    Reaction.HOLD: "the commands of the tool stay as they are; the feeds stop",
    Reaction.RETRACT: "the tool moves out of the part along a bounded profile; the feeds stop",
    Reaction.STOP: "as retract; only a new run ends it",
}

RETRACTED, RESET = "retracted", "reset"  #: what else changes the state: the tool is out, somebody says so


def after(state: State, cause: Reaction | str) -> State | None:
    """State that a cause leads to.

    Args:
        state: before.
        cause: a reaction that a monitor asks for, `RETRACTED` or `RESET`.

    Returns:
        None if the cause means nothing in this state.
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
    """Rows for the documentation: the cause, then the state that it leads to from each state; "" for none."""
    for cause in (*Reaction, RETRACTED, RESET):
        if cause is not Reaction.NONE:
            found = [after(state, cause) for state in State]
            name = cause.name.lower() if isinstance(cause, Reaction) else cause
            yield name, *("" if to is None else to.name.lower() for to in found)
