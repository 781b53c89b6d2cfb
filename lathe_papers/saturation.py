# SPDX-License-Identifier: Apache-2.0
"""Periodic control of a drive with input saturation (paper 002, Figs 2-4), and conditions of its long-term stability.

The study covers the example of the paper, its hyperstability conditions, and runs that show the purpose of the memory
filter, of anti-windup and of the choice of gains.
"""

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Gt, Le
from rich.console import Group
from rich.table import Table

from lathe_machine.control.periodic import PRESETS, PeriodicGains
from lathe_papers.formulas import hyperstability
from lathe_papers.formulas.hyperstability import BOX, NAMES, NOMINAL, Learning, Positivity
from lathe_papers.formulas.periodic_example import (
    Case,
    ExampleOutcome,
    ideal_input,
    limited_ideal_error,
    simulate,
    times,
)
from lathe_rc.arrays import Array
from lathe_rc.cell.parameters import parameter
from lathe_rc.study import Study, StudyParameters, Track, comparison, untracked

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_SHORT = 0.8  # input limit as a fraction of the input that the nominal drive requires
_COARSE = 1e-4  # quantisation step in the table
_REFERENCE_PERIODS = 400  # periods of the run with the filter
_LEVELS = (0.0, 0.5, 1.0)  # levels of y_F in the figure
_FREQUENCIES = np.geomspace(0.5, 50.0, 400)  # frequencies in the figure [rad/s]
_COLOURS = ("#1f6f8b", "#c0392b", "#e08e0b", "#7b5ea7")


class SaturationParameters(StudyParameters):
    """Parameters of the saturation study: law and duration of the run."""

    periods: Annotated[int, Ge(1), Le(10_000)] = parameter(8, "periods of 25 s to run")
    s0: Annotated[float, Gt(0), Le(1000)] = parameter(2.0, "limit S0 of the drive's input")
    memory_filter_s: Annotated[float, Ge(0), Le(2)] = parameter(0.1, "σ of the memory's Gaussian; 0: none", "s")
    antiwindup: bool = parameter(default=True, doc="false: the paper's switch alone")
    quantisation: Annotated[float, Ge(0), Le(0.1)] = parameter(0.0, "step of measurement and command; 0: none")
    corners: bool = parameter(default=False, doc="run all 32 corners of the box of drives, too")
    preset: Literal["published", "quantised"] = parameter("published", "gains of the law")
    step_ms: Annotated[float, Ge(0.2), Le(10)] = parameter(5.0, "sampling step; 25 s must be a multiple", "ms")

    @property
    def step(self) -> float:
        """Sampling step [s]."""
        return self.step_ms * 1e-3

    @property
    def gains(self) -> PeriodicGains:
        """Gains of the selected preset."""
        return PRESETS[self.preset]


@dataclass(frozen=True)
class Check:
    """Comparison of a number from spec/feed-and-force.md with its computed value."""

    name: str
    expected: str
    computed: float


@dataclass(frozen=True)
class Conditions:
    """Conditions of hyperstability over the box of drives.

    Attributes:
        neglected: eq. 14 with T* = 0, as assumed by the paper.
        whole: eq. 14 with T*.
        learning: learning behaviour of the memory.
        needed: largest |u°| of the nominal drive and of the worst corner.
    """

    neglected: Positivity
    whole: Positivity
    learning: Learning
    needed: tuple[float, float]


@dataclass(frozen=True)
class SaturationResult:
    """Results of the saturation study: runs and conditions.

    Attributes:
        parameters: parameters of the study.
        outcome: run of the nominal drive.
        without_filter: run with the published law, 200 periods.
        with_filter: run with published gains, filter and anti-windup, 400 periods.
        corners: runs of the corners of the box, one for each row of `hyperstability.corners`; empty unless requested.
        checks: comparisons with the numbers of the specification.
        conditions: conditions of hyperstability.
    """

    parameters: SaturationParameters
    outcome: ExampleOutcome
    without_filter: ExampleOutcome
    with_filter: ExampleOutcome
    corners: list[ExampleOutcome]
    checks: list[Check]
    conditions: Conditions

    def to_json(self) -> dict[str, Any]:
        """Return the run, corners, conditions, checks and curves of the first periods for JSON."""
        controller, conditions = self.outcome.controller, self.conditions
        return {
            **_errors(self.outcome),
            "corners": [
                {**dict(zip(NAMES, map(float, drive), strict=True)), **_errors(outcome)}
                for drive, outcome in zip(hyperstability.corners(), self.corners, strict=False)
            ],
            "saturated_samples": controller.saturated,
            "integrator": controller.integrator,
            "eq_15": {
                "integral": self.outcome.period_integral.tolist(),
                "bound": controller.popov_bound,
                "holds": controller.popov_holds,
            },
            "eq_14": {
                name: {
                    "least_gain": found.least_gain,
                    "drive": dict(zip(NAMES, map(float, found.drive), strict=True)),
                    "frequency_rad_s": _finite(found.frequency),
                    "hurwitz_gain": _finite(found.hurwitz_gain),
                    "possible": found.possible,
                }
                for name, found in (("lag_neglected", conditions.neglected), ("with_lag", conditions.whole))
            },
            "learning": {
                "grows_from_rad_s": [_finite(value) for value in conditions.learning.grows_from],
                "largest_factor": conditions.learning.largest,
                "drive": dict(zip(NAMES, map(float, conditions.learning.drive), strict=True)),
                "level": conditions.learning.level,
                "frequency_rad_s": conditions.learning.frequency,
            },
            "required_u": dict(zip(("nominal", "worst_corner"), conditions.needed, strict=True)),
            "checks": [asdict(check) for check in self.checks],
            "curves": dict(
                zip(("time_s", "reference", "output", "command", "disturbance"), self.outcome.curves.tolist(),
                    strict=True)
            ),
        }  # fmt: skip

    def table(self) -> Group:
        """Return tables of errors by period, conditions, and comparisons with the specification."""
        return Group(self._periods(), "", self._conditions(), "", self._checks())

    def _periods(self) -> Table:
        errors = self.outcome.period_max_error
        shown = sorted({n for n in (1, 2, 4, 8, 20, 40, 100, 200, 400) if n < errors.size} | {errors.size})
        given = self.parameters
        words = [
            f"{given.preset} gains",
            f"S0 = {given.s0:g}",
            f"σ = {given.memory_filter_s:g} s",
            "anti-windup" if given.antiwindup else "paper's switch",
        ]
        if given.quantisation:
            words.append(f"steps of {given.quantisation:g}")
        columns = [("nominal", [self.outcome])]
        if self.corners:
            columns.append(("worst of 32 corners", self.corners))
        rows = [
            (f"period {n}", *(f"{max(run.period_max_error[n - 1] for run in runs):.3g}" for _, runs in columns))
            for n in shown
        ]
        for name, value in (
            ("largest |u|", lambda run: run.controller.largest_demand),
            ("largest |memory|", lambda run: run.controller.largest_memory),
            ("samples limited", lambda run: run.controller.saturated),
            ("eq. 15: integral/bound, below 1", lambda run: run.controller.popov_integral / run.controller.popov_bound),
        ):
            rows.append((name, *(f"{max(map(value, runs)):.4g}" for _, runs in columns)))
        return comparison("Largest |r − y| by period", (", ".join(words), *(name for name, _ in columns)), rows)

    def _conditions(self) -> Table:
        neglected, whole, learning = self.conditions.neglected, self.conditions.whole, self.conditions.learning
        gains = self.parameters.gains
        rows = [
            ("eq. 14, T* neglected: χ* from", f"{neglected.least_gain:.4g}", _where(neglected)),
            (f"eq. 14, T* = {gains.lag:g} s: χ* from", f"{whole.least_gain:.4g}", _where(whole)),
            ("  but A* Hurwitz up to", f"{whole.hurwitz_gain:.4g}", "possible" if whole.possible else "no χ* meets it"),
            (
                "memory grows, σ = 0, from",
                f"{learning.grows_from[0]:.2g} to {learning.grows_from[1]:.2g}", "rad/s, by corner and y_F",
            ),
            (
                f"factor a period, σ = {self.parameters.memory_filter_s:g} s", f"{learning.largest:.4f}",
                f"at y_F = {learning.level:.1f}, {learning.frequency:.3g} rad/s",
            ),
        ]  # fmt: skip
        return comparison(
            f"Conditions over the box, {self.parameters.preset} gains",
            ("", "value", "at; corner as K a1 a2 a3 a4"),
            rows,
        )

    def _checks(self) -> Table:
        return comparison(
            "Numbers of the specification: nominal drive, published gains",
            ("error: largest |r − y| of a period", "expected", "computed"),
            [(check.name, check.expected, f"{check.computed:.3g}") for check in self.checks],
        )

    def draw(self, figure: "Figure") -> None:
        """Draw Figs 2, 3 and 4 of the paper, error and eq. 15 by period, and the learning factor of the memory."""
        (motion, error, inputs), (errors, integral, factor) = figure.subplots(2, 3)
        time, wanted, output, command, load = self.outcome.curves
        motion.plot(time, output, color=_COLOURS[0], label="y")
        motion.plot(time, wanted, "k--", lw=1.0, label="r")
        motion.set_title("Fig. 2: motion", fontsize=10)
        error.plot(time, wanted - output, color=_COLOURS[1], label="r − y")
        error.set_title("Fig. 3: error", fontsize=10)
        inputs.plot(time, command, color=_COLOURS[0], label="S(u)")
        inputs.plot(time, load, color=_COLOURS[2], label="f")
        inputs.set_title("Fig. 4: command and disturbance", fontsize=10)
        for axes in (motion, error, inputs):
            axes.set(xlabel="time [s]", xlim=(0.0, time[-1]))
        self._draw_periods(errors, integral)
        self._draw_learning(factor)
        for axes in (motion, error, inputs, errors, integral, factor):
            axes.grid(visible=True, alpha=0.3)
            axes.legend(fontsize=8, ncols=2 if axes is factor else 1)

    def _draw_periods(self, errors: "Axes", integral: "Axes") -> None:
        for number, corner in enumerate(self.corners):
            label = None if number else "as set, corners"
            errors.loglog(_counted(corner), corner.period_max_error, color="0.75", lw=0.6, label=label)
        runs = (
            ("as published", self.without_filter, {"color": _COLOURS[1]}),
            ("with filter and anti-windup", self.with_filter, {"color": _COLOURS[0]}),
            ("as set", self.outcome, {"color": "k", "marker": ".", "ls": ":", "ms": 4.0, "lw": 0.8}),
        )
        for label, outcome, style in runs:
            errors.loglog(_counted(outcome), outcome.period_max_error, label=label, **style)
            integral.loglog(_counted(outcome), -outcome.period_integral, label=label, **style)
        errors.set(xlabel="period")
        errors.set_title("largest |r − y| of each period", fontsize=10)
        integral.axhline(-self.with_filter.controller.popov_bound, color="k", lw=0.8)
        integral.set(xlabel="period", ylabel="−η [s]")
        integral.set_title("integral of eq. 15 (line: bound, published gains)", fontsize=10)

    def _draw_learning(self, axes: "Axes") -> None:
        given = self.parameters
        for sigma, style in {0.0: "--", given.memory_filter_s: "-"}.items():
            for level, colour in zip(_LEVELS, _COLOURS, strict=False):
                values = hyperstability.learning_factor(NOMINAL[None], given.gains, level, sigma, _FREQUENCIES)[0]
                axes.semilogx(_FREQUENCIES, values, style, color=colour, label=f"y_F = {level:g}, σ = {sigma:g} s")
        axes.axhline(1.0, color="k", lw=0.8)
        axes.set(xlabel="ω [rad/s]", ylim=(0.0, 2.0))
        axes.set_title("factor of the memory in a period, nominal drive", fontsize=10)


def _errors(outcome: ExampleOutcome) -> dict[str, Any]:
    controller = outcome.controller
    return {
        "period_max_error": outcome.period_max_error.tolist(),
        "u_max": controller.largest_demand,
        "memory_max": controller.largest_memory,
    }


def _counted(outcome: ExampleOutcome) -> Array:
    return np.arange(1.0, outcome.period_max_error.size + 1.0)


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _where(found: Positivity) -> str:
    frequency = "ω → ∞" if np.isinf(found.frequency) else f"{found.frequency:.3g} rad/s"
    ends = ("−" if value == low else "+" for value, low in zip(found.drive, BOX[:, 0], strict=True))
    return f"{frequency}, corner {''.join(ends)}"


def _checks(
    step: float, needed: tuple[float, float], without_filter: ExampleOutcome, with_filter: ExampleOutcome
) -> list[Check]:
    """Compute the comparisons with the numbers of the specification."""

    def at(outcome: ExampleOutcome, period: int) -> float:
        return float(outcome.period_max_error[period - 1])

    def short(*, anti_windup: bool) -> ExampleOutcome:
        return simulate(Case(periods=40, step=step, s0=_SHORT * needed[0], anti_windup=anti_windup), NOMINAL)

    def quantised(preset: str) -> float:
        case = Case(periods=100, step=step, quantisation=_COARSE, gains=PRESETS[preset])
        return float(simulate(case, NOMINAL).period_max_error[50:].max())

    switch = short(anti_windup=False)  # the error alternates between periods, so its mean is compared
    return [
        Check("needed |u|, nominal drive", "0.891", needed[0]),
        Check("needed |u|, worst corner", "1.10", needed[1]),
        *(
            Check(f"error in period {period}", expected, at(with_filter, period))
            for period, expected in ((1, "0.105"), (2, "5.4e-3"), (4, "2.2e-3"), (8, "1.2e-3"))
        ),
        Check("  from 100 to 400", "below 1e-4", float(with_filter.period_max_error[99:].max())),
        *(
            Check(f"as published, in period {period}", expected, at(without_filter, period))
            for period, expected in ((20, "5e-4"), (40, "0.011"), (200, "0.45"))
        ),
        Check(
            "S0 = 0.8 of the need: limited ideal input", "0.140", limited_ideal_error(NOMINAL, _SHORT * needed[0], step)
        ),
        Check("  anti-windup, period 40", "0.140", at(short(anti_windup=True), 40)),
        Check("  published switch, mean of 31 to 40", "0.31", float(switch.period_max_error[30:].mean())),
        Check("  published switch, largest |memory|", "153", switch.controller.largest_memory),
        Check(f"steps of {_COARSE:g}, from 51 to 100", "0.11-0.13", quantised("published")),
        Check("  with 'quantised' gains", "survives", quantised("quantised")),
    ]


def _conditions(gains: PeriodicGains, memory_filter: float, step: float) -> Conditions:
    box = hyperstability.corners()
    needed = np.abs(ideal_input(np.vstack((NOMINAL, box)), times(step))).max(axis=1)
    return Conditions(
        hyperstability.positivity(box, gains.lead, 0.0),
        hyperstability.positivity(box, gains.lead, gains.lag),
        hyperstability.learning(box, gains, memory_filter),
        (float(needed[0]), float(needed[1:].max())),
    )


def run(parameters: SaturationParameters, track: Track = untracked) -> SaturationResult:
    """Run the example and evaluate the conditions of hyperstability.

    Raises:
        InputError: the period is not a whole number of steps.
    """
    step = parameters.step
    case = Case(
        periods=parameters.periods,
        step=step,
        s0=parameters.s0,
        memory_filter=parameters.memory_filter_s,
        anti_windup=parameters.antiwindup,
        quantisation=parameters.quantisation,
        gains=parameters.gains,
    )
    drives = [NOMINAL, *(hyperstability.corners() if parameters.corners else ())]
    outcome, *corners = [simulate(case, drive) for drive in track(drives)]
    conditions = _conditions(case.gains, case.memory_filter, step)
    without_filter = simulate(Case(periods=200, step=step, memory_filter=0.0, anti_windup=False), NOMINAL)
    with_filter = simulate(Case(periods=_REFERENCE_PERIODS, step=step), NOMINAL)
    checks = _checks(step, conditions.needed, without_filter, with_filter)
    return SaturationResult(parameters, outcome, without_filter, with_filter, corners, checks, conditions)


STUDY = Study(
    "saturation",
    "periodic control of a drive whose input saturates: hyperstability, filter, anti-windup (002, Figs 2-4)",
    SaturationParameters,
    run,
    size=(14.0, 7.2),
)
