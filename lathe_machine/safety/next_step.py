# SPDX-License-Identifier: Apache-2.0
"""Next step of the operator: which reset and retraction the supervisor accepts, and what to do before a reset.

`refusal` is the rule by which the supervisor itself refuses a reset; the words are for people.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from lathe_rc.safety.state_machine import RESET, Reaction, State, after

#: built-in monitors of signals that a learning controller commands: its memory may hold what raised the alarm
OF_MEMORY = frozenset({"following", "stroke", "effort", "error", "error_growth"})
OPERATOR = "operator"  #: name in place of a monitor's for a retraction that the operator asks for
MARGIN = "stability_margin"  #: built-in monitor of the gain with which a controller learns


def refusal(state: State, reaction: Reaction) -> str:
    """Return why a reset is refused; an empty text if it is accepted.

    Args:
        state: state of the cell.
        reaction: reaction in force.
    """
    if reaction is Reaction.STOP:
        return "a reset is refused after a stop: begin a new run"
    if after(state, RESET) is None:
        return "wait until the tool is out of the part; a reset is refused until then"
    return ""


@dataclass(frozen=True)
class OperatorStep:
    """Step of the operator.

    Attributes:
        text: what it does or needs, in words.
        allowed: whether the supervisor carries it out now.
        due: whether it is to be taken, now or after what the text says.
    """

    text: str
    allowed: bool = False
    due: bool = True


def retraction(state: State) -> OperatorStep:
    """Return what a retraction would do in a state of the cell."""
    if state in (State.RETRACTING, State.SAFE):
        return OperatorStep("the tool is out of the part" if state is State.SAFE else "the tool is on its way out")
    return OperatorStep("takes the tool out of the part; the feeds stop", allowed=True)


def reset(
    state: State,
    reaction: Reaction,
    alarms: Sequence[str],
    faults: Sequence[str] = (),
    memories: Collection[str] = (),
) -> OperatorStep:
    """Return whether a reset is accepted, what to do before, and why the alarm would be raised again otherwise.

    Args:
        state: state of the cell.
        reaction: reaction in force.
        alarms: monitors that have raised alarms since the last reset.
        faults: faults in force.
        memories: learning controllers whose memories were not cleared since the first of these alarms.
    """
    if why := refusal(state, reaction):
        stuck = state is State.RETRACTING and faults
        return OperatorStep(f"repair {_listed(faults)}, with which the tool may not come out; {why}" if stuck else why)
    if reaction is Reaction.NONE:
        return OperatorStep("nothing to reset", due=False)
    before, reasons = [], []
    if faults:
        before.append(f"repair {_listed(faults)}")
        reasons.append("the fault lasts")
    if memories and OF_MEMORY.intersection(alarms):
        before.append(f"clear {_listed(sorted(memories))}")
        reasons.append("the memory holds what was learned up to the alarm")
    if MARGIN in alarms:
        before.append("set a smaller learning_gain")
        reasons.append("the stability margin is that of the gain")
    does = "the tool approaches the part again" if state is State.SAFE else "the alarm is taken back"
    if not before:
        lasts = "the monitors watch on" if set(alarms) <= {OPERATOR} else "the alarm is raised again if its cause lasts"
        return OperatorStep(f"reset: {does}; {lasts}", allowed=True)
    again = "the tool may be retracted again" if reaction is Reaction.RETRACT else "the alarm may be raised again"
    return OperatorStep(f"{', '.join(before)}, then reset; otherwise {again}: {', '.join(reasons)}", allowed=True)


def _listed(names: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
