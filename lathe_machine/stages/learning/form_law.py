# SPDX-License-Identifier: Apache-2.0
"""Common part of laws that know the form of the part and feed it forward through the inverse of the drive.

    u = r(φ⁺) + a1·Ω⁺·r'(φ⁺) + a2·(Ω⁺²·r''(φ⁺) + (dΩ/dt)·r'(φ⁺)),    φ⁺ = φ(t + τ), Ω⁺ = Ω(t + τ)

for a drive e^{-pτ}/(1 + a1·p + a2·p²). The form is a function of the angle and the drive one of time, so the formula
holds at any speed. Angle, speed and dΩ/dt come from `lathe_machine.control.angle_filter`.
"""

import math
from collections.abc import Mapping
from fractions import Fraction
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from annotated_types import Ge, Gt, Le

from lathe_machine.control.angle_filter import (
    AngleFilterTable,
    angle_filter,
    at,
    counts_per_sample,
    follow,
    followed_ratio,
)
from lathe_machine.control.disturbance import FormAhead
from lathe_machine.signals.profile_table import derivatives_at
from lathe_machine.stages.learning.law import Law
from lathe_machine.stages.learning.learner import LawParameters
from lathe_machine.stages.tool.form import FORM, Form, FormParameters
from lathe_rc.cell.parameters import Positive, Value, parameter
from lathe_rc.errors import InputError
from lathe_rc.jit import inlined, kernel

#: counts per sample at which the error is 2 to 8 times as large as nearby; other ratios matter less, see docs/robust.md
_BAD = frozenset(Fraction(p, m) for p in (1, 2, 3) for m in (1, 2, 3))
_CLEAR = _BAD | {Fraction(n) for n in (4, 5)} | {Fraction(1, n) for n in (4, 5)}  # a suggested sample rate avoids these
#: sample rates in whole kHz whose step is a whole number of ns [Hz]
_RATES = [1000 * kilo for kilo in range(1, 1001) if 1_000_000 % kilo == 0]
_TICKS = 4  # of the edges' clock in a sample and in a count, from which their rounding does no harm; by simulation
_CLOCKS = [1e-6, 1e-7, 1e-8]  # [s] resolutions of edge times that a warning may name


class FormLawParameters(LawParameters, FormParameters):
    """Form, encoder and drive model of the law; values that are not given are those of the cell."""

    asks: ClassVar[tuple[frozenset[str], ...]] = (FORM, frozenset({"encoder_counts", "encoder_edge_clock"}))

    feedback_delay: Annotated[int, Ge(1), Le(2**16)] = parameter(
        64, "samples from a measured position or error to when it is visible; at least a block", "sample"
    )
    encoder_counts: Annotated[int, Ge(0), Le(2**31 - 1)] = parameter(
        0, "counts of the encoder per revolution; 0: an ideal one; not given in a scenario: those of the spindle"
    )
    encoder_edge_clock: Annotated[float, Ge(0), Le(1)] = parameter(
        0.0, "resolution of the times of its edges; 0: they have none; goes with encoder_counts", "s"
    )
    expected_deviation: Annotated[float, Gt(0), Le(1)] = parameter(
        0.1, "amplitude of the speed deviations that the angle filter expects, relative to the nominal speed", "1"
    )
    expected_frequency: Annotated[float, Gt(0), Le(10_000)] = parameter(
        300.0, "up to which frequency it expects them", "rad/s"
    )
    model_natural_frequency: Positive = parameter(1038.0, "drive model: ωn", "rad/s", drive="natural_frequency")
    model_damping: Positive = parameter(0.804, "drive model: ζ", drive="damping")
    model_delay: Annotated[float, Ge(0), Le(0.1)] = parameter(0.36e-3, "drive model: delay", "s", drive="delay")

    def known(self) -> Mapping[str, Value]:
        """Empty mapping, since the law asks for the form instead of providing it."""
        return {}

    commanded_topic: ClassVar[str] = "coarse/command"

    @property
    def second_order(self) -> tuple[float, float]:
        """Coefficients a1 [s] and a2 [s²] of the model."""
        return 2.0 * self.model_damping / self.model_natural_frequency, 1.0 / self.model_natural_frequency**2


class ForwardTable(NamedTuple):
    """Feed-forward through the given drive model, for kernels.

    Attributes:
        spindle: filter of the spindle angle.
        form: form of the part.
        a1, a2, ahead: coefficients and lead time of the model [s, s², s].
        late: delay of the error [samples].
    """

    spindle: AngleFilterTable
    form: FormAhead
    a1: float
    a2: float
    ahead: float
    late: int


class FormLaw(Law):
    """Base class of laws with a known form.

    Attributes:
        form: form that the drive must follow.

    Raises:
        InputError: a slide determines the height along the part, which therefore cannot be previewed.
    """

    parameters: FormLawParameters
    Parameters = FormLawParameters
    senses: ClassVar[bool] = True

    def __init__(self, name: str, parameters: FormLawParameters) -> None:
        if parameters.height_from != "feed":
            raise InputError(
                f"{name}.height_from = {parameters.height_from}; allowed: feed, for the law looks ahead along it"
            )
        profile = Form(name, parameters).profile
        self.form = FormAhead(
            profile.heights, profile.table, parameters.feed, parameters.start_height, parameters.part_revolutions
        )
        super().__init__(name, parameters)

    def make_filter(self) -> AngleFilterTable:
        """Return the filter of the spindle angle in its initial state, before sample 0."""
        parameters = self.parameters
        return self._filter(parameters.step, parameters.encoder_counts, parameters.encoder_edge_clock)

    def _filter(self, step: float, counts: int, edge_clock: float = 0.0) -> AngleFilterTable:
        parameters = self.parameters
        deviation, frequency = parameters.expected_deviation, parameters.expected_frequency
        return angle_filter(step, counts, parameters.nominal_speed, deviation, frequency, edge_clock)

    def _resolves(self, clock: float, counts: int, high: float) -> bool:
        """Return whether a clock [s] resolves the edges: their rounding to its ticks then does no harm."""
        return _TICKS * clock <= min(self.parameters.step, 2.0 * math.pi / (counts * high))

    def encoder_warnings(self, low: float, high: float, counts: int, edge_clock: float = 0.0) -> list[str]:
        """Return a warning about counts per sample near a ratio of small integers, or about coarse times of edges."""
        step = self.parameters.step
        spindle = self._filter(step, counts)
        ratio = followed_ratio(spindle, low, high, _BAD)
        if not counts or (edge_clock and self._resolves(edge_clock, counts, high)):
            return []
        if ratio is not None:
            what = (
                f"counts per sample c = counts·rpm/(60·sample_rate) = {_passed(spindle, low, high)}, near {ratio}: the "
                "encoder's rounding repeats slowly there, the angle filter follows it, and the form error is 2 to 8 "
                "times as large"
            )
            cures = [self._clear_rate(low, high, counts)]
        elif step / _TICKS < edge_clock < 2.0 * math.pi / (counts * low):
            what = (
                f"times of edges to {edge_clock:.3g} s, more than 1/{_TICKS} of a sample: the angle filter follows "
                "their rounding, and the form error is up to twice that without such times"
            )
            cures = []
        else:  # between two ticks there are counts: the angle is that of an encoder without times
            return []
        if clock := next((each for each in _CLOCKS if self._resolves(each, counts, high)), 0.0):
            cures.append(f"times of edges (edge_clock = {clock:g})")
        return [f"{self.name}: {what}; cure: {', or '.join(cures)}"]

    def _clear_rate(self, low: float, high: float, counts: int) -> str:
        """Return the nearest sample rate that is near no ratio, or else more counts, in words."""
        rate = self.parameters.sample_rate
        # Nearest rates first, and higher rates before lower ones, which read the encoder less often.
        near = [each for each in _RATES if rate / 2 <= each <= rate * 2]
        for cure in sorted(near, key=lambda each: (each < rate, abs(math.log(each / rate)))):
            spindle = self._filter(1.0 / cure, counts)
            if not followed_ratio(spindle, low, high, _CLEAR):
                return f"sample_rate = {cure} ({_passed(spindle, low, high)})"
        finer = math.ceil(1.1 * max(_BAD) * counts / counts_per_sample(self._filter(1.0 / rate, counts), low))
        return f"{finer} counts per revolution or more: no sample rate up to {2 * rate} keeps clear of such ratios"

    def make_forward(self) -> ForwardTable:
        """Return the feed-forward in its initial state, before sample 0."""
        parameters = self.parameters
        return ForwardTable(
            self.make_filter(), self.form, *parameters.second_order, parameters.model_delay, parameters.feedback_delay
        )

    def largest_delay(self, speed: float, acceleration: float, count: float, speed_window: float) -> int:
        """Return the largest delay, half a revolution [samples], since delayed and learned errors must not meet."""
        return int(np.pi / (speed * self.parameters.step))


def _passed(spindle: AngleFilterTable, low: float, high: float) -> str:
    """Return the counts per sample between two speeds [rad/s], in words."""
    slowest, fastest = f"{counts_per_sample(spindle, low):.3g}", f"{counts_per_sample(spindle, high):.3g}"
    return slowest if slowest == fastest else f"{slowest} to {fastest}"


@kernel
def feed_forward(form: FormAhead, a1: float, a2: float, angle: float, speed: float, acceleration: float) -> float:
    """Return the command [m] for the form at an angle [rad], a speed [rad/s] and dΩ/dt [rad/s²]."""
    value, slope, bow = derivatives_at(form.heights, form.table, form.feed, form.start, form.part, angle)
    return value + a1 * speed * slope + a2 * (speed * speed * bow + acceleration * slope)


@inlined
def fed_forward(forward: ForwardTable, angle: float) -> float:
    """Return the feed-forward command [m] of a sample with the measured encoder angle [rad]."""
    follow(forward.spindle, angle)
    ahead, speed, acceleration = at(forward.spindle, forward.ahead)
    return feed_forward(forward.form, forward.a1, forward.a2, ahead, speed, acceleration)
