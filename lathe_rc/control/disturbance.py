# SPDX-License-Identifier: Apache-2.0
"""The disturbance at a drive's input, learned over the angle and observed in time; and the drive, identified.

The drive is x + a1·dx/dt + a2·d²x/dt² = u(t - τ) + f. What acts on it, in metres of its command, is then

    w = x + a1·dx/dt + a2·d²x/dt² - u(t - τ)

of the measured position x and the command u. w is no error that a command brings about: with a good model it does not
depend on u, so that learning it is no loop and cannot diverge. A wrong model makes it one, with the gain
E = (Wi/Ŵi)·e^{pτ̂} - 1, and it still converges to x = r as long as |E| is below 1.

**Memory** (repetitive control). For each grid point of the angle it holds a value and how that changes with the speed,
F̂ = v + s·(Ω/Ω0 - 1), a Kalman filter for each point from revolution to revolution: what follows the cut with a lag lies
at another angle when the spindle turns faster. What is learned passes a zero-phase filter S over the angle; what S does
not pass leaks away, a tenth in a revolution.

**Observer** (in time). L·w - L·F̂, L = 1/(1 + p/ωo)³: what the memory does not know yet.

**Identification.** a1 and a2 by least squares of u(t - τ) - x = a1·dx/dt + a2·d²x/dt² - f. f is unknown, but it repeats
with the angle: the difference from the last revolution at the same angle has no f. It needs a speed that varies;
otherwise the equation itself counts, with a small weight, and beside it the model that was given, the more the larger f
is. What the result is wrong by then repeats and is learned as a part of f.

Source: spec/robust.md; learning over the position for non-circular cutting: Nakano, 1996.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.control.interpolation import read
from lathe_rc.errors import InputError
from lathe_rc.jit import inlined, kernel
from lathe_rc.signals.profile import derivatives_at

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

_TURN = 2.0 * np.pi
_STAGES = 3  # first-order stages of each low-pass
_TAIL = 5.0  # standard deviations at which S is cut off
_HALF = float(np.sqrt(-2.0 * np.log(1.0 - np.sqrt(0.5))))  # where the twiced Gaussian is 1/2, for a deviation of 1
_UNKNOWN = 1e4  # variance of a value before anything was learned, over that of a measurement
_SLOPE = 1e2  # the same of its change with the relative speed
_SLOPE_DRIFT = 1e-2  # part of that by which it may have changed in a revolution
_SWINGS_IN = 10.0  # of a1 until the drive has
LEAK = 0.1  #: part of what S does not pass that a revolution takes out of the memory
_SETTLED = 8  # revolutions that are learned before the change with the speed is
_WHOLE = 3e-4  # weight of the equation itself beside its difference from the last revolution
_UNSURE = (0.3, 0.4)  # standard deviations of a1 and a2 as they are given, relative
_LEAST_EXCITED = 1e-6  # determinant of the normal equations, 1 for independent regressors

# Places in the integer state: grid point that is being measured, the first one of all, whether there is one,
# revolutions that are learned, whether a position has been seen.
_POINT, _FIRST, _BEGUN, _REVOLUTIONS, _SEEN = range(5)
# Places in the sums of a grid point: what is learned and how often, relative speed, dx/dt, d²x/dt², u - x.
_SUM, _COUNT, _SPEED, _VELOCITY, _ACCELERATION, _REST = range(6)


class FormAhead(NamedTuple):
    """The form that is turned, for kernels; see `lathe_rc.signals.profile.derivatives_at`."""

    heights: Array
    table: Array
    feed: float
    start: float
    part: int


class LowPass(NamedTuple):
    """1/(1 + p/ω)³ by the bilinear rule, for some signals; stage by stage, so that derivatives need no differences.

    Attributes:
        bandwidth: ω [rad/s].
        keep, take: of a stage.
        position, command: their values before and after each stage, shape (4,) [m].
    """

    bandwidth: float
    keep: float
    take: float
    position: Array
    command: Array


class DisturbanceTable(NamedTuple):
    """The law's knowledge of drive and disturbance.

    Attributes:
        step: sampling step [s].
        nominal: speed Ω0 [rad/s].
        given, model: a1 [s] and a2 [s²] as they are told and as they are identified, shape (2,).
        late: samples until a position is seen.
        begins: sample from which on it is learned from: until then the drive swings in.
        whole, part: of the drive's delay: samples, and the rest in samples.
        commands: of the past; sample n stands at n modulo their number, a power of two [m].
        observer, observes: low-pass of the observer, and whether it acts.
        learned: what the memory says, as it passes that low-pass, shape (4,) [m].
        learner: low-pass of what is learned.
        learns, drift: whether the memory is used, and by how much a value drifts in a revolution, as variance.
        follows_speed: whether how a value changes with the speed is learned.
        value, slope: of the memory by grid point, shape (n,) [m].
        spread: their covariance, shape (3, n).
        fresh, speeds: what the newest revolution says beyond the memory [m], and at which relative speed, shape (n,).
        smoothing: S by grid point, shape (odd,).
        identifier, identifies: low-pass of the identification, and whether it acts.
        before: dx/dt, d²x/dt² and u - x of the last revolution, shape (3, n).
        sums: of the normal equations, differences first.
        means: how many, sums of dx/dt, d²x/dt², u - x and (u - x)²: a steady force counts for nothing.
        forgetting: what a revolution leaves of both.
        point: sums of the grid point that is being measured.
        state: see above.
    """

    step: float
    nominal: float
    given: Array
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
    learns: bool
    drift: float
    follows_speed: bool
    value: Array
    slope: Array
    spread: Array
    fresh: Array
    speeds: Array
    smoothing: Array
    identifier: LowPass
    identifies: bool
    before: Array
    sums: Array
    means: Array
    forgetting: float
    point: Array
    state: Integers


def smoothing(waves: float, points: int) -> Array:
    """S over the angle: a Gaussian, twiced, so that 1 - S is the square of 1 minus the Gaussian; shape (odd,).

    Args:
        waves: per revolution at which S is 1/2.
        points: of the grid per revolution.

    Raises:
        InputError: it is wider than a revolution.
    """
    deviation = _HALF * points / (_TURN * waves)
    reach = int(np.ceil(_TAIL * deviation))
    if 4 * reach + 1 > points:
        raise InputError(
            f"{waves:g} waves per revolution: the filter is wider than a revolution; allowed: {_HALF * 22 / _TURN:.0f} "
            "waves or more"
        )
    gauss = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation) ** 2)
    gauss /= gauss.sum()
    twiced = -np.convolve(gauss, gauss)
    twiced[reach : 3 * reach + 1] += 2.0 * gauss
    return np.asarray(twiced)


def _low_pass(bandwidth: float, step: float) -> LowPass:
    half = 0.5 * bandwidth * step
    return LowPass(
        bandwidth, (1.0 - half) / (1.0 + half), half / (1.0 + half), np.zeros(_STAGES + 1), np.zeros(_STAGES + 1)
    )


def disturbance(
    *,
    step: float,
    nominal: float,
    model: tuple[float, float, float],
    late: int,
    observer: float,
    learner: float,
    gain: float,
    follows_speed: bool,
    waves: float,
    points: int,
    identifier: float,
    identifies: bool,
    forgetting: float,
) -> DisturbanceTable:
    """Nothing is known yet.

    Args:
        step: sampling step [s].
        nominal: speed Ω0 [rad/s].
        model: natural frequency [rad/s], damping and delay [s] of the drive.
        late: samples until a position is seen.
        observer: bandwidth of the observer [rad/s]; 0: there is none.
        learner: bandwidth of what is learned [rad/s].
        gain: part of what is new that the memory takes up in the long run, below 1; 0: there is no memory.
        follows_speed: whether how a value changes with the speed is learned.
        waves: per revolution that are learned, see `smoothing`.
        points: of the memory per revolution, a power of two.
        identifier: bandwidth of the identification [rad/s].
        identifies: whether the model is identified.
        forgetting: what a revolution leaves of the measurements before.

    Raises:
        InputError: S is wider than a revolution.
    """
    frequency, damping, delay = model
    whole = int(np.floor(delay / step + 1e-9))
    given = np.array([2.0 * damping / frequency, 1.0 / frequency**2])
    spread = np.zeros((3, points))
    spread[0] = _UNKNOWN
    return DisturbanceTable(
        step=step,
        nominal=nominal,
        given=given,
        model=given.copy(),
        late=late,
        begins=late + int(_SWINGS_IN * given[0] / step),
        whole=whole,
        part=max(delay / step - whole, 0.0),
        commands=np.zeros(1 << (late + whole + 2).bit_length()),
        observer=_low_pass(observer, step),
        observes=observer > 0.0,
        learned=np.zeros(_STAGES + 1),
        learner=_low_pass(learner, step),
        learns=gain > 0.0,
        drift=gain**2 / (1.0 - gain),
        follows_speed=follows_speed,
        value=np.zeros(points),
        slope=np.zeros(points),
        spread=spread,
        fresh=np.zeros(points),
        speeds=np.zeros(points),
        smoothing=smoothing(waves, points),
        identifier=_low_pass(identifier, step),
        identifies=identifies,
        before=np.zeros((3, points)),
        sums=np.zeros(10),
        means=np.zeros(5),
        forgetting=forgetting,
        point=np.zeros(6),
        state=np.zeros(5, np.int64),
    )


def forget(m: DisturbanceTable) -> None:
    """Forget what was learned over the angle; model and observer stay."""
    for array in (m.value, m.slope, m.fresh, m.spread, m.before, m.sums, m.means, m.point):
        array[:] = 0.0
    m.spread[0] = _UNKNOWN
    m.state[:_SEEN] = 0


@inlined
def _pass(stages: Array, value: float, keep: float, take: float) -> None:
    new = value
    for stage in range(_STAGES):
        old = stages[stage]
        stages[stage] = new
        new = keep * stages[stage + 1] + take * (new + old)
    stages[_STAGES] = new


@inlined
def _derivatives(stages: Array, bandwidth: float) -> tuple[float, float]:
    """First two derivatives of what has passed a low-pass."""
    first = bandwidth * (stages[_STAGES - 1] - stages[_STAGES])
    return first, bandwidth**2 * (stages[_STAGES - 2] - 2.0 * stages[_STAGES - 1] + stages[_STAGES])


@kernel
def expected(m: DisturbanceTable, angle: float, speed: float) -> float:
    """The memory's prediction at an angle [rad] and a speed [rad/s], in metres of the command."""
    if not m.learns:
        return 0.0
    place = angle * (m.value.size / _TURN)
    i = int(np.floor(place))
    value = read(m.value, i, place - i)
    if m.follows_speed:
        value += (speed / m.nominal - 1.0) * read(m.slope, i, place - i)
    return value


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
    """Take the measured position of ``late`` samples ago; what the observer finds beyond the memory [m].

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
    known = expected(m, angle, speed)
    if not m.state[_SEEN]:  # the drive has stood where it is
        m.state[_SEEN] = 1
        m.observer.position[:] = m.learner.position[:] = m.identifier.position[:] = position
        m.observer.command[:] = m.learner.command[:] = m.identifier.command[:] = position
    found = 0.0
    if m.observes:
        low = m.observer
        _pass(low.position, position, low.keep, low.take)
        _pass(low.command, command, low.keep, low.take)
        _pass(m.learned, known, low.keep, low.take)
        first, second = _derivatives(low.position, low.bandwidth)
        found = low.position[_STAGES] + m.model[0] * first + m.model[1] * second
        found -= low.command[_STAGES] + m.learned[_STAGES]
    if m.learns or m.identifies:
        low = m.learner
        _pass(low.position, position, low.keep, low.take)
        _pass(low.command, command + known, low.keep, low.take)
        low = m.identifier
        _pass(low.position, position, low.keep, low.take)
        _pass(low.command, command, low.keep, low.take)
        if learning and sample >= m.begins:
            _measure(m, form, angle, speed)
        else:
            m.state[_BEGUN] = 0
    return found


@inlined
def _measure(m: DisturbanceTable, form: FormAhead, angle: float, speed: float) -> None:
    low, point, state = m.learner, m.point, m.state
    first, second = _derivatives(low.position, low.bandwidth)
    beyond = low.position[_STAGES] + m.model[0] * first + m.model[1] * second - low.command[_STAGES]
    lag = _STAGES / low.bandwidth
    place = int(np.floor((angle - speed * lag) * (m.value.size / _TURN)))
    low = m.identifier
    if not state[_BEGUN]:
        state[_BEGUN], state[_POINT], state[_FIRST] = 1, place, place
        m.fresh[:] = 0.0
    while state[_POINT] < place:
        _end_point(m, form, speed)
    if state[_POINT] == place:
        point[_SUM] += beyond
        point[_COUNT] += 1.0
        point[_SPEED] = speed / m.nominal - 1.0
        point[_VELOCITY], point[_ACCELERATION] = _derivatives(low.position, low.bandwidth)
        point[_REST] = low.command[_STAGES] - low.position[_STAGES]


@kernel
def _end_point(m: DisturbanceTable, form: FormAhead, speed: float) -> None:
    """A grid point has been measured: learn those that S can smooth now, and look at the model."""
    state, point, points = m.state, m.point, m.value.size
    here = state[_POINT] & (points - 1)
    reach = m.smoothing.size // 2
    m.fresh[here] = point[_SUM] / point[_COUNT] if point[_COUNT] > 0.0 else 0.0
    m.speeds[here] = point[_SPEED]
    if m.learns and state[_POINT] - reach >= state[_FIRST]:
        _learn(m, state[_POINT] - reach)
    if m.identifies and point[_COUNT] > 0.0:
        _sum_up(m, here)
    point[_SUM] = point[_COUNT] = 0.0
    state[_POINT] += 1
    if (state[_POINT] - state[_FIRST]) % points == 0:
        state[_REVOLUTIONS] += 1
        if m.identifies:
            _fit(m, form, speed)
        m.sums[:] *= m.forgetting
        m.means[:] *= m.forgetting
        if state[_REVOLUTIONS] == _SETTLED and m.follows_speed:
            m.spread[2] = _SLOPE


@inlined
def _learn(m: DisturbanceTable, centre: int) -> None:
    """Kalman filter of a grid point; the variance of what is measured is 1."""
    points, reach = m.value.size, m.smoothing.size // 2
    found = smooth = 0.0
    for k in range(m.smoothing.size):
        i = (centre - reach + k) & (points - 1)
        found += m.smoothing[k] * m.fresh[i]
        smooth += m.smoothing[k] * m.value[i]
    j = centre & (points - 1)
    faster = m.speeds[j]
    p0, p1, p2 = m.spread[0, j] + m.drift, m.spread[1, j], m.spread[2, j]
    if p2 > 0.0:
        p2 = min(p2 + _SLOPE_DRIFT * _SLOPE, _SLOPE)
    g0, g1 = p0 + p1 * faster, p1 + p2 * faster
    total = g0 + g1 * faster + 1.0
    m.value[j] += g0 / total * found + LEAK * (smooth - m.value[j])
    m.slope[j] += g1 / total * found
    m.spread[0, j], m.spread[1, j], m.spread[2, j] = p0 - g0 * g0 / total, p1 - g0 * g1 / total, p2 - g1 * g1 / total


@inlined
def _sum_up(m: DisturbanceTable, here: int) -> None:
    sums, before = m.sums, m.before
    velocity, acceleration, rest = m.point[_VELOCITY], m.point[_ACCELERATION], m.point[_REST]
    if m.state[_POINT] - m.state[_FIRST] >= m.value.size:
        v, a, r = velocity - before[0, here], acceleration - before[1, here], rest - before[2, here]
        sums[0] += v * v
        sums[1] += v * a
        sums[2] += a * a
        sums[3] += v * r
        sums[4] += a * r
    sums[5] += velocity * velocity
    sums[6] += velocity * acceleration
    sums[7] += acceleration * acceleration
    sums[8] += velocity * rest
    sums[9] += acceleration * rest
    mean = m.means
    mean[0] += 1.0
    mean[1] += velocity
    mean[2] += acceleration
    mean[3] += rest
    mean[4] += rest * rest
    before[0, here], before[1, here], before[2, here] = velocity, acceleration, rest


@inlined
def _fit(m: DisturbanceTable, form: FormAhead, speed: float) -> None:
    """Fit the model; what it explained otherwise is in the memory, and goes along."""
    count, v, a, r, rr = m.means[0], m.means[1], m.means[2], m.means[3], m.means[4]
    whole, s = m.sums[5:].copy(), m.sums[:5].copy()
    for k, mean in enumerate((v * v, v * a, a * a, v * r, a * r)):
        whole[k] -= mean / count
    determinant = whole[0] * whole[2] - whole[1] * whole[1]
    if not determinant > _LEAST_EXCITED * whole[0] * whole[2]:
        return
    a1 = (whole[3] * whole[2] - whole[4] * whole[1]) / determinant
    a2 = (whole[4] * whole[0] - whole[3] * whole[1]) / determinant
    # The force is as large in the waves that the drive moves in as in the others, where it is what is left.
    left = _WHOLE * max(rr - r * r / count - a1 * whole[3] - a2 * whole[4], 0.0)
    sure1, sure2 = left / (_UNSURE[0] * m.given[0]) ** 2, left / (_UNSURE[1] * m.given[1]) ** 2
    s += _WHOLE * whole
    s[0] += sure1
    s[2] += sure2
    s[3] += sure1 * m.given[0]
    s[4] += sure2 * m.given[1]
    determinant = s[0] * s[2] - s[1] * s[1]
    a1 = (s[3] * s[2] - s[4] * s[1]) / determinant
    a2 = (s[4] * s[0] - s[3] * s[1]) / determinant
    if not (a1 > 0.0 and a2 > 0.0):
        return
    more1, more2 = a1 - m.model[0], a2 - m.model[1]
    m.model[0], m.model[1] = a1, a2
    for low, known in ((m.observer, m.learned), (m.learner, m.learner.command)):
        first, second = _derivatives(low.position, low.bandwidth)
        known[:] += more1 * first + more2 * second
    if not m.learns:
        return
    points = m.value.size
    for i in range(m.state[_POINT] - points, m.state[_POINT]):
        _, slope, bow = derivatives_at(
            form.heights, form.table, form.feed, form.start, form.part, (i + 0.5) * _TURN / points
        )
        m.value[i & (points - 1)] += more1 * speed * slope + more2 * speed**2 * bow
