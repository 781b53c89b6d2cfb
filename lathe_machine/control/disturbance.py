# SPDX-License-Identifier: Apache-2.0
"""Disturbance at a drive's input, learned over the angle and observed in time, with identification of the drive.

The drive is x + a1·dx/dt + a2·d²x/dt² = u(t - τ) + f. The disturbance, in metres of the command, is then

    w = x + a1·dx/dt + a2·d²x/dt² - u(t - τ)

with the measured position x and the command u. With a good model, w does not depend on u, so learning w closes no loop
and cannot diverge. A wrong model closes a loop with the gain E = (Wi/Ŵi)·e^{pτ̂} - 1, which still converges to
x = r as long as |E| is below 1.

**Memory** over the angle (repetitive control): `lathe_machine.control.disturbance_memory`.

**Observer** (in time): L·w - L·F̂ with L = 1/(1 + p/ωo)³, the part of the disturbance not yet in the memory.

**Identification** of a1 and a2: `lathe_machine.control.identification`. The effect of an error in the identified model
repeats, and is therefore learned as part of f.

**Resonance**: an inverse of fourth order in place of that of second order, `lathe_machine.control.rational_inverse`.

Source: spec/robust.md.
"""

from typing import NamedTuple

import numpy as np

from lathe_machine.control.disturbance_memory import (
    MemoryTable,
    empty_memory,
    expected,
    forget_all,
    learn,
    revolution_ended,
)
from lathe_machine.control.identification import (
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
from lathe_machine.control.rational_fit import forget_rational, put_latest, sum_up_rational
from lathe_machine.control.rational_inverse import (
    FORM,
    LEARNER,
    OBSERVER,
    RationalTable,
    at_sample,
    begin_at,
    changed,
    forget_candidate,
    inverted,
    is_rational,
    proved,
    refit,
    use_candidate,
)
from lathe_machine.signals.profile_table import derivatives_at
from lathe_rc.arrays import Array, Integers
from lathe_rc.jit import inlined, kernel

_TURN = 2.0 * np.pi
_SWINGS_IN = 10.0  # settling time of the drive, in units of a1

_SETTLING = 3  # simulated revolutions for the conversion of a memory: in all but the last the filters settle

# Indices in the integer state: current grid point, first grid point, whether there is a current grid point, number of
# learned revolutions, whether a position has been received.
_POINT, _FIRST, _BEGUN, _REVOLUTIONS, _SEEN = range(5)
# Indices in the sums of a grid point: learned disturbance and its count, relative speed, dx/dt, d²x/dt², u - x.
_SUM, _COUNT, _SPEED, _VELOCITY, _ACCELERATION, _REST = range(6)


class FormAhead(NamedTuple):
    """Desired form of the part for kernels, as arguments of `lathe_machine.signals.profile_table.derivatives_at`."""

    heights: Array
    table: Array
    feed: float
    start: float
    part: int


class DisturbanceTable(NamedTuple):
    """Model of drive and disturbance with its learning state, for kernels.

    Attributes:
        step: sampling step [s].
        model: identified a1 [s] and a2 [s²], shape (2,).
        late: number of samples until a measured position is available.
        begins: first sample used for learning, after the transient of the drive.
        whole, part: delay of the drive, as whole samples and a fraction of a sample.
        commands: past commands; sample n is at index n modulo the length, a power of two [m].
        observer, observes: low-pass of the observer, and whether the observer is on.
        learned: states of the observer's low-pass for the memory's prediction, shape (4,) [m].
        learner: low-pass of the learned disturbance.
        memory: memory of the disturbance over the angle.
        identifier, identifies: low-pass of the identification, and whether identification is on.
        fit: accumulated measurements for fitting the model.
        point: sums of the current grid point.
        state: integer state, indexed by the module's constants.
        rational: rational inverse in place of the model of second order.
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
    rational: RationalTable


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
    rational: RationalTable,
) -> DisturbanceTable:
    """Create a disturbance model in its initial state, with an empty memory.

    Args:
        step: sampling step [s].
        nominal_speed: speed Ω0 [rad/s].
        model: natural frequency [rad/s], damping and delay [s] of the drive.
        feedback_delay: number of samples until a measured position is available.
        observer_bandwidth: bandwidth of the observer [rad/s]; 0 for no observer.
        learning_bandwidth: bandwidth of the learned disturbance [rad/s].
        learning_gain: stationary gain of the memory's Kalman filters, below 1; 0 for no memory.
        follows_speed: whether the slope of the disturbance with respect to the speed is learned.
        learned_waves: cut-off of S in waves per revolution, see `lathe_machine.control.disturbance_memory.smoothing`.
        points_per_revolution: memory points per revolution, a power of two.
        identification_bandwidth: bandwidth of the identification [rad/s].
        identify: whether the model is identified.
        identification_forgetting: forgetting factor applied to the measurements once per revolution.
        rational: rational inverse in its initial state.

    Raises:
        InputError: the filter S is wider than a revolution.
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
        rational=rational,
    )


def forget(m: DisturbanceTable) -> None:
    """Clear the memory over the angle and the fit; keep the model and the observer."""
    forget_all(m.memory)
    forget_measurements(m.fit)
    m.point[:] = 0.0
    m.state[:_SEEN] = 0
    forget_rational(m.rational.fit)
    forget_candidate(m.rational)


@kernel
def fed_forward(m: DisturbanceTable, form: FormAhead, angle: float, speed: float, acceleration: float) -> float:
    """Return the command [m] for the form at an angle [rad], a speed [rad/s] and dΩ/dt [rad/s²]."""
    value, slope, bow = derivatives_at(form.heights, form.table, form.feed, form.start, form.part, angle)
    second = speed * speed * bow + acceleration * slope
    plain = value + m.model[0] * speed * slope + m.model[1] * second
    return inverted(m.rational, FORM, plain, value, speed * slope, second)


@kernel
def commanded(m: DisturbanceTable, sample: int, command: float) -> None:
    """Store the command of a sample [m]."""
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
    """Process the position measured ``late`` samples ago; return the observed minus the learned disturbance [m].

    Args:
        m: model of drive and disturbance.
        form: desired form of the part.
        sample: index of the current sample.
        angle: spindle angle ``late`` samples ago [rad].
        speed: spindle speed ``late`` samples ago [rad/s].
        position: position of the drive ``late`` samples ago [m].
        learning: whether memory and model are updated.
    """
    k = sample - m.late - m.whole
    mask = m.commands.size - 1
    command = (1.0 - m.part) * m.commands[k & mask] + m.part * m.commands[(k - 1) & mask] if k >= 1 else 0.0
    known = expected(m.memory, angle, speed)
    if not m.state[_SEEN]:  # the drive is assumed to be at rest at its first position
        m.state[_SEEN] = 1
        m.observer.position[:] = m.learner.position[:] = m.identifier.position[:] = position
        m.observer.command[:] = m.learner.command[:] = m.identifier.command[:] = position
        begin_at(m.rational, position)
    found = 0.0
    if m.observes:
        low = m.observer
        pass_through(low.position, position, low.keep, low.take)
        pass_through(low.command, command, low.keep, low.take)
        pass_through(m.learned, known, low.keep, low.take)
        first, second = derivatives(low.position, low.bandwidth)
        found = low.position[STAGES] + m.model[0] * first + m.model[1] * second
        found = inverted(m.rational, OBSERVER, found, low.position[STAGES], first, second)
        found -= low.command[STAGES] + m.learned[STAGES]
    if m.memory.learns or m.identifies:
        low = m.learner
        pass_through(low.position, position, low.keep, low.take)
        pass_through(low.command, command + known, low.keep, low.take)
        first, second = derivatives(low.position, low.bandwidth)
        beyond = low.position[STAGES] + m.model[0] * first + m.model[1] * second
        beyond = inverted(m.rational, LEARNER, beyond, low.position[STAGES], first, second)
        beyond -= low.command[STAGES]
        low = m.identifier
        pass_through(low.position, position, low.keep, low.take)
        pass_through(low.command, command, low.keep, low.take)
        at_sample(m.rational, sample, position, command)
        if learning and sample >= m.begins:
            _measure(m, form, angle, speed, beyond)
        else:
            m.state[_BEGUN] = 0
            forget_candidate(m.rational)
    return found


@inlined
def _measure(m: DisturbanceTable, form: FormAhead, angle: float, speed: float, beyond: float) -> None:
    """Add a sample to its grid point, and complete the grid points already passed."""
    low, point, state = m.learner, m.point, m.state
    lag = STAGES / low.bandwidth  # of the low-pass for slow signals, which thus belong to an earlier angle
    place = int(np.floor((angle - speed * lag) * (m.memory.value.size / _TURN)))
    low = m.identifier
    if not state[_BEGUN] or place - state[_POINT] > m.memory.value.size:  # or the angle has jumped by a revolution
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
        if m.rational.fits:
            put_latest(m.rational.fit)


@kernel
def _end_point(m: DisturbanceTable, form: FormAhead, speed: float) -> None:
    """Complete a grid point: learn the point that S can now smooth, and add the measurements to the fit."""
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
        if m.rational.fits:
            sum_up_rational(m.rational.fit, here, again)
    point[_SUM] = point[_COUNT] = 0.0
    state[_POINT] += 1
    if (state[_POINT] - state[_FIRST]) % points == 0:
        state[_REVOLUTIONS] += 1
        if m.rational.fits:
            if proved(m.rational, m.model):
                _take_over(m, form)
            refit(m.rational, m.state[_REVOLUTIONS])
        if m.identifies and not is_rational(m.rational):
            _adopt(m, form, speed)
        fade(m.fit)
        revolution_ended(m.memory, state[_REVOLUTIONS])


@inlined
def _adopt(m: DisturbanceTable, form: FormAhead, speed: float) -> None:
    """Adopt the identified model, and correct the filters and the memory for the change of the model."""
    a1, a2 = fitted(m.fit)
    if not (a1 > 0.0 and a2 > 0.0):
        return
    more1, more2 = a1 - m.model[0], a2 - m.model[1]
    m.model[0], m.model[1] = a1, a2
    # The states of the low-passes belong to the old model; left unchanged, they would cause a step in the disturbance.
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


@inlined
def _take_over(m: DisturbanceTable, form: FormAhead) -> None:
    """Use the candidate from now on; convert the memory to it at the nominal speed, and the filters."""
    memory, points, end = m.memory, m.memory.value.size, m.state[_POINT]
    if memory.learns:
        speed, before = memory.nominal, memory.value[end & (points - 1)]
        step = _TURN / (points * speed)
        for i in range(end - _SETTLING * points, end):
            value, slope, bow = derivatives_at(
                form.heights, form.table, form.feed, form.start, form.part, i * (_TURN / points)
            )
            first, second = speed * slope, speed * speed * bow
            plain = value + m.model[0] * first + m.model[1] * second
            more = changed(m.rational, step, plain, value, first, second)
            if i >= end - points:
                memory.value[i & (points - 1)] += more
        more = memory.value[end & (points - 1)] - before
        for stage in range(m.learned.size):
            m.learned[stage] += more
            m.learner.command[stage] += more
    use_candidate(m.rational)
