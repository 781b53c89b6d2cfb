# SPDX-License-Identifier: Apache-2.0
"""Step function of the learning controller."""

from typing import NamedTuple

import numpy as np

from lathe_machine.control import angle_memory
from lathe_machine.control.angle_memory import AngleMemory
from lathe_machine.control.identification import IdentifierTable, accumulate, command_sent
from lathe_machine.control.lead import PreviewTable, look_ahead
from lathe_machine.stages.common.obedience import OBEY, Listener, apply, forbidden, may_learn, obeyed, piece
from lathe_rc.arrays import Integers
from lathe_rc.cell.stage import DONE, Fields, Reached
from lathe_rc.jit import inlined, kernel
from lathe_rc.messages import Samples
from lathe_rc.safety.state_machine import Reaction

# Indices into the state of the step function: whether it is inside a segment of a block, start and end of the segment,
# whether the angle is lost, and the sample at which it was lost, if not yet reported.
_INSIDE, _BEGIN, _END, _LOST, LOST_AT = range(5)


class Memory(NamedTuple):
    """State of the learning controller's step function.

    Attributes:
        control: repetitive memory of the channel.
        preview: lead law.
        identifier: identifier of the drive, if ``identifies``.
        who: obedience to the supervisor, if any.
        nominal: nominal speed of the spindle [rad/s].
        period: sampling step [s].
        by_time: whether time replaces the angle.
        falls_back: whether the lead angle of the nominal speed is used when the supervisor requests a fallback.
        rates: whether the correction needs the time derivatives of the read angle.
        finer: number of finer drives included in the error.
        margin: stability margin of the latest cycle, shape (1,).
        state: integer state, indexed by the module's constants.
    """

    control: AngleMemory
    preview: PreviewTable
    identifier: IdentifierTable
    who: Listener
    nominal: float
    period: float
    by_time: bool
    falls_back: bool
    rates: bool
    finer: int
    identifies: bool
    margin: Samples
    state: Integers


@inlined
def _angle(memory: Memory, first: int, late: int, measured: Samples) -> Samples:
    """Return the angle that indexes the memory [rad], ``late`` samples before the samples starting at ``first``."""
    if not memory.by_time:
        return measured
    angle = np.empty(measured.size)
    for k in range(angle.size):
        angle[k] = memory.nominal * (memory.period * (first + k))
    if late:
        # The order of multiplication and subtraction determines the last bits of the angle.
        angle -= memory.nominal * (memory.period * late)
    return angle


@inlined
def _begin(memory: Memory, first: int, start: int, stop: int, inputs: Fields) -> None:
    """Compute the lead of a segment of a block, and store the errors of the segment."""
    control, samples = memory.control, stop - start
    speed, error = inputs[1][start:stop], inputs[3][start:stop]
    if memory.by_time or (memory.falls_back and obeyed(memory.who) >= Reaction.FALL_BACK.value):
        speed = np.full(samples, memory.nominal)
    if memory.finer:
        error = error.copy()
        for finer in range(memory.finer):
            error += inputs[4 + finer][start:stop]
    ahead = control.ahead
    look_ahead(
        memory.preview, first + start, memory.rates, speed, ahead[0, :samples], ahead[1, :samples], ahead[2, :samples]
    )
    angle = _angle(memory, first + start, 0, inputs[0][start:stop])
    past_angle = _angle(memory, first + start, control.delay, inputs[2][start:stop])
    angle_memory.begin(control, first + start, angle, past_angle, error)


@inlined
def _lose(memory: Memory, start: int, stop: int, command: Samples) -> None:
    """Hold the command from sample ``start`` of a block on, after a loss of the angle."""
    command[start:stop] = command[start - 1] if start > memory.state[_BEGIN] else memory.who.obedience.takeover.given[1]


@inlined
def _publish(memory: Memory, start: int, stop: int, outputs: Fields) -> None:
    """Fill the stability margin of some samples, if it is published."""
    for published in range(1, len(outputs)):
        outputs[published][start:stop] = memory.margin[0]


@kernel
def step(memory: Memory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Compute the command of one block from the repetitive memory over the angle."""
    control, state, who, command = memory.control, memory.state, memory.who, outputs[0]
    n = command.size
    if state[_INSIDE] and start > 0:
        # A cycle has ended with the previous sample, to which its margin applies.
        _publish(memory, start - 1, start, outputs)
    # If it stopped within a segment, the step function resumes with this segment still open, possibly at its end.
    while start < n or state[_INSIDE]:
        if not state[_INSIDE]:
            stop = piece(who, start, n, flags[0])
            if stop == start:
                return start, OBEY
            if who.listens:
                control.whole[angle_memory.LEARNS] = may_learn(who)
                if forbidden(who):
                    angle_memory.leave(control)
            state[_INSIDE], state[_BEGIN], state[_END] = 1, start, stop
            if not state[_LOST]:
                _begin(memory, first, start, stop, inputs)
        begin, stop = state[_BEGIN], state[_END]
        reached, reason = stop, DONE
        if state[_LOST]:
            _lose(memory, start, stop, command)
        else:
            angle = _angle(memory, first + begin, 0, inputs[0][begin:stop])
            reached, reason = angle_memory.advance(control, first + begin, start - begin, angle, command[begin:stop])
            reached += begin
            if reason in (angle_memory.AHEAD, angle_memory.BEHIND, angle_memory.JUMPED) and who.listens:
                state[_LOST], state[LOST_AT] = 1, first + reached
                _lose(memory, reached, stop, command)
                reached, reason = stop, DONE
        apply(who, command[start:reached])
        if memory.identifies and not state[_LOST]:
            # What the drive is sent; before `accumulate`, since a segment may be longer than the delay.
            command_sent(memory.identifier, first, start, reached, command)
            accumulate(memory.identifier, first, start, reached, inputs[4 + memory.finer])
        _publish(memory, start, reached, outputs)
        if reason != DONE:
            return reached, reason
        state[_INSIDE] = 0
        start = stop
    return n, DONE
