# SPDX-License-Identifier: Apache-2.0
"""Gauge that measures the turned surface, and the correction of a drive's sensor that is learned from its readings.

The gauge reads the form error of a place of the part some revolutions after the edge has cut it. Its readings e are
averaged over the angle, filtered, and summed up:

    c(φ) = c(φ) + g·(G·e)(φ),    measured position of the drive = that of its own sensor - c(φ)

G is the Gaussian filter of ISO 16610-21. A learner that reads the corrected position brings the part to its form, where
its drive's own sensor sees neither deflection nor run-out. Along the revolutions this is the integrator
c[k+1] = c[k] + b·e[k-D], where the drive follows its corrected sensor a revolution later: D = delay + 1. Its limit is

    |b| = 2·sin((π/2 - |arg b|)/(2D + 1)),

and the fastest without overshoot with b = D^D/(D+1)^(D+1) (both from λ^(D+1) - λ^D + b = 0).
"""

import math
from collections.abc import Mapping, Sequence
from statistics import NormalDist
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from annotated_types import Ge, Gt, Le, Lt

from lathe_machine.control.interpolation import read
from lathe_rc import messages
from lathe_rc.analysis.metrology import gaussian_share
from lathe_rc.arrays import Integers, put
from lathe_rc.blocks.ports import Input, Output, Sparse
from lathe_rc.cell.parameters import NodeParameters, NonNegative, Positive, parameter, remapped
from lathe_rc.cell.stage import DONE, Fields, Reached, Stage, WiredCell
from lathe_rc.errors import InputError, LatheError, at_least, at_most
from lathe_rc.jit import inlined, kernel
from lathe_rc.messages import Samples, Signals
from lathe_rc.signals.noise import Sensor, SensorTable, quantise

_TURN = 2.0 * np.pi
_CORRECTED = "gauge/state"  # topic
_NOTHING = 1e-9  # a smaller part of a reading does not count in any run
_GRID = 4096  # recorded points per revolution
_LEAST_POINTS = 64  # of the correction per revolution
_SPREAD = float(np.sqrt(2.0 * np.log(2.0)))  # standard deviation of the filter [rad], for a cut-off of 1
_TAIL = 5.0  # standard deviations at which the filter ends
# Indices in the integer state: next grid point of the record, its first one, whether it has begun; current point of the
# correction, the first one, whether there is one; whether the correction learns.
_NEXT, _FIRST, _RECORDS, _POINT, _SINCE, _BEGUN, LEARNS = range(7)
# Indices in the real state: newest recorded angle and error; angle up to which there is no reading; sum and count of
# the readings at the current point.
_ANGLE, _ERROR, _MISSING, _SUM, _COUNT = range(5)
_JUMPED = 1  # stop reason of the step


class GaugeParameters(NodeParameters):
    """The gauge, and how the correction of the drive's sensor is learned from it."""

    drive: str = parameter("coarse", "drive whose sensor is corrected, by the first word of its state topic")
    revolutions_late: Annotated[int, Ge(1), Le(1024)] = parameter(
        1, "revolutions from the cut of a place to its reading; those of a part for a gauge after the machine", "rev"
    )
    angle_offset: Annotated[float, Gt(-1.6), Lt(1.6)] = parameter(
        0.0, "how far ahead of the place that it names the gauge reads", "rad"
    )
    noise_rms: NonNegative = parameter(0.0, "white noise of a reading, RMS; 0: none", "m")
    resolution: NonNegative = parameter(0.0, "quantisation step of a reading; 0: none", "m")
    dropouts_per_revolution: NonNegative = parameter(
        0.0, "random drop-outs that begin in a revolution at nominal speed, on average (coolant, chips)"
    )
    dropout_angle: Positive = parameter(0.1, "angle without a reading from the begin of a drop-out on", "rad")
    gap_start: list[float] = parameter([], "where places without a surface begin (keyways): no reading", "rad")
    gap_width: list[Positive] = parameter([], "their widths", "rad")
    cutoff: Positive = parameter(
        50.0, "waves per revolution of which the filter of the readings leaves a half (ISO 16610-21)"
    )
    gain: NonNegative = parameter(
        0.0, "part of a revolution's readings that the correction takes up; 0: the largest without overshoot"
    )
    points_per_revolution: Annotated[int, Ge(_LEAST_POINTS), Le(4096)] = parameter(
        512, "points of the correction per revolution, a power of 2"
    )
    tool_delay: Annotated[int, Ge(1), Le(2**16)] = parameter(
        64, "delay of the feedback edge from the tool, at least a block", "sample"
    )

    @property
    def lag(self) -> int:
        """Revolutions D from a correction to the reading of what it brings."""
        return self.revolutions_late + 1

    @property
    def used_gain(self) -> float:
        """Gain g of the correction."""
        lag = self.lag
        return self.gain or float(lag**lag / (lag + 1) ** (lag + 1))


class Memory(NamedTuple):
    """Memory of the step of the gauge.

    Attributes:
        delay: delay of the tool's error [sample].
        record: form error by grid point of the last revolutions, a ring [m].
        back: grid points from the current angle back to the place of a reading.
        sensor: noise and resolution of a reading.
        dropouts: random numbers that begin a drop-out.
        begins: limit above which one begins.
        length: angle of a drop-out [rad].
        gaps: starts and widths of places without a surface, shape (2, n) [rad].
        taps: weights of the filter, shape (odd,).
        gain: g.
        correction: c by grid point, their number a power of two [m].
        fresh: mean reading by grid point in the newest revolution [m].
        whole, real: integer and real state, indexed by the constants of the module.
    """

    delay: int
    record: Samples
    back: float
    sensor: SensorTable
    dropouts: SensorTable
    begins: float
    length: float
    gaps: Samples
    taps: Samples
    gain: float
    correction: Samples
    fresh: Samples
    whole: Integers
    real: Samples


@inlined
def _record(m: Memory, angle: float, error: float) -> None:
    """Record the error of a cut sample at the grid points since the sample before, linear between both."""
    whole, real = m.whole, m.real
    place = angle * (_GRID / _TURN)
    if not whole[_RECORDS]:
        whole[_RECORDS] = 1
        whole[_NEXT] = whole[_FIRST] = int(np.ceil(place))
    elif place > real[_ANGLE]:
        slope = (error - real[_ERROR]) / (place - real[_ANGLE])
        while whole[_NEXT] <= place:
            m.record[whole[_NEXT] % m.record.size] = real[_ERROR] + slope * (whole[_NEXT] - real[_ANGLE])
            whole[_NEXT] += 1
    real[_ANGLE], real[_ERROR] = place, error


@inlined
def _in_a_gap(gaps: Samples, angle: float) -> bool:
    """Return whether there is no surface at an angle of the part [rad]."""
    for k in range(gaps.shape[1]):  # noqa: SIM110 - Numba compiles no generators here
        if (angle - gaps[0, k]) % _TURN < gaps[1, k]:
            return True
    return False


@inlined
def _end_point(m: Memory) -> None:
    """Complete a point of the correction, and correct the point that the filter can now smooth."""
    whole, real, mask, reach = m.whole, m.real, m.correction.size - 1, m.taps.size // 2
    # Without a reading the correction stays.
    m.fresh[whole[_POINT] & mask] = real[_SUM] / real[_COUNT] if real[_COUNT] > 0.0 else 0.0
    real[_SUM] = real[_COUNT] = 0.0
    centre = whole[_POINT] - reach
    if centre - reach >= whole[_SINCE]:
        smooth = 0.0
        for k in range(m.taps.size):
            smooth += m.taps[k] * m.fresh[(centre - reach + k) & mask]
        m.correction[centre & mask] += m.gain * smooth
    whole[_POINT] += 1


@inlined
def _learn(m: Memory, angle: float, reading: float, there: bool) -> None:  # noqa: FBT001 - a kernel's arguments
    """Add a reading to its point of the correction."""
    whole, real = m.whole, m.real
    # A point lies in the middle of its readings.
    point = int(np.floor(angle * (m.correction.size / _TURN) + 0.5))
    if not whole[_BEGUN]:
        whole[_BEGUN], whole[_POINT], whole[_SINCE] = 1, point, point
        real[_SUM] = real[_COUNT] = 0.0
    while whole[_POINT] < point:
        _end_point(m)
    if there and whole[_POINT] == point:
        real[_SUM] += reading
        real[_COUNT] += 1.0


@kernel
def step(memory: Memory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Record, read and correct one block."""
    m, whole, real = memory, memory.whole, memory.real
    angle, angle_true, cut_angle, cut_error = inputs[0], inputs[1], inputs[2], inputs[3]
    for field in range(3):
        put(outputs[field], inputs[4 + field])
    measured, corrected = inputs[7], outputs[3]
    error, nothing, there, reading = outputs[4], outputs[5], outputs[6], outputs[7]
    noise, gone = m.sensor.noise.used[0], m.dropouts.noise.used[0]
    noisy, drops = m.sensor.rms > 0.0, m.dropouts.rms > 0.0
    for k in range(angle.size):
        if first + k >= m.delay:
            if whole[_RECORDS] and abs(cut_angle[k] * (_GRID / _TURN) - real[_ANGLE]) > m.record.size:
                return k, _JUMPED
            _record(m, cut_angle[k], cut_error[k])
        place = angle_true[k] * (_GRID / _TURN) - m.back
        left = int(np.floor(place))
        # Before the first places come round the gauge sees what is left of the blank.
        seen = whole[_RECORDS] != 0 and left >= whole[_FIRST] and left + 1 < whole[_NEXT]
        error[k] = nothing[k] = reading[k] = there[k] = 0.0
        if seen:
            before = m.record[left % m.record.size]
            error[k] = before + (place - left) * (m.record[(left + 1) % m.record.size] - before)
        if drops and m.dropouts.noise.values[gone + k] > m.begins:
            real[_MISSING] = max(real[_MISSING], angle_true[k] + m.length)
        if seen and angle_true[k] >= real[_MISSING] and not _in_a_gap(m.gaps, place * (_TURN / _GRID)):
            there[k] = 1.0
            value = error[k] + (m.sensor.rms * m.sensor.noise.values[noise + k] if noisy else 0.0)
            reading[k] = quantise(value, m.sensor.resolution)
        if whole[LEARNS]:
            if whole[_BEGUN] and abs(angle[k] * (m.correction.size / _TURN) - whole[_POINT]) > m.correction.size:
                return k, _JUMPED
            _learn(m, angle[k], reading[k], there[k] > 0.0)
        point = angle[k] * (m.correction.size / _TURN)
        i = int(np.floor(point))
        corrected[k] = measured[k] - read(m.correction, i, point - i)
    if noisy:
        m.sensor.noise.used[0] = noise + angle.size
    if drops:
        m.dropouts.noise.used[0] = gone + angle.size
    return angle.size, DONE


def filter_taps(cutoff: float, points: int) -> Samples:
    """Return the weights of the Gaussian filter of ISO 16610-21 over the angle, shape (odd,).

    Args:
        cutoff: cut-off [undulations per revolution].
        points: grid points per revolution.

    Raises:
        InputError: the filter is wider than half a revolution, or passes more than the points can carry.
    """
    deviation = _SPREAD / cutoff * points / _TURN
    reach = math.ceil(_TAIL * deviation)
    low, high = math.ceil(_TAIL * _SPREAD / _TURN * 4.0 + 1.0), points // 8
    if not low <= cutoff <= high:
        raise InputError(f"cutoff = {cutoff:g} UPR; allowed: {low} up to {high} with {points} points per revolution")
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation) ** 2)
    return np.asarray(taps / taps.sum())


class Gauge(Stage):
    """Gauge behind the tool or after the machine.

    The topic ``gauge/state`` is the state of the drive with its measured position corrected; a tool or a law reads it
    by ``remap: ["coarse/state:=gauge/state"]``. In ``gauge/reading``, ``position`` is the form error of the place under
    the gauge, ``measured_position`` the reading, and ``effort`` is 1 where there is one.
    """

    kind = "gauge"
    Parameters = GaugeParameters
    parameters: GaugeParameters
    actions = ("freeze", "learn", "clear")
    stops: ClassVar[Mapping[int, str]] = {_JUMPED: "jumped: the spindle angle, by more than the record holds"}
    step = staticmethod(step)

    def __init__(self, name: str, parameters: GaugeParameters) -> None:
        super().__init__(name, parameters)
        points, seed = parameters.points_per_revolution, parameters.seed
        if points & (points - 1):
            raise InputError(f"{name}.points_per_revolution = {points}; allowed: a power of 2, 64 up to 4096")
        if len(parameters.gap_start) != len(parameters.gap_width):
            raise InputError(
                f"{name}.gap_start, gap_width: {len(parameters.gap_start)} and {len(parameters.gap_width)}; give as "
                "many of each"
            )
        try:
            taps = filter_taps(parameters.cutoff, points)
        except InputError as error:
            raise InputError(f"{name}.{error}") from None
        share = parameters.dropouts_per_revolution * parameters.nominal_speed * parameters.step / _TURN
        if share >= 1.0:
            most = at_most(_TURN / (parameters.nominal_speed * parameters.step))
            raise InputError(
                f"{name}.dropouts_per_revolution = {parameters.dropouts_per_revolution:g}; allowed: below {most}, one "
                "at each sample"
            )
        reading = Sensor(parameters.noise_rms, parameters.resolution, seed, name)
        dropouts = Sensor(float(share > 0.0), 0.0, seed, f"{name}/dropouts")
        self._sensors = [reading, dropouts]
        self._memory = Memory(
            delay=parameters.tool_delay,
            record=np.zeros(_GRID * (parameters.revolutions_late + 2)),
            back=_GRID * (parameters.revolutions_late - parameters.angle_offset / _TURN),
            sensor=reading.table,
            dropouts=dropouts.table,
            begins=-NormalDist().inv_cdf(share) if share else math.inf,
            length=parameters.dropout_angle,
            gaps=np.array([parameters.gap_start, parameters.gap_width], dtype=float).reshape(2, -1),
            taps=taps,
            gain=parameters.used_gain,
            correction=np.zeros(points),
            fresh=np.zeros(points),
            whole=np.zeros(7, np.int64),
            real=np.array([0.0, 0.0, -math.inf, 0.0, 0.0]),
        )
        self._memory.whole[LEARNS] = 1
        self.declare(
            inputs=[
                Input("encoder", messages.ENCODER, ("angle", "angle_true")),
                Input("encoder", messages.ENCODER, ("angle_true",), parameters.tool_delay),
                Input("tool", messages.TOOL, ("error",), parameters.tool_delay),
                Input(self.relayed, messages.STATE, ("position", "velocity", "effort", "measured_position")),
            ],
            outputs=[Output(_CORRECTED, messages.STATE), Output("gauge/reading", messages.STATE)],
        )

    @property
    def relayed(self) -> str:  # type: ignore[override]
        """Topic of the drive's state, before remapping."""
        return f"{self.parameters.drive}/state"

    def _check_convergence(self) -> None:
        """Check that the correction converges at each wave that it learns."""
        parameters = self.parameters
        waves = np.arange(parameters.points_per_revolution // 2)
        learned = parameters.used_gain * gaussian_share(waves, parameters.cutoff)
        waves, learned = waves[learned > _NOTHING], learned[learned > _NOTHING]
        if not learned.size:
            return
        turns = 2 * parameters.lag + 1
        limit = 2.0 * np.sin(np.pi / 2.0 / turns)
        if learned[0] >= limit:
            raise InputError(
                f"{self.name}.gain = {parameters.used_gain:g}: readings that are {parameters.revolutions_late} "
                f"revolutions late make the correction diverge; allowed: below {at_most(limit)}, or 0"
            )
        phases = (np.pi / 2.0 - turns * np.arcsin(learned[1:] / 2.0)) / waves[1:]
        allowed = float(np.min(phases, initial=np.inf))
        if abs(parameters.angle_offset) >= allowed:
            raise InputError(
                f"{self.name}.angle_offset = {parameters.angle_offset:g} rad: the correction diverges; allowed: less "
                f"than {at_most(allowed, 3)} rad, or more with a smaller cutoff than {parameters.cutoff:g}"
            )

    def _check_points(self, fastest: float) -> None:
        """Check that each point of the correction gets a reading in a revolution at the highest speed [rad/s]."""
        parameters = self.parameters
        samples, points = _TURN / (fastest * parameters.step), parameters.points_per_revolution
        if samples >= points:
            return
        most = 2 ** int(np.log2(samples))
        fewer = f"{most} or fewer, or " if most >= _LEAST_POINTS else ""
        rate = at_least(points * fastest / _TURN)
        raise InputError(
            f"{self.name}.points_per_revolution = {points}: a revolution takes {samples:.4g} samples at {fastest:.4g} "
            f"rad/s; allowed: {fewer}a sample_rate of {rate} Hz or more"
        )

    def check_cell(self, cell: WiredCell, *, cures: bool = True) -> None:
        """Check that a place is recorded when its reading is due, and that a correction in use can be learned."""
        super().check_cell(cell, cures=cures)
        parameters, fastest = self.parameters, cell.speed_range[1]
        if cell.reader_names(remapped(self.shared, _CORRECTED)):
            self._check_points(fastest)
            self._check_convergence()
        turned = parameters.tool_delay * parameters.step * fastest + 2.0 * _TURN / _GRID
        room = _TURN * parameters.revolutions_late - max(parameters.angle_offset, 0.0)
        if turned > room:
            raise InputError(
                f"{self.name}.tool_delay = {parameters.tool_delay} samples: the spindle turns by {turned:.3g} rad in "
                f"that, and a reading is due after {room:.3g} rad; allowed: a shorter delay, or more revolutions_late"
            )

    def perform(self, action: str) -> None:
        """Freeze the correction, learn again, or clear it."""
        memory = self._memory
        if action == "clear":
            memory.correction[:] = 0.0
        else:
            memory.whole[LEARNS] = action == "learn"
        # Points since then are no whole revolution of readings.
        memory.whole[_BEGUN] = 0

    def serve(
        self, reason: int, first: int, reached: int, inputs: Sequence[Signals], outputs: Sequence[Signals]
    ) -> list[Sparse]:
        """End a run whose angle jumps, since the points in between would take hours.

        Raises:
            LatheError: the angle jumps.
        """
        raise LatheError(
            f"sample {first + reached}: the spindle angle jumps to {inputs[0]['angle'][reached]:.6g} rad; allowed: a "
            "revolution or less in a sample"
        )

    @property
    def memory(self) -> Memory:
        """Current memory of the step of the gauge."""
        return self._memory
