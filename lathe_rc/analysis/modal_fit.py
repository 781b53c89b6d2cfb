# SPDX-License-Identifier: Apache-2.0
"""Fit of a drive with modes to a measured frequency response or step response.

Least squares, weighted by the variance of the measurement σ² plus that of the model, (ε·|W|)². ε, the relative error of
the model, is as large as the residuals require: 0 for residuals within σ. So parameters of a model that leaves
something out do not depend on the few points with the least noise, and their covariance includes its error.

The number of modes is that of the least BIC, -2·ln(likelihood) + k·ln(m) with m real numbers, two for each point of a
frequency response: a mode is added where it reduces the residual most, then all parameters are fitted again, until a
further mode no longer pays.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy

from lathe_rc.analysis.frequency_response import LEAST, FrequencyResponse
from lathe_rc.analysis.modal_drive import BASE, EACH, MILLI, ModalDrive, resonance, resonance_step
from lathe_rc.analysis.reduced_order import refuse_unusable
from lathe_rc.arrays import Array, Complex
from lathe_rc.errors import InputError

MOST_MODES = 8  #: that a fit looks for
COVERED = 0.95  #: confidence of the set of drives

_LONGEST_DELAY = 0.1  # [s], as the drive's parameter allows
_DAMPINGS = (1e-4, 20.0)
_MODE_DAMPINGS = (1e-4, 0.3)  # beyond: no resonance, but a substitute for something else that the model lacks
_LARGEST_SHARE = 10.0  # of a mode
_LEAST_PART = 0.01  # of the drive itself in the motion, relative to the fit; without it no cell takes the drive
_PAYS = 10.0  # least gain of BIC for a further mode: strong evidence (Kass and Raftery 1995)
_AHEAD = 5  # modes beyond the best number that are tried: with some missing, a fit may be worse than with none
_COARSE, _FINE = 0.03, 1e-4  # ε while modes are looked for: at first, and at least
_NEAR, _NEAR_LAG = (0.05, 0.1), 0.05  # of a held drive: logarithms of ω1 and ζ1, and delay over 1/ω1
_BEYOND = 20.0  # times the highest frequency: place of the mode that stands for those that are still missing
_FEW = 4000  # points in which modes are looked for
_TRIED = (0.005, 0.02, 0.08)  # damping of a mode
_PLACES = 1.012  # between tried frequencies
_STARTS = 3  # places from which a further mode is fitted
_APART = 1.2  # between these places
_DELAYS = 60  # trial delays
_ROUNDS = 4  # of fit and ε
_EPSILON = (1e-9, 10.0)
_LEAST_GAIN, _MOST_GAIN = 0.8, 1.25  # static, outside of which the units are wrong
_OFF = 0.05  # of the end of a step from 1: modes would be sought for the rest, in vain and for minutes


class Data(Protocol):
    """Measured points, as real numbers in units of nothing in particular."""

    @property
    def size(self) -> int:
        """Number of real numbers m."""

    def residual(self, drive: ModalDrive) -> Array:
        """Return model less measurement, shape (m,)."""

    def jacobian(self, drive: ModalDrive) -> Array:
        """Return the derivatives of `residual` by the searched parameters, shape (m, k)."""

    def mode(self, drive: ModalDrive, frequency: Array, damping: float) -> Array:
        """Return the derivatives of `residual` by the participation of further modes, shape (m, len(frequency))."""

    def deviation(self, drive: ModalDrive, model_error: float) -> Array:
        """Return the standard deviation of each number, for a relative error ε of the model, shape (m,)."""

    def coarse(self, level: float) -> Array:
        """Return deviations for the search of modes, relative to the static gain, not to a small magnitude."""

    def thinned(self, most: int) -> "Data":
        """Return at most about ``most`` of the points."""

    @property
    def band(self) -> tuple[float, float]:
        """Range of the frequencies of modes that it can show [rad/s]."""

    def resolved(self, drive: ModalDrive) -> bool:
        """Return whether each mode is wider than the distance of the points; otherwise it stands for a single one."""

    def low(self) -> "Data":
        """Return the points in which the drive without modes shows."""

    def starts(self) -> Sequence[ModalDrive]:
        """Return drives without modes from which the search starts."""


def _split(values: Complex) -> Array:
    """Return real and imaginary parts one after the other, shape (2n,) or (2n, k)."""
    return np.concatenate((values.real, values.imag))


@dataclass(frozen=True)
class ResponseData:
    """Frequency response as data of a fit."""

    measured: FrequencyResponse

    @property
    def size(self) -> int:
        """Number of real numbers."""
        return 2 * self.measured.frequency.size

    def residual(self, drive: ModalDrive) -> Array:
        """Return model less measurement, real parts, then imaginary parts."""
        return _split(self.measured.smoothed(drive.response) - self.measured.value)

    def jacobian(self, drive: ModalDrive) -> Array:
        """Return the derivatives of the residual."""
        return _split(self.measured.smoothed(drive.derivatives))

    def mode(self, drive: ModalDrive, frequency: Array, damping: float) -> Array:
        """Return the derivatives of the residual by the participation of further modes."""
        p = np.asarray(1j * self.measured.frequency, np.complex128)
        own, delayed = resonance(p, drive.natural_frequency, drive.damping)[0], np.exp(-p * drive.delay)
        below = (p**2)[:, None] + 2.0 * damping * frequency * p[:, None] + frequency**2
        return _split(delayed[:, None] * (frequency**2 / below - own[:, None]))

    def deviation(self, drive: ModalDrive, model_error: float) -> Array:
        """Return the standard deviation of each number."""
        noise = 0.0 if self.measured.deviation is None else self.measured.deviation * np.abs(self.measured.value)
        model = model_error * np.abs(self.measured.smoothed(drive.response))
        return np.tile(np.hypot(noise, model), 2)

    def coarse(self, level: float) -> Array:
        """Return deviations for the search of modes."""
        noise = 0.0 if self.measured.deviation is None else self.measured.deviation * np.abs(self.measured.value)
        return np.tile(np.hypot(noise, level) * np.ones(self.measured.frequency.size), 2)

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

    def resolved(self, drive: ModalDrive) -> bool:
        """Return whether each mode is wider than the distance of the points."""
        frequency = self.measured.frequency
        places = np.clip(np.searchsorted(frequency, drive.mode_frequency), 1, frequency.size - 1)
        widths = 2.0 * np.array(drive.mode_damping) * np.array(drive.mode_frequency)
        return bool(np.all(widths > frequency[places] - frequency[places - 1]))

    def low(self) -> "ResponseData":
        """Return the points below the frequency at which the magnitude has fallen to 0.3."""
        most = max(self._corner(), float(self.measured.frequency[min(2 * LEAST, self.measured.frequency.size) - 1]))
        return ResponseData(self.measured.within(0.0, most))

    def starts(self) -> Sequence[ModalDrive]:
        """Return the best drives of linear fits with trial delays: W·e^{pτ}·(1 + a1·p + a2·p²) = 1."""
        gain = float(np.median(np.abs(self.measured.value[:3])))
        near = self.measured.frequency <= self._corner()
        if np.count_nonzero(near) < BASE + 2:
            near = np.arange(self.measured.frequency.size) < BASE + 2
        frequency, value = self.measured.frequency[near], self.measured.value[near] / gain
        scale = frequency[-1]
        found = []
        for delay in min(_LONGEST_DELAY, 6.0 / scale) * np.linspace(0.0, 1.0, _DELAYS) ** 2:
            p = 1j * frequency / scale
            turned = value * np.exp(1j * frequency * delay)
            matrix, wanted = _split(np.stack((turned * p, turned * p**2), axis=1)), _split(1.0 - turned)
            (a1, a2), *_ = np.linalg.lstsq(matrix, wanted, rcond=None)
            if a1 > 0.0 and a2 > 0.0:
                rest = float(np.sum((matrix @ (a1, a2) - wanted) ** 2))
                own = scale / np.sqrt(a2)
                damping = float(np.clip(a1 / (2.0 * np.sqrt(a2)), *_DAMPINGS))
                found.append((rest, ModalDrive(float(own), damping, float(delay))))
        best = sorted(found, key=lambda pair: pair[0])
        corner = self._corner()
        plain = [ModalDrive(corner, damping, part / corner) for damping in (0.3, 0.8) for part in (0.0, 0.5)]
        return [drive for _, drive in best[:1] + best[5:6]] + plain

    def _corner(self) -> float:
        """Return the first frequency whose magnitude is below 0.3 of the static gain, or the last one [rad/s]."""
        magnitude = np.abs(self.measured.value)
        below = magnitude < 0.3 * np.median(magnitude[:3])
        return float(self.measured.frequency[int(np.argmax(below))] if below.any() else self.measured.frequency[-1])


@dataclass(frozen=True)
class StepData:
    """Response to a unit step at time 0 as data of a fit.

    Args:
        time: increasing times [s], shape (n,), n at least 16; the first one is at most a step after 0.
        response: response relative to the step [1], shape (n,); ends near 1.

    Raises:
        InputError: the arrays are not such a response.
    """

    time: Array
    response: Array

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
        settled = float(np.mean(self.response[-(self.time.size // 16) :]))
        if not abs(settled - 1.0) <= _OFF:
            raise InputError(
                f"step response: ends at {settled:.4g}; allowed: {1.0 - _OFF:g} to {1.0 + _OFF:g} (divide by its "
                "height, and record until the drive has settled)"
            )

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
            ahead, behind = (ModalDrive.of_searched(x + sign * offset).step(self.time) for sign in (1.0, -1.0))
            columns.append((ahead - behind) / 2e-5)
        return np.stack(columns, axis=1)

    def mode(self, drive: ModalDrive, frequency: Array, damping: float) -> Array:
        """Return the derivatives of the residual by the participation of further modes."""
        later = self.time - drive.delay
        own = resonance_step(later, drive.natural_frequency, drive.damping)
        return np.stack([resonance_step(later, float(each), damping) - own for each in frequency], axis=1)

    def deviation(self, drive: ModalDrive, model_error: float) -> Array:
        """Return the standard deviation of each number: noise and error of the model are not separated."""
        return np.full(self.time.size, model_error)

    def coarse(self, level: float) -> Array:
        """Return deviations for the search of modes."""
        return np.full(self.time.size, level)

    def thinned(self, most: int) -> "StepData":
        """Return every n-th point."""
        every = -(-self.time.size // most)
        return self if every == 1 else StepData(self.time[::every], self.response[::every])

    @property
    def band(self) -> tuple[float, float]:
        """Range of frequencies between the length of the record and its step [rad/s]."""
        return 2.0 * np.pi / float(self.time[-1] - self.time[0]), 0.8 * np.pi / float(np.diff(self.time).min())

    def resolved(self, drive: ModalDrive) -> bool:
        """Return True: a step shows a mode in all of its samples."""
        return True

    def low(self) -> "StepData":
        """Return all points."""
        return self

    def starts(self) -> Sequence[ModalDrive]:
        """Return drives whose response rises through 1/2 where the measured one does."""
        half = max(float(self.time[int(np.argmax(self.response >= 0.5))]), float(np.diff(self.time).min()))
        # Half of the step is reached at about (1 + 0.7ζ)/ω1 after the delay.
        return [
            ModalDrive((1.0 + 0.7 * damping) / (half * (1.0 - part)), damping, part * half)
            for damping in (0.3, 1.0, 3.0)
            for part in (0.0, 0.3, 0.7)
        ]


@dataclass(frozen=True)
class ModalFit:
    """Fitted drive with its uncertainty.

    Attributes:
        drive: fitted drive.
        covariance: covariance of the searched parameters (see `ModalDrive.searched`), shape (k, k).
        model_error: ε, relative error of the model beyond the noise; of a step response RMS of the residual.
        bic: BIC by number of modes, from 0 on; as many as were fitted.
    """

    drive: ModalDrive
    covariance: Array
    model_error: float
    bic: tuple[float, ...]

    @property
    def errors(self) -> ModalDrive:
        """Standard errors of the parameters."""
        x, spread = self.drive.searched(), np.sqrt(np.diag(self.covariance))
        modes = [(np.exp(x[k]) * spread[k], np.exp(x[k + 1]) * spread[k + 1], spread[k + 2]) for k in self._places]
        own = np.exp(x[:2]) * spread[:2]
        drive = ModalDrive(float(own[0]), float(own[1]), float(spread[2]) * MILLI)
        return drive.with_modes([(float(w), float(z), float(share)) for w, z, share in modes])

    @property
    def _places(self) -> range:
        return range(BASE, self.covariance.shape[0], EACH)

    def distance(self, drive: ModalDrive) -> float:
        """Return the squared distance of a drive from the fit in standard deviations; COVERED lies below `limit`."""
        off = drive.sorted().searched() - self.drive.searched()
        return float(off @ np.linalg.solve(self.covariance, off))

    @property
    def limit(self) -> float:
        """Squared distance below which the true drive lies with the confidence `COVERED`."""
        return float(scipy.stats.chi2.ppf(COVERED, self.covariance.shape[0]))

    def drives(self, count: int, seed: int) -> list[ModalDrive]:
        """Return the fit and ``count`` drives on the surface of its region of confidence (`COVERED`).

        They lie in random directions, in opposite pairs: the worst of them is near the worst drive that the measurement
        allows, which draws from the inside of the region are not. A delay below 0 is a delay of 0. An offset that would
        leave the drive itself no part in the motion is shortened until 1 % of this part is left.
        """
        size = self.covariance.shape[0]
        directions = np.random.default_rng(seed).normal(size=(-(-count // 2), size))
        directions *= np.sqrt(self.limit) / np.linalg.norm(directions, axis=1, keepdims=True)
        root = scipy.linalg.cholesky(self.covariance, lower=True)
        offsets = np.stack((directions, -directions), axis=1).reshape(-1, size)[:count] @ root.T
        most = (1.0 - _LEAST_PART) * (1.0 - sum(self.drive.mode_participation))
        offsets *= (most / np.maximum(offsets[:, BASE + EACH - 1 :: EACH].sum(axis=1), most))[:, None]
        places = self.drive.searched() + offsets
        places[:, 2] = np.maximum(places[:, 2], 0.0)
        return [self.drive, *(ModalDrive.of_searched(place) for place in places)]


def _search(
    data: Data, start: ModalDrive, deviation: Array, *, rest: bool = False, held: ModalDrive | None = None
) -> ModalDrive:
    """Fit all parameters by weighted least squares from a start.

    Args:
        data: the points.
        start: drive from which the search starts.
        deviation: standard deviations of the points, shape (m,).
        rest: whether the last mode stands for those that are still missing: far above the band, static within it. The
            loss is then one on which their points have little influence.
        held: drive near which frequency, damping and delay stay; None: they are free.
    """
    low, high = data.band
    count = len(start.mode_frequency)
    own = (np.log([low / 3.0, high * 3.0]), np.log(_DAMPINGS), (0.0, _LONGEST_DELAY / MILLI))
    mode = (np.log([low, high]), np.log(_MODE_DAMPINGS), (-_LARGEST_SHARE, _LARGEST_SHARE))
    bounds = np.array([*own, *(mode * count)], dtype=np.float64)
    if rest:
        bounds[-EACH : -EACH + 2] = np.log([[0.5 * _BEYOND * high, 2.0 * _BEYOND * high], [0.5, 2.0]])
    if held is not None:
        near = np.array([*_NEAR, _NEAR_LAG / (held.natural_frequency * MILLI)])
        bounds[:BASE] = held.searched()[:BASE, None] + near[:, None] * np.array([-1.0, 1.0])
        bounds[2, 0] = max(bounds[2, 0], 0.0)
    bottom, top = bounds.T
    begin = np.clip(start.searched(), bottom + 1e-9, top - 1e-9)

    def residual(x: Array) -> Array:
        return np.asarray(data.residual(ModalDrive.of_searched(x)) / deviation, np.float64)

    def jacobian(x: Array) -> Array:
        return np.asarray(data.jacobian(ModalDrive.of_searched(x)) / deviation[:, None], np.float64)

    found = scipy.optimize.least_squares(
        residual,
        begin,
        jac=jacobian,
        bounds=(bottom, top),
        x_scale="jac",
        loss="soft_l1" if rest else "linear",
        xtol=1e-10,
        ftol=1e-10,
        gtol=1e-10,
        max_nfev=100,
    )
    return ModalDrive.of_searched(found.x)


def _first(data: Data) -> ModalDrive:
    """Return the drive without modes that the low frequencies show."""
    low = data.low()
    deviation = low.coarse(_FINE)
    found = [_search(low, _with_rest(low, start), deviation, rest=True) for start in data.starts()]
    return _without_rest(min(found, key=lambda one: _robust_cost(low, one, deviation)))


def _cost(data: Data, drive: ModalDrive, deviation: Array) -> float:
    return float(np.sum((data.residual(drive) / deviation) ** 2))


def _robust_cost(data: Data, drive: ModalDrive, deviation: Array) -> float:
    """Return the cost of the loss ``soft_l1``, on which the points of further modes have little influence."""
    return float(np.sum(2.0 * (np.sqrt(1.0 + (data.residual(drive) / deviation) ** 2) - 1.0)))


def _model_error(data: Data, drive: ModalDrive) -> float:
    """Return the least ε with which the residuals are within their deviations, in the mean square."""
    freedom = max(data.size - drive.searched().size, 1)

    def excess(logarithm: float) -> float:
        return _cost(data, drive, data.deviation(drive, float(np.exp(logarithm)))) - freedom

    low, high = np.log(_EPSILON)
    if excess(low) <= 0.0:
        return _EPSILON[0]
    return float(np.exp(scipy.optimize.brentq(excess, low, high, xtol=1e-3))) if excess(high) < 0.0 else _EPSILON[1]


def _polish(data: Data, drive: ModalDrive) -> tuple[ModalDrive, float]:
    """Fit all parameters with the error of the model that the residuals require; return both."""
    error = _model_error(data, drive)
    for _ in range(_ROUNDS):
        drive, before = _search(data, drive, data.deviation(drive, error)), error
        error = _model_error(data, drive)
        if abs(error - before) <= 0.02 * before:
            break
    return drive.sorted(), error


def _bic(data: Data, drive: ModalDrive, model_error: float) -> float:
    deviation = data.deviation(drive, model_error)
    likelihood = _cost(data, drive, deviation) + 2.0 * float(np.sum(np.log(deviation)))
    return likelihood + (drive.searched().size + 1) * float(np.log(data.size))


def _with_rest(data: Data, drive: ModalDrive) -> ModalDrive:
    """Return the drive with a mode for those that are still missing, see `_search`."""
    return drive.with_modes([*drive.modes, (_BEYOND * data.band[1], 1.0, 0.0)])


def _without_rest(drive: ModalDrive) -> ModalDrive:
    """Return the drive without its last mode."""
    return drive.with_modes(drive.modes[:-1])


def _with_mode(data: Data, drive: ModalDrive, deviation: Array, held: ModalDrive | None) -> ModalDrive:
    """Return the drive with a further mode where it reduces the residual most, all parameters fitted again.

    The last mode of the drive is the one that stands for others, and stays the last.
    """
    rest = data.residual(drive) / deviation
    low, high = data.band
    count = max(int(np.log(0.98 * high / (1.5 * low)) / np.log(_PLACES)), 8)
    frequency = np.geomspace(1.5 * low, 0.98 * high, count)
    gains, shares = np.empty((len(_TRIED), count)), np.empty((len(_TRIED), count))
    for row, damping in enumerate(_TRIED):
        for piece in np.array_split(np.arange(count), -(-count // 64)):
            columns = data.mode(drive, frequency[piece], damping) / deviation[:, None]
            power = np.maximum(np.sum(columns**2, axis=0), np.finfo(float).tiny)
            shares[row, piece] = -(rest @ columns) / power
            gains[row, piece] = shares[row, piece] ** 2 * power
    found: list[ModalDrive] = []
    best = gains.max(axis=0)
    for _ in range(_STARTS):
        place = int(np.argmax(best))
        row = int(np.argmax(gains[:, place]))
        share = float(np.clip(shares[row, place], -1.0, 1.0))
        *modes, others = drive.modes
        begun = drive.with_modes([*modes, (float(frequency[place]), _TRIED[row], share), others])
        found.append(_search(data, begun, deviation, rest=True, held=held))
        best[np.abs(np.log(frequency / frequency[place])) < np.log(_APART)] = -1.0
        if best.max() <= 0.0:
            break
    return min(found, key=lambda one: _robust_cost(data, one, deviation))


def fit(data: Data, *, modes: int | None = None, report: Callable[[int], None] = lambda _: None) -> ModalFit:
    """Fit a drive with modes to measured points.

    Args:
        data: the points.
        modes: number of modes; None: that of the least BIC, up to `MOST_MODES`.
        report: is called with each number of modes before its fit.

    Raises:
        InputError: the points are too few, do not determine the parameters, or show participations that sum up to 1 or
            more.
    """
    wanted = MOST_MODES if modes is None else modes
    fewest = 2 * (BASE + EACH * (modes or 0))
    if data.size < fewest:
        raise InputError(f"fit: {data.size} real numbers; allowed: {fewest} or more for {modes or 0} modes")
    report(0)
    points = data.thinned(_FEW)
    deviation = points.coarse(_COARSE)
    first = _first(data)
    # With modes missing, a fit of all points distorts the drive that the low frequencies show, and this one may be
    # wrong where a mode is near: both are tried.
    tracks = {
        held: _search(points, _with_rest(points, first), deviation, rest=True, held=held) for held in (first, None)
    }
    chosen, error = min((_polish(points, _without_rest(drive)) for drive in tracks.values()), key=lambda pair: pair[1])
    bic = [_bic(points, chosen, error)]
    for count in range(1, wanted + 1):
        if points.size < 2 * (BASE + EACH * count):
            break
        report(count)
        if error < _COARSE:  # the modes so far are right: a further one is looked for with the error that they leave
            tracks = {None: _with_rest(points, chosen)}
            deviation = points.deviation(chosen, max(error, _FINE))
        tracks = {held: _with_mode(points, drive, deviation, held) for held, drive in tracks.items()}
        further, further_error = min(
            (_polish(points, _without_rest(drive)) for drive in tracks.values()), key=lambda pair: pair[1]
        )
        bic.append(_bic(points, further, further_error))
        pays = bic[-1] < min(bic[:-1]) - _PAYS and _certain(points, further, further_error)
        if modes is not None or pays:
            chosen, error = further, further_error
        elif error < _COARSE or count - len(chosen.mode_frequency) >= _AHEAD:
            break
    chosen, error = _polish(data, chosen)
    whole = sum(chosen.mode_participation)
    if whole >= 1.0:
        raise InputError(
            f"fit: the participations of the modes sum up to {whole:.4g}; allowed: below 1 (give fewer --modes, or "
            "measure lower frequencies too)"
        )
    return ModalFit(chosen, _covariance(data, chosen, error), error, tuple(bic))


def _certain(data: Data, drive: ModalDrive, model_error: float) -> bool:
    """Return whether the points determine each mode: its width, and its participation to a third.

    A mode at the lower end of the band or with the largest damping is a substitute for something else, and so are modes
    that leave the drive itself no part in the motion.
    """
    if sum(drive.mode_participation) >= 1.0:
        return False
    try:
        covariance = _covariance(data, drive, model_error)
    except InputError:
        return False
    uncertain = np.sqrt(np.diag(covariance))[BASE + EACH - 1 :: EACH]
    inside = all(w > 1.05 * data.band[0] and damping < 0.95 * _MODE_DAMPINGS[1] for w, damping, _ in drive.modes)
    return inside and data.resolved(drive) and bool(np.all(uncertain < np.abs(drive.mode_participation) / 3.0))


def _covariance(data: Data, drive: ModalDrive, model_error: float) -> Array:
    """Return the covariance of the searched parameters.

    (JᵀJ)⁻¹ for independent residuals, times (1 + r)/(1 - r) for residuals with the correlation r between neighbours,
    as an incomplete model leaves them.

    Raises:
        InputError: the points do not determine a parameter.
    """
    deviation = data.deviation(drive, model_error)
    jacobian = data.jacobian(drive) / deviation[:, None]
    lengths = np.linalg.norm(jacobian, axis=0)
    names = ["natural_frequency", "damping", "delay"]
    names += [f"{name} of mode {k + 1}" for k in range(len(drive.mode_frequency)) for name in _OF_MODE]
    if np.any(lengths == 0.0):
        raise InputError(f"fit: the measurement does not determine the {names[int(np.argmin(lengths))]}")
    _, sizes, directions = np.linalg.svd(jacobian / lengths, full_matrices=False)
    if sizes[-1] < 1e-8 * sizes[0]:
        worst = " and ".join(name for name, part in zip(names, directions[-1], strict=True) if abs(part) > 0.3)
        raise InputError(f"fit: the measurement does not distinguish {worst}; measure a wider band, or give --modes")
    rest = data.residual(drive) / deviation
    likeness = float(np.clip(rest[1:] @ rest[:-1] / (rest @ rest), 0.0, 0.95))
    inverse = (directions.T / sizes**2) @ directions / np.outer(lengths, lengths)
    return np.asarray(inverse * (1.0 + likeness) / (1.0 - likeness))


_OF_MODE = ("frequency", "damping", "participation")


def refuse_other_gain(data: ResponseData) -> None:
    """Reject a response whose magnitude at its lowest frequencies is not that of a drive, 1.

    Raises:
        InputError: the gain is another one.
    """
    gain = float(np.median(np.abs(data.measured.value[:3])))
    if not _LEAST_GAIN <= gain <= _MOST_GAIN:
        at = data.measured.frequency[0] / (2.0 * np.pi)
        raise InputError(
            f"response: magnitude {gain:.4g} at {at:.4g} Hz, the lowest frequency; allowed: near the static gain of 1, "
            f"{_LEAST_GAIN:g} to {_MOST_GAIN:g} (measure lower frequencies too; if the units differ, give them, such "
            f"as --column response=NAME:{1.0 / gain:.4g})"
        )
