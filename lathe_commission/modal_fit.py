# SPDX-License-Identifier: Apache-2.0
"""Fit of a drive with modes and lags to a measured frequency response or step response.

Least squares, weighted by the variance of the measurement σ² plus that of the model, (ε·|W|)². ε, the relative error of
the model, is as large as the residuals require: 0 for residuals within σ. So parameters of a model that leaves
something out do not depend on the few points with the least noise, and their covariance includes its error. Where
neighbouring residuals have the same sign, the covariance grows until the region of confidence covers their mean.

The model is rational with a delay (`lathe_machine.analysis.modal_drive`). The search starts from the poles of vector
fitting, for trial delays and each order. Normal modes and complex residues with lags compete; the model is that
of the least BIC, -2·ln(likelihood) + k·ln(m) with k parameters and m real numbers, two for each point of a frequency
response, among those whose parameters the points determine.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import scipy

from lathe_commission import vector_fitting
from lathe_commission.reduced_order import refuse_unusable
from lathe_commission.vector_fitting import real_and_imaginary
from lathe_machine.analysis.modal_drive import BASE, MILLI, ModalDrive, composed, resonance
from lathe_rc.analysis.frequency_response import FrequencyResponse
from lathe_rc.arrays import Array, Complex
from lathe_rc.errors import InputError, LatheError

MOST_MODES = 8  #: that a fit looks for
MOST_LAGS = 2  #: beside them
COVERED = 0.95  #: confidence of the set of drives
LARGEST_ERROR = 0.1  #: ε of a result
UNKNOWN = 0.25  #: standard error of a parameter of a result, relative; of the delay, over the whole lag

_LONGEST_DELAY = 0.1  # [s], as the drive's parameter allows
_DAMPINGS = (1e-4, 20.0)
_MODE_DAMPINGS = (1e-4, 0.3)  # beyond: no resonance, but a substitute for something else that the model lacks
_COMPLEX_DAMPING = 1.0  # largest one of a mode with a complex residue
_LARGEST_SHARE = 30.0  # of a mode or a lag
_GAINS = (1e-3, 1e3)
_ABOVE = 2.0  # times the highest frequency: place of the last mode
_LEAST_PART = 0.01  # of the drive itself in the motion, relative to the fit; without it no cell takes the drive
_PAYS = 10.0  # least gain of BIC for a larger model: strong evidence (Kass and Raftery 1995)
_PATIENCE = (2, 4)  # orders without a better model after which the search ends: with an ε below _FLOOR, and otherwise
_FLOOR = 3e-3  # relative deviation of a point while poles are looked for, at least
_FEW = 1500  # points in which the model is looked for
_DELAYS = 16  # trial delays
_SCAN, _MORE = 3, 8  # rounds of vector fitting for each trial delay, and for the best ones
_FINEST_TURN = 0.1  # [rad] of the highest frequency by the last change of a trial delay
_STARTS = 2  # delays from which a model is fitted
_COARSE, _FINE = 1e-5, 1e-10  # tolerance of a model among others, and of the result
_STEPS = 40  # of a search
_ROUNDS = 4  # of fit and ε
_EPSILON = (1e-9, 10.0)
_LEAST_GAIN, _MOST_GAIN = 0.25, 4.0  # static, outside of which the units are wrong
_UNSETTLED = 0.05  # change of a step's end from its last quarter to its last sixteenth
_SINGULAR = 1e-6  # of the sensitivities, each normalised to length 1
_TURNED = (0.03, 0.3)  # [rad] turn of the highest frequency by an unknown delay
_CHANCE = 12.0  # times its variance: a mean square of independent residuals that chance hardly exceeds
_RIGID = 1e-3  # least size of the region over its median, squared
_SAFETY = 2.0  # square of the size of the region over the mean of residuals
_WINDOWS = (8, 24, 72)  # parts of the band over which residuals are averaged


class Data(Protocol):
    """Measured points, as real numbers in units of nothing in particular."""

    @property
    def parts(self) -> int:
        """Number of real numbers of a point: 2 of a response, 1 of a step."""

    @property
    def values(self) -> Array | Complex:
        """Measured values, or what they are relative to, shape (m,)."""

    @property
    def size(self) -> int:
        """Number of real numbers m."""

    def residual(self, drive: ModalDrive) -> Array:
        """Return model less measurement, shape (m,)."""

    def jacobian(self, drive: ModalDrive) -> Array:
        """Return the derivatives of `residual` by the searched parameters, shape (m, k)."""

    def deviation(self, drive: ModalDrive, model_error: float) -> Array:
        """Return the standard deviation of each number, for a relative error ε of the model, shape (m,)."""

    def thinned(self, most: int) -> "Data":
        """Return at most about ``most`` of the points."""

    @property
    def band(self) -> tuple[float, float]:
        """Range of the frequencies of modes that it can show [rad/s]."""

    def unresolved(self, drive: ModalDrive) -> list[str]:
        """Return, for each mode that is narrower than the distance of the points, between which points it lies."""

    def spectrum(self) -> tuple[Array, Complex, Array]:
        """Return frequencies [rad/s], response and its deviation for the search of poles, shape (n,) each."""


@dataclass(frozen=True)
class ResponseData:
    """Frequency response as data of a fit."""

    measured: FrequencyResponse
    parts = 2

    @property
    def values(self) -> Complex:
        """Measured values, once for the real and once for the imaginary parts."""
        return np.tile(self.measured.value, 2)

    @property
    def size(self) -> int:
        """Number of real numbers."""
        return 2 * self.measured.frequency.size

    def residual(self, drive: ModalDrive) -> Array:
        """Return model less measurement, real parts, then imaginary parts."""
        return real_and_imaginary(self.measured.smoothed(drive.response) - self.measured.value)

    def jacobian(self, drive: ModalDrive) -> Array:
        """Return the derivatives of the residual."""
        return real_and_imaginary(self.measured.smoothed(drive.derivatives))

    def deviation(self, drive: ModalDrive, model_error: float) -> Array:
        """Return the standard deviation of each number."""
        noise = 0.0 if self.measured.deviation is None else self.measured.deviation * np.abs(self.measured.value)
        model = model_error * np.abs(self.measured.smoothed(drive.response))
        return np.tile(np.hypot(noise, model), 2)

    def thinned(self, most: int) -> "ResponseData":
        """Return points at logarithmic distances, or all where they are further apart."""
        measured = self.measured
        if measured.frequency.size <= most:
            return self
        places = np.searchsorted(measured.frequency, np.geomspace(*self.band, most))
        kept = np.unique(np.minimum(places, measured.frequency.size - 1))
        return ResponseData(measured.at(kept))

    @property
    def band(self) -> tuple[float, float]:
        """Range of the measured frequencies [rad/s]."""
        return float(self.measured.frequency[0]), float(self.measured.frequency[-1])

    def unresolved(self, drive: ModalDrive) -> list[str]:
        """Return, for each mode that is narrower than the distance of the points, between which points it lies."""
        frequency, found = self.measured.frequency, []
        # A point of a windowed record is an average that leaves no frequency out.
        for mode, damping, *_ in drive.modes if self.measured.spread is None else ():
            place = int(np.clip(np.searchsorted(frequency, mode), 1, frequency.size - 1))
            below, above, width = *frequency[place - 1 : place + 1] / (2.0 * np.pi), damping * mode / np.pi
            if mode < frequency[-1] and width < above - below:
                found.append(
                    f"a resonance {width:.2g} Hz wide lies between the points at {below:.5g} and {above:.5g} Hz: "
                    f"measure from {below:.4g} to {above:.4g} Hz in steps of {float(f'{width / 3.0:.1g}'):g} Hz"
                )
        return found

    def spectrum(self) -> tuple[Array, Complex, Array]:
        """Return frequencies, response and its deviation for the search of poles."""
        measured = self.measured
        noise = np.zeros(measured.frequency.size) if measured.deviation is None else measured.deviation
        return measured.frequency, measured.value, np.hypot(noise, _FLOOR) * np.abs(measured.value)


@dataclass(frozen=True)
class StepData:
    """Response to a unit step at time 0 as data of a fit.

    Args:
        time: increasing times [s], shape (n,), n at least 16; the first one is at most a step after 0.
        response: response relative to the step [1], shape (n,); ends at rest.

    Raises:
        InputError: the arrays are not such a response.
    """

    time: Array
    response: Array
    parts = 1

    def __post_init__(self) -> None:
        refuse_unusable("step response", self.time, self.response, 16)
        falling = np.flatnonzero(np.diff(self.time) <= 0.0)
        if falling.size:
            a, b = self.time[falling[0]], self.time[falling[0] + 1]
            raise InputError(f"step response: time {a:g} s is followed by {b:g} s; allowed: increasing times")
        begin, end = float(self.time[0]), float(self.time[-1])
        if not begin - 1.5 * (float(self.time[1]) - begin) <= 0.0 < end:
            raise InputError(
                f"step response: times from {begin:.6g} to {end:.6g} s; allowed: from 0 or before "
                "(the step is at 0: subtract its time, or record the command too)"
            )
        settled = self._settled
        if not _LEAST_GAIN <= abs(settled) <= _MOST_GAIN:
            raise InputError(
                f"step response: ends at {settled:.4g}; allowed: {_LEAST_GAIN:g} to {_MOST_GAIN:g}, of either sign "
                "(divide by the height of the command's step)"
            )
        before = float(np.mean(self.response[-(self.time.size // 4) : -(self.time.size // 8)]))
        if not abs(before - settled) <= _UNSETTLED * abs(settled):
            raise InputError(
                f"step response: moves from {before:.4g} to {settled:.4g} in its last quarter; allowed: a change of "
                f"{100.0 * _UNSETTLED:g} % (record until the drive has settled)"
            )

    @property
    def values(self) -> Array:
        """Height of the step at each point."""
        return np.full(self.time.size, self._settled)

    @property
    def _settled(self) -> float:
        return float(np.mean(self.response[-(self.time.size // 16) :]))

    @property
    def size(self) -> int:
        """Number of real numbers."""
        return self.time.size

    def residual(self, drive: ModalDrive) -> Array:
        """Return model less measurement."""
        return drive.step(self.time) - self.response

    def jacobian(self, drive: ModalDrive) -> Array:
        """Return the derivatives of the residual, by central differences."""
        x, columns = drive.searched(), []
        for place in range(x.size):
            offset = np.zeros(x.size)
            offset[place] = 1e-5
            ahead, behind = (drive.at(x + sign * offset).step(self.time) for sign in (1.0, -1.0))
            columns.append((ahead - behind) / 2e-5)
        return np.stack(columns, axis=1)

    def deviation(self, drive: ModalDrive, model_error: float) -> Array:
        """Return the standard deviation of each number: noise and error of the model are not separated."""
        return np.full(self.time.size, model_error)

    def thinned(self, most: int) -> "StepData":
        """Return every n-th point."""
        every = -(-self.time.size // most)
        return self if every == 1 else StepData(self.time[::every], self.response[::every])

    @property
    def band(self) -> tuple[float, float]:
        """Range of frequencies between the length of the record and its step [rad/s]."""
        return 2.0 * np.pi / float(self.time[-1] - self.time[0]), 0.8 * np.pi / float(np.diff(self.time).min())

    def unresolved(self, drive: ModalDrive) -> list[str]:
        """Return nothing: a step shows a mode in all of its samples."""
        return []

    def spectrum(self) -> tuple[Array, Complex, Array]:
        """Return the transform of the rate at which the response moves to its end."""
        low, high = self.band
        time = np.arange(0.0, float(self.time[-1]), 0.8 * np.pi / high)
        moved = np.diff(np.interp(time, self.time, self.response), prepend=0.0, append=self._settled)
        frequency = np.asarray(low * np.arange(1, min(time.size // 3, _FEW) + 1), np.float64)
        middle = np.append(time, time[-1]) - 0.4 * np.pi / high
        value = np.asarray(np.exp(-1j * np.outer(frequency, middle)) @ moved, np.complex128)
        return frequency, value, np.hypot(0.02 * np.abs(value), 2e-3 * abs(self._settled))


class Structure(NamedTuple):
    """Structure of a model.

    Attributes:
        modes: number of modes.
        lags: number of lags.
        complex_residues: whether the modes are complex.
    """

    modes: int
    lags: int = 0
    complex_residues: bool = False

    @classmethod
    def of(cls, drive: ModalDrive) -> "Structure":
        """Return the structure of a drive."""
        return cls(len(drive.mode_frequency), len(drive.lag_time), bool(drive.mode_velocity))

    def __str__(self) -> str:
        """Return the structure in words."""
        kind = " with complex residues" if self.complex_residues else ""
        lags = f" and {self.lags} {'lag' if self.lags == 1 else 'lags'}" if self.lags else ""
        return f"{self.modes} {'mode' if self.modes == 1 else 'modes'}{kind}{lags}"


@dataclass(frozen=True)
class ModalFit:
    """Fitted drive with its uncertainty.

    Attributes:
        drive: fitted drive.
        covariance: covariance of the searched parameters (see `ModalDrive.searched`), shape (k, k).
        model_error: ε, relative error of the model beyond the noise; of a step response RMS of the residual.
        bic: BIC of the structures that were fitted.
        unresolved: modes that lie between the points, in words.
    """

    drive: ModalDrive
    covariance: Array
    model_error: float
    bic: Mapping[Structure, float]
    unresolved: tuple[str, ...] = ()

    @property
    def errors(self) -> ModalDrive:
        """Standard errors of the parameters."""
        x, spread = self.drive.searched(), np.sqrt(np.diag(self.covariance))
        places = self.drive.logarithmic
        spread[places] *= np.exp(x[places])
        return self.drive.of_values(spread)

    def distance(self, drive: ModalDrive) -> float:
        """Return the squared distance of a drive from the fit in standard deviations; COVERED lies below `limit`."""
        off = drive.sorted().searched() - self.drive.searched()
        return float(off @ np.linalg.solve(self.covariance, off))

    @property
    def limit(self) -> float:
        """Squared distance below which the true drive lies with the confidence `COVERED`."""
        return float(scipy.stats.chi2.ppf(COVERED, self.covariance.shape[0]))

    def envelope(self, frequency: Array) -> Array:
        """Return the largest distance of a response within the region from that of the fit, shape (n,) [rad/s]."""
        slopes = self.drive.derivatives(frequency)
        slopes = np.stack((slopes.real, slopes.imag), axis=1)
        spread = np.einsum("nik,kl,njl->nij", slopes, self.covariance, slopes)
        return np.asarray(np.sqrt(self.limit * np.linalg.eigvalsh(spread)[:, -1]))

    def drives(self, count: int, seed: int) -> list[ModalDrive]:
        """Return the fit and ``count`` drives on the surface of its region of confidence (`COVERED`).

        They lie in random directions, in opposite pairs: the worst of them is near the worst drive that the measurement
        allows, which draws from the inside of the region are not. A delay below 0 is a delay of 0. An offset that would
        leave the drive itself no part in the motion is shortened until 1 % of this part is left.
        """
        drive, size = self.drive, self.covariance.shape[0]
        directions = np.random.default_rng(seed).normal(size=(-(-count // 2), size))
        directions *= np.sqrt(self.limit) / np.linalg.norm(directions, axis=1, keepdims=True)
        spread = np.sqrt(np.diag(self.covariance))
        root = spread[:, None] * scipy.linalg.cholesky(self.covariance / np.outer(spread, spread), lower=True)
        offsets = np.stack((directions, -directions), axis=1).reshape(-1, size)[:count] @ root.T
        if drive.normal:
            most = (1.0 - _LEAST_PART) * (1.0 - sum(drive.mode_participation))
            offsets *= (most / np.maximum(offsets[:, BASE + 2 :: drive.each].sum(axis=1), most))[:, None]
        places = drive.searched() + offsets
        places[:, 2] = np.maximum(places[:, 2], 0.0)
        return [drive, *(drive.at(place) for place in places)]


class NoFitError(LatheError):
    """Error of a fit that is no result.

    Attributes:
        fit: what was found.
    """

    def __init__(self, message: str, fit: ModalFit) -> None:
        super().__init__(message)
        self.fit = fit


def _bounds(data: Data, drive: ModalDrive) -> Array:
    """Return the bounds of the searched parameters, shape (k, 2)."""
    low, high = data.band
    own = [np.log([low / 3.0, high * 3.0]), np.log(_DAMPINGS), (0.0, _LONGEST_DELAY / MILLI)]
    own.append(np.sort(np.sign(drive.gain) * np.array(_GAINS)))
    share = (-_LARGEST_SHARE, _LARGEST_SHARE)
    damping = (_DAMPINGS[0], _COMPLEX_DAMPING) if drive.mode_velocity else _MODE_DAMPINGS
    mode = [np.log([low, _ABOVE * high]), np.log(damping), share, share][: drive.each]
    lag = [np.log([0.1 / high, 3.0 / low]), share]
    rows = [*own, *(mode * len(drive.mode_frequency)), *(lag * len(drive.lag_time))]
    return np.array(rows, dtype=np.float64)


def _at_bounds(data: Data, drive: ModalDrive) -> npt.NDArray[np.bool_]:
    """Return which of the searched parameters lie at a bound, shape (k,)."""
    return np.asarray(np.abs(drive.searched()[:, None] - _bounds(data, drive)).min(axis=1) < 1e-3)


def _search(data: Data, start: ModalDrive, deviation: Array, tolerance: float) -> ModalDrive:
    """Fit all parameters by weighted least squares from a start, until a step changes them and the sum by less."""
    bottom, top = _bounds(data, start).T
    begin = np.clip(start.searched(), bottom + 1e-9, top - 1e-9)

    def residual(x: Array) -> Array:
        return np.asarray(data.residual(start.at(x)) / deviation, np.float64)

    def jacobian(x: Array) -> Array:
        return np.asarray(data.jacobian(start.at(x)) / deviation[:, None], np.float64)

    found = scipy.optimize.least_squares(
        residual, begin, jac=jacobian, bounds=(bottom, top), x_scale="jac", xtol=tolerance, ftol=tolerance,
        gtol=tolerance, max_nfev=_STEPS,
    )  # fmt: skip
    return start.at(found.x)


def _cost(data: Data, drive: ModalDrive, deviation: Array) -> float:
    return float(np.sum((data.residual(drive) / deviation) ** 2))


def _model_error(data: Data, drive: ModalDrive) -> float:
    """Return the least ε with which the residuals are within their deviations, in the mean square."""
    freedom = max(data.size - drive.searched().size, 1)

    def excess(logarithm: float) -> float:
        return _cost(data, drive, data.deviation(drive, float(np.exp(logarithm)))) - freedom

    low, high = np.log(_EPSILON)
    if excess(low) <= 0.0:
        return _EPSILON[0]
    return float(np.exp(scipy.optimize.brentq(excess, low, high, xtol=1e-3))) if excess(high) < 0.0 else _EPSILON[1]


def _polish(data: Data, drive: ModalDrive, tolerance: float) -> tuple[ModalDrive, float]:
    """Fit all parameters with the error of the model that the residuals require; return both."""
    error = _model_error(data, drive)
    for _ in range(_ROUNDS):
        drive, before = _search(data, drive, data.deviation(drive, error), tolerance), error
        error = _model_error(data, drive)
        if abs(error - before) <= 0.02 * before:
            break
    return drive.sorted(), error


def _bic(data: Data, drive: ModalDrive, model_error: float) -> float:
    deviation = data.deviation(drive, model_error)
    likelihood = _cost(data, drive, deviation) + 2.0 * float(np.sum(np.log(deviation)))
    return likelihood + (drive.searched().size + 1) * float(np.log(data.size))


def _delays(frequency: Array, value: Complex) -> Array:
    """Return trial delays [s], from 0 to the lag at low frequencies, shape (n,)."""
    sign = 1.0 if np.median(value[:5].real) >= 0.0 else -1.0
    phase = np.unwrap(np.angle(sign * value))
    near = np.abs(phase) < 1.0
    near[:5] = True
    lag = -float(frequency[near] @ phase[near] / (frequency[near] @ frequency[near]))
    return np.asarray(np.linspace(0.0, min(max(lag, 1.0 / frequency[-1]), _LONGEST_DELAY), _DELAYS))


def _with_shares(
    poles: Complex, delay: float, spectrum: tuple[Array, Complex, Array], *, normal: bool
) -> ModalDrive | None:
    """Return the drive with given poles, its shares those of linear least squares; None if it has no such form.

    Two real poles are those of the drive itself if there is no complex pair; the others are lags.
    """
    frequency, value, deviation = spectrum
    pairs = [(abs(pole), -pole.real / abs(pole)) for pole in poles if pole.imag > 0.0]
    real = sorted(-pole.real for pole in poles if pole.imag == 0.0)
    while len(real) > 1 and (not pairs or normal):  # two real poles are a pair of a damping above 1
        product = np.sqrt(real[0] * real[1])
        pairs.append((product, (real[0] + real[1]) / (2.0 * product)))
        real = real[2:]
    if not pairs or (normal and real) or len(real) > MOST_LAGS:
        return None
    p = np.asarray(1j * frequency, np.complex128)
    sections = [resonance(p, *pair)[0] for pair in pairs]
    lags = [1.0 / (1.0 + p / pole) for pole in real]
    columns = [*sections, *lags]
    if not normal:
        w1, first = pairs[0][0], p / pairs[0][0] * sections[0]  # its velocity balances that of the others
        columns[len(sections) :] = [lag - pole / w1 * first for lag, pole in zip(lags, real, strict=True)]
        columns += [p / w * own - w / w1 * first for (w, _), own in zip(pairs[1:], sections[1:], strict=True)]
    turned = value * np.exp(p * delay)
    matrix = real_and_imaginary(np.asarray(np.stack(columns, axis=1) / deviation[:, None], np.complex128))
    wanted = real_and_imaginary(turned / deviation)
    solution = np.linalg.lstsq(matrix, wanted, rcond=None)[0]
    count, gain = len(pairs), float(np.sum(solution[: len(pairs) + len(real)]))
    if not gain:
        return None
    shares, of_lags, velocity = np.split(solution / gain, [count, count + len(real)])
    if not normal:
        rest = velocity @ [w for w, _ in pairs[1:]] + of_lags @ real
        velocity = np.append(-rest / w1, velocity)
    own = int(np.argmax(np.abs(shares)))
    parts = (shares,) if normal else (shares, velocity)
    rows = [(*pairs[k], *(float(part[k]) for part in parts)) for k in range(count) if k != own]
    times = [(1.0 / pole, float(share)) for pole, share in zip(real, of_lags, strict=True)]
    drive = composed((*pairs[own], delay), gain, rows, times)
    return drive.sorted()


def _starts(spectrum: tuple[Array, Complex, Array], order: int) -> Iterator[ModalDrive]:
    """Yield drives of an order from which a fit starts, the best ones of each kind."""
    frequency, value, deviation = spectrum
    low, high = float(frequency[0]), float(frequency[-1])

    def moved(delay: float, poles: Complex, rounds: int) -> tuple[float, float, Complex]:
        turned = value * np.exp(1j * frequency * delay)
        poles, rest = vector_fitting.relocated(frequency, turned, 1.0 / deviation, poles, rounds)
        return rest, delay, poles

    delays = _delays(frequency, value)
    first = vector_fitting.first_poles(low, high, order)
    tried = sorted((moved(float(delay), first, _SCAN) for delay in delays), key=lambda each: each[0])
    apart = [each for each in tried if abs(each[1] - tried[0][1]) > 1.5 * delays[1]]
    found: dict[bool, list[ModalDrive]] = {True: [], False: []}
    for near in (tried[0], *apart[: _STARTS - 1]):
        best, step = near, float(delays[1])
        while step * high > _FINEST_TURN:
            step /= 2.0
            beside = (moved(max(best[1] + sign * step, 0.0), best[2], _SCAN) for sign in (-1.0, 1.0))
            best = min(best, *beside, key=lambda each: each[0])
        _, delay, poles = moved(*best[1:], _MORE)
        for normal, drives in found.items():
            if drive := _with_shares(poles, delay, spectrum, normal=normal):
                drives.append(drive)
    yield from (drive for drives in found.values() for drive in drives)


def _models(data: Data, modes: int | None, report: Callable[[int], None]) -> Iterator[tuple[ModalDrive, float, float]]:
    """Yield fitted drives with ε and BIC, by increasing order, until further poles no longer pay.

    Args:
        data: the points.
        modes: number of modes; None: any.
        report: is called with each order.
    """
    spectrum, best, last, patience = data.spectrum(), np.inf, 0, _PATIENCE[1]
    orders = range(2, 2 * (MOST_MODES + 1) + MOST_LAGS + 1)
    if modes is not None:
        orders = range(2 * (modes + 1), 2 * (modes + 1) + MOST_LAGS + 1)
    for order in orders:
        if modes is None and order > last + patience and last:
            break
        report(order)
        fitted: dict[Structure, tuple[ModalDrive, float]] = {}
        for start in _starts(spectrum, order):
            kind = Structure.of(start)
            if (modes is not None and kind.modes != modes) or data.size < 2 * start.searched().size:
                continue
            made = _polish(data, start, _COARSE)
            if kind not in fitted or made[1] < fitted[kind][1]:
                fitted[kind] = made
        for drive, error in fitted.values():
            bic = _bic(data, drive, error)
            if bic < best - _PAYS:
                best, last, patience = bic, order, _PATIENCE[0 if error < _FLOOR else 1]
            yield drive, error, bic


def fit(data: Data, *, modes: int | None = None, report: Callable[[int], None] = lambda _: None) -> ModalFit:
    """Fit a drive with modes and lags to measured points.

    Args:
        data: the points.
        modes: number of modes; None: that of the least BIC, up to `MOST_MODES`.
        report: is called with the order of each model before its fit.

    Raises:
        InputError: the points are too few, or do not determine the parameters.
        NoFitError: the error of the model or of a parameter is too large, or a resonance lies between the points.
    """
    fewest = 2 * (BASE + 3 * (modes or 0))
    if data.size < fewest:
        raise InputError(f"fit: {data.size} real numbers; allowed: {fewest} or more for {modes or 0} modes")
    points = data.thinned(_FEW)
    found = list(_models(points, modes, report))
    if modes is None and found:
        found += _pruned(points, min(found, key=lambda each: each[2])[0])
    found.sort(key=lambda each: each[0].searched().size)
    bic: dict[Structure, float] = {}
    best: tuple[ModalDrive, float, float] | None = None
    missing: tuple[float, list[str]] = (np.inf, [])
    for each in found:
        drive, error, criterion = each
        bic[Structure.of(drive)] = min(criterion, bic.get(Structure.of(drive), np.inf))
        if best is not None and not criterion < best[2] - _PAYS:
            continue
        if not _unsure(points, drive, error):
            best = each
        elif criterion < missing[0] and (between := data.unresolved(drive)):
            missing = (criterion, between)
    undetermined = best is None
    if best is None:
        if not found:
            raise InputError("fit: the measurement does not follow a drive; measure a wider band, or more points")
        best = min(found, key=lambda each: each[2])
    drive, error = _polish(data, best[0], _FINE)
    made = ModalFit(drive, _covariance(data, drive, error), error, bic, tuple(data.unresolved(drive)))
    reasons = _refusals(data, made)
    if modes is None and (undetermined or missing[0] < best[2] - _PAYS):
        reasons = ["; ".join(missing[1])] * bool(missing[1]) + reasons
        if undetermined and not reasons:
            reasons = [
                "the measurement does not determine all parameters; allowed: a wider band, more points or averages"
            ]
    if reasons:
        raise NoFitError(f"fit: {reasons[0]}", made)
    return made


def _pruned(data: Data, drive: ModalDrive) -> Iterator[tuple[ModalDrive, float, float]]:
    """Yield a drive without the mode or lag that the points determine least, and so on until all are determined."""
    while (drive.modes or drive.lags) and _unsure(data, drive, error := _model_error(data, drive)):
        try:
            spread = np.sqrt(np.diag(_covariance(data, drive, error)))
        except InputError:
            spread = np.ones(drive.searched().size)
        modes, lags = np.split(spread[BASE:], [drive.each * len(drive.modes)])
        doubts = [
            *(
                np.max(mode) / np.hypot(*each[2:])
                for mode, each in zip(modes.reshape(-1, drive.each), drive.modes, strict=True)
            )
        ]
        doubts += [np.max(lag) / abs(each[1]) for lag, each in zip(lags.reshape(-1, 2), drive.lags, strict=True)]
        worst = int(np.argmax(doubts))
        kept_modes = [mode for k, mode in enumerate(drive.modes) if k != worst]
        kept_lags = [lag for k, lag in enumerate(drive.lags, len(drive.modes)) if k != worst]
        drive, error = _polish(data, drive.with_sections(kept_modes, kept_lags), _COARSE)
        yield drive, error, _bic(data, drive, error)


def reversed_phase(data: ResponseData, modes: int | None, limit: float) -> bool:
    """Return whether the conjugate of a response that has no fit is that of a drive, with an ε below a limit."""
    return _has_fit(data, np.conj, modes, limit)


def swapped(data: ResponseData, modes: int | None, limit: float) -> bool:
    """Return whether the inverse of a response that has no fit is that of a drive, with an ε below a limit."""
    return _has_fit(data, np.reciprocal, modes, limit)


def _has_fit(data: ResponseData, change: Callable[[Complex], Complex], modes: int | None, limit: float) -> bool:
    try:
        other = fit(ResponseData(replace(data.measured, value=change(data.measured.value))), modes=modes)
    except LatheError:
        return False
    return other.model_error < limit


def _refusals(data: Data, fit: ModalFit) -> list[str]:
    """Return why a fit is no result; nothing if it is one."""
    drive, errors, found = fit.drive, fit.errors, []
    if not fit.model_error <= LARGEST_ERROR:
        found.append(
            f"the model leaves {100.0 * fit.model_error:.3g} % of the magnitude; allowed: up to "
            f"{100.0 * LARGEST_ERROR:g} % (another --band, other --modes, or a drive that is linear there)"
        )
    lag = drive.delay + 2.0 * drive.damping / drive.natural_frequency
    shown = [
        ("frequency", drive.natural_frequency / (2.0 * np.pi), errors.natural_frequency / (2.0 * np.pi), "Hz", 0.0),
        ("damping", drive.damping, errors.damping, "", 0.0),
        ("delay", 1e6 * drive.delay, 1e6 * errors.delay, "µs", 1e6 * lag),
        ("gain", drive.gain, errors.gain, "", 0.0),
    ]
    for k, (mode, off) in enumerate(zip(drive.modes, errors.modes, strict=True), 1):
        shown.append((f"frequency of mode {k}", mode[0] / (2.0 * np.pi), off[0] / (2.0 * np.pi), "Hz", 0.0))
        shown.append((f"damping of mode {k}", mode[1], off[1], "", 0.0))
    for name, value, error, unit, reference in shown:
        if not error < UNKNOWN * (reference or abs(value)):
            found.append(
                f"{name} = {value:.4g} ± {error:.2g} {unit}".rstrip()
                + f"; allowed: known to {100.0 * UNKNOWN:g} % (a wider band, more points or averages, other --modes)"
            )
    edge = _at_bounds(data, drive)
    edge[2] &= drive.delay > MILLI
    if edge.any():
        found.append("a parameter lies at its bound; allowed: a drive of second order or more, with modes and lags")
    whole = sum(drive.mode_participation)
    if whole >= 1.0 and drive.normal:
        found.append(
            f"the participations of the modes sum up to {whole:.4g}; allowed: below 1 (give fewer --modes, or "
            "measure lower frequencies too)"
        )
    return found


def _unsure(data: Data, drive: ModalDrive, model_error: float) -> bool:
    """Return whether the points leave a parameter of the model open, so that it stands for something else."""
    if sum(drive.mode_participation) >= 1.0 and drive.normal:
        return True
    try:
        spread = np.sqrt(np.diag(_covariance(data, drive, model_error)))
    except InputError:
        return True
    count = len(drive.mode_frequency)
    modes, lags = np.split(np.stack((drive.searched(), spread), axis=1)[BASE:], [drive.each * count])
    for mode in modes.reshape(count, drive.each, 2):
        size = np.hypot(*mode[2:, 0]) if drive.each == 4 else abs(mode[2, 0])
        if not (mode[0, 1] < UNKNOWN and mode[1, 1] < UNKNOWN and np.max(mode[2:, 1]) < size / 3.0):
            return True
    for lag in lags.reshape(-1, 2, 2):
        if not (lag[0, 1] < UNKNOWN and lag[1, 1] < abs(lag[1, 0]) / 3.0):
            return True
    edge = _at_bounds(data, drive)
    edge[2] = False
    return bool(edge.any() or np.any(spread[:2] > UNKNOWN))


def _covariance(data: Data, drive: ModalDrive, model_error: float) -> Array:
    """Return the covariance of the searched parameters.

    (JᵀJ)⁻¹ for independent residuals, times (1 + r)/(1 - r) for residuals with the correlation r between neighbours,
    as an incomplete model leaves them, and at least so large that the region covers the mean of neighbouring residuals.

    Raises:
        InputError: the points do not determine a parameter.
    """
    deviation = data.deviation(drive, model_error)
    jacobian = data.jacobian(drive) / deviation[:, None]
    # A delay is to first order a zero far above the band, which the shares of a relative degree of 3 take up: what it
    # then changes in the second order is as large as the noise.
    turned = float(np.clip(np.sqrt(np.median(deviation / np.abs(data.values))), *_TURNED))
    known = np.zeros((1, jacobian.shape[1]))
    known[0, 2] = MILLI * data.band[1] / turned
    jacobian = np.vstack((jacobian, known))
    lengths = np.linalg.norm(jacobian, axis=0)
    names = ["natural_frequency", "damping", "delay", "gain"]
    of_mode = ("frequency", "damping", "participation", "velocity")[: drive.each]
    names += [f"{name} of mode {k + 1}" for k in range(len(drive.mode_frequency)) for name in of_mode]
    names += [f"{name} of lag {k + 1}" for k in range(len(drive.lag_time)) for name in ("time", "participation")]
    if np.any(lengths == 0.0):
        raise InputError(f"fit: the measurement does not determine the {names[int(np.argmin(lengths))]}")
    _, sizes, directions = np.linalg.svd(jacobian / lengths, full_matrices=False)
    if sizes[-1] < _SINGULAR * sizes[0]:
        worst = " and ".join(name for name, part in zip(names, directions[-1], strict=True) if abs(part) > 0.3)
        raise InputError(f"fit: the measurement does not distinguish {worst}; measure a wider band, or give --modes")
    rest = data.residual(drive) / deviation
    likeness = float(np.clip(rest[1:] @ rest[:-1] / (rest @ rest), 0.0, 0.95))
    root = directions.T / sizes / lengths[:, None] * np.sqrt((1.0 + likeness) / (1.0 - likeness))
    return np.asarray(root @ root.T * max(1.0, _uncovered(data.parts, rest, jacobian[:-1], root)))


def _uncovered(parts: int, rest: Array, jacobian: Array, root: Array) -> float:
    """Return the largest square of a mean of neighbouring residuals, beyond noise, over that of the region there."""
    limit = float(scipy.stats.chi2.ppf(COVERED, root.shape[0]))
    rest, slopes = rest.reshape(parts, -1), (jacobian @ root).reshape(parts, -1, root.shape[0])
    largest = 0.0
    for windows in _WINDOWS:
        size = max(rest.shape[1] // windows, 5)
        mean = np.sum(scipy.ndimage.uniform_filter1d(rest, size, axis=1) ** 2, axis=0)
        region = scipy.ndimage.uniform_filter1d(slopes, size, axis=1)
        covered = limit * np.sum(region**2, axis=(0, 2))
        covered = np.maximum(covered, _RIGID * np.median(covered))  # none of it moves a step before the delay
        beyond = np.maximum(mean - parts * _CHANCE / size, 0.0) * _SAFETY / covered
        largest = max(largest, float(beyond.max()))
    return largest


def refuse_other_gain(data: ResponseData) -> None:
    """Reject a response whose magnitude at its lowest frequencies is far from that of a drive, 1.

    Raises:
        InputError: the gain is another one.
    """
    gain = float(np.median(np.abs(data.measured.value[:3])))
    if not _LEAST_GAIN <= gain <= _MOST_GAIN:
        at = data.measured.frequency[0] / (2.0 * np.pi)
        raise InputError(
            f"response: magnitude {gain:.4g} at {at:.4g} Hz, the lowest frequency; allowed: near a static gain of 1, "
            f"{_LEAST_GAIN:g} to {_MOST_GAIN:g} (measure lower frequencies too; if the units differ, give them, such "
            f"as --column response=NAME:{1.0 / gain:.4g})"
        )
