# SPDX-License-Identifier: Apache-2.0
"""Invariance of a step response to the spindle speed (paper 000, Figs 2 and 3, eqs 13-17).

The response of a first-order plant to a unit step is drawn against the angle: at constant speeds, and at an
oscillating speed, with the step at many phases of the oscillation. A speed-independent response gives a single curve.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import scipy
from annotated_types import Ge, Gt, Le
from rich.console import Group

from lathe_machine.plants.linear import discretise
from lathe_papers.formulas.invariance import FirstOrderInvariance
from lathe_rc.arrays import Array
from lathe_rc.cell.parameters import parameter
from lathe_rc.errors import InputError
from lathe_rc.signals import speed
from lathe_rc.signals.speed import SpeedLaw
from lathe_rc.study import Study, StudyParameters, Track, comparison, untracked

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_STEPS = 1000  # integration steps per T0
_SPAN = 5.0  # angle range of the figure, in θ0
_POINTS = 201  # points of the curves
_PHASES = 16  # number of phases of the oscillation at which the step occurs
_CHAINS = ("Wk2 → Wk1 → plant", "plant alone", "Wk1 → Wk2 → plant")  # in the order of `responses`
_COLOURS = ("#1f6f8b", "#c0392b", "#e08e0b")


class InvarianceParameters(StudyParameters):
    """Parameters of the invariance study: plant, speeds and speed deviation."""

    t0_ms: Annotated[float, Gt(0), Le(1000)] = parameter(2.0, "time constant T0 of the plant", "ms")
    speeds: list[Annotated[float, Gt(0), Le(10_000)]] = parameter([84.0, 105.0, 126.0], "spindle speeds", "rad/s")
    nominal_speed: Annotated[float, Gt(0), Le(10_000)] = parameter(
        105.0, "Ω0, at which the corrected plant is the plant itself", "rad/s"
    )
    deviation_amplitude: Annotated[float, Ge(0), Le(0.9)] = parameter(0.1, "of the swinging speed, relative to Ω0")
    deviation_frequencies: list[Annotated[float, Gt(0), Le(10_000)]] = parameter(
        [10.7, 106.0, 213.0, 1000.0], "of the swing", "rad/s"
    )

    def model_post_init(self, context: Any, /) -> None:
        """Reject speeds at which the response would take more than ten times as long as at the nominal speed."""
        super().model_post_init(context)
        if min(self.speeds) < self.nominal_speed / 10:
            raise InputError(f"speeds = {self.speeds}; allowed: from {self.nominal_speed / 10:g} rad/s, a tenth of Ω0")

    @property
    def time_constant(self) -> float:
        """Time constant T0 of the plant [s]."""
        return self.t0_ms * 1e-3


@dataclass(frozen=True)
class InvarianceResult:
    """Results of the invariance study: step responses against the angle.

    Attributes:
        parameters: parameters of the study.
        angles: angles since the step [rad], shape (m,).
        corrected, uncorrected: responses at constant speed, one row per speed, shape (speeds, m).
        deviating: responses at oscillating speed (corrected, uncorrected, wrong order), shape
            (frequencies, 3, phases, m).
    """

    parameters: InvarianceParameters
    angles: Array
    corrected: Array
    uncorrected: Array
    deviating: Array

    def to_json(self) -> dict[str, Any]:
        """Return the results for JSON: responses, and the largest difference at the same angle within each group."""
        swing = _spread(self.deviating)
        return {
            "speeds": self.parameters.speeds,
            "angles": self.angles.tolist(),
            "corrected": self.corrected.tolist(),
            "uncorrected": self.uncorrected.tolist(),
            "max_spread_corrected": float(_spread(self.corrected)),
            "max_spread_uncorrected": float(_spread(self.uncorrected)),
            "deviation_amplitude": self.parameters.deviation_amplitude,
            "deviation_frequencies": self.parameters.deviation_frequencies,
            "deviation_spread_corrected": swing[:, 0].tolist(),
            "deviation_spread_uncorrected": swing[:, 1].tolist(),
            "deviation_spread_wrong_order": swing[:, 2].tolist(),
        }

    def table(self) -> Group:
        """Return a table of the spreads at constant and oscillating speed."""
        constant = comparison(
            f"Step responses over the angle at {', '.join(f'{v:g}' for v in self.parameters.speeds)} rad/s",
            ("", "largest difference", "paper 000, Fig. 3"),
            [
                ("plant alone", f"{_spread(self.uncorrected):.4f}", "depends on the speed"),
                ("Wk2 → Wk1 → plant", f"{_spread(self.corrected):.1e}", "does not"),
            ],
        )
        swinging = comparison(
            f"Largest difference while the speed swings by {self.parameters.deviation_amplitude:.0%}",
            ("deviation [rad/s]", "plant alone", "Wk1 → Wk2 → plant", "Wk2 → Wk1 → plant"),
            [
                (f"{frequency:g}", f"{alone:.4f}", f"{wrong:.4f}", f"{right:.1e}")
                for frequency, (right, alone, wrong) in zip(
                    self.parameters.deviation_frequencies, _spread(self.deviating), strict=True
                )
            ],
        )
        return Group(constant, "", swinging)

    def draw(self, figure: "Figure") -> None:
        """Draw Fig. 3 of the paper, the responses at oscillating speed, and the spread against its frequency."""
        given = self.parameters
        constant, swinging, spread = figure.subplots(1, 3)
        for chain, rows in ((1, self.uncorrected), (0, self.corrected)):
            for number, (row, value) in enumerate(zip(rows, given.speeds, strict=True)):
                label = f"{_CHAINS[chain]}, {value:g} rad/s"
                constant.plot(self.angles, row, ("-", "--", ":")[number % 3], color=_COLOURS[chain], label=label)
        constant.set(xlabel="angle since the step [rad]", ylabel="step response")
        constant.set_title("constant speeds", fontsize=10)
        frequencies = np.array(given.deviation_frequencies)
        order = frequencies.argsort()
        wanted = -np.expm1(-self.angles / (given.time_constant * given.nominal_speed))
        for chain in (2, 1, 0):
            colour, label = _COLOURS[chain], _CHAINS[chain]
            lines = swinging.plot(self.angles, (self.deviating[order[-1], chain] - wanted).T, color=colour, lw=0.8)
            lines[0].set_label(label)
            values = _spread(self.deviating)[order, chain]
            spread.loglog(frequencies[order], values, ".-", color=colour, label=label)
        swinging.set(xlabel="angle since the step [rad]", ylabel="step response less 1 − exp(−φ/θ0)")
        swing = f"{given.deviation_amplitude:.0%} at {frequencies[order[-1]]:g} rad/s"
        swinging.set_title(f"speed swings by {swing}, {_PHASES} phases", fontsize=10)
        spread.set(xlabel="frequency of the swing [rad/s]", ylabel="largest difference of two responses")
        spread.set_title(f"speed swings by {given.deviation_amplitude:.0%}", fontsize=10)
        for axes in (constant, swinging, spread):
            axes.grid(visible=True, alpha=0.3)
            axes.legend(fontsize=7)


def _spread(responses: Array) -> Array:
    """Return the largest difference at the same angle between responses along the second-to-last axis."""
    return np.asarray(np.ptp(responses, axis=-2).max(axis=-1))


def _wrong_order(time_constant: float, angle_constant: float, motion: Array) -> Array:
    """Return the plant input [1] for a unit step when Wk1 precedes Wk2.

    Wk1 turns the step into an impulse, and Wk2 turns the impulse into a jump. With u = (T0·Ω/θ0)·Y + r the
    equation of Wk2 is (θ0/Ω)·dr/dt + r = (1 - T0·Ω/θ0 - T0·(dΩ/dt)/Ω)·Y, without derivatives of Y.
    """
    angle, omega, acceleration = motion
    jump = time_constant * omega / angle_constant
    rest, unused = np.empty((2, angle.size))
    FirstOrderInvariance(time_constant, angle_constant).block(
        angle=angle,
        speed=omega,
        desired=1.0 - jump - time_constant * acceleration / omega,
        substitute=rest,
        command=unused,
    )
    return np.asarray(jump + rest)


def responses(law: SpeedLaw, time_constant: float, nominal: float, angles: Array) -> Array:
    """Compute step responses of the plant: corrected, uncorrected, and corrected in the wrong order.

    Args:
        law: spindle speed; the step occurs at time 0.
        time_constant: time constant T0 of the plant [s].
        nominal: nominal speed Ω0 [rad/s]; θ0 = T0·Ω0.
        angles: angles of the responses [rad], shape (m,).

    Returns:
        Responses, shape (3, m).
    """
    step, angle_constant = time_constant / _STEPS, time_constant * nominal
    motion = law.at(np.arange(law.samples_until(float(angles[-1]), step) + 2) * step)
    angle, omega = motion[0], motion[1]
    desired = np.ones(angle.size)
    substitute, corrected = np.empty((2, angle.size))
    FirstOrderInvariance(time_constant, angle_constant).block(
        angle=angle, speed=omega, desired=desired, substitute=substitute, command=corrected
    )
    commands = np.stack((corrected, desired, _wrong_order(time_constant, angle_constant, motion)))
    plant = discretise(np.array([[-1.0 / time_constant]]), np.array([1.0 / time_constant]), 0.0, step, "foh")
    # The command jumps at sample 0, when the plant is still at rest.
    still = -plant.weights[0, 0] * commands[:, :1]
    moved, _ = scipy.signal.lfilter(plant.weights[0, :2], [1.0, -plant.transition[0, 0]], commands, zi=still)
    return np.asarray(scipy.interpolate.CubicSpline(angle, moved, axis=1)(angles))


def run(parameters: InvarianceParameters, track: Track = untracked) -> InvarianceResult:
    """Compute the step responses at constant and oscillating speed."""
    t0, nominal = parameters.time_constant, parameters.nominal_speed
    angles = np.linspace(0.0, _SPAN * t0 * nominal, _POINTS)
    constant = np.stack([responses(speed.constant(value), t0, nominal, angles) for value in parameters.speeds])
    amplitude = np.array([parameters.deviation_amplitude])
    deviating = np.empty((len(parameters.deviation_frequencies), len(_CHAINS), _PHASES, _POINTS))
    for place, frequency in enumerate(track(parameters.deviation_frequencies)):
        for n in range(_PHASES):
            phase = np.array([2.0 * np.pi * n / _PHASES])
            law = speed.harmonic(nominal, amplitude, np.array([frequency]), phase)
            deviating[place, :, n] = responses(law, t0, nominal, angles)
    return InvarianceResult(parameters, angles, constant[:, 0], constant[:, 1], deviating)


STUDY = Study(
    "invariance",
    "step responses over the angle of a first-order plant, corrected for the speed or not (000, Figs 2-3)",
    InvarianceParameters,
    run,
    size=(13.0, 3.8),
)
