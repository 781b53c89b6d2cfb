# SPDX-License-Identifier: Apache-2.0
"""PID tuning for specified margins, and evaluation of loops with a PID.

At the crossover ωc the gain of the loop is 1, and its phase exceeds -π by the phase margin. For a plant P this gives

    C(jωc) = e^{j(margin - π)}/P(jωc),   C = P + I/p + D·N·p/(p + N)

These are two equations for the three gains. The third is I/ωc = |C(jωc)|/integral_ratio, which bounds the lag of the
integral part.
Paper 004 tuned with Matlab's PID Tuner.

Systems are python-control systems. The companion form of paper 004's compensators has coefficients from 1 to 10¹², and
the computed poles of a loop with it are wrong by several rad/s, so each system is balanced before it is connected to
others.
"""

from dataclasses import dataclass
from typing import Any, TypeAlias

import control
import numpy as np
import numpy.typing as npt

from lathe_machine.control.pid import PidGains
from lathe_machine.transfer import TransferFunction, realise
from lathe_rc.arrays import Array, Complex
from lathe_rc.errors import InputError

Lti: TypeAlias = Any  # control.lti.LTI, which has no type annotations
Plant: TypeAlias = TransferFunction | Lti

_PADE = 4  # order; the phase is accurate to 1e-4 rad up to ωτ = 2


def state_space(plant: Plant) -> Lti:
    """Convert a plant to state space: balanced for a transfer function, by python-control for other systems."""
    if not isinstance(plant, TransferFunction):
        return control.ss(plant)
    a, b, c, d = realise(plant)
    return control.ss(a, b[:, None], c[None, :], [[d]])


def delay(seconds: float) -> Lti:
    """Create the Padé approximation of a delay e^{-p·seconds}."""
    if seconds == 0.0:
        return control.ss([], [], [], [[1.0]])
    return state_space(TransferFunction(*(tuple(part) for part in control.pade(seconds, _PADE))))


_FREQUENCIES = 600  # points of the Bode plot from which margins are read
_SAMPLES = 4000  # samples of a step response
_TRIES = 60  # trial crossovers of `fastest`


def response(plant: Plant, frequency: npt.ArrayLike) -> Complex:
    """Compute the frequency response of a plant at ``frequency`` [rad/s]."""
    if isinstance(plant, TransferFunction):
        return plant.response(frequency)
    return np.asarray(plant(1j * np.asarray(frequency)), dtype=np.complex128)


@dataclass(frozen=True)
class TunedLoop:
    """Margins and closed-loop step response of a loop.

    Attributes:
        rise: rise time from 10 to 90 % of a step [s].
        settling: settling time to within 2 % [s].
        overshoot: overshoot relative to the step [1].
        gain_margin: gain margin as a factor; infinite if no gain destabilises the loop.
        gain_frequency: frequency at which the phase is -π [rad/s]; NaN if there is none.
        phase_margin: phase margin [rad].
        phase_frequency: crossover [rad/s].
        stable: whether the closed loop is stable; if not, the step measures are NaN.
    """

    rise: float
    settling: float
    overshoot: float
    gain_margin: float
    gain_frequency: float
    phase_margin: float
    phase_frequency: float
    stable: bool


def _band(plant: Plant, gains: PidGains, wait: float) -> Array:
    """Return increasing frequencies [rad/s] that cover all features of the loop in a Bode plot."""
    wide = np.geomspace(1e-5, 1e6, _FREQUENCIES)
    above = np.abs(response(plant, wide) * gains.transfer.response(wide)) > 1.0
    crossovers = wide[:-1][above[:-1] != above[1:]]
    zeros = np.roots(gains.transfer.numerator)
    corners = np.abs(np.concatenate((state_space(plant).poles(), gains.transfer.poles, zeros)))
    found = np.concatenate((crossovers, corners[corners > 1e-9], [np.pi / wait] if wait else []))
    return np.geomspace(found.min() / 10.0, found.max() * 10.0, _FREQUENCIES) if found.size else wide


def closed_loop(plant: Plant, gains: PidGains, wait: float = 0.0) -> Lti:
    """Create the closed loop from set point to measurement, with the delay ``wait`` [s] as a Padé approximation."""
    return control.feedback(state_space(plant) * state_space(gains.transfer) * delay(wait))


def evaluate(plant: Plant, gains: PidGains, wait: float = 0.0) -> TunedLoop:
    """Compute margins and step response of a loop with a PID.

    Args:
        plant: plant of the loop.
        gains: gains of the PID.
        wait: pure delay in the loop [s]; exact for the margins, a Padé approximation for the step.
    """
    frequency = _band(plant, gains, wait)
    loop = response(plant, frequency) * gains.transfer.response(frequency) * np.exp(-1j * frequency * wait)
    gain, phase, at_gain, at_phase = control.margin(control.frd(loop, frequency))
    closed = closed_loop(plant, gains, wait)
    poles = closed.poles()
    stable = bool(np.all(poles.real < 0.0))
    rise, settling, overshoot = _step(closed, poles) if stable else (np.nan, np.nan, np.nan)
    return TunedLoop(
        rise, settling, overshoot, float(gain), float(at_gain), float(np.radians(phase)), float(at_phase), stable
    )


def _step(closed: Lti, poles: Complex) -> tuple[float, float, float]:
    """Compute rise time [s], settling time [s] and relative overshoot of a stable system."""
    final = float(np.real(closed.dcgain()))
    span = 10.0 / np.abs(poles.real).min()
    for _ in range(2):  # a slow pole with a negligible residue makes the first time span far too long
        time, y = control.step_response(closed, np.linspace(0.0, span, _SAMPLES))
        measured = control.step_info(y, T=time, yfinal=final)
        span = min(span, 4.0 * measured["SettlingTime"])
    return float(measured["RiseTime"]), float(measured["SettlingTime"]), float(measured["Overshoot"]) / 100.0


def tune(
    plant: Plant,
    *,
    crossover: float,
    phase_margin: float,
    integral_ratio: float = 6.0,
    filter_ratio: float = 100.0,
    wait: float = 0.0,
) -> PidGains:
    """Compute PID gains for a specified crossover and phase margin.

    If the margin is exceeded without a derivative, D is 0, and I follows from the margin.

    Args:
        plant: plant of the loop.
        crossover: ωc [rad/s].
        phase_margin: phase margin [rad].
        integral_ratio: ratio of the gain of the PID to that of its integral part, at the crossover.
        filter_ratio: ratio of N to the crossover.
        wait: pure delay in the loop [s].

    Raises:
        InputError: no PID has the required phase at the crossover.
    """
    if not (crossover > 0.0 and 0.0 < phase_margin < np.pi / 2.0 and integral_ratio > 0.0 and filter_ratio > 0.0):
        raise InputError(
            f"tuning: crossover {crossover:g} rad/s, phase margin {np.degrees(phase_margin):.4g}°, ratios "
            f"{integral_ratio:g} and {filter_ratio:g}; allowed: above 0, the margin below 90°"
        )
    there = complex(response(plant, crossover)) * np.exp(-1j * crossover * wait)
    wanted = complex(np.exp(1j * (phase_margin - np.pi)) / there)
    filter_ = filter_ratio * crossover
    lead = 1j * crossover * filter_ / (1j * crossover + filter_)
    integral = abs(wanted) / integral_ratio
    derivative = max(0.0, (wanted.imag + integral) / lead.imag)
    if derivative == 0.0:
        integral = -wanted.imag
    proportional = wanted.real - derivative * lead.real
    if proportional <= 0.0:
        raise InputError(
            f"tuning: at {crossover:g} rad/s the plant's phase is {np.degrees(np.angle(there)):.4g}°, which no PID "
            f"brings to a margin of {np.degrees(phase_margin):.4g}°; allowed: a lower crossover or margin"
        )
    return PidGains(proportional, integral * crossover, derivative, filter_)


def fastest(
    plant: Plant, *, band: tuple[float, float], phase_margin: float, gain_margin: float, wait: float = 0.0
) -> PidGains:
    """Compute the gains for the highest crossover in a band that meets both margins with a stable loop.

    Args:
        plant: plant of the loop.
        band: lowest and highest crossover [rad/s].
        phase_margin: required phase margin [rad].
        gain_margin: required gain margin, as a factor.
        wait: pure delay in the loop [s].

    Raises:
        InputError: no crossover in the band meets the margins.
    """
    for crossover in np.geomspace(*band, _TRIES)[::-1]:
        try:
            gains = tune(plant, crossover=float(crossover), phase_margin=phase_margin, wait=wait)
        except InputError:
            continue
        loop = evaluate(plant, gains, wait)
        if loop.stable and loop.gain_margin >= gain_margin and loop.phase_margin >= phase_margin * (1.0 - 1e-4):
            return gains
    raise InputError(
        f"tuning: no crossover from {band[0]:g} to {band[1]:g} rad/s has margins of "
        f"{np.degrees(phase_margin):.4g}° and {gain_margin:g}; allowed: a lower band, smaller margins or a "
        "shorter delay"
    )
