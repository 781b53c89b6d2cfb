# SPDX-License-Identifier: Apache-2.0
"""Sampled position servo of paper 003: in z, in the pseudo-frequency, and as a simulation between the samples.

    z = (1 + jλ·T/2)/(1 - jλ·T/2),   λ = (2/T)·tan(ωT/2)

In the pseudo-frequency λ, the drive with its hold is W = K·(1 - jλ·T/2)·(1 + jλ·T2)/(jλ·(1 + jλ·T3)).
"""

from dataclasses import dataclass
from typing import Any

import control
import numpy as np
import numpy.typing as npt

from lathe_machine.control.sampled_link import (
    Link,
    LinkTable,
    SampledDrive,
    closed_loop,
    correct,
    largest_pole,
    rest,
    table,
)
from lathe_machine.plants.feed import DriveTable, Feedback, FeedDrive, hold, load_of, motor_of, move
from lathe_machine.plants.feed_models import sampled
from lathe_rc.arrays import Array, Complex
from lathe_rc.jit import kernel

_BAND = 0.05  # settling band, relative to the step
STEPS = 400  #: simulation steps per period, to resolve the motion between samples
_POINTS = 400  # points of a Bode plot
_SETTLED = 1e-5  # allowed residue of the slowest pole at the end of a response
_MOST_PERIODS = 2000
_SAME = 1e-9  # roots closer than this count as equal


@dataclass(frozen=True)
class PseudoFrequency:
    """Transfer function K·(1 - jλ·T/2)·(1 + jλ·T2)/(jλ·(1 + jλ·T3)) in the pseudo-frequency (paper 003, eqs 4-7).

    Attributes:
        gain: gain K [1/s].
        half_period: half of the sampling period, T/2 [s].
        zero: time constant T2 of the zero [s].
        pole: time constant T3 of the pole [s].
    """

    gain: float
    half_period: float
    zero: float
    pole: float

    def response(self, frequency: npt.ArrayLike) -> Complex:
        """Return the response at the pseudo-frequency λ [rad/s], any shape."""
        s = 1j * np.asarray(frequency, dtype=np.float64)
        return np.asarray(
            self.gain * (1.0 - s * self.half_period) * (1.0 + s * self.zero) / (s * (1.0 + s * self.pole))
        )

    def closed(self) -> tuple[Array, Array]:
        """Return the numerator and denominator of the closed loop in descending powers of z."""
        half, two = self.half_period, np.array([1.0, -1.0])
        zero, pole = (np.array([1.0, 1.0]) + time / half * two for time in (self.zero, self.pole))
        top = 2.0 * self.gain * half * zero
        bottom = np.polyadd(np.polymul(two, pole), top)
        return top / bottom[0], bottom / bottom[0]

    def as_continuous(self) -> tuple[Array, Array]:
        """Return the numerator and denominator of the closed loop with jλ replaced by p, in descending powers of p.

        The table of the paper was computed from this function.
        """
        top = self.gain * np.polymul([-self.half_period, 1.0], [self.zero, 1.0])
        return np.asarray(top), np.asarray(np.polyadd(top, [self.pole, 1.0, 0.0]))


def pseudo_frequency(drive: SampledDrive) -> PseudoFrequency:
    """Return the drive with its hold: T2 = (T/2)·(b1 - b0)/(b1 + b0), T3 = (T/2)·(1 + d)/(1 - d)."""
    half = drive.period / 2.0
    zero = half * (drive.b1 - drive.b0) / (drive.b1 + drive.b0)
    return PseudoFrequency(drive.gain, half, zero, half * (1.0 + drive.d) / (1.0 - drive.d))


def desired(drive: SampledDrive, ratio: float) -> PseudoFrequency:
    """Return the desired function K·(1 - jλ·T/2)·(1 + jλ·Te)/(jλ·(1 + jλ·T/2)) with Te = ratio·T/2."""
    half = drive.period / 2.0
    return PseudoFrequency(drive.gain, half, ratio * half, half)


def series(top: Array, bottom: Array, terms: int) -> Array:
    """Return X[0], X[T], … of the response of a rational function of z to a unit step, shape (terms,)."""
    system = control.tf(top, bottom, 1.0)
    return np.asarray(control.step_response(system, np.arange(terms, dtype=np.float64)).outputs)


@dataclass(frozen=True)
class Measures:
    """Overshoot and settling time of a step response.

    Attributes:
        overshoot: overshoot relative to the step; 0 for none.
        settling: time of the last entry into the ±5 % band [s]; None if the response ends outside the band.
    """

    overshoot: float
    settling: float | None


def measures(time: Array, response: Array) -> Measures:
    """Return overshoot and settling time of the response to a unit step, shape (n,) each [s, 1]."""
    # step_info requires a response that rises through 90 %.
    if response.max() < 0.9:
        return Measures(0.0, None)
    found = control.step_info(response, time, SettlingTimeThreshold=_BAND, yfinal=1.0)
    settling = found["SettlingTime"]
    return Measures(found["Overshoot"] / 100.0, float(settling) if np.isfinite(settling) else None)


def continuous_step(top: Array, bottom: Array, time: Array) -> Array | None:
    """Return the response of a continuous system to a unit step, shape (n,); None if it is unstable."""
    # A sign change of the leading coefficient corresponds to a pole passing through infinity.
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
    """Simulate a unit step at sample 0; each command acts from the sample of its measurement onwards."""
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
    """Response of a servo to a unit step, including the motion between the samples; arrays of shape (n,).

    Attributes:
        time: times [s].
        command: output of the link, relative to the step.
        motor, load: positions relative to the step.
    """

    time: Array
    command: Array
    motor: Array
    load: Array

    @property
    def at_samples(self) -> tuple[Array, Array]:
        """Times and motor positions at the sampling instants of the controller."""
        return self.time[::STEPS], self.motor[::STEPS]

    @property
    def reversals(self) -> int:
        """Number of direction changes of the load."""
        moves = np.diff(self.load)
        direction = np.sign(moves[moves != 0.0])
        return int(np.count_nonzero(np.diff(direction)))

    @property
    def offset(self) -> float:
        """Remaining error of the load at the end, relative to the step."""
        return float(1.0 - self.load[-1])


def periods_to_settle(drive: SampledDrive, link: Link, delay: float = 0.0) -> int | None:
    """Return the number of periods until a loop is at rest; None if it is unstable."""
    slowest = largest_pole(drive, link, delay)  # 0 for a dead-beat loop, hence max() below
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
    """Simulate the response to a unit step, with the exact response of the drive between samples.

    Args:
        drive: the drive.
        link: link that precedes the drive.
        periods: number of periods to simulate.
        backlash: backlash after the motor, relative to the step.
        feedback: measured position, motor or load.
        delay: delay of the measurement [s], rounded to 1/400 of the period.
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
    """Design report of a link and its loop, without simulation.

    Attributes:
        drive: drive for which the link is designed.
        link: coefficients of the link.
        poles: poles of the closed loop, including poles that cancel a zero.
        stable: whether the closed loop is stable.
        gain_margin: factor by which the gain may increase; infinite without a limit, NaN if the loop is unstable.
        phase_margin: phase margin [rad]; NaN if the loop is unstable.
        crossover: pseudo-frequency of the phase margin, where the gain of the open loop is 1 [rad/s].
        frequency: pseudo-frequencies λ of the Bode plot [rad/s], shape (n,).
        response: open-loop response at these frequencies, shape (n,).
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
        """Return W(z), W(jλ), D(z), poles and margins as text, one per line."""
        drive, pseudo = self.drive, pseudo_frequency(self.drive)
        top, bottom = (" ".join(f"{c:.5g}" for c in part) for part in (self.link.numerator, self.link.denominator))
        # A double pole at 0 is accurate only to the square root of the rounding error.
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
    """Remove zeros and poles that coincide to within rounding."""
    left, kept = [complex(pole) for pole in poles], []
    for zero in zeros:
        near = min(left, key=lambda pole: abs(pole - zero), default=np.inf)
        if abs(near - zero) < _SAME:
            left.remove(near)
        else:
            kept.append(complex(zero))
    return kept, left


def open_loop(drive: SampledDrive, link: Link) -> control.TransferFunction:
    """Return D·W as a rational function of jλ, in python-control's continuous form, with common factors cancelled."""
    top = np.polymul(link.numerator, drive.numerator)
    zeros, poles = _cancel(np.roots(top), np.roots(np.polymul(link.denominator, drive.denominator)))
    half = drive.period / 2.0
    # z = 1/r represents the zeros at infinity, which map to jλ = 2/T.
    places = [np.array([(root - 1.0) / (root + 1.0) / half for root in roots]) for roots in (zeros, poles)]
    places[0] = np.append(places[0], np.full(len(poles) - len(zeros), 1.0 / half))
    factor = float(np.real(top[0] * np.prod([root + 1.0 for root in zeros]) / np.prod([r + 1.0 for r in poles])))
    return control.zpk(*places, factor * (-1.0) ** (len(poles) - len(zeros)))


def _gain_margin(loop: control.TransferFunction) -> float:
    """Return the factor by which the gain may increase; infinite without a limit."""
    found, *_ = control.stability_margins(loop, returnall=True)
    # At an infinite pseudo-frequency, which is half the sampling rate, the response is real too.
    end = float(loop.num[0][0][0] / loop.den[0][0][0]) if loop.num[0][0].size == loop.den[0][0].size else 0.0
    candidates = np.append(found, -1.0 / end if end < 0.0 else np.inf)
    return float(np.min(candidates[candidates > 1.0], initial=np.inf))


def report(drive: SampledDrive, link: Link) -> DesignReport:
    """Compute poles, margins and Bode plot in the pseudo-frequency for a loop without delay."""
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
