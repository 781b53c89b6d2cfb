# SPDX-License-Identifier: Apache-2.0
"""Learning control from a measured response: margin, expected error, a run, and a scenario of the cell.

Two kinds of learning. `Loop` learns over the spindle angle, at a speed that may vary: the law, drive and tool of the
cell (docs/learning.md). `Trials` learns over time, from one trial of equal length to the next, in lifted form
(Bristow, Tharayil and Alleyne 2006, IEEE Control Systems Magazine 26(3)).

Example:
    >>> import numpy as np
    >>> from scipy import signal
    >>> from lathe_commission import ilc
    >>> f = np.geomspace(5.0, 2000.0, 200)
    >>> _, H = signal.freqresp(signal.lti([1038.0**2], [1.0, 2 * 0.8 * 1038.0, 1038.0**2]), 2 * np.pi * f)
    >>> G = ilc.frequency_response(f, H * np.exp(-2j * np.pi * f * 0.36e-3)).fit()
    >>> L = ilc.learning_filter(G, "zero-phase")
    >>> Q = ilc.q_filter(G, L, margin=0.3)
    >>> loop, part = ilc.Loop(G, L, Q), ilc.reference({2: 100e-6}, rpm=1000)
    >>> loop.margin().error > 0.3
    True
    >>> run = loop.simulate(G, part, trials=12)
    >>> bool(run.errors[-1] < 0.01 * run.errors[0])
    True
"""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, cast

import numpy as np
import numpy.typing as npt
import scipy

from lathe_commission import given
from lathe_commission.design import LAWS, Known
from lathe_commission.modal_fit import MOST_MODES, ResponseData, fit
from lathe_commission.trials import Trials
from lathe_machine.analysis.modal_drive import ModalDrive
from lathe_machine.stages.learning.learning_controller import LearningController
from lathe_rc.analysis.cycle_factors import DriveMargin
from lathe_rc.analysis.frequency_response import (
    AVERAGES,
    FrequencyResponse,
    deviation_of,
    of_measurement,
    write_states,
)
from lathe_rc.analysis.measured_drive import MeasuredDrive
from lathe_rc.arrays import Array, Complex
from lathe_rc.cell.parameters import Value, Values
from lathe_rc.cell.scenario import Scenario, load
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError
from lathe_rc.harness.result import Result
from lathe_rc.harness.runner import run
from lathe_rc.signals import measurement_file

if TYPE_CHECKING:
    from lathe_rc.drawing.form import RunFigure

__all__ = [
    "Expected",
    "Loop",
    "Margin",
    "Part",
    "Response",
    "Run",
    "Trials",
    "frequency_response",
    "learning_filter",
    "q_filter",
    "reference",
]

Filter = Literal["lead", "inverse", "zero-phase", "notch"]

_NODE, _DRIVE, _TOOL, _SPINDLE = "learning_controller", "electrodynamic_actuator", "tool", "spindle_encoder"
_PENALTY = 1e-3  # ρ of an FIR inverse
_DELAY = 64  # samples, with which the position reaches the law
_LINEAR, _FEWEST = 0.8, 3  # phase [rad] up to which the lag is fitted to points, and the least number of these
_STATIC = 100.0  # gain, above which or below whose inverse the units differ from those of the cell
_GAINS = (0.7, 0.5, 0.3, 0.2, 0.1)  # that a refused Q is tried with
_POINTS = 4096  # per revolution, at which an expected error is evaluated
_ORDERS = 1000  # highest
_TURN = 2.0 * math.pi
_MAKE = "ilc.frequency_response(...)"


@dataclass(frozen=True, repr=False)
class Response:
    """Response of a drive, from its command to its position.

    Attributes:
        points: the points, see `lathe_rc.analysis.frequency_response.FrequencyResponse`.
        model: model of the drive from `fit`; None before.
        unresolved: resonances of the model that lie between the points, in words: their height rests on the model.
    """

    points: FrequencyResponse
    model: ModalDrive | None = None
    unresolved: tuple[str, ...] = ()

    def fit(self, modes: int | None = None) -> "Response":
        """Return the response with a model of the drive fitted to the points (docs/drives.md#measured-drives).

        Args:
            modes: number of modes; None: as many as the points determine.

        Raises:
            InputError, LatheError: the points do not determine a model.
        """
        wanted = None if modes is None else given.whole("modes", modes, 0, MOST_MODES)
        found = fit(ResponseData(self.points), modes=wanted)
        return replace(self, model=found.drive, unresolved=found.unresolved)

    def __repr__(self) -> str:
        """Return the range of the points, and the frequencies of the model."""
        low, high = self.points.frequency[[0, -1]] / _TURN
        told = f"{self.points.frequency.size} points from {low:.4g} to {high:.4g} Hz"
        if self.model is None:
            return f"<Response of {told}, no model>"
        places = ", ".join(f"{mode / _TURN:.4g}" for mode, *_ in self.model.sections)
        model = f"model of {places} Hz and a delay of {self.model.delay * 1e6:.3g} µs"
        return f"<Response of {'; '.join((told, model, *self.unresolved))}>"

    @cached_property
    def lag(self) -> float:
        """Lag at low frequencies [s]: that of the model, or of the phase φ = -lag·ω + c·ω³ of the lowest points."""
        if self.model is not None:
            return float(-np.angle(self.model.response(np.ones(1))[0]))
        phase = np.unwrap(np.angle(self.points.value))
        low = np.arange(phase.size) < max(int(np.argmax(np.abs(phase) > _LINEAR)), _FEWEST)
        frequency = self.points.frequency[low]
        fitted = np.linalg.lstsq(np.stack([frequency, frequency**3], axis=1) / frequency[-1], phase[low], rcond=None)[0]
        return float(-fitted[0] / frequency[-1])

    def __call__(self, frequency: Array) -> Complex:
        """Return the response at frequencies [rad/s], shape (n,).

        Without a model it is 0 above the points, and below them the lowest point with the lag.
        """
        if self.model is not None:
            return self.model.response(frequency)
        lowest = np.abs(self.points.value[0]) * np.exp(-1j * frequency * self.lag)
        outside = np.where(frequency < self.points.frequency[0], lowest, 0.0)
        return MeasuredDrive(self.points.frequency, self.points.value, lambda _: outside)(frequency)

    @property
    def drives(self) -> list[Any]:
        """Responses that a loop must bear: the points, and the model if there is one."""
        points = MeasuredDrive(self.points.frequency, self.points.value, self)
        return [points] if self.model is None else [points, self.model.response]

    @property
    def known(self) -> Known:
        """Knowledge of the drive for laws."""
        model = self.model
        return Known(self, model.delay if model else 0.0, self.points, model.mode_frequency if model else ())


def frequency_response(
    of: object,
    value: npt.ArrayLike | None = None,
    *,
    coherence: npt.ArrayLike | None = None,
    averages: float | None = None,
) -> Response:
    """Return a frequency response from arrays, a file, or a system.

    Args:
        of: frequencies [Hz], shape (n,), with ``value``; or a file, as for ``lathe fit drive``; or
            ``control.FrequencyResponseData``; or a system with one input and one output: ``scipy.signal.lti`` or
            ``dlti``, or a system of python-control, with the frequencies [Hz] as ``value``.
        value: complex response, shape (n,); for a system the frequencies [Hz].
        coherence: γ² of each point, shape (n,); None: unknown.
        averages: number of averages of the coherence; None: 16.

    Raises:
        InputError: the values are no response.
    """
    if isinstance(of, str | os.PathLike):
        return Response(of_measurement(measurement_file.read(Path(of)), averages))
    if hasattr(of, "omega"):
        frequency, found = np.asarray(of.omega, float), np.ravel(getattr(of, "frdata", ()))
        if found.size != frequency.size:
            raise InputError("a response of several inputs or outputs; allowed: one of each")
    elif isinstance(of, scipy.signal.lti | scipy.signal.dlti) or callable(of):
        if value is None:
            raise InputError("a system without frequencies; allowed: frequency_response(system, frequencies in Hz)")
        frequency = _TURN * given.array("frequencies", value)
        found = _of_system(of, frequency)
    else:
        frequency = _TURN * given.array("frequencies", of)
        found = given.complex_array("response", value, size=frequency.size)
    if coherence is None:
        return Response(FrequencyResponse(frequency, given.complex_array("response", found, size=frequency.size)))
    known = given.array("coherence", coherence, size=frequency.size)
    if not np.all((known > 0.0) & (known <= 1.0)):
        raise InputError(f"coherence of {known.min():g} to {known.max():g}; allowed: above 0 to 1")
    count = given.number("averages", AVERAGES if averages is None else averages, 1.0)
    return Response(FrequencyResponse(frequency, found, deviation_of(known, count), known, count))


def _of_system(of: Any, frequency: Array) -> Complex:
    step = getattr(of, "dt", None) or 0.0  # 0 and None: continuous
    if step is True or step * frequency.max() > math.pi:
        raise InputError(
            f"frequencies up to {frequency.max() / _TURN:.4g} Hz with dt = {step}; allowed: up to half of 1/dt"
        )
    try:
        if isinstance(of, scipy.signal.dlti):
            return np.asarray(scipy.signal.dfreqresp(of, frequency * step)[1])
        if isinstance(of, scipy.signal.lti):
            return np.asarray(scipy.signal.freqresp(of, frequency)[1])
        p = 1j * frequency
        found = np.asarray(of(np.exp(p * step) if step else p), complex)
    except (TypeError, ValueError) as error:
        raise InputError(f"the system gives no response ({error}); allowed: one input and one output") from None
    if found.size != frequency.size:
        raise InputError("a system of several inputs or outputs; allowed: one of each")
    return found.ravel()


def learning_filter(response: Response, kind: Filter = "zero-phase", *, gain: float = 1.0) -> Values:
    """Return a learning filter γL as parameters of ``learning_controller`` (docs/learning.md#laws).

    Args:
        response: response of the drive.
        kind: ``zero-phase``: an FIR filter conj(G)/(|G|² + ρ), also for drives that are not minimum-phase, with a small
            gain where a resonance is narrow; ``lead``: the lag at low frequencies, for drives with little resonance;
            ``notch``: a lead with zero-phase notches at the modes of a fitted model; ``inverse``: delay and second
            order of a fitted model, without its modes, at which it needs a small gain.
        gain: γ. Where Q is 0, the loop still needs |γZ| < 1.

    Raises:
        InputError: the kind needs a fitted model.
    """
    known = given.instance("response", response, Response, _MAKE).known
    static = float(np.abs(response(np.ones(1))[0]))
    if not 1.0 / _STATIC <= static <= _STATIC:
        raise InputError(
            f"a response with a static gain of {static:.3g}; allowed: {1.0 / _STATIC:g} to {_STATIC:g}: position over "
            f"command, both in metres (such as H / {static:.3g})"
        )
    chosen = {"learning_gain": given.number("gain", gain, 0.0, 2.0, above=True)}
    if kind in ("inverse", "notch") and response.model is None:
        raise InputError(f"learning filter {kind!r} of a response without a model; allowed: response = response.fit()")
    if kind == "notch" and not known.resonances:
        raise InputError("learning filter 'notch' of a model without modes; allowed: lead, inverse, zero-phase")
    if kind == "lead":
        return {**chosen, "lead_time": response.lag}
    if kind == "inverse":
        return {**chosen, "correction": "second_order_inverse", "lead_time": max(known.delay, 0.1 * response.lag)}
    if kind == "zero-phase":
        return {**chosen, "correction": "fir", **known.inverse(_PENALTY, measured=response.model is None)}
    if kind == "notch":
        return {**chosen, "correction": "fir", **known.notched(response.lag)}
    raise InputError(f"learning filter {kind!r}; allowed: lead, inverse, zero-phase, notch")


def q_filter(
    response: Response, learning: Values, *, margin: float = 0.3, rpm: float = 1000.0, speed_deviation: float = 0.0
) -> Values:
    """Return the widest flat Q with which the loop keeps a drive margin, as parameters of ``learning_controller``.

    The filters are those that ``lathe design`` tries, so the loop may have more than the margin. Their ripple in the
    pass band decides what error of the form is left. Without a model of the drive, Q is 0 above the points.

    Args:
        response: response of the drive.
        learning: learning filter, see `learning_filter`.
        margin: least drive margin [1].
        rpm: speed of the spindle [rev/min].
        speed_deviation: largest deviation over that speed [1], within which the loop keeps the margin.

    Returns:
        The filter, ``q_pass`` and ``q_stop`` in rad/s.

    Raises:
        InputError: an argument is wrong, or no Q has the margin.
    """
    least = given.number("margin", margin, 0.0, 1.0)
    highest = given.instance("response", response, Response, _MAKE).points.frequency[-1]
    filters = sorted(LAWS["lead, flat Q"].filters, key=lambda each: -_number(each["q_pass"]))
    if response.model is None:  # nothing is known above the points
        filters = [each for each in filters if _number(each["q_stop"]) <= highest]
    if not filters:
        needed = min(_number(each["q_stop"]) for each in LAWS["lead, flat Q"].filters)
        raise InputError(
            f"Q of a response without a model, with points up to {highest / _TURN:.4g} Hz; allowed: up to "
            f"{needed / _TURN:.4g} Hz or more, or response = response.fit()"
        )
    speeds = rpm, speed_deviation
    found, best = _widest(response, learning, filters, least, *speeds)
    if found is None:
        smaller = (each for each in _GAINS if each < _number(learning.get("learning_gain", 1.0)))
        cures = (
            f"gain={gain:g} or "
            for gain in smaller
            if _widest(response, {**learning, "learning_gain": gain}, filters, least, *speeds)[0]
        )
        raise InputError(
            f"Q with a drive margin of {margin:g}; allowed: up to {best.error:.3g}, which {best.frequency:.4g} Hz "
            f"limits (more by {next(cures, '')}another filter)"
        )
    return found


def _widest(
    response: Response, learning: Values, filters: Sequence[Values], least: float, rpm: float, speed_deviation: float
) -> tuple[Values | None, "Margin"]:
    """Return the first filter with which a loop has a margin, or None, and the largest margin found.

    Raises:
        InputError: an argument is wrong, or no filter fits into the memory.
    """
    margins, refused = list[Margin](), None
    for values in filters:
        made: Values = {"q_filter": "fir", **values}
        try:
            margins.append(Loop(response, learning, made, rpm, speed_deviation).margin())
        except InputError as error:  # such as a filter that does not fit into the memory
            refused = error
            continue
        if margins[-1].error >= least:
            return made, margins[-1]
    if not margins and refused:
        raise refused
    return None, max(margins, key=lambda each: each.error)


def _number(value: Value) -> float:
    assert isinstance(value, float | int)
    return float(value)


@dataclass(frozen=True)
class Part:
    """Form of a part at a speed.

    Attributes:
        harmonics: amplitude by waves per revolution [m].
        rpm: speed of the spindle [rev/min].
        tolerance: largest form error of a good part [m].
    """

    harmonics: Mapping[int, float]
    rpm: float
    tolerance: float


def reference(harmonics: Mapping[int, float], rpm: float = 1000.0, *, tolerance: float = 2e-6) -> Part:
    """Return a form with amplitudes [m] by waves per revolution, at a speed [rev/min], with a tolerance [m].

    Raises:
        InputError: an order is no whole number from 1 on, or an amplitude, the speed or the tolerance is none.
    """
    if not isinstance(harmonics, Mapping) or not harmonics:
        raise InputError(f"harmonics = {harmonics!r:.60}; allowed: {{ORDER: AMPLITUDE, ...}}, such as {{2: 100e-6}}")
    found = {
        given.whole("order", order, 1, _ORDERS): given.number(f"amplitude of {order} waves", size, -1.0, 1.0)
        for order, size in harmonics.items()
    }
    speed = given.number("rpm", rpm, 0.0, above=True)
    return Part(found, speed, given.number("tolerance", tolerance, 0.0, above=True))


class Margin(NamedTuple):
    """Smallest error of a response with which learning diverges, and its ground.

    Attributes:
        error: error relative to the response, at one frequency, of any phase [1].
        frequency: where it occurs [Hz].
        points: lowest and highest frequency of the points within the grid of the memory [Hz].
        beyond: magnitude of the drive above the points up to which learning converges there whatever its phase; None
            with a model, whose margin is evaluated there.
        speeds: lowest and highest speed at which it is evaluated [rev/min].
        unresolved: see `Response`.
    """

    error: float
    frequency: float
    points: tuple[float, float]
    beyond: float | None
    speeds: tuple[float, float]
    unresolved: tuple[str, ...]

    def __str__(self) -> str:
        """Return the margin, where it is, and what it is known from."""
        low, high = self.points
        speeds = " to ".join(f"{speed:.5g}" for speed in dict.fromkeys(self.speeds))
        rest = " and the model"
        if self.beyond is not None:
            rest = f"; between unknown, beyond too: where the drive moves less than {self.beyond:.3g}, it converges"
        ground = f"{speeds} rpm, from points of {low:.4g} to {high:.4g} Hz{rest}"
        return "; ".join((f"{self.error:.4g} at {self.frequency:.4g} Hz, for {ground}", *self.unresolved))


class Expected(NamedTuple):
    """Form error at constant speed, without noise.

    Attributes:
        rms: root mean square over a revolution [m].
        largest: largest magnitude [m].
    """

    rms: float
    largest: float


@dataclass(frozen=True)
class Loop:
    """Learning loop over the spindle angle: M = Q·M + γ·δ with the command L·M.

    Args:
        response: response of the drive.
        learning: learning filter, see `learning_filter`.
        q: Q, see `q_filter`, or other parameters of ``learning_controller``.
        rpm: nominal speed, which determines the grid of the memory [rev/min].
        speed_deviation: largest deviation over that speed [1]; the margin is the least within it.
    """

    response: Response
    learning: Values
    q: Values
    rpm: float = 1000.0
    speed_deviation: float = 0.0

    def __post_init__(self) -> None:
        """Check the arguments."""
        given.instance("response", self.response, Response, _MAKE)
        given.instance("learning", self.learning, dict, "ilc.learning_filter(...)")
        given.instance("q", self.q, dict, "ilc.q_filter(...)")
        given.number("rpm", self.rpm, 0.0, above=True)
        given.number("speed_deviation", self.speed_deviation, 0.0, 0.9)

    def _check(self, part: Part) -> None:
        given.instance("part", part, Part, "ilc.reference(...)")
        if part.rpm != self.rpm:
            raise InputError(f"a part at {part.rpm:g} rpm in a loop at {self.rpm:g} rpm; allowed: equal speeds")

    @property
    def _speed(self) -> float:
        return self.rpm * _TURN / 60.0

    @cached_property
    def _stage(self) -> LearningController:
        cell = Cell(self._scenario(reference({2: 1e-6}, self.rpm), {}, 2).nodes)
        stage = cell.stages[_NODE]
        assert isinstance(stage, LearningController), "it is that of piston"
        return stage

    def scenario(
        self,
        part: Part,
        drive: Response | None = None,
        *,
        trials: int = 40,
        noise_rms: float = 0.0,
        speed_deviation: tuple[float, float] | None = None,
        seed: int = 1,
    ) -> Scenario:
        """Return the cell ``piston`` with this loop.

        Args:
            part: the form and the speed, which is that of the loop.
            drive: drive with a model; None: that of the loop, which may have been designed for another one.
            trials: number of revolutions.
            noise_rms: noise of the position sensor [m].
            speed_deviation: amplitude over the nominal speed, and frequency [rad/s]; None: constant speed. Beyond the
                deviation of the loop its margin is another one, see `Run.margin`.
            seed: seed of the noise.

        Raises:
            InputError: the drive has no model, or a value is out of its range.
        """
        self._check(part)
        model = given.instance("drive", drive or self.response, Response, _MAKE).model
        if model is None:
            raise InputError("a drive without a model in a cell; allowed: drive = response.fit()")
        values = cast("Values", model.parameters())
        return self._scenario(part, values, trials, noise_rms, speed_deviation, seed)

    def _scenario(
        self,
        part: Part,
        drive: Values,
        trials: int,
        noise_rms: float = 0.0,
        speed_deviation: tuple[float, float] | None = None,
        seed: int = 1,
    ) -> Scenario:
        swing = () if speed_deviation is None else given.array("speed_deviation", speed_deviation, size=2).tolist()
        harmonics: Values = {"harmonic_order": [*part.harmonics], "harmonic_amplitude": [*part.harmonics.values()]}
        nodes: dict[str, Values] = {
            _SPINDLE: {
                "revolutions": trials,
                "deviation_amplitude": [*swing[:1]],
                "deviation_frequency": [*swing[1:]],
            },
            _NODE: {"feedback_delay": _DELAY, **self.learning, **self.q},
            _DRIVE: {"noise_rms": noise_rms, **drive},
            _TOOL: {"profile": "harmonics", "profile_file": "", "tolerance": part.tolerance, **harmonics},
        }
        values = {f"{node}.{name}": value for node, table in nodes.items() for name, value in table.items()}
        return load("piston").varied({"nominal_rpm": part.rpm, "seed": seed, **values})

    def to_scenario(
        self, path: str | os.PathLike[str], part: Part, drive: Response | None = None, **conditions: Any
    ) -> None:
        """Write the cell with this loop as a scenario, for ``lathe run`` and all other commands.

        The points of the drive are written beside it, as ``NAME.points.csv``, so that the margin of the cell has the
        same ground.

        Args:
            path: file to write.
            part: see `scenario`.
            drive: see `scenario`.
            conditions: trials, noise_rms, speed_deviation and seed, see `scenario`.

        Raises:
            InputError: see `scenario`; or the file cannot be written.
        """
        cell = self.scenario(part, drive, **conditions)
        try:
            points = Path(path).absolute().with_suffix(".points.csv")
            write_states(points, [(drive or self.response).points], "points of the drive")
            cell = cell.varied({f"{_DRIVE}.response_file": str(points)})
            Path(path).write_text(cell.to_yaml(given=True), encoding="utf-8")
        except (OSError, TypeError, ValueError) as error:
            raise InputError(f"{path!r:.80}: cannot be written ({error})") from None

    def margin(self) -> Margin:
        """Return the smallest relative error of the response, at one frequency, with which learning diverges.

        It is evaluated at all points, and with the model if there is one, at the nominal speed and at the ends of the
        deviation (docs/learning.md).

        Raises:
            InputError: no point is among the frequencies at which the law acts.
        """
        points, swing = self.response.points.frequency, self._speed * self.speed_deviation
        speeds = self._stage.checked_speeds(self._speed - swing, self._speed + swing)
        found = [self._stage.drive_margin(drive, each) for drive in self.response.drives for each in speeds]
        least = min(each for each in found if each is not None)
        speed = least.speed
        highest = self._stage.highest_waves(speed) * speed
        within = points[points <= highest]
        beyond = None
        if self.response.model is None:
            waves = np.linspace(within[-1], highest, _POINTS) / speed
            loop = self._stage.loop(np.ones_like)
            kept = np.abs(loop.q.response(_TURN * waves / loop.grid))
            beyond = float(
                np.min((1.0 - kept) / np.maximum(np.abs(loop.gain * loop.corrected_drive(waves, speed)), 1e-9))
            )
        band = float(within[0] / _TURN), float(within[-1] / _TURN)
        told = self.rpm * (1.0 - self.speed_deviation), self.rpm * (1.0 + self.speed_deviation)
        return Margin(least.error, least.waves * speed / _TURN, band, beyond, told, self.response.unresolved)

    def supremum(self) -> tuple[float, float]:
        """Return the largest |Q - γZ| over all frequencies, and where it is [Hz]; learning converges below 1."""
        factor, waves = self._stage.loop(self.response).worst(self._speed)
        return factor, waves * self._speed / _TURN

    def factor(self, waves: npt.ArrayLike) -> Complex:
        """Return the factor Q - γZ of a revolution at ``waves`` per revolution, shape (n,); it converges below 1."""
        (factor,) = self._stage.factors(self.response, given.array("waves", np.atleast_1d(waves)), self._speed)
        return np.asarray(factor)

    def expected_errors(self, part: Part, revolutions: int) -> Array:
        """Return the RMS form error of each revolution at constant speed, full gain from the first on, shape (n,) [m].

        Each harmonic goes from its amplitude to its limit (see `asymptotic_error`) by Q - γZ in a revolution.
        """
        orders, limit = self._limit(part)
        factor = self.factor(orders)
        excess = np.array([*part.harmonics.values()]) - limit
        errors = [limit + factor**k * excess for k in range(given.whole("revolutions", revolutions, 1, 1_000_000))]
        return np.array([np.sqrt(0.5 * np.sum(np.abs(each) ** 2)) for each in errors])

    def asymptotic_error(self, part: Part) -> Expected:
        """Return the form error that learning leaves at constant speed: (1 - Q)/(γZ + 1 - Q) of each harmonic."""
        orders, limit = self._limit(part)
        error = (np.exp(1j * np.outer(np.arange(_POINTS) * _TURN / _POINTS, orders)) @ limit).real
        return Expected(float(np.sqrt(np.mean(error**2))), float(np.abs(error).max()))

    def _limit(self, part: Part) -> tuple[Array, Complex]:
        """Return the harmonics of a part, and the error that learning leaves of each, shape (n,) each."""
        self._check(part)
        orders = np.array([*part.harmonics], float)
        ratio = self._stage.loop(self.response).steady_error(orders, self._speed)
        return orders, ratio * np.array([*part.harmonics.values()])

    def simulate(self, drive: Response, part: Part, **conditions: Any) -> "Run":
        """Run the cell with a drive.

        Args:
            drive: see `scenario`.
            part: see `scenario`.
            conditions: trials, noise_rms, speed_deviation and seed, see `scenario`.

        Raises:
            InputError: see `scenario`; or learning would diverge.
        """
        return Run(run(self.scenario(part, drive, **conditions)), part)


@dataclass(frozen=True)
class Run:
    """Run of a loop.

    Attributes:
        result: the run, with all signals.
        part: its form.
    """

    result: Result
    part: Part

    @property
    def errors(self) -> Array:
        """RMS form error of each revolution [m], shape (revolutions,)."""
        return self.result.errors.rms

    @property
    def margin(self) -> DriveMargin:
        """Drive margin of the cell, at all speeds of the run and with the model of its drive."""
        return self.result.drive_margins[_NODE]

    def plot_convergence(self, loop: Loop | None = None) -> "RunFigure":
        """Return a figure of the RMS form error by revolution, with the one expected at constant speed of a loop."""
        from lathe_rc.drawing.form import RunFigure

        figure = RunFigure(figsize=(6.0, 3.6), layout="constrained")
        axes = figure.subplots()
        turns = np.arange(1, self.errors.size + 1)
        axes.semilogy(turns, self.errors * 1e6, ".-", label="run")
        if loop is not None:
            given.instance("loop", loop, Loop, "ilc.Loop(...)")
            expected = loop.expected_errors(self.part, turns.size)
            axes.semilogy(turns, expected * 1e6, label="expected at constant speed")
            limit = loop.asymptotic_error(self.part).rms
            axes.axhline(limit * 1e6, ls=":", color="gray", label="limit at constant speed")
        axes.set(xlabel="revolution", ylabel="form error, RMS [µm]")
        axes.legend()
        axes.grid(alpha=0.3)
        return figure
