# SPDX-License-Identifier: Apache-2.0
"""Form metrology of the part per revolution: roundness, undulations, roughness and lay.

`lathe_rc.signals.form_errors` weights the samples of a run by their angle. All other figures start from `evenly`,
which interpolates the samples at equidistant angles and thus removes the influence of the spindle speed; a profile is
then an array of shape (revolutions, points) whose last axis is one revolution from angle 0.

UPR stands for undulations per revolution. Terms follow ISO 12181-1 (roundness) and ISO 21920-2 (roughness), the filter
ISO 16610-21 for closed profiles.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from lathe_rc.arrays import Array, Integers
from lathe_rc.errors import InputError
from lathe_rc.signals.form_errors import FormErrors, form_errors, turns_at_end

POINTS = 4096  #: angles per revolution, about the number of the cell's samples at 1000 rpm
_STANDSTILL = 1e-3  # of the largest step of the angle between samples
_PER_MARK = 64  # places between revolutions
_PER_UNDULATION = 7  # points required per undulation at the filter's cut-off


def evenly(angle: Array, values: Array, points: int = POINTS) -> Array:
    """Interpolate each complete revolution at the angles 0, 2π/points, … by cubic splines.

    At a standstill only the last sample is used, with which the tool leaves the position. Where the angle steps differ
    as much as around a standstill, a cubic spline would overshoot; a spline without overshoot is used instead.

    Args:
        angle: true spindle angle [rad], not decreasing, shape (n,).
        values: value of each sample, shape (n,).
        points: points per revolution.

    Returns:
        Values of shape (revolutions, points); revolutions as in `form_errors`. If the run ends up to two samples
        before the end of the last revolution, the last value is held.

    Raises:
        InputError: the angle decreases, or there are too few points.
    """
    if points < 3:
        raise InputError(f"{points} points in a revolution; allowed: 3 or more")
    if angle.size < 2:
        return np.empty((0, points))
    steps = np.diff(angle)
    if not np.all(steps >= 0.0):
        k = int(np.argmin(steps >= 0.0))
        raise InputError(
            f"the angle goes from {angle[k]:g} to {angle[k + 1]:g} rad at sample {k}; allowed: an angle that does not "
            "fall (take the true one, not that of the encoder)"
        )
    turns = angle / (2.0 * np.pi)
    whole = max(turns_at_end(*turns[-2:]), 0)
    if not whole:
        return np.empty((0, points))
    at = np.arange(whole * points) / points
    spline: Any = scipy.interpolate.CubicSpline
    if steps.min() <= _STANDSTILL * steps.max():
        leaves = np.append(np.diff(np.floor(angle / (_STANDSTILL * steps.max()))) > 0.0, True)
        turns, values, spline = turns[leaves], values[leaves], scipy.interpolate.PchipInterpolator
    return np.asarray(spline(turns, values)(np.clip(at, turns[0], turns[-1]))).reshape(whole, points)


@dataclass(frozen=True)
class Undulations:
    """Harmonics of each profile: r(φ) = Σ amplitude·sin(UPR·φ + phase), the convention of the cell's profiles.

    Attributes:
        amplitude: amplitudes [m], shape (revolutions, highest UPR + 1); UPR 0 is the magnitude of the mean.
        phase: phases [rad], from -π to π, the same shape.
    """

    amplitude: Array
    phase: Array


def undulations(profile: Array, highest: int) -> Undulations:
    """Compute the harmonics up to ``highest`` UPR of profiles at equidistant angles [m], shape (revolutions, points).

    Raises:
        InputError: the profile has too few points for the highest UPR.
    """
    points = profile.shape[-1]
    if not 0 <= highest < points / 2:
        raise InputError(
            f"harmonics up to {highest} UPR of {points} points; allowed: from 0, less than half the points"
        )
    waves = np.fft.rfft(profile, axis=-1)[..., : highest + 1] / points
    waves[..., 1:] *= 2.0
    return Undulations(np.abs(waves), np.angle(1j * waves))


def gaussian(profile: Array, cutoff: float) -> Array:
    """Compute the long-wave component of profiles by the Gaussian filter of ISO 16610-21 for closed profiles.

    The amplitude at n UPR is multiplied by exp(-π·(α·n/cutoff)²) with α = sqrt(ln 2/π), by 1/2 at the cut-off.

    Args:
        profile: profiles at equidistant angles [m], shape (revolutions, points), also the shape of the result.
        cutoff: cut-off [UPR]; ISO 12181-2 specifies 15, 50, 150, 500 and 1500.

    Raises:
        InputError: there are less than seven points per undulation at the cut-off.
    """
    points = profile.shape[-1]
    if not 0.0 < cutoff <= points / _PER_UNDULATION:
        raise InputError(
            f"filter cut-off {cutoff:g} UPR for {points} points; allowed: above 0 and up to a seventh of the points"
        )
    kept = gaussian_share(np.arange(points // 2 + 1), cutoff)
    return np.fft.irfft(np.fft.rfft(profile, axis=-1) * kept, n=points, axis=-1)


def gaussian_share(order: Integers, cutoff: float) -> Array:
    """Compute the part of an amplitude at ``order`` UPR that the Gaussian filter of ISO 16610-21 keeps, shape (n,)."""
    return np.asarray(np.exp(-np.log(2.0) * (order / cutoff) ** 2))


@dataclass(frozen=True)
class Roundness:
    """Least-squares circle of each profile and the deviation from it, shape (revolutions,).

    Attributes:
        radius: radius of the circle, relative to the reference radius of the profile [m].
        x, y: centre of the circle [m], x at angle 0 and y at π/2.
        peak_to_valley: RONt [m].
        rms: RONq [m].
    """

    radius: Array
    x: Array
    y: Array
    peak_to_valley: Array
    rms: Array

    @property
    def eccentricity(self) -> Array:
        """Distance of the centre from the axis [m]."""
        return np.hypot(self.x, self.y)


def roundness(profile: Array, cutoff: float | None = None) -> Roundness:
    """Compute the least-squares circle (LSCI of ISO 12181-1) and the roundness deviations from it.

    The circle is approximated by R + x·cos φ + y·sin φ, for a centre near the axis. A true circle of radius R with the
    eccentricity e then has an apparent roundness deviation of e²/2R.

    Args:
        profile: radius deviations at equidistant angles [m], shape (revolutions, points).
        cutoff: cut-off of the Gaussian filter for the deviations [UPR]; None for no filter.

    Raises:
        InputError: there are less than seven points per undulation at the cut-off.
    """
    angle = 2.0 * np.pi * np.arange(profile.shape[-1]) / profile.shape[-1]
    cosine, sine = np.cos(angle), np.sin(angle)
    radius = profile.mean(axis=-1)
    x, y = 2.0 * (profile * cosine).mean(axis=-1), 2.0 * (profile * sine).mean(axis=-1)
    circle = radius[..., None] + x[..., None] * cosine + y[..., None] * sine
    deviation = profile - circle
    if cutoff is not None:
        deviation = gaussian(deviation, cutoff)
    return Roundness(radius, x, y, np.ptp(deviation, axis=-1), np.sqrt((deviation**2).mean(axis=-1)))


@dataclass(frozen=True)
class Roughness:
    """Roughness in circumferential direction, shape (revolutions,).

    Attributes:
        ra: arithmetic mean deviation [m].
        rq: root mean square deviation [m].
    """

    ra: Array
    rq: Array


def roughness(profile: Array, cutoff: float) -> Roughness:
    """Compute Ra and Rq of the short-wave component: the profile less its Gaussian filter with the given cut-off.

    If the radii at the start and the end of a revolution differ, the short-wave component of this step counts as
    roughness.

    Args:
        profile: profiles at equidistant angles [m], shape (revolutions, points).
        cutoff: cut-off of the Gaussian filter [UPR].

    Raises:
        InputError: there are less than seven points per undulation at the cut-off.
    """
    short = profile - gaussian(profile, cutoff)
    return Roughness(np.abs(short).mean(axis=-1), np.sqrt((short**2).mean(axis=-1)))


def feed_mark(feed: float, nose_radius: float) -> float:
    """Compute the height of the feed marks of a round nose, r - √(r² - f²/4), about f²/(8r) [m].

    The arithmetic mean deviation Ra of the marks is about f²/(18·√3·r).

    Args:
        feed: f [m/rev].
        nose_radius: r, in the plane of the feed [m].

    Raises:
        InputError: the nose radius is not positive, or too small to remove the material between revolutions.
    """
    # Where cuts barely touch, the rounding error decides whether the place between them is cut.
    if not 0.0 < abs(feed) < 2.0 * nose_radius * (1.0 - 1e-9) < np.inf:
        raise InputError(
            f"feed of {feed:g} m/rev and a nose of {nose_radius:g} m; allowed: a feed other than 0 and below twice "
            "the nose's radius"
        )
    return float(nose_radius - np.sqrt(nose_radius**2 - feed**2 / 4.0))


@dataclass(frozen=True)
class Lay:
    """Surface along the part that results from the feed marks of successive revolutions.

    Attributes:
        height: equidistant heights along the part [m], shape (places,).
        surface: deviation of the radius from the desired form [m], shape (angles, places); equidistant angles from 0.
        revolutions: number of revolutions used.
        feed: mean feed [m/rev].
        errorless: height of the feed marks of an error-free path at this feed, see `feed_mark` [m].
    """

    height: Array
    surface: Array
    revolutions: int
    feed: float
    errorless: float

    @property
    def ra(self) -> Array:
        """Arithmetic mean deviation Ra of each trace about its mean [m], shape (angles,)."""
        return np.asarray(np.abs(self.surface - self.surface.mean(axis=-1, keepdims=True)).mean(axis=-1))

    @property
    def rt(self) -> Array:
        """Total height Rt of each trace [m], shape (angles,)."""
        return np.asarray(np.ptp(self.surface, axis=-1))


def lay(profile: Array, height: Array, nose_radius: float, *, revolutions: int = 8, angles: int = 64) -> Lay:
    """Compute the surface along the part that is cut by a round nose.

    A nose at the height h whose apex deviates by e cuts down to e + r - √(r² - (z - h)²) at the height z; the deepest
    cut of all revolutions determines the surface. A nose does not reach heights further away than its radius.

    Args:
        profile: deviation of each revolution [m], shape (revolutions, points), see `Measurement`.
        height: height of the nose [m], the same shape.
        nose_radius: r, in the plane of the feed [m].
        revolutions: number of last revolutions used, as far as the feed has one direction.
        angles: number of traces, at equidistant points of the profile.

    Raises:
        InputError: the nose radius is invalid as in `feed_mark`, or less than three revolutions have the same feed
            direction.
    """
    steps = np.diff(height, axis=0)
    onward = np.all(steps > 0.0, axis=1) if steps.size and steps[-1, 0] > 0.0 else np.all(steps < 0.0, axis=1)
    stops = np.flatnonzero(~onward)
    count = min(revolutions, height.shape[0] - (int(stops[-1]) + 1 if stops.size else 0))
    if count < 3:
        raise InputError(
            f"roughness along the part: {max(count, 0)} revolutions that were fed one way; allowed: 3 or more (a feed "
            "above 0, a longer run)"
        )
    every = profile.shape[1] // min(angles, profile.shape[1])
    apex, at = profile[-count:, ::every].T, height[-count:, ::every].T  # (angles, revolutions)
    feed = float(np.abs(np.diff(at, axis=1)).mean())
    errorless = feed_mark(feed, nose_radius)
    low, high = at.min(axis=1).max(), at.max(axis=1).min()
    place = np.linspace(low, high, _PER_MARK * (count - 2) + 1)
    surface = np.full((at.shape[0], place.size), np.inf)
    for k in range(count):
        square = nose_radius**2 - (place[None, :] - at[:, k, None]) ** 2
        cut = apex[:, k, None] + nose_radius - np.sqrt(np.maximum(square, 0.0))
        surface = np.minimum(surface, np.where(square >= 0.0, cut, np.inf))
    return Lay(place, surface, count, feed, errorless)


@dataclass(frozen=True)
class Measurement:
    """Metrology of each complete revolution: profile, form error, undulations, roundness and roughness.

    Attributes:
        profile: deviation of the radius from the desired form at equidistant angles [m], shape (revolutions, points).
        form: RMS and extremes of the form error, from the samples themselves.
        undulations, roundness, roughness: figures of the profile.
    """

    profile: Array
    form: FormErrors
    undulations: Undulations
    roundness: Roundness
    roughness: Roughness


def measure(
    angle: Array,
    error: Array,
    *,
    points: int = POINTS,
    highest: int = 50,
    roundness_cutoff: float | None = None,
    roughness_cutoff: float = 50.0,
) -> Measurement:
    """Compute the metrology of a turned part from the form error of a run.

    The form error is desired less actual, so the radius deviates by its negative: at a positive error material is
    missing.

    Args:
        angle: true spindle angle [rad], not decreasing, shape (n,).
        error: form error [m], shape (n,).
        points: points per revolution.
        highest: highest undulation [UPR].
        roundness_cutoff: cut-off for `roundness` [UPR]; None for no filter.
        roughness_cutoff: cut-off for `roughness` [UPR].

    Raises:
        InputError: too few points for the undulations or for a cut-off, or a decreasing angle.
    """
    profile = -evenly(angle, error, points)
    return Measurement(
        profile,
        form_errors(angle, error),
        undulations(profile, highest),
        roundness(profile, roundness_cutoff),
        roughness(profile, roughness_cutoff),
    )
