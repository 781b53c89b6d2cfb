# SPDX-License-Identifier: Apache-2.0
"""Corrected form of the next part, from records of finished parts.

Records and forms are sums of harmonics, r(φ) = Σ Re(A_n·exp(inφ)). A record is turned to the part's angle, its
deviation D_n = desired less actual is averaged over revolutions and parts, and only harmonics that stand out of the
scatter of these are corrected: next programmed form = programmed form + g·Σ Re(D_n·exp(inφ)).

Iterative learning from part to part: Arimoto, Kawamura, Miyazaki, J. Robotic Systems 1 (1984) 123; with g the gain, the
error of a harmonic that the machine turns as programmed falls by the factor 1 - g from part to part.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from lathe_rc.analysis.metrology import gaussian_share
from lathe_rc.arrays import Array, Complex
from lathe_rc.errors import InputError

Places = npt.NDArray[np.intp]

_TURN = 2.0 * np.pi
_SEARCH = 8192  # angles at which the correlation is computed before it is refined
_ALIKE = 0.98  # of the highest correlation: a second maximum above it makes the angle ambiguous
_NEIGHBOURS = 4  # harmonics to each side whose scatter a harmonic has at least
_LARGEST_CONDITION = 1e3  # of the fit of the harmonics: gaps of a record amplify noise by less
_STANDS_OUT = 10.0  # an outlier is off the fit by more standard deviations
_TO_SIGMA = 1.4826  # standard deviation over the median distance, of normal noise
_NARROW = 4.0  # an outlier is narrower than the shortest fitted wave by this factor, or a single point
_FINE = 3.5  # readings to a coefficient of the fit, at least, for any to stand out
_PASSES, _HALF = 20, 0.5  # fits, and part of a distance that separates suspects, before the rule itself
_ALONE = 0.85  # part of its distance by which an outlier exceeds the readings around it
_MOST_OUTLIERS = 0.02  # of the readings of a revolution
_LEAST = 5e-9  # [m] least amplitude that is corrected: profile files end at 10 nm from peak to valley


@dataclass(frozen=True)
class MeasuredRevolution:
    """Measured revolution of a part.

    Attributes:
        angle: angles of the record [rad], shape (n,).
        radius: radius deviations [m], shape (n,).
        height: position along the part [m]; None: not known.
    """

    angle: Array
    radius: Array
    height: float | None = None


def harmonics(angle: Array, values: Array, highest: int, what: str = "revolution") -> Complex:
    """Fit harmonics up to ``highest`` to values at any angles [rad] by least squares, shape (highest + 1,).

    Raises:
        InputError: there are too few points, or gaps too wide for so many harmonics.
    """
    order = np.arange(highest + 1)
    if angle.size < 2 * highest + 1:
        raise InputError(
            f"{what}: {angle.size} points for {highest} harmonics; allowed: {2 * highest + 1} points or more, or fewer "
            "harmonics (--harmonics)"
        )
    waves = np.exp(1j * np.outer(angle, order))
    columns = np.hstack((waves.real, -waves.imag[:, 1:])) / np.sqrt(angle.size)
    u, sizes, v = scipy.linalg.svd(columns, full_matrices=False)
    if sizes[-1] * _LARGEST_CONDITION < sizes[0]:
        raise InputError(
            f"{what}: its gaps are too wide for {highest} harmonics; allowed: fewer harmonics (--harmonics), or a "
            "record without gaps"
        )
    found = v.T @ ((u.T @ values) / sizes) / np.sqrt(angle.size)
    return np.asarray(found[: highest + 1] + 1j * np.concatenate(([0.0], found[highest + 1 :])))


def outliers(angle: Array, values: Array, highest: int, what: str = "revolution") -> Places:
    """Return the places of readings that stand out of the harmonics and of their neighbours, such as dust, ascending.

    A reading stands out if its distance from the fitted harmonics exceeds ten times the robust standard deviation of
    these distances (1.48 times their median; F. R. Hampel, JASA 69 (1974) 383), if it and others beside it are at most
    a quarter of the shortest fitted wave wide, or alone, and if all further readings within half that wave are nearer
    to the fit than 15 % of its distance. Edges, grooves, kinks and waves of the form are wider, recur, or bend the fit
    around them. The fit leaves out what stands out, largest first. With fewer than 3.5 readings to a coefficient of
    the fit, nothing stands out: the fit follows each reading too closely.

    Args:
        angle: angles of the readings [rad], shape (n,).
        values: readings [m], shape (n,).
        highest: highest fitted harmonic.
        what: name of the revolution for error messages.

    Raises:
        InputError: see `harmonics`; or more than 2 % of the readings stand out.
    """
    if angle.size < _FINE * (2 * highest + 1):
        return np.empty(0, np.intp)
    order = np.argsort(np.mod(angle, _TURN), kind="stable")
    width = max(int(angle.size / (_NARROW * max(highest, 1))), 1)
    around = np.concatenate([np.arange(-2 * width - 2, 0), np.arange(1, 2 * width + 3)])
    neighbours = (np.arange(angle.size)[:, None] + around) % max(angle.size, 1)
    left = np.zeros(angle.size, bool)  # in the order of the angles, as all that follows

    def fit() -> tuple[Array, float]:
        """Return the distances from the harmonics of the readings that are not left out, and the largest usual one."""
        kept = order[~left]
        amplitudes = harmonics(angle[kept], values[kept], highest, what)
        distance = (values - evaluate(amplitudes, angle))[order]
        return distance, _STANDS_OUT * max(_TO_SIGMA * float(np.median(np.abs(distance[~left]))), _LEAST)

    for _ in range(_PASSES):
        distance, limit = fit()
        far = np.flatnonzero((np.abs(distance) > limit) & ~left)
        size = np.abs(distance[far])
        beside = np.sort(distance[neighbours[far]] * np.sign(distance[far])[:, None], axis=1)[:, -width]
        alone = far[beside < _HALF * size]
        if not alone.size:
            break
        # The largest bend the fit, so that readings beside them seem to stand out.
        left[alone[np.abs(distance[alone]) > _HALF * np.abs(distance[alone]).max()]] = True
    distance, limit = fit()
    around_it = np.abs(np.where(left, 0.0, distance)[neighbours]).max(axis=1)
    places = np.sort(order[left & (np.abs(distance) > limit) & (around_it < (1.0 - _ALONE) * np.abs(distance))])
    if places.size > _MOST_OUTLIERS * angle.size:
        raise InputError(
            f"{what}: {places.size} of {angle.size} points stand out, first {values[places[0]] * 1e6:.6g} µm at "
            f"{np.degrees(angle[places[0]]):.6g}°; allowed: up to {_MOST_OUTLIERS:.0%} (clean the part, or the record)"
        )
    return places


def evaluate(amplitudes: Complex, angle: Array) -> Array:
    """Evaluate Σ Re(A_n·exp(inφ)) at angles [rad], shape (n,)."""
    waves = np.exp(1j * np.outer(angle, np.arange(amplitudes.size)))
    return np.asarray((waves @ amplitudes).real)


@dataclass(frozen=True)
class Alignment:
    """Angle between a record and the part.

    Attributes:
        offset: angle of the record at which the part's angle 0 lies [rad].
        correlation: correlation of the turned record with the form, 1 for a record that is the form; NaN without one.
        scale: part of the form in the record, 1 for a record that is the form; NaN without a form.
    """

    offset: float
    correlation: float = np.nan
    scale: float = np.nan


def turn(amplitudes: Complex, offset: float, sense: float = 1.0) -> Complex:
    """Turn the harmonics of a record to the part's angle.

    Args:
        amplitudes: harmonics of the record, over its angle times ``sense``, shape (n,).
        offset: angle of the record at which the part's angle 0 lies [rad].
        sense: 1 for a record whose angle runs with that of the part, -1 for one against it.
    """
    return np.asarray(amplitudes * np.exp(1j * sense * offset * np.arange(amplitudes.size)))


def align(
    form: Sequence[Complex], record: Sequence[Complex], around: float, within: float, sense: float = 1.0
) -> Alignment:
    """Find the angle of a record by its cross-correlation with the form, without the mean radius.

    Args:
        form: harmonics of the form at the height of each revolution, of equal shapes (n,).
        record: harmonics of these revolutions.
        around: middle of the searched angles [rad].
        within: search to each side [rad]; 0: the offset is ``around``.
        sense: see `turn`.

    Raises:
        InputError: form or record are round, or look alike at several angles of the search.
    """
    cross = np.sum([np.conj(f) * b for f, b in zip(form, record, strict=True)], axis=0)
    squares = [sum(float(np.sum(np.abs(a[1:]) ** 2)) for a in both) for both in (form, record)]
    power = float(np.sqrt(np.prod(squares)))
    cross[0] = 0.0
    order = sense * np.arange(cross.size)

    def correlation(offset: Array) -> Array:
        return np.asarray((np.exp(1j * np.outer(offset, order)) @ cross).real)

    def at(offset: float) -> Alignment:
        if not power > 0.0:
            return Alignment(offset)
        found = float(correlation(np.array([offset]))[0])
        return Alignment(offset, found / power, found / squares[0])

    if within == 0.0:
        return at(around)
    if not power > 0.0:
        raise InputError("form or record is round: nothing to align it by; allowed: --offset with --search 0")
    offsets = around + np.linspace(-within, within, _SEARCH + 1)
    found = correlation(offsets)
    best = int(np.argmax(found))
    if within < np.pi and best in (0, _SEARCH):
        raise InputError(
            f"the correlation still rises at {np.degrees(offsets[best]):.4g}°, the end of the search; allowed: a "
            "larger --search, or another --offset"
        )
    peaks = [k for k in scipy.signal.argrelmax(found, mode="wrap")[0].tolist() if found[k] > _ALIKE * found[best]]
    apart = [k for k in peaks if abs(np.angle(np.exp(1j * (offsets[k] - offsets[best])))) > _TURN / _SEARCH]
    if apart:
        other = np.degrees(offsets[apart[0]] - offsets[best])
        raise InputError(
            f"the form looks the same when it is turned by {abs(other):.4g}°: the record's angle is ambiguous; "
            f"allowed: --offset with --search below {abs(other) / 2.0:.4g}"
        )
    refined = scipy.optimize.minimize_scalar(
        lambda offset: -correlation(np.array([offset]))[0],
        bounds=(offsets[max(best - 1, 0)], offsets[min(best + 1, _SEARCH)]),
        method="bounded",
        options={"xatol": 1e-9},
    )
    return at(float(np.angle(np.exp(1j * refined.x))))


@dataclass(frozen=True)
class Correction:
    """Correction of the programmed form by harmonics, shape (highest + 1,) each.

    Attributes:
        deviation: mean of desired less actual [m].
        noise: estimated RMS of the noise in it [m].
        corrected: whether the harmonic stands out of the noise and is corrected.
        change: harmonics added to the programmed form [m].
    """

    deviation: Complex
    noise: Array
    corrected: npt.NDArray[np.bool_]
    change: Complex


def correction(
    parts: Sequence[Sequence[Complex]],
    *,
    lowest: int,
    gain: float,
    guard: float,
    cutoff: float | None = None,
    noise: Array | None = None,
) -> Correction:
    """Estimate deviation and noise of each harmonic, and the change of the programmed form.

    The noise is the scatter between the revolutions or, with several parts, between the parts, whichever is larger. A
    harmonic has at least the middle scatter of its neighbours, since that of two or three revolutions is uncertain.

    Args:
        parts: deviation, desired less actual, of the revolutions of each part [m], arrays of shape (n,).
        lowest: lowest harmonic that is corrected: 0 with the size, 2 without size and centre.
        gain: part of the deviation that is corrected.
        guard: least ratio of an amplitude to its noise.
        cutoff: cut-off of a Gaussian filter of the change [UPR]; None for none.
        noise: RMS of the noise in the mean [m], shape (n,); None: estimated from the scatter.

    Raises:
        InputError: there is a single revolution, and no noise is given.
    """
    revolutions = np.array([each for part in parts for each in part])
    means = np.array([np.mean(part, axis=0) for part in parts])
    deviation = np.asarray(means.mean(axis=0))
    if noise is None:
        scatters = [_scatter(each) for each in (means, revolutions) if len(each) > 1]
        if not scatters:
            raise InputError(
                "one revolution of one part: its noise is not known; allowed: several revolutions or parts, or --noise"
            )
        noise = np.sqrt(np.max(scatters, axis=0))
    amplitude, order = np.abs(deviation), np.arange(deviation.size)
    corrected = (amplitude > guard * noise) & (amplitude >= _LEAST) & (order >= lowest)
    share = gaussian_share(order, cutoff) if cutoff else np.ones(order.size)
    return Correction(deviation, noise, corrected, np.where(corrected, gain * share * deviation, 0.0))


def _scatter(units: Complex) -> Array:
    """Return the variance of the mean of each harmonic, at least the middle one of its neighbours [m²]."""
    own = np.sum(np.abs(units - units.mean(axis=0)) ** 2, axis=0) / (len(units) * (len(units) - 1))
    spans = [own[max(n - _NEIGHBOURS, 0) : n + _NEIGHBOURS + 1] for n in range(own.size)]
    # The median of an exponential distribution, of the square of a complex amplitude, is ln 2 of its mean.
    return np.asarray(np.maximum(own, [np.median(span) / np.log(2.0) for span in spans]))


def white_noise(rms: float, points: int, revolutions: int, highest: int) -> Array:
    """Return the RMS of white noise in the mean harmonics of revolutions [m], shape (highest + 1,).

    Args:
        rms: of the noise of a point [m].
        points: points of a revolution.
        revolutions: number of revolutions.
        highest: highest harmonic.
    """
    found = np.full(highest + 1, 2.0 * rms / np.sqrt(points * revolutions))
    found[0] /= 2.0
    return found
