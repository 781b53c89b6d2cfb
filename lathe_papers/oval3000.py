# SPDX-License-Identifier: Apache-2.0
"""Benchmark oval3000: laws on one fixed problem, with drives that are drawn at random; others can enter theirs.

The cell of ``config/oval3000.yaml`` turns an oval form of 0.84 mm peak to valley at 3000 rpm, that of
``config/oval3000_hard.yaml`` the same with a drive that drifts, a spindle that errs, and tolerances by zone. Each law
is given the nominal drive without its resonances, and runs with drives that differ from it. Their first set is drawn by
a published seed, so that results can be compared, the second one by a seed that is drawn at the time, so that no law
can be tuned to it. Each drive has a noise and a random speed of its own; all laws get the same ones.
"""

import secrets
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np
from annotated_types import Ge, Gt, Le
from rich.console import Group
from rich.table import Table as RichTable

from lathe_machine.stages.drive.drive import Drive
from lathe_machine.stages.learning.learner import CheckedLoop, LawParameters, Learner
from lathe_papers import cells, marks, robust
from lathe_papers.judge import Judge, Judged, figure_of, finite, worst_of
from lathe_rc.analysis.tolerance import LAST
from lathe_rc.arrays import Array
from lathe_rc.cell import ros_yaml
from lathe_rc.cell.parameters import SharedParameters, Value, Values, parameter
from lathe_rc.cell.scenario import TABLES, Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError
from lathe_rc.extensions import in_words
from lathe_rc.study import Study, StudyParameters, Track, comparison, untracked

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PUBLISHED = 3000  #: seed of the first set of drives
_LARGEST = 2**31  # fresh seeds are below
_LOOP, _MODE, _LOSS = 0.2, 0.1, 0.5  # relative spreads of the drives, see `Oval3000Parameters.drives`
_DRIVE = "loaded_drive.coarse_"
_NODE = "controller"
_DELAY = 16  # [sample] of the position that the laws see


class Condition(NamedTuple):
    """Condition of the benchmark.

    Attributes:
        values: parameters of the cell.
        scenario: its scenario.
        remap: topic names that law and tool replace.
    """

    values: Values
    scenario: str = "oval3000"
    remap: tuple[str, ...] = ()


CONDITIONS: dict[str, Condition] = {
    "counts 100000": Condition({"spindle_encoder.counts_per_revolution": 100_000}),
    "counts 4096": Condition({"spindle_encoder.counts_per_revolution": 4096}),
    "4096, edge times": Condition({"spindle_encoder.counts_per_revolution": 4096, "spindle_encoder.edge_clock": 1e-6}),
    "hard": Condition({}, "oval3000_hard"),
    "hard with gauge": Condition({}, "oval3000_hard", ("coarse/state:=gauge/state",)),
}
_ANY: Values = {"allow_unstable": True, "stop_ratio": 0.0}  # divergence shows in the error
_FLAT: Values = {"q_filter": "fir", "q_ripple": 1e-3}
#: parameters of the node ``controller``, by law; figures/oval3000_settings.py has the grids they are from
LAWS: dict[str, cells.Values] = {
    "000": robust.LAWS["000"],
    "001": robust.LAWS["001"],
    "lead": {
        **_ANY, "stage": "learning_controller", "identify": False,
        **_FLAT, "q_pass": 2000.0, "q_stop": 5000.0, "lead_time": 1.7e-3, "learning_gain": 0.5,
    },
    "adapt.": {
        **robust.LAWS["adapt."], **_FLAT, "q_pass": 2000.0, "q_stop": 5000.0, "lead_time": 0.3e-3,
        "learning_gain": 0.03,
    },
    "comp.": {
        **_ANY, "stage": "compound_controller",
        "proportional": 1.0, "integral": 10.0, "derivative": 0.0, "derivative_bandwidth": 1600.0,
    },
    "AFC": {**_ANY, "stage": "resonant_controller", "highest_order": 12, "rate": 12.0},
    "ADRC": {**_ANY, "stage": "adrc", "observer_bandwidth": 2000.0, "control_bandwidth": 1750.0},
    "norm.": {
        **_ANY, "stage": "norm_optimal_controller", "command_acceleration": 1000.0,
        "highest_order": 8, "change_weight": 1.0,
    },
    "ours": {
        **_ANY, "stage": "disturbance_controller", "identification_bandwidth": 3000.0,
        "learned_waves": 7.5, "learning_bandwidth": 8000.0, "observer_bandwidth": 0.0,
        "inverse": "fourth_order", "model_denominator": [], "model_numerator": [], "expected_deviation": 0.015,
    },
}  # fmt: skip


class Oval3000Parameters(StudyParameters):
    """Parameters of the benchmark: drives, length, and a law that is entered."""

    drives: Annotated[int, Ge(2), Le(10_000)] = parameter(
        64,
        f"in each set; natural frequency, damping, delay and stiffness within ±{100 * _LOOP:.0f} % of the scenario's, "
        f"mode frequencies ±{100 * _MODE:.0f} %, mode dampings and participations ±{100 * _LOSS:.0f} %, independent "
        "and uniform",
    )
    fresh_seed: Annotated[int, Ge(0), Le(_LARGEST)] = parameter(
        0, "draws the second set, and is printed; 0: drawn at the time"
    )
    seeds: Annotated[int, Ge(1), Le(100)] = parameter(
        5, "of noise and speed, the drive's own and 1, 2, ..., for the worst and the median drive of a law"
    )
    revolutions: Annotated[int, Ge(15), Le(1000)] = parameter(40, "length of a run; the last 10 are judged", "rev")
    tolerance_um: Annotated[float, Gt(0), Le(1000)] = parameter(2.0, "form tolerance, either way", "µm")
    conditions: list[Literal[tuple(CONDITIONS)]] = parameter(list(CONDITIONS)[:3], "which encoders and cells")  # type: ignore[valid-type]
    laws: list[Literal[tuple(LAWS)]] = parameter(list(LAWS), "which laws of the benchmark")  # type: ignore[valid-type]
    law: str = parameter("", "a law that enters, PACKAGE.MODULE:CLASS or a name that a package offers; empty: none")
    law_set: str = parameter("", "its parameters, PARAM=VALUE PARAM=VALUE ...")
    quick: bool = parameter(
        default=False, doc="only the first encoder, two drives in each set, 15 revolutions, two seeds"
    )

    def model_post_init(self, context: Any, /) -> None:
        """Reject parameters of a law that does not enter."""
        super().model_post_init(context)
        if self.law_set and not self.law:
            raise InputError(f"law_set = {self.law_set!r} without a law; allowed: law = PACKAGE.MODULE:CLASS")


@dataclass(frozen=True)
class Oval3000Result:
    """Scores of each law in each condition and set of drives.

    Arrays have the shape (sets, conditions, laws, drives); the first set is that of the published seed.

    Attributes:
        seeds: seed of each set.
        conditions, laws: names of the conditions and laws.
        tolerance: tolerance of the form error [µm].
        largest: form error of the last ten revolutions outside the keyways [µm]; NaN for a stopped run.
        excess: the same over the tolerance, or over that of its zone.
        seeded: the same of the worst and the median drive, by seed of noise and speed, the drive's own seed first,
            shape (2, sets, conditions, laws, seeds).
        settled: revolution, counted from 1, from which the error stays within the tolerance; inf if it never does.
        effort: RMS current of the drive [A].
        margin: smallest relative error of the drive's response with which learning diverges; NaN for a law without
            factors of a cycle.
    """

    seeds: list[int]
    conditions: list[str]
    laws: list[str]
    tolerance: float
    largest: Array
    excess: Array
    seeded: Array
    settled: Array
    effort: Array
    margin: Array

    @property
    def share(self) -> Array:
        """Share of the drives in tolerance [1], shape (sets, conditions, laws)."""
        return np.asarray((self.excess <= 1.0).mean(axis=-1))

    def to_json(self) -> dict[str, Any]:
        """Return the scores for JSON, by set, condition and law, errors by seed; None for a stopped run or no value."""
        worst, median = self.seeded
        scores = {
            "worst_um": worst,
            "median_um": median,
            "in_tolerance": self.share,
            "revolutions": worst_of(self.settled),
            "effort_a": worst_of(self.effort),
            "drive_margin": self.margin.min(axis=-1),
        }
        named = {"seeds": self.seeds, "conditions": self.conditions, "laws": self.laws, "tolerance_um": self.tolerance}
        return {**named, "drives": self.largest.shape[-1], **{name: finite(each) for name, each in scores.items()}}

    def table(self) -> Group:
        """Return one table of scores for each condition and set of drives."""
        settled, effort = map(worst_of, (self.settled, self.effort))
        margin, tables = self.margin.min(axis=-1), list[RichTable | str]()
        for (k, condition), (s, seed) in product(enumerate(self.conditions), enumerate(self.seeds)):
            rows = [
                (
                    law,
                    *map(_range_of, self.seeded[:, s, k, n]),
                    f"{100.0 * self.share[s, k, n]:.0f} %",
                    figure_of(settled[s, k, n]),
                    figure_of(margin[s, k, n]),
                    f"{effort[s, k, n]:.1f}",
                )
                for n, law in enumerate(self.laws)
            ]
            drawn = "published seed" if s == 0 else "fresh seed"
            title = f"{condition}, {self.largest.shape[-1]} drives of the {drawn} {seed}"
            allowed = f"in ±{self.tolerance:g} µm" if CONDITIONS[condition].scenario == "oval3000" else "in zones"
            columns = ("law", "worst [µm]", "median [µm]", allowed, "settled", "margin", "effort [A]")
            tables += [comparison(title, columns, rows), ""]
        return Group(*tables[:-1])

    def draw(self, figure: "Figure") -> None:
        """Draw the share of drives below an error, by law: the published set as a line, the fresh one dashed."""
        panels = figure.subplots(1, len(self.conditions), sharey=True, squeeze=False)[0]
        shares = 100.0 * np.arange(1, self.largest.shape[-1] + 1) / self.largest.shape[-1]
        for k, (axes, condition) in enumerate(zip(panels, self.conditions, strict=True)):
            for n, law in enumerate(self.laws):
                for s, style in enumerate(("-", "--")):
                    mark = {**marks.point(n), "ms": 4, "markevery": (n, 12), "color": f"C{n}"}
                    label = law if s == 0 else None
                    axes.semilogx(np.sort(self.largest[s, k, n]), shares, style, lw=1.2, label=label, **mark)
            if CONDITIONS[condition].scenario == "oval3000":
                axes.axvline(self.tolerance, color="black", lw=0.8, ls=":")
            axes.set(xlabel="largest form error [µm]", title=condition)
            axes.grid(visible=True, alpha=0.3)
        panels[0].set_ylabel("drives below [%]")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center", fontsize=7)


def _range_of(values: Array) -> str:
    """Return the smallest and the largest value; - if a run was stopped."""
    low, high = figure_of(values.min()), figure_of(values.max())
    return low if low == high else f"{low}–{high}"


def drives_of(base: Scenario, seed: int, count: int) -> list[Values]:
    """Draw the parameters of ``count`` drives around that of the scenario, and of the noise and speed of each."""
    random = np.random.default_rng(seed)
    around: dict[str, Any] = {
        name: base.value(f"{_DRIVE}{name}")
        for name in ("natural_frequency", "damping", "delay", "mode_frequency", "mode_damping", "mode_participation")
    }
    mass, modes = base.value(f"{_DRIVE}moving_mass"), len(around["mode_frequency"])
    assert isinstance(mass, float), "it is one parameter"
    drawn: list[Values] = []
    for _ in range(count):
        frequency, damping, delay, stiffness = (1.0 + _LOOP * random.uniform(-1.0, 1.0, 4)).tolist()
        spreads = {"mode_frequency": _MODE, "mode_damping": _LOSS, "mode_participation": _LOSS}
        factors = {name: 1.0 + spread * random.uniform(-1.0, 1.0, modes) for name, spread in spreads.items()}
        values: dict[str, Value] = {
            "natural_frequency": around["natural_frequency"] * frequency,
            "damping": around["damping"] * damping,
            "delay": around["delay"] * delay,
            # the force deflects the drive by its stiffness, which is the mass times the square of the natural frequency
            "moving_mass": mass * stiffness / frequency**2,
            **{name: (np.array(around[name]) * factor).tolist() for name, factor in factors.items()},
        }
        drawn.append({**{_DRIVE + name: value for name, value in values.items()}, "seed": int(random.integers(2**31))})
    return drawn


def entered(base: Scenario, values: cells.Values) -> Scenario:
    """Return the cell with a law in place of its controller, which is given the scenario's drive.

    Args:
        base: cell of the benchmark.
        values: parameters of the law, with its ``stage``.

    Raises:
        InputError: there is no such law, or a parameter is not allowed.
    """
    before, kind = base.nodes[_NODE], str(values["stage"])
    if kind not in TABLES or not issubclass(table := TABLES[kind], LawParameters):
        known = [name for name in TABLES if issubclass(TABLES[name], LawParameters)]
        raise InputError(f"no law {kind!r}; allowed: {in_words(known)}")
    shared = {name: getattr(before, name) for name in SharedParameters.model_fields.keys() & before.model_fields_set}
    made = table.read(_NODE, {**shared, "feedback_delay": _DELAY, **values})
    return base.with_node(_NODE, made).with_models_given().named()


def margins(law: Scenario, drives: list[Values]) -> Array:
    """Return the drive margin of a law with each drive, at 0.9, 1 and 1.1 times the nominal speed; NaN if unknown.

    It is the least of all states of a drive that drifts.
    """
    stage, nominal = Cell(law.nodes).stages[_NODE], law.shared.nominal_speed
    assert isinstance(stage, Learner), "it commands the drive"
    found = []
    for values in drives:
        drive = Cell(law.varied(values).nodes).stages["loaded_drive"]
        assert isinstance(drive, Drive), "it is one"
        responses = [drive.responses()["coarse/command"], *drive.states().get("coarse/command", ())]
        loop = CheckedLoop(stage, responses, (0.9 * nominal, nominal, 1.1 * nominal))
        margin = loop.drive_margin()
        found.append(np.nan if margin is None else margin.error)
    return np.array(found)


def _own(parameters: Oval3000Parameters) -> dict[str, cells.Values]:
    """Return the law that enters, by its name in the tables; empty if there is none."""
    if not parameters.law:
        return {}
    values: dict[str, object] = {**_ANY, "stage": parameters.law}
    for text in parameters.law_set.split():
        name, equals, value = text.partition("=")
        if not equals:
            raise InputError(f"law_set: {text!r}; allowed: PARAM=VALUE PARAM=VALUE ...")
        values[name] = ros_yaml.parse_value(value, f"law_set {name}")
    name = parameters.law.rpartition(":")[2]
    return {f"{name} (entered)" if name in LAWS else name: values}


def _in_condition(base: Scenario, condition: Condition, law: cells.Values, tolerance: float) -> Scenario:
    """Return the cell of a condition with a law and a tolerance [µm]."""
    remap = list(condition.remap)
    changed = {**condition.values, "tool.remap": remap, "tool.tolerance": 1e-6 * tolerance}
    return entered(base, {**law, "remap": remap}).varied(changed)


def _scores(judged: Judged | None, revolutions: int, tolerance: float) -> tuple[float, ...]:
    """Return error, error over tolerance, settling and effort of a run; NaN for a stopped one."""
    if judged is None:
        return (np.nan,) * 4
    over = (values[:revolutions][-LAST:].max() for values in (judged.largest, judged.excess(tolerance)))
    return (*over, judged.settled(tolerance), judged.effort)


def run(parameters: Oval3000Parameters, track: Track = untracked) -> Oval3000Result:
    """Run every law in every condition with every drive of both sets; a missing fresh seed is drawn here, at random."""
    conditions, count, revolutions = parameters.conditions, parameters.drives, parameters.revolutions
    seeds_each = parameters.seeds
    if parameters.quick:
        conditions, count, revolutions, seeds_each = conditions[:1], 2, 15, 2
    tables = {**{name: LAWS[name] for name in parameters.laws}, **_own(parameters)}
    length = {"spindle_encoder": {"revolutions": float(revolutions)}}
    bases = {each.scenario: cells.load(each.scenario, **length) for each in map(CONDITIONS.__getitem__, conditions)}
    tolerance, chosen = parameters.tolerance_um, [CONDITIONS[name] for name in conditions]
    laws = [[_in_condition(bases[each.scenario], each, law, tolerance) for law in tables.values()] for each in chosen]
    seeds = [PUBLISHED, parameters.fresh_seed or 1 + secrets.randbelow(_LARGEST)]
    drives = [drives_of(next(iter(bases.values())), seed, count) for seed in seeds]
    cases = [(of_set, law) for of_set, of_condition in product(drives, laws) for law in of_condition]

    def scores(of_cases: list[list[Values]]) -> Array:
        """Run the drives chosen for each set, condition and law; return `_scores` of each, shape (4, ...)."""
        made = [law.varied(drive) for (_, law), of_law in zip(cases, of_cases, strict=True) for drive in of_law]
        found = [_scores(judged, revolutions, tolerance) for judged in cells.kept(made, Judge, track)]
        return np.reshape(np.transpose(found), (4, len(seeds), len(conditions), len(tables), -1))

    largest, excess, settled, effort = scores([of_set for of_set, _ in cases])
    # NaN, a stopped run, is the worst. Of an even number of drives the median one is the lower of the middle two.
    places = np.argsort(largest, axis=-1)[..., [-1, (count - 1) // 2]]
    seeded = scores(
        [
            [drive for k in pair for drive in (of_set[k], *({**of_set[k], "seed": n} for n in range(1, seeds_each)))]
            for (of_set, _), pair in zip(cases, places.reshape(-1, 2), strict=True)
        ]
    )[0]
    # Encoder and gauge do not change the margin.
    by_scenario = {each.scenario: of_condition for each, of_condition in zip(chosen, laws, strict=True)}
    margin = {
        name: [[margins(law, of_set) for law in of_scenario] for of_set in drives]
        for name, of_scenario in by_scenario.items()
    }
    return Oval3000Result(
        seeds=seeds,
        conditions=conditions,
        laws=list(tables),
        tolerance=tolerance,
        largest=largest,
        excess=excess,
        seeded=np.moveaxis(seeded.reshape(*seeded.shape[:3], 2, -1), 3, 0),
        settled=settled,
        effort=effort,
        margin=np.stack([np.array(margin[each.scenario]) for each in chosen], axis=1),
    )


STUDY = Study("oval3000", "benchmark: laws at 3000 rpm, with drives drawn at random", Oval3000Parameters, run)
