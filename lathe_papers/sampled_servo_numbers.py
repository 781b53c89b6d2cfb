# SPDX-License-Identifier: Apache-2.0
"""Numbers of paper 003 on the sampled position servo: parameters and results of the study.

The table of the paper gives the step response of the desired function with the pseudo-frequency treated as a frequency.
It is compared with the drive and the link that produces this function, including the motion between samples. The link
of the paper is compared with a ripple-free link, both on a drive with backlash.
"""

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Gt, Le

from lathe_machine.plants.feed import Feedback
from lathe_papers.formulas import sampled_loop
from lathe_papers.formulas.sampled_loop import DesignReport, Measures, PseudoFrequency, StepResponse
from lathe_rc.arrays import Array
from lathe_rc.cell.parameters import parameter
from lathe_rc.study import StudyParameters

RATIOS = (0.05, 0.1, 0.2, 0.3, 0.5, 0.775, 1.0, 1.125, 1.25, 1.5)
#: overshoot [%] and settling time [s] in the paper's table, by T/2 [s]; None for the entry "unstable"
PRINTED: dict[float, tuple[tuple[float, float] | None, ...]] = {
    0.04: (
        (2.5, 0.28), (2.0, 0.29), (1.2, 0.3), (0.5, 0.31), (0.0, 0.33),
        (0.0, 0.36), (0.0, 0.4), (0.0, 0.41), (0.0, 0.42), (0.0, 0.45),
    ),
    0.12: (
        (74.0, 2.38), (67.0, 2.25), (56.0, 1.7), (49.0, 1.33), (30.0, 0.85),
        (12.0, 0.46), (0.0, 0.18), (0.0, 0.26), (0.0, 0.35), None,
    ),
}  # fmt: skip
_GAIN, _LAG, PRINTED_PERIOD = 6.25, 0.08, 0.16  #: K [1/s], T1 [s] and T [s] of the printed values outside the table
#: Eqs 5-7, with T = 0.16 s
DESIRED = tuple(PseudoFrequency(_GAIN, 0.08, zero, pole) for zero, pole in ((0.08, 0.08), (0.062, 0.08), (0.105, 0.04)))
PRINTED_SERIES = (
    (0.0, 1.0, 1.0, 1.0),
    (0.0, 0.89, 1.1, 1.02, 0.99, 0.905, 0.897, 0.903, 0.903),
    (0.0, 0.19, 0.62, 1.1, 1.45, 1.57, 1.47),
)
TERMS = 9  #: number of displayed terms of the series, including X[0]
_POINTS = 8000  # points of the continuous responses
FEEDBACKS: tuple[Feedback, Feedback] = ("motor", "load")


class SampledServoParameters(StudyParameters):
    """Parameters of the sampled-servo study: drive, periods and backlash."""

    t: list[Annotated[float, Ge(0.01), Le(0.5)]] = parameter([0.08, 0.16, 0.24], "periods T of the hold", "s")
    gain: Annotated[float, Gt(0), Le(100)] = parameter(_GAIN, "K of the drive", "1/s")
    lag: Annotated[float, Ge(0.001), Le(1)] = parameter(_LAG, "T1 of the drive", "s")
    backlash: Annotated[float, Gt(0), Le(1)] = parameter(0.1, "width of the gap after the motor, relative to the step")
    delay_ms: Annotated[float, Ge(0), Le(10)] = parameter(1.0, "by which a late measurement is late", "ms")

    @property
    def as_printed(self) -> bool:
        """Whether the drive has the parameters of the paper's table."""
        return (self.gain, self.lag) == (_GAIN, _LAG)

    @property
    def time(self) -> Array:
        """Times of the continuous responses [s], long enough for them to settle."""
        return np.arange(_POINTS, dtype=np.float64) * (max(50.0 / self.gain, 20.0 * self.lag) / _POINTS)


@dataclass(frozen=True)
class ServoRow:
    """Row of the table of paper 003.

    Attributes:
        half_period: half of the sampling period, T/2 [s].
        ratio: ratio ρ = Te/(T/2).
        continuous: measures of the desired function with jλ replaced by p; None if it is unstable.
        true: measures of the drive with the link of this function; None if it is unstable.
        printed: printed overshoot [%] and settling time [s]; None if not printed.
    """

    half_period: float
    ratio: float
    continuous: Measures | None
    true: Measures | None
    printed: tuple[float, float] | None


@dataclass(frozen=True)
class LinkRow:
    """Results of one link at one period.

    Attributes:
        design: design report, without simulation.
        step: step response of a drive without backlash; None if the loop is unstable.
        motor, load: step responses with backlash, with the position measured at the motor or the load.
        late: measures with a delayed measurement; None if the loop is unstable.
        late_known: like ``late``, with a link designed for the delay; None if there is no such link.
    """

    design: DesignReport
    step: StepResponse | None
    motor: StepResponse | None
    load: StepResponse | None
    late: Measures | None
    late_known: Measures | None

    @property
    def measures(self) -> Measures | None:
        """Overshoot and settling time of the step response without backlash."""
        return None if self.step is None else sampled_loop.measures(self.step.time, self.step.load)

    def to_json(self) -> dict[str, Any]:
        """Return the results of the link for JSON; with backlash, for measurement at the motor and at the load."""
        found = numbers(self.measures)
        return {
            "t": self.design.drive.period,
            "overshoot_pct": found[0],
            "settling_s": found[1],
            "overshoot_at_samples_pct": None
            if self.step is None
            else 100.0 * sampled_loop.measures(*self.step.at_samples).overshoot,
            "peak_command": None if self.step is None else float(np.abs(self.step.command).max()),
            "backlash_reversals": None if self.motor is None else self.motor.reversals,
            "backlash_offset": None if self.motor is None else self.motor.offset,
            "backlash_reversals_load": None if self.load is None else self.load.reversals,
            "backlash_offset_load": None if self.load is None else self.load.offset,
            "late_overshoot_pct": numbers(self.late)[0],
            "late_known_overshoot_pct": numbers(self.late_known)[0],
            "numerator": list(self.design.link.numerator),
            "denominator": list(self.design.link.denominator),
            "gain_margin_db": float(20.0 * np.log10(self.design.gain_margin)) if self.design.stable else None,
            "phase_margin_deg": float(np.degrees(self.design.phase_margin)) if self.design.stable else None,
            "largest_pole": float(np.abs(self.design.poles).max()),
        }


@dataclass(frozen=True)
class SampledServoNumbers:
    """Numerical results of the sampled-servo study.

    Attributes:
        parameters: parameters of the study.
        analog: time [s] and step response of the loop without sampling, shape (2, n).
        rows: rows of the table, by period and ratio.
        uncorrected: results of the drive without a link, one for each period.
        misread: like ``uncorrected``, with jλ replaced by p; None if unstable.
        links: results of the links ``paper`` and ``ripple_free``, one for each period.
        computed: series of eqs 5-7, each of shape (10,).
    """

    parameters: SampledServoParameters
    analog: Array
    rows: tuple[ServoRow, ...]
    uncorrected: tuple[LinkRow, ...]
    misread: tuple[Measures | None, ...]
    links: dict[str, tuple[LinkRow, ...]]
    computed: tuple[Array, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the table, the links and the series for JSON; None for unstable loops and missing printed values."""
        time, analog = self.analog
        found, crossing = sampled_loop.measures(time, analog), first_crossing(time, analog)
        return {
            "table": [
                {
                    "half_t": row.half_period,
                    "rho": row.ratio,
                    **dict(zip(("overshoot_pct", "settling_s"), numbers(row.continuous), strict=True)),
                    **dict(
                        zip(("printed_overshoot_pct", "printed_settling_s"), row.printed or (None, None), strict=True)
                    ),
                    **dict(zip(("sampled_overshoot_pct", "sampled_settling_s"), numbers(row.true), strict=True)),
                }
                for row in self.rows
            ],
            "links": {name: [row.to_json() for row in rows] for name, rows in self.links.items()},
            "series": {
                "printed": [list(terms) for terms in PRINTED_SERIES],
                "computed": [terms.tolist() for terms in self.computed],
                "stable": [stable(function) for function in DESIRED],
            },
            "uncorrected": [
                row.to_json() | dict(zip(("as_p_overshoot_pct", "as_p_settling_s"), numbers(as_p), strict=True))
                for row, as_p in zip(self.uncorrected, self.misread, strict=True)
            ],
            "analog": {
                "overshoot_pct": 100.0 * found.overshoot,
                "settling_s": found.settling,
                "first_crossing_over_t1": crossing / self.parameters.lag if np.isfinite(crossing) else None,
            },
        }

    def all_links(self) -> list[tuple[str, tuple[LinkRow, ...]]]:
        """Names and rows of all links, starting with the drive without a link."""
        return [("none", self.uncorrected), ("paper", self.links["paper"]), ("ripple-free", self.links["ripple_free"])]


def numbers(found: Measures | None) -> tuple[float | None, float | None]:
    """Return overshoot [%] and settling time [s] of a response; None for both if there is no response."""
    return (None, None) if found is None else (100.0 * found.overshoot, found.settling)


def stable(function: PseudoFrequency) -> bool:
    """Whether the closed loop of a desired function is stable."""
    return bool(np.abs(np.roots(function.closed()[1])).max() < 1.0)


def first_crossing(time: Array, response: Array) -> float:
    """Return the time when the response first reaches its final value [s]; NaN if it never does."""
    reached = np.flatnonzero(response >= 1.0)
    return float(time[reached[0]]) if reached.size else np.nan
