# SPDX-License-Identifier: Apache-2.0
"""Robustness of the laws against varying speed, force and drive parameters.

The cell of ``config/robust_cutting.yaml`` runs under each condition, with the nominal drive that the laws assume and
with drives that differ in natural frequency, damping, stiffness and delay: at all corners of the range, and inside.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Gt, Le
from rich.console import Group
from rich.table import Table as RichTable

from lathe_machine.stages.drive.drive import Drive
from lathe_machine.stages.learning.learner import Learner
from lathe_papers import cells, marks
from lathe_papers.judge import Judge, figure_of, finite, worst_of
from lathe_rc.analysis.tolerance import LAST
from lathe_rc.arrays import Array
from lathe_rc.cell.parameters import Values, parameter
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.study import Study, StudyParameters, Track, comparison, untracked

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SPREAD = 0.2  # relative spread of the drives
TOLD = (1038.0, 0.804, 0.36e-3)  # nominal natural frequency [rad/s], damping and delay [s], assumed by the laws
_MASS = 1.2  # [kg] moving mass of the nominal drive
_MODEL = ("model_natural_frequency", "model_damping", "model_delay")
_FREQUENCIES = np.geomspace(1.0, 3e4, 4000)  # [rad/s] frequency grid of the margin

# Overrides that switch off individual disturbances of spindle and cut; the scenario itself combines all of them.
_STEADY: Values = {"spindle_encoder.random_rms": 0.0}
_WHOLE: Values = {"loaded_drive.cut_gap_start": [], "loaded_drive.cut_gap_width": []}
_EVEN: Values = {
    "loaded_drive.cut_run_out_amplitude": [0.0],
    "loaded_drive.cut_hard_spot_factor": [1.0],
    "loaded_drive.cut_wear_per_second": 0.0,
}


def _swinging(frequency: float) -> Values:
    swing = {"deviation_amplitude": [0.1], "deviation_frequency": [frequency]}
    return {**_STEADY, **_WHOLE, **_EVEN, **{f"spindle_encoder.{name}": value for name, value in swing.items()}}


CONDITIONS: dict[str, Values] = {
    "nominal": {**_STEADY, **_WHOLE, **_EVEN},
    "speed 10.7": _swinging(10.7),
    "speed 106": _swinging(106.0),
    "speed 213": _swinging(213.0),
    "speed random": {**_WHOLE, **_EVEN},
    "one keyway": {
        **_STEADY, **_EVEN, "loaded_drive.cut_gap_start": [0.5], "loaded_drive.cut_gap_width": [0.35],
    },
    "three keyways": {**_STEADY, **_EVEN},
    "uneven, worn": {**_STEADY, **_WHOLE},
    "slowed by cut": {**_STEADY, **_EVEN},
    "all at once": {},
}  # fmt: skip
_SLOWED = "slowed by cut"  # three keyways, and a spindle slowed by the cut between them
_SPINDLE: cells.Values = {"stage": "loaded_spindle", "inertia": 0.03, "motor_inertia": 0.01, "torque_limit": 10.0}
_QUICK = ("nominal", "speed 213", "three keyways", "all at once")

_INVERSE: cells.Values = {
    "correction": "second_order_inverse_dynamic",
    "correction_model": "identified",
    "lead_law": "variable_second_order",
    "lead_time": TOLD[2],
    "q_time": 40e-6,
    "soft_start": 1.0,
    "acceleration_window": 64,
}
_ANY: cells.Values = {"allow_unstable": True, "stop_ratio": 0.0}  # divergence shows in the error
_LEARNING: cells.Values = {**_ANY, "stage": "learning_controller", "identify": False}
#: parameters of the node ``controller``, by law
LAWS: dict[str, cells.Values] = {
    "000": {**_LEARNING, "lead_time": 2e-3, "q_time": 130e-6},
    "001": {**_LEARNING, "lead_time": 1.425e-3, "q_time": 67e-6},
    "adapt.": {**_LEARNING, **_INVERSE, "identify": True},
    "comp.": {
        **_ANY, "stage": "compound_controller",
        # tuned for unknown drives, so the error feedback must contribute more
        "proportional": 1.9, "integral": 28.0, "derivative": 1.4e-4, "derivative_bandwidth": 19_000.0,
    },
    "told": {**_ANY, "stage": "compound_controller"},
    "AFC": {**_ANY, "stage": "resonant_controller"},
    "DOB": {**_ANY, "learning_gain": 0.0, "identify": False},
    "ours": _ANY,
}  # fmt: skip
_WORDS = {
    "000": "000: lead and Q of paper 000",
    "001": "001: lead and Q of paper 001",
    "adapt.": "adapt.: adaptive inverse",
    "comp.": "comp.: feed-forward and PID",
    "told": "told: comp. that knows each drive",
    "AFC": "AFC: resonators over the angle",
    "DOB": "DOB: disturbance observer only",
    "ours": "ours: disturbance_controller",
}  # in the figure
_KNOWS = "told"  # the law with the true parameters of each drive


class RobustParameters(StudyParameters):
    """Parameters of the robustness study: number of drives, duration, and tolerance."""

    plants: Annotated[int, Ge(1), Le(1000)] = parameter(
        32, "drives beside the one that is told: the 16 corners of ±20 %, and random ones within"
    )
    seeds: Annotated[int, Ge(1), Le(100)] = parameter(3, "of noise, encoder and random speed; the worst counts")
    revolutions: Annotated[int, Ge(15), Le(1000)] = parameter(40, "length of a run; the last 10 are judged", "rev")
    tolerance_um: Annotated[float, Gt(0), Le(1000)] = parameter(1.0, "form tolerance, either way", "µm")
    conditions: list[Literal[tuple(CONDITIONS)]] = parameter(list(CONDITIONS), "which of them")  # type: ignore[valid-type]
    quick: bool = parameter(
        default=False, doc=f"only {', '.join(_QUICK)}, only the first 5 drives, one seed, 30 revolutions"
    )


@dataclass(frozen=True)
class RobustResult:
    """Results of the robustness study: error of each law under each condition.

    Arrays have the shape (conditions, laws, drives), with the nominal drive first.

    Each value is the largest over the seeds.

    Attributes:
        conditions, laws: names of the conditions and laws.
        seeds: number of seeds.
        tolerance: tolerance of the form error [µm].
        largest, rms: form error of the last ten revolutions, outside gaps in the material [µm]; NaN for a stopped run.
        settled: revolution from which the error stays within the tolerance, counted from 1; inf if it never does.
        effort: RMS current of the drive [A].
        margin: margin of the loop, shape (laws, drives): 1 - sup|factor per revolution| for a learning law, minimum
            |1 + L| for a time-domain law.
        curves: largest error by revolution under the last condition, for the worst drive of each law [µm].
    """

    conditions: list[str]
    laws: list[str]
    seeds: int
    tolerance: float
    largest: Array
    rms: Array
    settled: Array
    effort: Array
    margin: Array
    curves: list[Array]

    def to_json(self) -> dict[str, Any]:
        """Return the results for JSON, by condition and law: nominal drive and worst drive; None for a stopped run."""
        found: dict[str, Any] = {"conditions": self.conditions, "laws": self.laws, "seeds": self.seeds}
        found["tolerance_um"] = self.tolerance
        for name, values in (
            ("largest_um", self.largest),
            ("rms_um", self.rms),
            ("revolutions", self.settled),
            ("effort_a", self.effort),
        ):
            found[name] = {"told": finite(values[..., 0]), "worst": finite(worst_of(values))}
        found["margin"] = {"told": finite(self.margin[:, 0]), "worst": finite(self.margin.min(axis=-1))}
        return found

    def table(self) -> Group:
        """Return one table per quantity."""
        tables: list[RichTable | str] = []
        worst = f"worst of {self.largest.shape[-1]} drives"
        seeds = f", worst of {self.seeds} seeds" if self.seeds > 1 else ""
        for title, values in (
            ("Largest form error of the last 10 revolutions [µm], told drive", self.largest[..., 0]),
            (f"Largest form error of the last 10 revolutions [µm], {worst}", worst_of(self.largest)),
            ("RMS form error [µm], told drive", self.rms[..., 0]),
            (f"RMS form error [µm], {worst}", worst_of(self.rms)),
            (f"Revolution from which within ±{self.tolerance:g} µm, {worst}; -: not at all", worst_of(self.settled)),
            (f"Effort: RMS current [A], {worst}", worst_of(self.effort)),
        ):
            rows = [(name, *map(figure_of, row)) for name, row in zip(self.conditions, values, strict=True)]
            tables += [comparison(title + seeds, ("condition", *self.laws), rows), ""]
        rows = [
            (name, *(f"{value:.2f}" for value in row))
            for name, row in (("told drive", self.margin[:, 0]), (worst, self.margin.min(axis=-1)))
        ]
        return Group(*tables, comparison("Margin of the loop, before anything is identified", ("", *self.laws), rows))

    def draw(self, figure: "Figure") -> None:
        """Draw the largest errors by condition, and by revolution under the last condition, for the worst drive."""
        dots, course = figure.subplots(1, 2, width_ratios=(3, 2))
        largest, width = worst_of(self.largest), 0.8 / len(self.laws)
        for k, law in enumerate(self.laws):
            places = np.arange(len(self.conditions)) + (k - (len(self.laws) - 1) / 2) * width
            dots.semilogy(places, largest[:, k], ls="", ms=5, **marks.point(k))
            course.semilogy(self.curves[k], lw=1.2, **marks.curve(k), label=_WORDS[law])
        dots.set(ylabel="largest form error [µm], worst drive", xlim=(-0.5, len(self.conditions) - 0.5))
        dots.set_xticks(range(len(self.conditions)), self.conditions, rotation=25, ha="right", fontsize=8)
        for k in range(1, len(self.conditions), 2):
            dots.axvspan(k - 0.5, k + 0.5, color="0.95", zorder=0)
        course.set(xlabel="revolution", ylabel="largest form error [µm]")
        course.set_title(f"{self.conditions[-1]}, worst drive of each law", fontsize=10)
        for axes in (dots, course):
            axes.axhline(self.tolerance, color="black", lw=0.8, ls="--", label=f"tolerance ±{self.tolerance:g} µm")
            axes.grid(visible=True, alpha=0.3)
        figure.legend(*course.get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)


def drives_near(count: int) -> list[tuple[float, float, float, float]]:
    """Return factors of natural frequency, damping, stiffness and delay for each drive, the nominal drive first."""
    ends = (1.0 - _SPREAD, 1.0 + _SPREAD)
    corners = [*product(ends, repeat=4)]
    # With few drives, opposite corners come first.
    corners = [corners[k] for k in (3, 12, 5, 10, 15, 0, 6, 9, 1, 2, 4, 7, 8, 11, 13, 14)]
    random = np.random.default_rng(0).uniform(*ends, size=(max(count - len(corners), 0), 4)).tolist()
    return [(1.0, 1.0, 1.0, 1.0), *[*corners, *map(tuple, random)][:count]]


def machine(frequency: float, damping: float, stiffness: float, delay: float) -> Values:
    """Return the drive parameters, given as factors of the nominal drive that the laws assume."""
    natural_frequency, own_damping, own_delay = TOLD
    return {
        "loaded_drive.coarse_natural_frequency": natural_frequency * frequency,
        "loaded_drive.coarse_damping": own_damping * damping,
        "loaded_drive.coarse_delay": own_delay * delay,
        # the force deflects the drive by its stiffness, which is the mass times the square of the natural frequency
        "loaded_drive.coarse_moving_mass": _MASS * stiffness / frequency**2,
    }


def model(frequency: float = 1.0, damping: float = 1.0, delay: float = 1.0) -> Values:
    """Return the law's model parameters: those of the nominal drive times these error factors."""
    factors = zip(_MODEL, TOLD, (frequency, damping, delay), strict=True)
    return {f"controller.{name}": value * factor for name, value, factor in factors}


def _cell(
    bases: Mapping[tuple[str, bool], Scenario],
    condition: str,
    law: str,
    drive: tuple[float, float, float, float],
    seed: int = 0,
) -> Scenario:
    frequency, damping, _, delay = drive
    told = model(frequency, damping, delay) if law == _KNOWS else model()
    return bases[law, condition == _SLOWED].varied({**CONDITIONS[condition], **machine(*drive), **told, "seed": seed})


def _margin(scenario: Scenario) -> float:
    """Return the margin of the law's loop, as in `RobustResult.margin`."""
    cell = Cell(scenario.nodes)
    law, drive = cell.stages["controller"], cell.stages["loaded_drive"]
    assert isinstance(law, Learner), "it commands the drive"
    assert isinstance(drive, Drive), "it is one"
    response, nominal = drive.responses()["coarse/command"], scenario.shared.nominal_speed
    margins = []
    for speed in (0.9 * nominal, nominal, 1.1 * nominal):
        if parts := law.characteristic(response, _FREQUENCIES, speed):
            own, fed = parts
            margins.append(float(np.abs(1.0 + fed / own).min()))
        elif (worst := law.worst(response, speed)) is not None:
            margins.append(1.0 - worst[0])
    return min(margins)


def run(parameters: RobustParameters, track: Track = untracked) -> RobustResult:
    """Run every law under every condition with every drive."""
    conditions, count, revolutions = parameters.conditions, parameters.plants, parameters.revolutions
    seeds = parameters.seeds
    if parameters.quick:
        conditions, count, revolutions = [name for name in conditions if name in _QUICK], min(count, 4), 30
        seeds = 1
    length = {"revolutions": float(revolutions)}
    bases = {
        (law, slowed): cells.load("robust_cutting", spindle_encoder={**length, **spindle}, controller=LAWS[law])
        for law in LAWS
        for slowed, spindle in ((False, {}), (True, _SPINDLE))
    }
    drives = drives_near(count)
    made = [_cell(bases, *names) for names in product(conditions, LAWS, drives, range(seeds))]
    shape = len(conditions), len(LAWS), len(drives), seeds
    largest, rms, settled, effort = np.full((4, *shape), np.nan)
    curves = np.full((*shape, revolutions), np.nan)
    for place, judged in zip(np.ndindex(shape), cells.kept(made, Judge, track), strict=True):
        if judged is None:
            continue
        found = judged.largest[:revolutions]
        curves[place][: found.size] = found
        largest[place], rms[place] = found[-LAST:].max(), judged.rms
        settled[place], effort[place] = judged.settled(parameters.tolerance_um), judged.effort
    margin = np.array([[_margin(_cell(bases, conditions[0], law, drive)) for drive in drives] for law in LAWS])
    last = np.where(np.isnan(largest[-1]), np.inf, largest[-1]).reshape(len(LAWS), -1)
    return RobustResult(
        conditions=conditions,
        laws=list(LAWS),
        seeds=seeds,
        tolerance=parameters.tolerance_um,
        largest=worst_of(largest),
        rms=worst_of(rms),
        settled=worst_of(settled),
        effort=worst_of(effort),
        margin=margin,
        curves=[curves[-1, k].reshape(-1, revolutions)[worst] for k, worst in enumerate(last.argmax(axis=-1))],
    )


STUDY = Study(
    "robust",
    "which laws hold when speed, force and drive vary",
    RobustParameters,
    run,
    size=(15.0, 4.6),
)
