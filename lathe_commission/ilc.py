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
    >>> G = ilc.frequency_response(f, H * np.exp(-2j * np.pi * f * 0.36e-3))
    >>> L = ilc.learning_filter(G, "zero-phase")
    >>> Q = ilc.q_filter(G, L, margin=0.3)
    >>> loop, part = ilc.Loop(G, L, Q), ilc.reference({2: 100e-6}, rpm=1000)
    >>> loop.margin().error > 0.3
    True
    >>> run = loop.simulate(G.fit(), part, trials=12)
    >>> bool(run.errors[-1] < 0.01 * run.errors[0])
    True
"""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, cast

import numpy as np
import numpy.typing as npt
import scipy

from lathe_commission.design import LAWS, Known
from lathe_commission.modal_fit import ResponseData, fit
from lathe_rc.analysis.frequency_response import AVERAGES, FrequencyResponse, deviation_of, of_measurement
from lathe_rc.analysis.measured_drive import MeasuredDrive
from lathe_rc.analysis.modal_drive import ModalDrive
from lathe_rc.arrays import Array, Complex
from lathe_rc.cell.parameters import Value, Values
from lathe_rc.cell.scenario import Scenario, load
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError
from lathe_rc.harness.result import Result
from lathe_rc.harness.runner import run
from lathe_rc.signals import measurement_file
from lathe_rc.stages.learning.learning_controller import LearningController

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
_POINTS = 4096  # per revolution, at which an expected error is evaluated
_TURN = 2.0 * math.pi


@dataclass(frozen=True)
class Response:
    """Response of a drive, from its command to its position.

    Attributes:
        points: the points, see `lathe_rc.analysis.frequency_response.FrequencyResponse`.
        model: model of the drive from `fit`; None before.
    """

    points: FrequencyResponse
    model: ModalDrive | None = None

    def fit(self, modes: int | None = None) -> "Response":
        """Return the response with a model of the drive fitted to the points (docs/drives.md#measured-drives).

        Args:
            modes: number of modes; None: as many as the points determine.

        Raises:
            InputError, LatheError: the points do not determine a model.
        """
        return replace(self, model=fit(ResponseData(self.points), modes=modes).drive)

    @cached_property
    def lag(self) -> float:
        """Lag at low frequencies [s]: that of the model, or of the points below three times the lowest frequency."""
        if self.model is not None:
            return float(-np.angle(self.model.response(np.ones(1))[0]))
        low = self.points.frequency <= 3.0 * self.points.frequency[0]
        phase = np.unwrap(np.angle(self.points.value[low]))
        return float(-np.median(phase / self.points.frequency[low]))

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
        """What a law may know of the drive."""
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
        return Response(of_measurement(measurement_file.read(Path(of), {}, ".csv"), averages))
    if hasattr(of, "omega"):
        frequency, found = np.asarray(of.omega, float), np.asarray(getattr(of, "frdata", None), complex).ravel()
    elif isinstance(of, scipy.signal.lti | scipy.signal.dlti) or callable(of):
        if value is None:
            raise InputError("a system without frequencies; allowed: frequency_response(system, frequencies in Hz)")
        frequency = _TURN * np.asarray(value, float)
        found = _of_system(of, frequency)
    else:
        frequency, found = _TURN * np.asarray(of, float), np.asarray(value, complex)
    if frequency.shape != found.shape or frequency.ndim != 1:
        raise InputError(f"frequency response: shapes {frequency.shape} and {found.shape}; allowed: equal ones, (n,)")
    if not np.isfinite(found).all():
        raise InputError(f"frequency response: {found[~np.isfinite(found)][0]}; allowed: finite numbers")
    known = None if coherence is None else np.asarray(coherence, float)
    count = AVERAGES if averages is None else averages
    deviation = None if known is None else deviation_of(known, count)
    return Response(FrequencyResponse(frequency, found, deviation, known, 0.0 if known is None else count))


def _of_system(of: Any, frequency: Array) -> Complex:
    step: float = getattr(of, "dt", None) or 0.0  # 0 and None: continuous
    if isinstance(of, scipy.signal.dlti):
        return np.asarray(scipy.signal.dfreqresp(of, frequency * step)[1])
    if isinstance(of, scipy.signal.lti):
        return np.asarray(scipy.signal.freqresp(of, frequency)[1])
    p = 1j * frequency
    return np.asarray(of(np.exp(p * step) if step else p), complex).ravel()


def learning_filter(response: Response, kind: Filter = "zero-phase", *, gain: float = 1.0) -> Values:
    """Return a learning filter γL as parameters of ``learning_controller`` (docs/learning.md#laws).

    Args:
        response: response of the drive.
        kind: ``lead``: the lag at low frequencies; ``inverse``: delay and second order of a fitted model;
            ``zero-phase``: an FIR filter conj(G)/(|G|² + ρ), stable also for drives that are not minimum-phase;
            ``notch``: a lead with zero-phase notches at the modes of a fitted model.
        gain: γ.

    Raises:
        InputError: the kind needs a fitted model.
    """
    known, chosen = response.known, {"learning_gain": gain}
    if kind in ("inverse", "notch") and response.model is None:
        raise InputError(f"learning filter {kind!r} of a response without a model; allowed: of response.fit()")
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


def q_filter(response: Response, learning: Values, *, margin: float = 0.3, rpm: float = 1000.0) -> Values:
    """Return the widest flat Q with which the loop keeps a drive margin, as parameters of ``learning_controller``.

    Without a model of the drive, Q is 0 above the points.

    Args:
        response: response of the drive.
        learning: learning filter, see `learning_filter`.
        margin: least drive margin [1].
        rpm: speed of the spindle [rev/min].

    Raises:
        InputError: no Q has the margin.
    """
    found = []
    for values in sorted(LAWS["lead, flat Q"].filters, key=lambda each: -_number(each["q_pass"])):
        beyond = _number(values["q_stop"]) > response.points.frequency[-1]
        if beyond and response.model is None:
            continue  # nothing is known there
        made: Values = {"q_filter": "fir", **values}
        try:
            found.append(Loop(response, learning, made, rpm).margin())
        except InputError:  # the filter does not fit into the memory
            continue
        if found[-1].error >= margin:
            return made
    most = max((each.error for each in found), default=0.0)
    raise InputError(f"Q with a drive margin of {margin:g}; allowed: up to {most:.3g} (another learning filter or rpm)")


def _number(value: Value) -> float:
    assert isinstance(value, float | int)
    return float(value)


@dataclass(frozen=True)
class Part:
    """Form of a part at a speed.

    Attributes:
        harmonics: amplitude by waves per revolution [m].
        rpm: speed of the spindle [rev/min].
    """

    harmonics: Mapping[int, float]
    rpm: float


def reference(harmonics: Mapping[int, float], rpm: float = 1000.0) -> Part:
    """Return a form with amplitudes [m] by waves per revolution, at a speed [rev/min]."""
    return Part(dict(harmonics), rpm)


class Margin(NamedTuple):
    """Smallest error of a response with which learning diverges, and its ground.

    Attributes:
        error: error relative to the response, at one frequency, of any phase [1].
        frequency: where it occurs [Hz].
        points: lowest and highest frequency of the points that the law acts on [Hz]; nothing is known beyond unless
            there is a model.
        model: whether the response has a model, with which the margin is evaluated up to ``highest``.
        highest: highest frequency at which the law acts [Hz].
    """

    error: float
    frequency: float
    points: tuple[float, float]
    model: bool
    highest: float

    def __str__(self) -> str:
        """Return the margin, where it is, and what it is known from."""
        beyond = "beyond them by the model" if self.model else "beyond them unknown"
        low, high = self.points
        return (
            f"{self.error:.4g} at {self.frequency:.3g} Hz, from points of {low:.4g} to {high:.4g} Hz, {beyond} "
            f"(the law acts up to {self.highest:.4g} Hz)"
        )


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
        rpm: speed at which margin and factor are evaluated [rev/min].
    """

    response: Response
    learning: Values
    q: Values
    rpm: float = 1000.0

    @cached_property
    def _stage(self) -> LearningController:
        cell = Cell(self.scenario(reference({2: 1e-6}, self.rpm), trials=2).nodes)
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
            part: the form and the speed.
            drive: drive with a model; None: that of the loop, or without a model the drive of ``piston``.
            trials: number of revolutions.
            noise_rms: noise of the position sensor [m].
            speed_deviation: amplitude over the nominal speed, and frequency [rad/s]; None: constant speed.
            seed: seed of the noise.

        Raises:
            InputError: a value is out of its range.
        """
        model = (drive or self.response).model
        amplitude, frequency = ([each] for each in speed_deviation) if speed_deviation else ([], [])
        harmonics: Values = {"harmonic_order": [*part.harmonics], "harmonic_amplitude": [*part.harmonics.values()]}
        nodes: dict[str, Values] = {
            _SPINDLE: {"revolutions": trials, "deviation_amplitude": amplitude, "deviation_frequency": frequency},
            _NODE: {"feedback_delay": _DELAY, **self.learning, **self.q},
            _DRIVE: {"noise_rms": noise_rms, **(cast("Values", model.parameters()) if model else {})},
            _TOOL: {"profile": "harmonics", "profile_file": "", **harmonics},
        }
        values = {f"{node}.{name}": value for node, table in nodes.items() for name, value in table.items()}
        return load("piston").varied({"nominal_rpm": part.rpm, "seed": seed, **values})

    def to_scenario(self, path: str | os.PathLike[str], part: Part, drive: Response | None = None) -> None:
        """Write the cell with this loop as a scenario (see `scenario`), for ``lathe run`` and all other commands.

        Raises:
            InputError: a value is out of its range.
        """
        Path(path).write_text(self.scenario(part, drive).to_yaml(given=True), encoding="utf-8")

    def margin(self) -> Margin:
        """Return the smallest relative error of the response, at one frequency, with which learning diverges.

        It is evaluated at all points, and with the model if there is one (docs/learning.md).

        Raises:
            InputError: no point is among the frequencies at which the law acts.
        """
        speed = self.rpm * _TURN / 60.0
        found = [self._stage.drive_margin(drive, speed) for drive in self.response.drives]
        least = min(each for each in found if each is not None)
        frequency, highest = self.response.points.frequency / _TURN, self._stage.highest_waves(speed) * speed / _TURN
        points = float(frequency[0]), float(frequency[frequency <= highest][-1])
        where = least.waves * speed / _TURN
        return Margin(least.error, where, points, self.response.model is not None, highest)

    def factor(self, waves: npt.ArrayLike) -> Complex:
        """Return the factor Q - γZ of a revolution at ``waves`` per revolution, shape (n,); it converges below 1."""
        (factor,) = self._stage.factors(self.response, np.asarray(waves, float), self.rpm * _TURN / 60.0)
        return np.asarray(factor)

    def expected_errors(self, part: Part, revolutions: int) -> Array:
        """Return the RMS form error of each revolution at constant speed, full gain from the first on, shape (n,) [m].

        Each harmonic goes from its amplitude to its limit (see `asymptotic_error`) by Q - γZ in a revolution.
        """
        orders, limit = self._limit(part)
        factor = self.factor(orders)
        excess = np.array([*part.harmonics.values()]) - limit
        errors = [limit + factor**k * excess for k in range(revolutions)]
        return np.array([np.sqrt(0.5 * np.sum(np.abs(each) ** 2)) for each in errors])

    def asymptotic_error(self, part: Part) -> Expected:
        """Return the form error that learning leaves at constant speed: (1 - Q)/(γZ + 1 - Q) of each harmonic."""
        orders, limit = self._limit(part)
        error = (np.exp(1j * np.outer(np.arange(_POINTS) * _TURN / _POINTS, orders)) @ limit).real
        return Expected(float(np.sqrt(np.mean(error**2))), float(np.abs(error).max()))

    def _limit(self, part: Part) -> tuple[Array, Complex]:
        """Return the harmonics of a part, and the error that learning leaves of each, shape (n,) each."""
        if part.rpm != self.rpm:
            raise InputError(f"a part at {part.rpm:g} rpm in a loop at {self.rpm:g} rpm; allowed: equal speeds")
        orders = np.array([*part.harmonics], float)
        ratio = self._stage.loop(self.response).steady_error(orders, self.rpm * _TURN / 60.0)
        return orders, ratio * np.array([*part.harmonics.values()])

    def simulate(
        self,
        drive: Response,
        part: Part,
        *,
        trials: int = 40,
        noise_rms: float = 0.0,
        speed_deviation: tuple[float, float] | None = None,
        seed: int = 1,
    ) -> "Run":
        """Run the cell with a drive (see `scenario`); the loop may have been designed for another one.

        Raises:
            InputError: the drive has no model, a value is out of its range, or learning would diverge.
        """
        if drive.model is None:
            raise InputError("simulate with a response without a model; allowed: response.fit()")
        made = self.scenario(
            part, drive, trials=trials, noise_rms=noise_rms, speed_deviation=speed_deviation, seed=seed
        )
        return Run(run(made), part)


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

    def plot_convergence(self, loop: Loop | None = None) -> "RunFigure":
        """Return a figure of the RMS form error by revolution, with the one expected at constant speed of a loop."""
        from lathe_rc.drawing.form import RunFigure

        figure = RunFigure(figsize=(6.0, 3.6), layout="constrained")
        axes = figure.subplots()
        turns = np.arange(1, self.errors.size + 1)
        axes.semilogy(turns, self.errors * 1e6, ".-", label="run")
        if loop is not None:
            expected = loop.expected_errors(self.part, turns.size)
            axes.semilogy(turns, expected * 1e6, label="expected at constant speed")
            limit = loop.asymptotic_error(self.part).rms
            axes.axhline(limit * 1e6, ls=":", color="gray", label="limit at constant speed")
        axes.set(xlabel="revolution", ylabel="form error, RMS [µm]")
        axes.legend()
        axes.grid(alpha=0.3)
        return figure


class Trials:
    """Learning over time, in trials of n samples that begin in the same state: u' = Q(u + L·e), e = r - G·u.

    Args:
        system: impulse response, shape (n,) or more; or a discrete system (``scipy.signal.dlti``, or a StateSpace of
            python-control with ``dt``), from the command to the position.
        samples: n.

    Attributes:
        plant: lifted plant G, lower triangular, shape (n, n).

    Raises:
        InputError: the system has no sampling step, or its impulse response is shorter than a trial.
    """

    def __init__(self, system: object, samples: int) -> None:
        if isinstance(system, scipy.signal.dlti) or hasattr(system, "A"):
            step = getattr(system, "dt", None)
            if not step:
                raise InputError("a continuous system; allowed: a discrete one, with dt (system.to_discrete)")
            state: Any = system.to_ss() if isinstance(system, scipy.signal.dlti) else system
            _, (impulse,) = scipy.signal.dimpulse((state.A, state.B, state.C, state.D, step), n=samples)
        else:
            impulse = np.asarray(system, float)
        found: Array = np.ravel(impulse)
        if found.size < samples:
            raise InputError(f"impulse response of {found.size} samples; allowed: at least the {samples} of a trial")
        self.plant: Array = np.asarray(scipy.linalg.toeplitz(found[:samples], np.zeros(samples)))

    def norm_optimal(
        self, *, effort: float = 0.0, change: float = 0.0, basis: Array | None = None
    ) -> tuple[Array, Array]:
        """Return Q and L, shape (n, n), with the least |e'|² + ``effort``·|u'|² + ``change``·|u' - u|².

        Gunnarsson and Norrlöf 2001 (Automatica 37); with a basis Ψ, shape (n, k), the command is Ψ·θ (van de Wijdeven
        and Bosgra 2010, Int. J. Control 83). Plants that are not minimum-phase need ``effort`` or ``change`` above 0.

        Raises:
            InputError: the least is not unique.
        """
        basis = np.eye(len(self.plant)) if basis is None else np.asarray(basis, float)
        seen = self.plant @ basis
        weight = seen.T @ seen + (effort + change) * basis.T @ basis
        if np.linalg.cond(weight) > 1e13:
            raise InputError("norm-optimal law: the least is not unique; allowed: effort or change above 0")
        inner = np.linalg.solve(weight, np.concatenate((seen.T @ self.plant + change * basis.T, seen.T), axis=1))
        both = basis @ inner
        kept, learned = both[:, : len(self.plant)], both[:, len(self.plant) :]
        return kept, np.asarray(np.linalg.lstsq(kept, learned, rcond=None)[0])

    def norm(self, q: Array, learning: Array) -> float:
        """Return the largest singular value of Q(I - L·G): below 1 the command converges monotonously."""
        return float(np.linalg.norm(q @ (np.eye(len(self.plant)) - learning @ self.plant), 2))

    def errors(
        self, wanted: Array, q: Array, learning: Array, trials: int, *, noise_rms: float = 0.0, seed: int = 1
    ) -> Array:
        """Return the RMS error of each trial, shape (trials,), for a wanted position, shape (n,), and noise of e."""
        random, command, found = np.random.default_rng(seed), np.zeros(wanted.size), []
        for _ in range(trials):
            error = wanted - self.plant @ command
            found.append(np.sqrt(np.mean(error**2)))
            command = q @ (command + learning @ (error + noise_rms * random.standard_normal(wanted.size)))
        return np.array(found)
