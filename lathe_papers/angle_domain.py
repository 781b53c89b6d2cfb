# SPDX-License-Identifier: Apache-2.0
"""Accuracy of the drive's coefficient sets in the angle domain (paper 000, eqs 7-12).

The drive 1/(1 + 2ζp/ωn + p²/ωn²) follows a harmonic of the spindle angle while the speed oscillates. A delay is
neglected: it only shifts the command to φ(t - τ), equally for all coefficient sets.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from annotated_types import Ge, Gt, Le, Lt
from rich.console import Group

from lathe_papers.formulas.angle_domain import COEFFICIENTS, AngleDomain, harmonic_errors
from lathe_rc.arrays import Array
from lathe_rc.cell.parameters import parameter
from lathe_rc.errors import InputError
from lathe_rc.signals import speed
from lathe_rc.study import Study, StudyParameters, Track, comparison, untracked

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_GOST = (0.10, 0.15)  # speed deviations allowed by the standard for lathes, relative to Ω0 (paper 000, after eq. 11)
_LABELS = ("exact", "quasi-static, eq. 9", "linearised, eq. 12")
_COLOURS = ("#1f6f8b", "#c0392b", "#e08e0b")
_POINTS = 64  # points per period of the profile
_DECAY = 20.0  # time constants until the initial transient has decayed


class AngleDomainParameters(StudyParameters):
    """Parameters of the angle-domain study: drive, profile and speed deviations of the map."""

    natural_frequency: Annotated[float, Ge(50), Le(10_000)] = parameter(1038.0, "ωn of the drive", "rad/s")
    damping: Annotated[float, Ge(0.05), Le(10)] = parameter(0.804, "damping ratio ζ of the drive")
    waves: Annotated[int, Ge(1), Le(20)] = parameter(2, "harmonic of the profile, per revolution")
    nominal_rpm: Annotated[float, Ge(10), Le(60_000)] = parameter(1000.0, "nominal spindle speed", "1/min")
    amplitudes: list[Annotated[float, Gt(0), Lt(0.5)]] = parameter(
        [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3], "deviations, relative to Ω0"
    )
    frequencies: list[Annotated[float, Ge(0.5), Le(3000)]] = parameter(
        [1.0, 2.0, 5.0, 10.7, 20.0, 50.0, 106.0, 150.0, 213.0, 300.0], "of the deviations", "rad/s"
    )
    tolerance: Annotated[float, Gt(0), Lt(1)] = parameter(0.01, "error that is good enough, relative to the profile")

    def model_post_init(self, context: Any, /) -> None:
        """Reject amplitudes or frequencies that cannot span a map: fewer than two, or not in ascending order."""
        super().model_post_init(context)
        for name in ("amplitudes", "frequencies"):
            values = getattr(self, name)
            if len(values) < 2 or np.any(np.diff(values) <= 0.0):
                raise InputError(f"{name} = {values}; allowed: two or more, increasing")


@dataclass(frozen=True)
class AngleDomainResult:
    """Results of the angle-domain study: largest errors relative to the amplitude of the profile.

    Attributes:
        parameters: parameters of the study.
        errors: largest errors by coefficient set (in the order of `COEFFICIENTS`), amplitude and frequency of the
            deviation, shape (3, amplitudes, frequencies).
    """

    parameters: AngleDomainParameters
    errors: Array

    def good_to(self, kind: int, amplitude: int) -> float | None:
        """Return the highest frequency up to which a set stays within tolerance [rad/s]; None if there is none."""
        bad = self.errors[kind, amplitude] > self.parameters.tolerance
        good = int(bad.argmax()) if bad.any() else bad.size
        return self.parameters.frequencies[good - 1] if good else None

    def to_json(self) -> dict[str, Any]:
        """Return the results for JSON: errors by set, one row per amplitude.

        ``good_to_SET`` contains one frequency, or None, for each amplitude.
        """
        given = self.parameters
        rows = range(len(given.amplitudes))
        return {
            "amplitudes": given.amplitudes,
            "frequencies": given.frequencies,
            "tolerance": given.tolerance,
            "gost": list(_GOST),
            **{kind: self.errors[n].tolist() for n, kind in enumerate(COEFFICIENTS)},
            **{f"good_to_{kind}": [self.good_to(n, row) for row in rows] for n, kind in enumerate(COEFFICIENTS)},
        }

    def table(self) -> Group:
        """Return a table of the worst errors by amplitude, and of the frequency up to which each set is usable."""
        given = self.parameters
        highest = given.frequencies[-1]
        rows = []
        for row, amplitude in enumerate(given.amplitudes):
            limits = [self.good_to(n, row) for n in range(3)]
            words = ["none" if f is None else "all" if f == highest else f"to {f:g} rad/s" for f in limits]
            worst = [f"{self.errors[n, row].max():.1e} {words[n]}" for n in range(3)]
            rows.append((f"{amplitude:.1%}" + (" (GOST)" if amplitude in _GOST else ""), *worst))
        title = (
            f"Largest error / amplitude of the profile, deviations of {given.frequencies[0]:g} to {highest:g} rad/s, "
            f"and where it is within {given.tolerance:g}"
        )
        table = comparison(title, ("deviation", *_LABELS), rows)
        return Group(table, "paper 000: eq. 9 is complete; eq. 12 where the deviation is much smaller than Ω0")

    def draw(self, figure: "Figure") -> None:
        """Draw maps of the two approximations, and the errors at the limits of the standard."""
        from matplotlib.colors import LogNorm

        given = self.parameters
        axes = figure.subplots(1, 3)
        percent = np.array(given.amplitudes) * 100
        levels = 10.0 ** np.arange(-7.0, -0.9, 0.5)
        for place, kind in ((axes[0], 1), (axes[1], 2)):
            errors = self.errors[kind]
            filled = place.contourf(given.frequencies, percent, errors, levels, norm=LogNorm(1e-7, 1e-1), extend="both")
            if errors.min() < given.tolerance < errors.max():
                place.contour(given.frequencies, percent, errors, [given.tolerance], colors="w", linewidths=2)
            for allowed in _GOST:
                place.axhline(allowed * 100, color="k", ls="--", lw=0.9)
            place.text(
                given.frequencies[0] * 1.1, _GOST[1] * 103, "GOST 10-15 %", fontsize=7, va="bottom", clip_on=True
            )
            place.set(xscale="log", yscale="log", xlabel="frequency of the deviation [rad/s]", ylabel="deviation [%]")
            place.set_ylim(percent[0], percent[-1])
            place.set_title(f"{_LABELS[kind]} (white line: {given.tolerance:g})", fontsize=10)
        ticks = levels[::2]
        figure.colorbar(filled, ax=list(axes[:2]), label="error / amplitude of the profile", ticks=ticks)
        near = int(np.abs(percent - _GOST[1] * 100).argmin())
        for kind in range(3):
            axes[2].loglog(given.frequencies, self.errors[kind, near], ".-", color=_COLOURS[kind], label=_LABELS[kind])
        axes[2].axhline(given.tolerance, color="k", ls=":", lw=1, label="good enough")
        axes[2].set(xlabel="frequency of the deviation [rad/s]", ylabel="error / amplitude of the profile")
        axes[2].set_title(f"deviation of {given.amplitudes[near]:.1%}", fontsize=10)
        axes[2].grid(visible=True, alpha=0.3)
        axes[2].legend(fontsize=7)


def _errors(parameters: AngleDomainParameters, amplitude: float, frequency: float) -> list[float]:
    """Compute the errors of all coefficient sets for one deviation, over one period of the deviation."""
    nominal = parameters.nominal_rpm * np.pi / 30.0
    law = speed.harmonic(nominal, np.array([amplitude]), np.array([frequency]), np.zeros(1))
    wn = parameters.natural_frequency
    denominator = np.array([1.0, 2.0 * parameters.damping / wn, 1.0 / wn**2])
    slowest = -np.roots(denominator[::-1]).real.max()
    settled, end = law.at([_DECAY / slowest, _DECAY / slowest + 2.0 * np.pi / frequency])[0]
    angle = np.arange(0.0, end, 2.0 * np.pi / (parameters.waves * _POINTS))
    domain = AngleDomain(denominator, np.ones(1), law, angle)
    return list(harmonic_errors(domain, parameters.waves, float(settled)).values())


def run(parameters: AngleDomainParameters, track: Track = untracked) -> AngleDomainResult:
    """Compute the errors for all amplitudes and frequencies of the deviation."""
    cases = [(amplitude, frequency) for amplitude in parameters.amplitudes for frequency in parameters.frequencies]
    errors = np.array([_errors(parameters, *case) for case in track(cases)])
    shape = len(parameters.amplitudes), len(parameters.frequencies), len(COEFFICIENTS)
    return AngleDomainResult(parameters, np.moveaxis(errors.reshape(shape), 2, 0))


STUDY = Study(
    "angle-domain",
    "where the drive's coefficients in the angle domain, exact, quasi-static or linearised, are good (000, eqs 7-12)",
    AngleDomainParameters,
    run,
    size=(14.0, 4.0),
)
