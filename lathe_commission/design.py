# SPDX-License-Identifier: Apache-2.0
"""Design of the learning law of a cell for a drive that is known within a set: laws and filters compared.

For each law, settings on a grid are reduced to those whose drive margin
(`lathe_rc.analysis.cycle_factors.drive_margin`) is large enough with the nominal drive and at every measured point,
with the lead that has the largest margin. An even choice of these runs with the nominal drive. The setting with the
smallest error that keeps the margin with every drive of the set then runs with each of them, at the speed of the
scenario and at another one.
"""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from typing import Literal, NamedTuple

import numpy as np

from lathe_commission.cycle_weights import of_gaussian_process
from lathe_commission.fir_inverse import fir_inverse
from lathe_machine.stages.learning.learner import CheckedLoop, Learner, lag
from lathe_machine.stages.spindle.speed_law import SpeedLawParameters
from lathe_rc import messages
from lathe_rc.analysis.cycle_factors import DriveMargin, Response
from lathe_rc.analysis.frequency_response import FrequencyResponse
from lathe_rc.analysis.measured_drive import MeasuredDrive
from lathe_rc.analysis.tolerance import LAST, growth, judge
from lathe_rc.arrays import Array, Complex
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell import batch
from lathe_rc.cell.parameters import NodeParameters, SharedParameters, Values, judged
from lathe_rc.cell.scenario import TABLES, Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError
from lathe_rc.judge.part import strictest
from lathe_rc.messages import Signals
from lathe_rc.signals.form_errors import FormErrors

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
_SLIGHT = 0.005  # least damping of a resonance that the points may leave out
_RUNS = 12  # settings of a law that are run
SWING_FREQUENCY = 10.7  #: [rad/s]
#: parameters of the replaced controller that its law keeps
_COMMON = {"feedback_delay", "reaction_delay", "retract_velocity", "retract_acceleration", "retract_jerk"}


@dataclass(frozen=True)
class FilteredLaw:
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
_DISTURBANCE: list[Values] = [
    {"learned_waves": waves, "learning_bandwidth": bandwidth, "observer_bandwidth": observer}
    for waves, bandwidth, observer in product(_WAVES, _LEARNING, _OBSERVERS)
]
_INVERSE: Values = {"correction": "second_order_inverse"}
#: laws by name
LAWS: Mapping[str, FilteredLaw] = {
    "lead, exponential Q": FilteredLaw("learning_controller", {"q_filter": "exponential"}, _SMOOTH),
    "lead, Gaussian Q": FilteredLaw("learning_controller", {"q_filter": "gaussian"}, _SMOOTH),
    "lead, flat Q": FilteredLaw("learning_controller", {"q_filter": "fir"}, _FLAT),
    "notch, flat Q": FilteredLaw("learning_controller", {"q_filter": "fir", "correction": "fir"}, _FLAT, "notch"),
    "inverse, Gaussian Q": FilteredLaw("learning_controller", {"q_filter": "gaussian", **_INVERSE}, _SMOOTH, "delay"),
    "inverse, flat Q": FilteredLaw("learning_controller", {"q_filter": "fir", **_INVERSE}, _FLAT, "delay"),
    "zero phase, flat Q": FilteredLaw("learning_controller", {"q_filter": "fir", "correction": "fir"}, _FLAT, "model"),
    "measured, flat Q": FilteredLaw("learning_controller", {"q_filter": "fir", "correction": "fir"}, _FLAT, "measured"),
    "high order, flat Q": FilteredLaw(
        "learning_controller",
        {"q_filter": "fir", "correction": "fir"},
        [{**each, "cycle_weights": weights} for each in _FLAT_OF_CYCLES for weights in _CYCLES],
        "model",
    ),
    "Gaussian process": FilteredLaw(
        "learning_controller",
        {"q_filter": "fir", "correction": "fir"},
        [{**each, "cycle_weights": weights} for each in _FLAT_OF_CYCLES for weights in _PROCESSES],
        "model",
    ),
    "norm-optimal": FilteredLaw(
        "norm_optimal_controller",
        {},
        [{"highest_order": orders, "change_weight": weight} for orders in _ORDERS for weight in _WEIGHTS],
        "",
    ),
    "disturbance": FilteredLaw("disturbance_controller", {"identify": False}, _DISTURBANCE, ""),
    "disturbance, resonance": FilteredLaw(
        "disturbance_controller", {"identify": False, "inverse": "fourth_order"}, _DISTURBANCE, ""
    ),
}  # fmt: skip


class WorstResult(NamedTuple):
    """Worst result of some runs.

    Attributes:
        largest: largest magnitude of the form error in the last ten revolutions [m]; inf if a run failed.
        settled: first revolution from which on the error is in tolerance; inf if it is not in all of the last ten.
        effort: RMS of the effort of the drive [N, V or A].
        failure: why the run failed; empty: it did not.
    """

    largest: float
    settled: float
    effort: float
    failure: str = ""


class Covered(NamedTuple):
    """Frequencies at which the margin of a law was evaluated.

    Attributes:
        points: number of measured points among them.
        measured: lowest and highest of these [rad/s], if there is any.
        highest: highest frequency at which the law acts, from 0 on, with the model of each drive [rad/s].
    """

    points: int
    measured: tuple[float, float]
    highest: float


_FAILED = WorstResult(np.inf, np.inf, np.nan)


@dataclass(frozen=True)
class Candidate:
    """Law with its best settings.

    Attributes:
        law: name of the law, see `LAWS`.
        values: its parameters that differ from the defaults.
        scenario: the cell with the law; None if the law is not offered.
        margin: smallest drive margin over the set of drives and the measured points; None if the law is not offered.
        where: the drive or the points that have this margin.
        nominal: run with the nominal drive, at the speed of the scenario.
        worst: worst of the runs with all drives at the speed of the scenario.
        other: the same at the other speed, see `Design`; without one as ``worst``.
        covered: frequencies at which the margin was evaluated.
        shortened: feedback delay with which the law runs, where that of the scenario is too long [sample].
        reason: why the law is not offered; empty if it is.
    """

    law: str
    values: Values = field(default_factory=dict)
    scenario: Scenario | None = None
    margin: DriveMargin | None = None
    where: str = ""
    nominal: WorstResult = _FAILED
    worst: WorstResult = _FAILED
    other: WorstResult = _FAILED
    covered: Covered | None = None
    shortened: int | None = None
    reason: str = ""

    @property
    def settled(self) -> float:
        """First revolution from which on the error is in tolerance with every drive at both speeds; inf if never."""
        return max(self.worst.settled, self.other.settled)


def _rank(candidate: Candidate) -> tuple[bool, bool, bool, float, float]:
    out = not candidate.settled < np.inf
    margin = 0.0 if out or candidate.margin is None else min(candidate.margin.error, 1.0)
    largest = max(candidate.worst.largest, candidate.other.largest)
    return bool(candidate.reason), out, candidate.shortened is not None, -round(margin, 2), largest


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


def with_swing(scenario: Scenario, swing: float, drift: float) -> Scenario:
    """Return a scenario whose speed swings and drifts, in place of its own deviations; both 0: a constant speed.

    Args:
        scenario: scenario with a number of revolutions.
        swing: amplitude of a harmonic deviation with `SWING_FREQUENCY`, relative to the nominal speed.
        drift: linear change of the speed from the start to the end of the run, relative to the nominal speed.

    Raises:
        InputError: the speed of the scenario is not given by parameters.
    """
    master = scenario.masters[0]
    table = scenario.nodes[master]
    if not isinstance(table, SpeedLawParameters):
        raise InputError(f"{master}: no parameters of its speed; allowed: --swing and --drift of a spindle_encoder")
    own = SpeedLawParameters.model_fields.keys() - NodeParameters.model_fields.keys()
    values = {name: type(table).rows()[name].default for name in own}
    if swing:
        values |= {"deviation_amplitude": [swing], "deviation_frequency": [SWING_FREQUENCY]}
    if drift:
        seconds = 2.0 * math.pi * float(getattr(table, "revolutions", 0.0)) / table.nominal_speed
        values |= {"tachogram_time": [0.0, seconds], "tachogram_deviation": [-0.5 * drift, 0.5 * drift]}
    return scenario.varied({f"{master}.{name}": value for name, value in values.items()})


class Design:
    """Design of the learning law of a cell.

    Args:
        scenario: cell with form, speeds, sensors, tolerance, and a learning controller that is replaced.
        drives: parameters of each drive by the names of ``electrodynamic_actuator``; the first drive is the nominal
            one.
        margin: drive margin that each drive of the set, and each measured point, must leave.
        measured: measured responses of the drive, in one or several states.
        other: the scenario with another speed, at which each law runs as well; None: only at that of the scenario.

    Attributes:
        node: name of the learning controller.
        drive: ``NODE.`` of the drive with the prefix of its parameters.
        drives: parameters of each drive, by ``NODE.PARAM``.
        feedback_delay: that of the scenario [sample].

    Raises:
        InputError: the scenario has no tool with a tolerance, or not one learning controller and one drive.
    """

    def __init__(
        self,
        scenario: Scenario,
        drives: Sequence[Values],
        margin: float,
        measured: Sequence[FrequencyResponse] = (),
        other: Scenario | None = None,
    ) -> None:
        self._margin, self._measured, self._runner = margin, measured, batch.CellRunner()
        cell = Cell(scenario.nodes)
        learners = [stage for stage in cell.stages.values() if isinstance(stage, Learner)]
        if len(learners) != 1:
            raise InputError(
                f"design of {scenario.name}: {len(learners)} learning controllers; allowed: a scenario with one"
            )
        self.node, self.feedback_delay = learners[0].name, learners[0].parameters.feedback_delay
        learned = learners[0].learned(cell.stages.values())
        commanded = {drive.name for _, drive in learned}
        if len(commanded) != 1:
            raise InputError(f"design of {scenario.name}: {self.node} commands {len(commanded)} drives; allowed: one")
        drive = learned[0][1]
        declared = judged({name: scenario.nodes[name] for name in [*scenario.of_kind("tool"), self.node]})
        self._tolerance = strictest(declared)
        if not self._tolerance:
            raise InputError(f"design of {scenario.name}: no tolerance; allowed: tool.tolerance above 0")
        self._limits = {
            f"command_{name}": limit
            for limits in drive.limits().values()
            for name, limit in vars(limits).items()
            if math.isfinite(limit)
        }
        prefix = "coarse_" if "coarse_damping" in type(drive.shared).model_fields else ""
        self.drive, self._node = f"{drive.name}.{prefix}", drive.name
        self.drives: list[Values] = [{f"{self.drive}{name}": value for name, value in each.items()} for each in drives]
        self._speeds = [each.varied(self.drives[0]) for each in (scenario, other) if each]
        # Margins, longest feedback delay and the choice of settings are those of the larger range of speeds.
        self._base = max(self._speeds, key=lambda each: float(np.ptp(Cell(each.nodes).speed_range)))
        self._resonances = getattr(self._base.nodes[drive.name], f"{prefix}mode_frequency", ())
        models = [list(self._loop(self._base.varied(values))[0].responses) for values in self.drives]
        nominal = models[0][0]
        points = [MeasuredDrive(each.frequency, each.value, nominal) for each in measured]
        self._points = [*(each for each in models[0] if isinstance(each, MeasuredDrive)), *points]
        # The points and the nominal drive first: the settings have the margin with these before they run.
        state = " in state {}" if len(self._points) > 1 else ""
        self._drives: list[tuple[str, Response]] = [
            (f"the measured points{state.format(k)}", each) for k, each in enumerate(self._points, 1)
        ]
        self._drives += [("the nominal drive", nominal)]
        self._gaps = [gap for each in self._points for gap in _gaps(each, nominal, margin)]
        self._nominal = len(self._drives)
        self._drives += [(f"drive {k}", model) for k, (model, *_) in enumerate(models[1:], 2)]

    def candidates(self, watch: Callable[[str], None] = lambda _: None) -> list[Candidate]:
        """Return each law with its best settings, the best law first; ``watch`` is called with the name of each.

        The best law is in tolerance with every drive at both speeds, if possible with the feedback delay of the
        scenario, and has the largest drive margin. If none is in tolerance, it is the one with the smallest error.
        """
        found = []
        for name, law in LAWS.items():
            if self._applies(law):
                watch(name)
                found.append(self._candidate(name, law))
        return sorted(found, key=_rank)

    def _applies(self, law: FilteredLaw) -> bool:
        """Return whether the drive is known as a law needs it: with measured points, or with resonances."""
        if "inverse" in law.fixed:
            return any("inverse.denominator" in each for each in self._base.nodes[self._node].drive_models().values())
        return bool({"measured": self._measured, "notch": self._resonances}.get(law.lead, True))

    def _with(self, base: Scenario, law: FilteredLaw, values: Values) -> Scenario:
        """Return a scenario with a law in place of its learning controller."""
        before, table = base.nodes[self.node], TABLES[law.kind]
        common = table.model_fields.keys() & before.model_fields_set & (_COMMON | SharedParameters.model_fields.keys())
        kept = {name: getattr(before, name) for name in common}
        kept |= {name: limit for name, limit in self._limits.items() if name in table.model_fields}
        return base.with_node(self.node, table.read(self.node, {**kept, "stage": law.kind, **law.fixed, **values}))

    def _candidate(self, name: str, law: FilteredLaw) -> Candidate:
        settings, reason = self._settings(law)
        results = self._run([self._with(self._base, law, each.values) for each in settings])
        reasons = [] if settings else [reason]
        for k in sorted(range(len(settings)), key=lambda k: results[k].largest):
            values, loop = settings[k].values, settings[k].loop
            if results[k].failure:
                reasons.append(results[k].failure)
                continue
            margin, where = self._least(loop, self._drives, self._margin)
            if margin is None or margin.error < self._margin:
                reasons.append(_lost(margin, where))
                continue
            # The law keeps the model of the nominal drive.
            scenarios = [self._with(speed, law, values) for speed in self._speeds]
            runs = [self._run([each.with_models_given().varied(drive) for drive in self.drives]) for each in scenarios]
            worst = [WorstResult(*map(max, zip(*found, strict=True))) for found in runs]
            failed = ((k, run.failure) for found in runs for k, run in enumerate(found, 1) if run.failure)
            if first := next(failed, None):
                reasons.append(f"run with drive {first[0]}: {first[1]}")
                continue
            covered, delay = self._covered(loop), values.get("feedback_delay")
            whole = {**law.fixed, **values}
            shortened = delay if isinstance(delay, int) else None
            of_runs = (runs[0][0], worst[0], worst[-1])
            return Candidate(name, whole, scenarios[0], margin, where, *of_runs, covered, shortened)
        return Candidate(name, reason=reasons[0])

    def _settings(self, law: FilteredLaw) -> tuple[list["_Setting"], str]:
        """Return the settings to run, and why there is none.

        They are an even choice of those with the margin with the nominal drive and the measured points, with the best
        lead of each.
        """
        known = self._base.nodes[self._node].drive_models().values()
        delay = next((value for each in known if isinstance(value := each.get("delay"), float)), 0.0)
        points = self._measured[0] if self._measured else None
        kept: list[_Setting] = []
        reason, gap, most = "", "", -1.0
        for alike in law.settings(Known(self._drives[self._nominal - 1][1], delay, points, self._resonances)):
            best: _Setting | None = None
            for values in alike:
                try:
                    found = self._setting(law, values, max(best.error if best else 0.0, self._margin))
                except InputError as error:  # the filter does not fit into the memory, or the cycle leaves no time
                    reason = reason or str(error)
                else:
                    gap = gap or found.gap
                    best = found if best is None or found.error > best.error else best
            if best and best.error > most:
                reason, most = _lost(best.margin, best.where), best.error
            kept += [best] if best and best.error >= self._margin else []
        chosen = sorted({round(k) for k in np.linspace(0, len(kept) - 1, _RUNS)}) if kept else []
        return [kept[k] for k in chosen], gap or reason

    def _setting(self, law: FilteredLaw, values: Values, wanted: float) -> "_Setting":
        """Return a law with values, and with the longest feedback delay if that of the scenario is too long for it.

        A margin below ``wanted`` is an upper bound, see `_least`.

        Raises:
            InputError: the values are invalid, or no feedback delay is short enough.
        """
        loop, cell = self._loop(self._with(self._base, law, values))
        allowed = loop.stage.allowed_delay(cell)
        if allowed is not None and allowed < loop.stage.parameters.feedback_delay:
            if allowed < loop.stage.shared.block_size:
                loop.stage.check_delay(cell)
            values = {**values, "feedback_delay": allowed}
            loop, _ = self._loop(self._with(self._base, law, values))
        found = _Setting(values, loop, *self._least(loop, self._drives[: self._nominal], wanted))
        return found._replace(gap=self._gap(loop)) if found.error >= wanted else found

    def _gap(self, loop: CheckedLoop) -> str:
        """Return which gap between the measured points may hide what a law does not bear; empty if there is none."""
        _, nominal = self._drives[self._nominal - 1]
        for speed, (low, high, change) in product(loop.speeds, self._gaps):
            if low <= loop.stage.highest_waves(speed) * speed:
                borne = loop.stage.smallest_errors(nominal, np.array([low, high]) / speed, speed).min()
                if borne < change:
                    hertz = " and ".join(f"{each / (2.0 * math.pi):.4g}" for each in (low, high))
                    return (
                        f"a resonance between the points at {hertz} Hz, where these differ from the model, may change "
                        f"the drive by {change:.2g}; allowed for this law: {borne:.2g} (more points there)"
                    )
        return ""

    def _least(
        self, loop: CheckedLoop, drives: Sequence[tuple[str, Response]], wanted: float
    ) -> tuple[DriveMargin | None, str]:
        """Return the smallest drive margin, and the name of the drive; None if no check covers one of them.

        The first margin below ``wanted`` is returned at once.
        """
        least: tuple[DriveMargin | None, str] = (None, "")
        for name, drive in drives:
            for speed in loop.speeds:
                margin = loop.stage.drive_margin(drive, speed)
                if margin is None:
                    return None, name
                least = (margin, name) if least[0] is None or margin < least[0] else least
                if margin.error < wanted:
                    return least
        return least

    def _covered(self, loop: CheckedLoop) -> Covered:
        highest = max(loop.stage.highest_waves(speed) * speed for speed in loop.speeds)
        points = np.concatenate([np.zeros(0), *(each.frequency for each in self._points)])
        points = points[points <= highest]
        return Covered(points.size, (float(points.min(initial=np.inf)), float(points.max(initial=0.0))), highest)

    def _loop(self, scenario: Scenario) -> tuple[CheckedLoop, Cell]:
        cell = self._runner.cell(scenario)
        stage = cell.stages[self.node]
        assert isinstance(stage, Learner), "as before, or a law has taken its place"
        return stage.checked_loop(cell), cell

    def _run(self, scenarios: Sequence[Scenario]) -> list[WorstResult]:
        found = []
        keep: batch.Make[tuple[FormErrors, float]] = partial(_Keep, self._node)
        for outcome in batch.run_many(scenarios, keep):
            if outcome.kept is None:
                found.append(_FAILED._replace(failure=str(outcome.error)))
                continue
            errors, effort = outcome.kept
            largest = float(errors.largest[-LAST:].max())
            since = judge(errors.largest, self._tolerance).since if largest <= self._tolerance else 0
            grown = growth(errors.largest)
            failure = grown.told() if grown and grown.diverges else ""
            found.append(WorstResult(largest, float(since or np.inf), effort, failure))
        return found


class _Setting(NamedTuple):
    """Values of a law with its loop and the smallest margin with some drives, see `Design._least`."""

    values: Values
    loop: CheckedLoop
    margin: DriveMargin | None
    where: str
    gap: str = ""

    @property
    def error(self) -> float:
        return self.margin.error if self.margin and not self.gap else -1.0


def _gaps(points: MeasuredDrive, model: Response, least: float) -> list[tuple[float, float, float]]:
    """Return the gaps between points in which a resonance may change the drive by more than ``least``.

    A resonance of the damping `_SLIGHT` changes the response at the edge of a gap of the width h, in units of its half
    width σ, by 2σ/h of the change at its middle. So the difference of points and model at both edges bounds it.

    Returns:
        Lower and upper end of each gap [rad/s], and the largest change relative to the model.
    """
    frequency = points.frequency
    differs = np.abs(points.value / model(frequency) - 1.0)
    change = np.maximum(differs[1:], differs[:-1]) * np.diff(frequency) / (_SLIGHT * (frequency[1:] + frequency[:-1]))
    wide = np.flatnonzero((np.diff(frequency) > _SLIGHT * (frequency[1:] + frequency[:-1])) & (change > least))
    return [(float(frequency[k]), float(frequency[k + 1]), float(change[k])) for k in wide]


def _lost(margin: DriveMargin | None, where: str) -> str:
    if margin is None:
        return f"no check covers it with {where}"
    hertz = margin.waves * margin.speed / (2.0 * math.pi)
    return f"drive margin at most {margin.error:.3g}, with {where} at {hertz:.4g} Hz"
