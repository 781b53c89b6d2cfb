# SPDX-License-Identifier: Apache-2.0
"""The sampled position servo of paper 003: in z, in the pseudo-frequency, and as it really moves between samples.

    z = (1 + jλ·T/2)/(1 - jλ·T/2),   λ = (2/T)·tan(ωT/2)

In the pseudo-frequency λ the drive behind its hold is W = K·(1 - jλ·T/2)·(1 + jλ·T2)/(jλ·(1 + jλ·T3)).
"""

from dataclasses import dataclass
from typing import Any

import control
import numpy as np
import numpy.typing as npt

from lathe_rc.control.sampled_link import Link, LinkTable, SampledDrive, closed_loop, correct, largest_pole, rest, table
from lathe_rc.jit import kernel
from lathe_rc.plants.feed import DriveTable, Feedback, FeedDrive, hold, load_of, motor_of, move
from lathe_rc.plants.feed_models import sampled

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

_BAND = 0.05  # of the step: settled is what stays within
STEPS = 400  #: of the simulation in a period, to see what happens in it
_POINTS = 400  # of a Bode plot
_SETTLED = 1e-5  # what may be left of the slowest pole at the end of a response
_MOST_PERIODS = 2000
_SAME = 1e-9  # roots that differ by less are one


@dataclass(frozen=True)
class PseudoFrequency:
    """K·(1 - jλ·T/2)·(1 + jλ·T2)/(jλ·(1 + jλ·T3)) (paper 003, eqs 4-7).

    Attributes:
        gain: K [1/s].
        half_period: T/2 [s].
        zero: T2 [s].
        pole: T3 [s].
    """

    gain: float
    half_period: float
    zero: float
    pole: float

    def response(self, frequency: npt.ArrayLike) -> Complex:
        """Response at the pseudo-frequency λ [rad/s], any shape."""
        s = 1j * np.asarray(frequency, dtype=np.float64)
        return np.asarray(
            self.gain * (1.0 - s * self.half_period) * (1.0 + s * self.zero) / (s * (1.0 + s * self.pole))
        )

    def closed(self) -> tuple[Array, Array]:
        """Numerator and denominator of the closed loop, falling powers of z."""
        half, two = self.half_period, np.array([1.0, -1.0])
        zero, pole = (np.array([1.0, 1.0]) + time / half * two for time in (self.zero, self.pole))
        top = 2.0 * self.gain * half * zero
        bottom = np.polyadd(np.polymul(two, pole), top)
        return top / bottom[0], bottom / bottom[0]

    def as_continuous(self) -> tuple[Array, Array]:
        """Numerator and denominator of the closed loop with jλ read as p, falling powers of p.

        This is what the table of the paper was computed from.
        """
        top = self.gain * np.polymul([-self.half_period, 1.0], [self.zero, 1.0])
        return np.asarray(top), np.asarray(np.polyadd(top, [self.pole, 1.0, 0.0]))


def pseudo_frequency(drive: SampledDrive) -> PseudoFrequency:
    """The drive behind its hold: T2 = (T/2)·(b1 - b0)/(b1 + b0), T3 = (T/2)·(1 + d)/(1 - d)."""
    half = drive.period / 2.0
    zero = half * (drive.b1 - drive.b0) / (drive.b1 + drive.b0)
    return PseudoFrequency(drive.gain, half, zero, half * (1.0 + drive.d) / (1.0 - drive.d))


def desired(drive: SampledDrive, ratio: float) -> PseudoFrequency:
    """The desired function with Te = ratio·T/2, K·(1 - jλ·T/2)·(1 + jλ·Te)/(jλ·(1 + jλ·T/2))."""
    half = drive.period / 2.0
    return PseudoFrequency(drive.gain, half, ratio * half, half)


def series(top: Array, bottom: Array, terms: int) -> Array:
    """X[0], X[T], … of a unit step through a rational function of z, shape (terms,)."""
    system = control.tf(top, bottom, 1.0)
    return np.asarray(control.step_response(system, np.arange(terms, dtype=np.float64)).outputs)


@dataclass(frozen=True)
class Measures:
    """Measures of a step response.

    Attributes:
        overshoot: relative to the step, 0 for none.
        settling: last entry into the band of ±5 % [s]; None if it is not there at the end.
    """

    overshoot: float
    settling: float | None


def measures(time: Array, response: Array) -> Measures:
    """Overshoot and settling of the response to a unit step, shape (n,) each [s, 1]."""
    # step_info wants a response that rises through 90 %.
    if response.max() < 0.9:
        return Measures(0.0, None)
    found = control.step_info(response, time, SettlingTimeThreshold=_BAND, yfinal=1.0)
    settling = found["SettlingTime"]
    return Measures(found["Overshoot"] / 100.0, float(settling) if np.isfinite(settling) else None)


def continuous_step(top: Array, bottom: Array, time: Array) -> Array | None:
    """Response of a continuous system to a unit step, shape (n,); None where it is unstable."""
    # A leading coefficient that changes its sign passes through a pole at infinity.
    if bottom[0] * bottom[-1] <= 0.0 or np.roots(bottom).real.max() >= 0.0:
        return None
    return np.asarray(control.step_response(control.tf(top, bottom), time).outputs)


@kernel
def _simulate(
    drive: DriveTable,
    drive_state: Array,
    link: LinkTable,
    link_state: Array,
    divisor: int,
    delay: int,
    from_load: bool,  # noqa: FBT001 - kernels take everything by position
    command: Array,
    motor: Array,
    load: Array,
) -> None:
    """A unit step at sample 0; the command acts from the sample on whose measurement it comes from."""
    for n in range(command.size):
        move(drive, drive_state)
        motor[n], load[n] = motor_of(drive_state), load_of(drive_state)
        if n % divisor == 0:
            seen = 0.0
            if n >= delay:
                seen = load[n - delay] if from_load else motor[n - delay]
            command[n], _ = correct(link, link_state, 1.0 - seen)
            hold(drive, drive_state, command[n])
        else:
            command[n] = command[n - 1]


@dataclass(frozen=True)
class StepResponse:
    """A servo's response to a unit step, with what happens between the samples; arrays of shape (n,).

    Attributes:
        time: [s].
        command: of the link, relative to the step.
        motor, load: relative to the step.
    """

    time: Array
    command: Array
    motor: Array
    load: Array

    @property
    def at_samples(self) -> tuple[Array, Array]:
        """Time and position of the motor where the controller looks."""
        return self.time[::STEPS], self.motor[::STEPS]

    @property
    def reversals(self) -> int:
        """How often the load is taken back: changes of the direction in which it moves."""
        moves = np.diff(self.load)
        direction = np.sign(moves[moves != 0.0])
        return int(np.count_nonzero(np.diff(direction)))

    @property
    def offset(self) -> float:
        """The load's remaining error at the end, relative to the step."""
        return float(1.0 - self.load[-1])


def periods_to_settle(drive: SampledDrive, link: Link, delay: float = 0.0) -> int | None:
    """Periods until a loop is at rest; None if it never is."""
    slowest = largest_pole(drive, link, delay)  # 0 for a dead-beat loop: hence max() below
    if slowest >= 1.0:
        return None
    return int(np.clip(np.ceil(np.log(_SETTLED) / np.log(max(slowest, _SETTLED))), 10, _MOST_PERIODS))


def step_response(
    drive: SampledDrive,
    link: Link,
    *,
    periods: int,
    backlash: float = 0.0,
    feedback: Feedback = "load",
    delay: float = 0.0,
) -> StepResponse:
    """Simulate a unit step; between samples the drive is exact.

    Args:
        drive: the motor.
        link: before it.
        periods: how long.
        backlash: after the motor, relative to the step.
        feedback: what is measured.
        delay: by which the measurement comes late [s], rounded to a 400th of the period.
    """
    step = drive.period / STEPS
    machine = FeedDrive(sampled(drive.gain, drive.lag), step=step, divisor=STEPS, backlash=backlash)
    time = np.arange(periods * STEPS + 1, dtype=np.float64) * step
    command, motor, load = np.zeros_like(time), np.zeros_like(time), np.zeros_like(time)
    _simulate(
        machine.table, machine.state, table(link), rest(link), STEPS, round(delay / step), feedback == "load",
        command, motor, load,
    )  # fmt: skip
    return StepResponse(time, command, motor, load)


@dataclass(frozen=True)
class DesignReport:
    """A link and its loop on paper.

    Attributes:
        drive: what the link is for.
        link: its coefficients.
        poles: of the closed loop, those that cancel a zero included.
        stable: whether the closed loop is.
        gain_margin: factor by which the gain may rise; infinite if by any, NaN where the loop is unstable.
        phase_margin: [rad]; NaN where the loop is unstable.
        crossover: pseudo-frequency at which it is taken, where the gain of the open loop is 1 [rad/s].
        frequency: pseudo-frequencies λ of the Bode plot [rad/s], shape (n,).
        response: of the open loop there, shape (n,).
    """

    drive: SampledDrive
    link: Link
    poles: Complex
    stable: bool
    gain_margin: float
    phase_margin: float
    crossover: float
    frequency: Array
    response: Complex

    def text(self) -> str:
        """W(z), W(jλ), D(z), poles and margins, a line each."""
        drive, pseudo = self.drive, pseudo_frequency(self.drive)
        top, bottom = (" ".join(f"{c:.5g}" for c in part) for part in (self.link.numerator, self.link.denominator))
        # A double pole at 0 is found to the root of the rounding only.
        rounded = np.round(self.poles, 4) + 0.0
        poles = ", ".join(f"{pole:g}" if pole.imag else f"{pole.real:g}" for pole in rounded)
        gain = f"(1 - {pseudo.half_period:g}jλ)(1 + {pseudo.zero:.4f}jλ)"
        lines = [
            f"W(z)  = ({drive.b1:.4f}z + {drive.b0:.4f})/((z - 1)(z - {drive.d:.4f})), T = {drive.period:g} s",
            f"W(jλ) = {pseudo.gain:g}{gain}/(jλ(1 + {pseudo.pole:.4f}jλ))",
            f"D(z)  = [{top}]/[{bottom}], falling powers of z",
            f"poles of the closed loop: {poles} ({'stable' if self.stable else 'unstable'})",
        ]
        if self.stable:
            lines += [
                f"gain margin {20.0 * np.log10(self.gain_margin):.1f} dB",
                f"phase margin {np.degrees(self.phase_margin):.1f}° at λ = {self.crossover:.3g} rad/s",
            ]
        return "\n".join(lines)


def _cancel(zeros: npt.NDArray[Any], poles: npt.NDArray[Any]) -> tuple[list[complex], list[complex]]:
    """Zeros and poles without those that are the same but for rounding."""
    left, kept = [complex(pole) for pole in poles], []
    for zero in zeros:
        near = min(left, key=lambda pole: abs(pole - zero), default=np.inf)
        if abs(near - zero) < _SAME:
            left.remove(near)
        else:
            kept.append(complex(zero))
    return kept, left


def open_loop(drive: SampledDrive, link: Link) -> control.TransferFunction:
    """D·W as a rational function of jλ, in python-control's continuous form; what can be cancelled is."""
    top = np.polymul(link.numerator, drive.numerator)
    zeros, poles = _cancel(np.roots(top), np.roots(np.polymul(link.denominator, drive.denominator)))
    half = drive.period / 2.0
    # z = 1/r stands for the zeros at infinity, which go to jλ = 2/T.
    places = [np.array([(root - 1.0) / (root + 1.0) / half for root in roots]) for roots in (zeros, poles)]
    places[0] = np.append(places[0], np.full(len(poles) - len(zeros), 1.0 / half))
    factor = float(np.real(top[0] * np.prod([root + 1.0 for root in zeros]) / np.prod([r + 1.0 for r in poles])))
    return control.zpk(*places, factor * (-1.0) ** (len(poles) - len(zeros)))


def _gain_margin(loop: control.TransferFunction) -> float:
    """How many times the gain may rise; infinite if by any."""
    found, *_ = control.stability_margins(loop, returnall=True)
    # At an infinite pseudo-frequency, half the sampling rate, the response is real too.
    end = float(loop.num[0][0][0] / loop.den[0][0][0]) if loop.num[0][0].size == loop.den[0][0].size else 0.0
    candidates = np.append(found, -1.0 / end if end < 0.0 else np.inf)
    return float(np.min(candidates[candidates > 1.0], initial=np.inf))


def report(drive: SampledDrive, link: Link) -> DesignReport:
    """Poles, margins and Bode plot in the pseudo-frequency, of a loop without delay."""
    loop = open_loop(drive, link)
    poles = np.asarray(np.roots(closed_loop(drive, link)), dtype=np.complex128)
    gain_margin, phase_margin, crossover = np.nan, np.nan, np.nan
    stable = largest_pole(drive, link) < 1.0
    if stable:
        _, phases, _, _, crossovers, _ = control.stability_margins(loop, returnall=True)
        worst = int(np.argmin(phases))
        gain_margin, phase_margin, crossover = _gain_margin(loop), np.radians(phases[worst]), crossovers[worst]
    frequency = np.geomspace(min(0.02 / drive.period, 0.1 * drive.gain), 200.0 / drive.period, _POINTS)
    return DesignReport(
        drive,
        link,
        poles,
        stable,
        float(gain_margin),
        float(phase_margin),
        float(crossover),
        frequency,
        np.asarray(loop(1j * frequency)),
    )
