# SPDX-License-Identifier: Apache-2.0
"""The disturbance at a drive's input, learned over the angle and observed in time; and the drive, identified.

The drive is x + a1·dx/dt + a2·d²x/dt² = u(t - τ) + f. What acts on it, in metres of its command, is then

    w = x + a1·dx/dt + a2·d²x/dt² - u(t - τ)

of the measured position x and the command u. w is no error that a command brings about: with a good model it does not
depend on u, so that learning it is no loop and cannot diverge. A wrong model makes it one, with the gain
E = (Wi/Ŵi)·e^{pτ̂} - 1, and it still converges to x = r as long as |E| is below 1.

**Memory** (repetitive control), over the angle: `lathe_rc.control.disturbance_memory`.

**Observer** (in time). L·w - L·F̂, L = 1/(1 + p/ωo)³: what the memory does not know yet.

**Identification** of a1 and a2: `lathe_rc.control.identification`. What the result is wrong by repeats and is
learned as a part of f.

Source: spec/robust.md.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.control.disturbance_memory import MemoryTable, empty_memory, expected, forget_all, learn, revolution_ended
from lathe_rc.control.identification import (
    STAGES,
    FitTable,
    LowPass,
    derivatives,
    fade,
    fitted,
    forget_measurements,
    low_pass,
    no_measurements,
    pass_through,
    sum_up,
)
from lathe_rc.jit import inlined, kernel
from lathe_rc.signals.profile_table import derivatives_at

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

_TURN = 2.0 * np.pi
_SWINGS_IN = 10.0  # of a1 until the drive has

# Places in the integer state: grid point that is being measured, the first one of all, whether there is one,
# revolutions that are learned, whether a position has been seen.
_POINT, _FIRST, _BEGUN, _REVOLUTIONS, _SEEN = range(5)
# Places in the sums of a grid point: what is learned and how often, relative speed, dx/dt, d²x/dt², u - x.
_SUM, _COUNT, _SPEED, _VELOCITY, _ACCELERATION, _REST = range(6)


class FormAhead(NamedTuple):
    """The form that is turned, for kernels; see `lathe_rc.signals.profile_table.derivatives_at`."""

    heights: Array
    table: Array
    feed: float
    start: float
    part: int


class DisturbanceTable(NamedTuple):
    """The law's knowledge of drive and disturbance.

    Attributes:
        step: sampling step [s].
        model: a1 [s] and a2 [s²] as they are identified, shape (2,).
        late: samples until a position is seen.
        begins: sample from which on it is learned from: until then the drive swings in.
        whole, part: of the drive's delay: samples, and the rest in samples.
        commands: of the past; sample n stands at n modulo their number, a power of two [m].
        observer, observes: low-pass of the observer, and whether it acts.
        learned: what the memory says, as it passes that low-pass, shape (4,) [m].
        learner: low-pass of what is learned.
        memory: of the disturbance over the angle.
        identifier, identifies: low-pass of the identification, and whether it acts.
        fit: of the model.
        point: sums of the grid point that is being measured.
        state: see above.
    """

    step: float
    model: Array
    late: int
    begins: int
    whole: int
    part: float
    commands: Array
    observer: LowPass
    observes: bool
    learned: Array
    learner: LowPass
    memory: MemoryTable
    identifier: LowPass
    identifies: bool
    fit: FitTable
    point: Array
    state: Integers


def disturbance(
    *,
    step: float,
    nominal_speed: float,
    model: tuple[float, float, float],
    feedback_delay: int,
    observer_bandwidth: float,
    learning_bandwidth: float,
    learning_gain: float,
    follows_speed: bool,
    learned_waves: float,
    points_per_revolution: int,
    identification_bandwidth: float,
    identify: bool,
    identification_forgetting: float,
) -> DisturbanceTable:
    """Law before its first sample, without any knowledge.

    Args:
        step: sampling step [s].
        nominal_speed: speed Ω0 [rad/s].
        model: natural frequency [rad/s], damping and delay [s] of the drive.
        feedback_delay: samples until a position is seen.
        observer_bandwidth: bandwidth of the observer [rad/s]; 0: there is none.
        learning_bandwidth: bandwidth of what is learned [rad/s].
        learning_gain: part of what is new that the memory takes up in the long run, below 1; 0: there is no memory.
        follows_speed: whether how a value changes with the speed is learned.
        learned_waves: per revolution that are learned, see `lathe_rc.control.disturbance_memory.smoothing`.
        points_per_revolution: of the memory per revolution, a power of two.
        identification_bandwidth: bandwidth of the identification [rad/s].
        identify: whether the model is identified.
        identification_forgetting: what a revolution leaves of the measurements before.

    Raises:
        InputError: S is wider than a revolution.
    """
    frequency, damping, delay = model
    whole = int(np.floor(delay / step + 1e-9))
    given = np.array([2.0 * damping / frequency, 1.0 / frequency**2])
    return DisturbanceTable(
        step=step,
        model=given.copy(),
        late=feedback_delay,
        begins=feedback_delay + int(_SWINGS_IN * given[0] / step),
        whole=whole,
        part=max(delay / step - whole, 0.0),
        commands=np.zeros(1 << (feedback_delay + whole + 2).bit_length()),
        observer=low_pass(observer_bandwidth, step),
        observes=observer_bandwidth > 0.0,
        learned=np.zeros(STAGES + 1),
        learner=low_pass(learning_bandwidth, step),
        memory=empty_memory(
            nominal_speed, learning_gain, learned_waves, points_per_revolution, follows_speed=follows_speed
        ),
        identifier=low_pass(identification_bandwidth, step),
        identifies=identify,
        fit=no_measurements(given, points_per_revolution, identification_forgetting),
        point=np.zeros(6),
        state=np.zeros(5, np.int64),
    )


def forget(m: DisturbanceTable) -> None:
    """Forget what was learned over the angle; model and observer stay."""
    forget_all(m.memory)
    forget_measurements(m.fit)
    m.point[:] = 0.0
    m.state[:_SEEN] = 0


@kernel
def commanded(m: DisturbanceTable, sample: int, command: float) -> None:
    """Remember the command of a sample [m]."""
    m.commands[sample & (m.commands.size - 1)] = command


@kernel
def observed(
    m: DisturbanceTable,
    form: FormAhead,
    sample: int,
    angle: float,
    speed: float,
    position: float,
    learning: bool,  # noqa: FBT001 - kernels take their arguments by position
) -> float:
    """Take the measured position of ``late`` samples ago; return the disturbance beyond the memory [m].

    Args:
        m: of the drive.
        form: that is turned.
        sample: index of the sample at hand.
        angle: of the spindle ``late`` samples ago [rad].
        speed: the same [rad/s].
        position: the same [m].
        learning: whether memory and model may change.
    """
    k = sample - m.late - m.whole
    mask = m.commands.size - 1
    command = (1.0 - m.part) * m.commands[k & mask] + m.part * m.commands[(k - 1) & mask] if k >= 1 else 0.0
    known = expected(m.memory, angle, speed)
    if not m.state[_SEEN]:  # the drive has stood where it is
        m.state[_SEEN] = 1
        m.observer.position[:] = m.learner.position[:] = m.identifier.position[:] = position
        m.observer.command[:] = m.learner.command[:] = m.identifier.command[:] = position
    found = 0.0
    if m.observes:
        low = m.observer
        pass_through(low.position, position, low.keep, low.take)
        pass_through(low.command, command, low.keep, low.take)
        pass_through(m.learned, known, low.keep, low.take)
        first, second = derivatives(low.position, low.bandwidth)
        found = low.position[STAGES] + m.model[0] * first + m.model[1] * second
        found -= low.command[STAGES] + m.learned[STAGES]
    if m.memory.learns or m.identifies:
        low = m.learner
        pass_through(low.position, position, low.keep, low.take)
        pass_through(low.command, command + known, low.keep, low.take)
        low = m.identifier
        pass_through(low.position, position, low.keep, low.take)
        pass_through(low.command, command, low.keep, low.take)
        if learning and sample >= m.begins:
            _measure(m, form, angle, speed)
        else:
            m.state[_BEGUN] = 0
    return found


@inlined
def _measure(m: DisturbanceTable, form: FormAhead, angle: float, speed: float) -> None:
    """Add a sample to its grid point; grid points that the spindle has left before are ended."""
    low, point, state = m.learner, m.point, m.state
    first, second = derivatives(low.position, low.bandwidth)
    beyond = low.position[STAGES] + m.model[0] * first + m.model[1] * second - low.command[STAGES]
    lag = STAGES / low.bandwidth  # of a slow signal behind the low-pass: it belongs to the angle of that time before
    place = int(np.floor((angle - speed * lag) * (m.memory.value.size / _TURN)))
    low = m.identifier
    if not state[_BEGUN]:
        state[_BEGUN], state[_POINT], state[_FIRST] = 1, place, place
        m.memory.fresh[:] = 0.0
    while state[_POINT] < place:
        _end_point(m, form, speed)
    if state[_POINT] == place:
        point[_SUM] += beyond
        point[_COUNT] += 1.0
        point[_SPEED] = speed / m.memory.nominal - 1.0
        point[_VELOCITY], point[_ACCELERATION] = derivatives(low.position, low.bandwidth)
        point[_REST] = low.command[STAGES] - low.position[STAGES]


@kernel
def _end_point(m: DisturbanceTable, form: FormAhead, speed: float) -> None:
    """End a grid point: learn the points that S can smooth by now, and sum up for the model."""
    state, point, points = m.state, m.point, m.memory.value.size
    here = state[_POINT] & (points - 1)
    reach = m.memory.smoothing.size // 2
    m.memory.fresh[here] = point[_SUM] / point[_COUNT] if point[_COUNT] > 0.0 else 0.0
    m.memory.speeds[here] = point[_SPEED]
    if m.memory.learns and state[_POINT] - reach >= state[_FIRST]:
        learn(m.memory, state[_POINT] - reach)
    if m.identifies and point[_COUNT] > 0.0:
        again = state[_POINT] - state[_FIRST] >= points
        sum_up(m.fit, here, again, point[_VELOCITY], point[_ACCELERATION], point[_REST])
    point[_SUM] = point[_COUNT] = 0.0
    state[_POINT] += 1
    if (state[_POINT] - state[_FIRST]) % points == 0:
        state[_REVOLUTIONS] += 1
        if m.identifies:
            _adopt(m, form, speed)
        fade(m.fit)
        revolution_ended(m.memory, state[_REVOLUTIONS])


@inlined
def _adopt(m: DisturbanceTable, form: FormAhead, speed: float) -> None:
    """Adopt the identified model; the part of w that it explains in place of the memory moves from one to the other."""
    a1, a2 = fitted(m.fit)
    if not (a1 > 0.0 and a2 > 0.0):
        return
    more1, more2 = a1 - m.model[0], a2 - m.model[1]
    m.model[0], m.model[1] = a1, a2
    # What has passed the low-passes belongs to the old model: unchanged, it would be a step of the disturbance.
    for low, known in ((m.observer, m.learned), (m.learner, m.learner.command)):
        first, second = derivatives(low.position, low.bandwidth)
        for place in range(known.size):
            known[place] += more1 * first + more2 * second
    if not m.memory.learns:
        return
    points = m.memory.value.size
    for i in range(m.state[_POINT] - points, m.state[_POINT]):
        _, slope, bow = derivatives_at(
            form.heights, form.table, form.feed, form.start, form.part, (i + 0.5) * _TURN / points
        )
        m.memory.value[i & (points - 1)] += more1 * speed * slope + more2 * speed**2 * bow
