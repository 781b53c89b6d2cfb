# SPDX-License-Identifier: Apache-2.0
"""Cost of a tolerance on the drive parameters: one controller design for many drives of a batch.

The controllers keep the models and settings of the scenario. Natural frequency, damping and delay of every drive are
independent and normally distributed about the scenario's values, with the tolerance as standard deviation. A drive with
which learning would diverge is rejected, and its error counts as infinite. The study is a sweep; see docs/sweeps.md.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Gt, Le

from lathe_machine.stages.drive.drive import Drive
from lathe_papers import cells, marks, sweeps
from lathe_papers.judge import finite
from lathe_rc.arrays import Array
from lathe_rc.cell.parameters import parameter
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.study import Study, StudyParameters, Track, comparison, untracked

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.table import Table as RichTable


_DRAWN = ("natural_frequency", "damping", "delay")
_SHARES = (0.5, 0.95, 0.99)


class DriveToleranceParameters(StudyParameters):
    """Parameters of the drive-tolerance study: cell, tolerances, and number of drives for each tolerance."""

    scenario: Literal["piston", "two_channel"] = parameter("two_channel", "what is turned")
    tolerance: list[Annotated[float, Gt(0), Le(0.3)]] = parameter(
        [0.01, 0.02, 0.05, 0.1, 0.15], "standard deviations of natural frequency, damping and delay, in parts of them"
    )
    drives: Annotated[int, Ge(16), Le(2**16)] = parameter(512, "of each tolerance; a power of two is spread best")
    revolutions: Annotated[float, Ge(5), Le(1000)] = parameter(40.0, "of each run; the last counts", "rev")
    folder: str = parameter("", "keeps the rows, and goes on from them; empty: nothing is kept")


@dataclass(frozen=True)
class DriveToleranceResult:
    """Results of the drive-tolerance study: errors by tolerance.

    Attributes:
        parameters: parameters of the study.
        nominal: largest error of the last revolution with the drives of the scenario [µm].
        error: error of each drive in ascending order; infinite if learning would diverge, shape (tolerances, drives)
            [µm].
    """

    parameters: DriveToleranceParameters
    nominal: float
    error: Array

    def _at(self, share: float) -> Array:
        """Return the error that ``share`` of the drives do not exceed, for each tolerance [µm]."""
        place = int(np.ceil(share * self.error.shape[1])) - 1
        return np.asarray(self.error[:, place])

    def to_json(self) -> dict[str, Any]:
        """Return the results for JSON: 50, 95 and 99 % quantiles of the error; None if the quantile is infinite."""
        return {
            "tolerance": self.parameters.tolerance,
            "nominal_um": self.nominal,
            **{f"{100 * share:g}_percent_um": finite(self._at(share)) for share in _SHARES},
            "refused": np.isinf(self.error).sum(axis=1).tolist(),
        }

    def table(self) -> "RichTable":
        """Return a table of the 50, 95 and 99 % quantiles of the error, and the share of rejected drives."""
        columns = ("tolerance (1σ)", *(f"{100 * share:g} % below [µm]" for share in _SHARES), "refused [%]")
        at = [self._at(share) for share in _SHARES]
        rows = [("none", *(f"{self.nominal:.3g}" for _ in _SHARES), "0")]
        for place, tolerance in enumerate(self.parameters.tolerance):
            limits = [f"{errors[place]:.3g}" if np.isfinite(errors[place]) else "diverges" for errors in at]
            refused = 100.0 * np.isinf(self.error[place]).mean()
            rows.append((f"{100 * tolerance:g} %", *limits, f"{refused:.3g}"))
        title = f"{self.parameters.scenario}: largest error of the last revolution over {self.parameters.drives} drives"
        return comparison(title, columns, rows)

    def draw(self, figure: "Figure") -> None:
        """Draw the distribution of the error over the drives, and its 50, 95 and 99 % quantiles."""
        left, right = figure.subplots(1, 2)
        shares = 100.0 * np.arange(1, self.error.shape[1] + 1) / self.error.shape[1]
        for place, tolerance in enumerate(self.parameters.tolerance):
            errors = self.error[place][np.isfinite(self.error[place])]
            label = f"{100 * tolerance:g} %"
            left.semilogx(errors, shares[: errors.size], label=label, **marks.curve(place))
        left.axvline(self.nominal, color="#7f7f7f", ls=":", label="the scenario's own")
        left.set(xlabel="largest form error of the last revolution [µm]", ylabel="drives below [%]")
        left.legend(title="tolerance (1σ)", fontsize=8, title_fontsize=8)
        for place, share in enumerate(_SHARES):
            errors = self._at(share)
            shown = np.isfinite(errors)
            percent = 100.0 * np.array(self.parameters.tolerance)
            right.loglog(percent[shown], errors[shown], label=f"{100 * share:g} % of the drives", **marks.point(place))
        right.axhline(self.nominal, color="#7f7f7f", ls=":", label="the scenario's own")
        right.set(xlabel="tolerance of the drives (1σ) [%]", ylabel="form error that they stay below [µm]")
        right.legend(fontsize=8)
        right.set_xticks(100.0 * np.array(self.parameters.tolerance))
        for axis in (left.xaxis, right.xaxis, right.yaxis):
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter("")
        for axes in (left, right):
            axes.grid(visible=True, which="both", alpha=0.25)


def _drawn(scenario: Scenario) -> list[str]:
    """Return the names of the parameters that differ between drives."""
    drives = [name for name, stage in Cell(scenario.nodes).stages.items() if isinstance(stage, Drive)]
    return [
        f"{node}.{name}"
        for node in drives
        for name in _DRAWN
        if name in type(scenario.nodes[node]).rows() and scenario.value(f"{node}.{name}")
    ]


def run(parameters: DriveToleranceParameters, track: Track = untracked) -> DriveToleranceResult:
    """Run the sweep and collect the errors by tolerance."""
    from lathe_explore.sweep.space import Space

    base = cells.load(parameters.scenario, spindle_encoder={"revolutions": parameters.revolutions})
    spaces = [Space(given=[{"seed": base.shared.seed}])]
    for tolerance in parameters.tolerance:
        laws = dict.fromkeys(_drawn(base), f"normal:{100.0 * tolerance!r}%")
        spaces.append(Space(sampled=laws, sample=f"sobol:{parameters.drives}"))
    # One folder per tolerance, because nothing else distinguishes the rows of different tolerances.
    asked = [(f"tolerance-{number}", base, space) for number, space in enumerate(spaces)]
    own, *found = sweeps.table(asked, parameters.folder, ["tool.max_error"], track, models="nominal")
    errors = [
        sorted(np.inf if error is None else error * 1e6 for error in table["tool.max_error"].to_pylist())
        for table in found
    ]
    return DriveToleranceResult(parameters, own["tool.max_error"].to_pylist()[0] * 1e6, np.array(errors))


STUDY = Study(
    "drive-tolerance",
    "what a tolerance of drives costs a controller that knows the nominal one",
    DriveToleranceParameters,
    run,
    size=(11.0, 4.2),
)
