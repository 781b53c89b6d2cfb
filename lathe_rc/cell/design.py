# SPDX-License-Identifier: Apache-2.0
"""Design of the learning law of a cell for a drive that is known within a set: laws and filters compared.

For each law, settings on a grid are reduced to those whose drive margin (`lathe_rc.analysis.learning.drive_margin`) is
large enough with the nominal drive, with the lead that has the largest margin. An even choice of these runs with the
nominal drive. The setting with the smallest error that keeps the margin with every drive of the set then runs with each
of them.
"""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Literal, NamedTuple

import numpy as np

from lathe_rc import messages
from lathe_rc.analysis.cycle_weights import of_gaussian_process
from lathe_rc.analysis.fir_inverse import fir_inverse
from lathe_rc.analysis.form_errors import FormErrors
from lathe_rc.analysis.frequency_response import FrequencyResponse
from lathe_rc.analysis.learning import DriveMargin, Response
from lathe_rc.analysis.tolerance import LAST, judge
from lathe_rc.arrays import Array, Complex
from lathe_rc.cell import batch
from lathe_rc.cell.parameters import SharedParameters, Values
from lathe_rc.cell.scenario import TABLES, Scenario
from lathe_rc.cell.stage import Sparse
from lathe_rc.cell.stages.learner import Learner, Loop, lag
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError
from lathe_rc.messages import Signals

_LEADS = np.linspace(0.5, 1.3, 9)  # over the lag that the correction leaves
_GAINS = (1.0, 0.5)
_BANDS = np.geomspace(1000.0, 20_000.0, 18)  # [rad/s] of a flat Q
_SHAPES = ((2.5, 1e-4), (1.7, 1e-4), (1.4, 1e-3))  # begin of its stop band over the end of its pass band, and ripple
_WIDTHS = np.geomspace(20e-6, 1e-3, 10)  # [s] q_time of the other ones
_WAVES = (5.0, 8.0, 12.0, 20.0, 35.0, 60.0)  # of the disturbance law
_LEARNING, _OBSERVERS = (1000.0, 3000.0, 8000.0), (0.0, 500.0, 2000.0, 4000.0)  # [rad/s]
_PENALTIES = (1e-4, 1e-3, 1e-2)  # ρ of an FIR inverse
_TAPS, _AHEAD, _DENSE = 64, 2.0, 1024  # its length, its lead and its interval in lags of the drive, points of a model
_PER_LAG = 16
_NOTCH, _NARROW = 100.0, 0.2  # ρ of a notch in its middle, and its half width over the frequency
_ORDERS, _WEIGHTS = (6, 8, 12, 16, 24), (0.01, 0.1, 1.0)  # of the norm-optimal law
_RUNS = 12  # settings of a law that are run
#: parameters of the replaced controller that its law keeps
_COMMON = {"feedback_delay", "reaction_delay", "retract_velocity", "retract_acceleration", "retract_jerk"}


@dataclass(frozen=True)
class Law:
    """Law with a filter.

    Attributes:
        kind: kind of the controller.
        fixed: parameters that distinguish the law.
        filters: parameters of its filter, each a choice between robustness and error.
        lead: what its lead compensates: the lag of the drive, without or with notches at its resonances, the delay that
            a second-order inverse leaves, or the response of the nominal drive or as measured, by an FIR inverse; empty
            for a law without lead and gain.
    """

    kind: str
    fixed: Values
    filters: Sequence[Values]
    lead: Literal["", "lag", "notch", "delay", "model", "measured"] = "lag"

    def settings(self, drive: "Known") -> Iterator[Sequence[Values]]:
        """Yield settings that differ in the lead alone, for a drive."""
        leads: Sequence[Values] = [{}]
        if self.lead in ("lag", "delay"):
            time = drive.lag if self.lead == "lag" else max(drive.delay, 0.1 * drive.lag)
            leads = [{"lead_time": lead} for lead in (_LEADS * time).tolist()]
        elif self.lead == "notch":
            leads = [drive.notched(lead) for lead in (_LEADS * drive.lag).tolist()]
        elif self.lead:
            leads = [drive.inverse(penalty, measured=self.lead == "measured") for penalty in _PENALTIES]
        gains: Sequence[Values] = [{"learning_gain": gain} for gain in _GAINS] if self.lead else [{}]
        for each, gain in product(self.filters, gains):
            yield [{**each, **gain, **lead} for lead in leads]


class Known(NamedTuple):
    """Nominal drive as a law may know it.

    Attributes:
        response: response of its position to its command.
        delay: its delay [s]; 0 if unknown.
        measured: points of its measured response; None if unknown.
        resonances: frequencies of its modes [rad/s].
    """

    response: Response
    delay: float
    measured: FrequencyResponse | None
    resonances: Sequence[float] = ()

    @property
    def lag(self) -> float:
        """Lag at low frequencies [s]."""
        return lag(self.response)

    @property
    def _frequency(self) -> Array:
        """Frequencies of the taps [rad/s]."""
        return np.linspace(1.0, _DENSE, _DENSE) * np.pi * _PER_LAG / self.lag / _DENSE

    def notched(self, lead: float) -> Values:
        """Return an FIR filter with a lead [s] and zero-phase notches at the resonances."""
        frequency, floor = self._frequency, np.zeros(_DENSE)
        for mode in self.resonances:
            floor += _NOTCH * np.exp(-((frequency / mode - 1.0) ** 2) / _NARROW**2)
        return self._taps(np.exp(-1j * frequency * lead), floor)

    def inverse(self, penalty: float, *, measured: bool) -> Values:
        """Return an FIR inverse of the response of the model, or as ``measured`` and 0 beyond."""
        frequency = self._frequency
        value, floor = np.asarray(self.response(frequency)), np.full(_DENSE, penalty)
        if measured and (points := self.measured) is not None:
            value, noise = np.where(frequency > points.frequency[-1], 0.0, value), np.zeros(_DENSE)
            inside = (frequency >= points.frequency[0]) & (frequency <= points.frequency[-1])
            value[inside] = np.interp(frequency[inside], points.frequency, points.value)
            if points.deviation is not None:
                deviation = points.deviation * np.abs(points.value)
                noise[inside] = 2.0 * np.interp(frequency[inside], points.frequency, deviation) ** 2
            floor += noise
        return self._taps(value, floor)

    def _taps(self, response: Complex, floor: Array) -> Values:
        lead_time, interval = _AHEAD * self.lag, self.lag / _PER_LAG
        taps = fir_inverse(self._frequency, response, floor, lead_time=lead_time, interval=interval, taps=_TAPS)
        return {"lead_time": lead_time, "correction_interval": interval, "correction_taps": taps.tolist()}


_FLAT: list[Values] = [
    {"q_pass": float(band), "q_stop": float(stop * band), "q_ripple": ripple}
    for band, (stop, ripple) in product(_BANDS, _SHAPES)
]
_FLAT_OF_CYCLES = _FLAT[:: len(_SHAPES)]  # those that several cycles are weighted with
_SMOOTH: list[Values] = [{"q_time": float(width)} for width in _WIDTHS]
_CYCLES: Sequence[list[float]] = [[1.0] * count for count in (2, 4, 8)]
_PROCESSES: Sequence[list[float]] = [of_gaussian_process(8, *each) for each in ((10.0, 0.3), (30.0, 1.0), (100.0, 3.0))]
_INVERSE: Values = {"correction": "second_order_inverse"}
#: laws by name
LAWS: Mapping[str, Law] = {
    "lead, exponential Q": Law("learning_controller", {"q_filter": "exponential"}, _SMOOTH),
    "lead, Gaussian Q": Law("learning_controller", {"q_filter": "gaussian"}, _SMOOTH),
    "lead, flat Q": Law("learning_controller", {"q_filter": "fir"}, _FLAT),
    "notch, flat Q": Law("learning_controller", {"q_filter": "fir", "correction": "fir"}, _FLAT, "notch"),
    "inverse, Gaussian Q": Law("learning_controller", {"q_filter": "gaussian", **_INVERSE}, _SMOOTH, "delay"),
    "inverse, flat Q": Law("learning_controller", {"q_filter": "fir", **_INVERSE}, _FLAT, "delay"),
    "zero phase, flat Q": Law("learning_controller", {"q_filter": "fir", "correction": "fir"}, _FLAT, "model"),
    "measured, flat Q": Law("learning_controller", {"q_filter": "fir", "correction": "fir"}, _FLAT, "measured"),
    "high order, flat Q": Law(
        "learning_controller",
        {"q_filter": "fir", "correction": "fir"},
        [{**each, "cycle_weights": weights} for each in _FLAT_OF_CYCLES for weights in _CYCLES],
        "model",
    ),
    "Gaussian process": Law(
        "learning_controller",
        {"q_filter": "fir", "correction": "fir"},
        [{**each, "cycle_weights": weights} for each in _FLAT_OF_CYCLES for weights in _PROCESSES],
        "model",
    ),
    "norm-optimal": Law(
        "norm_optimal_controller",
        {},
        [{"highest_order": orders, "change_weight": weight} for orders in _ORDERS for weight in _WEIGHTS],
        "",
    ),
    "disturbance": Law(
        "disturbance_controller",
        {"identify": False},
        [
            {"learned_waves": waves, "learning_bandwidth": bandwidth, "observer_bandwidth": observer}
            for waves, bandwidth, observer in product(_WAVES, _LEARNING, _OBSERVERS)
        ],
        "",
    ),
}  # fmt: skip


class Found(NamedTuple):
    """Result of a run.

    Attributes:
        largest: largest magnitude of the form error in the last ten revolutions [m]; inf if the run failed.
        settled: first revolution from which on the error is in tolerance; inf if never.
        effort: RMS of the effort of the drive [N, V or A].
    """

    largest: float
    settled: float
    effort: float


_FAILED = Found(np.inf, np.inf, np.nan)


@dataclass(frozen=True)
class Candidate:
    """Law with its best settings.

    Attributes:
        law: name of the law, see `LAWS`.
        values: its parameters that differ from the defaults.
        scenario: the cell with the law; None if no setting has the margin.
        margin: smallest drive margin over the set of drives; None if no setting has one.
        nominal: run with the nominal drive.
        worst: worst of the runs with all drives.
    """

    law: str
    values: Values
    scenario: Scenario | None
    margin: DriveMargin | None
    nominal: Found
    worst: Found


def _rank(candidate: Candidate) -> tuple[bool, float, float]:
    out = not candidate.worst.settled < np.inf
    margin = 0.0 if out or candidate.margin is None else min(candidate.margin.error, 1.0)
    return out, -round(margin, 2), candidate.worst.largest


class _Keep:
    """Keeper of form error and effort (see `lathe_rc.cell.batch.Keeper`)."""

    def __init__(self, drive: str, cell: Cell, samples: int) -> None:
        self._errors = batch.Errors(cell, samples)
        self._effort = next(
            topic for topic, source in cell.dense.items() if (source.node, source.type) == (drive, messages.STATE)
        )
        self.heard: Collection[str] = [*self._errors.heard, f"{self._effort}.effort"]
        self._square, self._samples = 0.0, samples

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Process a chunk of the run, as a sink of the engine."""
        self._errors.chunk(first, samples, dense, sparse)
        self._square += float(np.sum(dense[self._effort]["effort"] ** 2))

    def kept(self) -> tuple[FormErrors, float]:
        """Return the form error of each revolution, and the RMS of the effort."""
        return self._errors.kept(), math.sqrt(self._square / self._samples)


class Design:
    """Design of the learning law of a cell.

    Args:
        scenario: cell with form, speeds, sensors, tolerance, and a learning controller that is replaced.
        drives: parameters of each drive by the names of ``electrodynamic_actuator``; the first drive is the nominal
            one.
        margin: drive margin that each drive of the set must leave.
        measured: measured response of the nominal drive; None if there is none.

    Attributes:
        node: name of the learning controller.
        drives: parameters of each drive, by ``NODE.PARAM``.
        refused: the first reason why a setting or a run was rejected or failed; None if there was none.

    Raises:
        InputError: the scenario has no tool with a tolerance, or not one learning controller and one drive.
    """

    def __init__(
        self,
        scenario: Scenario,
        drives: Sequence[Values],
        margin: float,
        measured: FrequencyResponse | None = None,
    ) -> None:
        self._margin, self._measured = margin, measured
        self.refused: LatheError | None = None
        cell = Cell(scenario.nodes)
        learners = [stage for stage in cell.stages.values() if isinstance(stage, Learner)]
        if len(learners) != 1:
            raise InputError(
                f"design of {scenario.name}: {len(learners)} learning controllers; allowed: a scenario with one"
            )
        self.node = learners[0].name
        learned = learners[0].learned(cell.stages.values())
        commanded = {drive.name for _, drive in learned}
        if len(commanded) != 1:
            raise InputError(f"design of {scenario.name}: {self.node} commands {len(commanded)} drives; allowed: one")
        self._drive = learned[0][1]
        self._tolerance = max(
            getattr(scenario.nodes[name], "tolerance", 0.0) for name in [*scenario.of_kind("tool"), self.node]
        )
        if not self._tolerance:
            raise InputError(f"design of {scenario.name}: no tolerance; allowed: tool.tolerance above 0")
        self._limits = {
            f"command_{name}": limit
            for limits in self._drive.limits().values()
            for name, limit in vars(limits).items()
            if math.isfinite(limit)
        }
        self._scenario = scenario
        fields = type(self._drive.shared).model_fields
        prefix = "coarse_" if "coarse_damping" in fields else ""
        self.drives: list[Values] = [
            {f"{self._drive.name}.{prefix}{name}": value for name, value in each.items()} for each in drives
        ]
        self._nominal = scenario.varied(self.drives[0])
        self._resonances = getattr(self._nominal.nodes[self._drive.name], f"{prefix}mode_frequency", ())

    def candidates(self, watch: Callable[[str], None] = lambda _: None) -> list[Candidate]:
        """Return each law with its best settings, the best law first; ``watch`` is called with the name of each.

        The best law is in tolerance with every drive and has the largest drive margin. If none is in tolerance, it is
        the one with the smallest error.
        """
        found = []
        for name, law in LAWS.items():
            if {"measured": self._measured, "notch": self._resonances}.get(law.lead, True):
                watch(name)
                found.append(self._candidate(name))
        return sorted(found, key=_rank)

    def _with(self, base: Scenario, law: Law, values: Values) -> Scenario:
        """Return a scenario with a law in place of its learning controller."""
        before, table = base.nodes[self.node], TABLES[law.kind]
        common = table.model_fields.keys() & before.model_fields_set & (_COMMON | SharedParameters.model_fields.keys())
        kept = {name: getattr(before, name) for name in common}
        kept |= {name: limit for name, limit in self._limits.items() if name in table.model_fields}
        return base.with_node(self.node, table.read(self.node, {**kept, "stage": law.kind, **law.fixed, **values}))

    def _responses(self, drives: Sequence[Values]) -> list[Response]:
        return [found for values in drives for found in self._loop(self._scenario.varied(values)).responses]

    def _candidate(self, name: str) -> Candidate:
        law = LAWS[name]
        settings = self._settings(law)
        runs = [(values, self._with(self._nominal, law, values)) for values in settings]
        results = self._run([scenario for _, scenario in runs])
        order = sorted(range(len(runs)), key=lambda k: results[k].largest)
        whole = self._responses(self.drives)
        for k in order:
            values, scenario = runs[k]
            margin = self._loop(scenario)._replace(responses=whole).drive_margin()
            if margin is not None and margin.error >= self._margin:
                # The law keeps the model of the nominal drive.
                fixed = scenario.with_models_given()
                each = self._run([fixed.varied(drive) for drive in self.drives])
                worst = Found(
                    max(run.largest for run in each), max(run.settled for run in each), max(run.effort for run in each)
                )
                return Candidate(name, {**law.fixed, **values}, scenario, margin, results[k], worst)
        return Candidate(name, {}, None, None, _FAILED, _FAILED)

    def _settings(self, law: Law) -> list[Values]:
        """Return the settings to run: an even choice of those with the margin, with the best lead of each."""
        responses = self._responses(self.drives[:1])
        known = self._nominal.nodes[self._drive.name].drive_models().values()
        delay = next((value for each in known if isinstance(value := each.get("delay"), float)), 0.0)
        kept: list[Values] = []
        for alike in law.settings(Known(responses[0], delay, self._measured, self._resonances)):
            tried = [(self._margin_of(law, values, responses), values) for values in alike]
            margin, best = max(tried, key=lambda pair: pair[0])
            kept += [best] if margin >= self._margin else []
        chosen = sorted({round(k) for k in np.linspace(0, len(kept) - 1, _RUNS)}) if kept else []
        return [kept[k] for k in chosen]

    def _margin_of(self, law: Law, values: Values, responses: Collection[Response]) -> float:
        try:
            loop = self._loop(self._with(self._nominal, law, values))
            margin = loop._replace(responses=responses).drive_margin()
        except InputError as error:  # the filter does not fit into the memory
            self.refused = self.refused or error
            return 0.0
        return margin.error if margin else 0.0

    def _loop(self, scenario: Scenario) -> Loop:
        cell = Cell(scenario.nodes)
        stage = cell.stages[self.node]
        assert isinstance(stage, Learner), "as before, or a law has taken its place"
        return stage.checked_loop(cell)

    def _run(self, scenarios: Sequence[Scenario]) -> list[Found]:
        found = []
        keep: batch.Make[tuple[FormErrors, float]] = partial(_Keep, self._drive.name)
        for outcome in batch.run_many(scenarios, keep):
            if outcome.kept is None:
                self.refused = self.refused or outcome.error
                found.append(_FAILED)
                continue
            errors, effort = outcome.kept
            settled = float(judge(errors.largest, self._tolerance).since or np.inf)
            found.append(Found(float(errors.largest[-LAST:].max()), settled, effort))
        return found
