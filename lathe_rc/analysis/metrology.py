# SPDX-License-Identifier: Apache-2.0
"""The form of the part, revolution by revolution, as the workshop reads it.

`lathe_rc.analysis.form_errors` weighs the samples of a run by the angle that they stand for. All else starts from
`evenly`, which interpolates them at even angles, so that it does not matter how fast the spindle passed a place; a
profile is then an array of shape (revolutions, points) whose last axis goes once round from angle 0.

Undulations per revolution are UPR. Terms are those of ISO 12181-1 (roundness) and ISO 21920-2 (roughness), the filter
is that of ISO 16610-21 for closed profiles.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from lathe_rc.analysis.form_errors import FormErrors, form_errors, turns_at_end
from lathe_rc.errors import InputError

Array = npt.NDArray[np.float64]

POINTS = 4096  #: even angles in a revolution, about as many as the cell has samples at 1000 rpm
_STANDSTILL = 1e-3  # of the largest step of the angle between samples
_PER_MARK = 64  # places between revolutions
_PER_UNDULATION = 7  # points that an undulation at the filter's cut-off needs


def evenly(angle: Array, values: Array, points: int = POINTS) -> Array:
    """Values of each complete revolution at the angles 0, 2π/points, …, by cubic splines.

    Where the spindle stands still, the last sample counts: with that the tool leaves the place. With steps as
    different as before and after a standstill a cubic spline overshoots; then one without overshoot takes its place.

    Args:
        angle: true spindle angle [rad], not falling, shape (n,).
        values: of each sample, shape (n,).
        points: in a revolution.

    Returns:
        Shape (revolutions, points); revolutions as in `form_errors`. Where the run ends up to two samples before
        the last revolution does, the last value is held.

    Raises:
        InputError: the angle falls, or there are too few points.
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
    """Harmonics of each profile: r(φ) = Σ amplitude·sin(UPR·φ + phase), as profiles are given to the cell.

    Attributes:
        amplitude: [m], shape (revolutions, highest UPR + 1); UPR 0 is the magnitude of the mean.
        phase: [rad], from -π to π, the same shape.
    """

    amplitude: Array
    phase: Array


def undulations(profile: Array, highest: int) -> Undulations:
    """Harmonics up to ``highest`` UPR of profiles at even angles [m], shape (revolutions, points).

    Raises:
        InputError: the profile has too few points for so many undulations.
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
    """The long waves of profiles, by the Gaussian filter of ISO 16610-21 for closed profiles.

    An undulation of n UPR keeps exp(-π·(α·n/cutoff)²) of its amplitude, α = sqrt(ln 2/π): half of it at the cut-off.

    Args:
        profile: at even angles [m], shape (revolutions, points); so is the result.
        cutoff: [UPR]; ISO 12181-2 has 15, 50, 150, 500 and 1500.

    Raises:
        InputError: the cut-off leaves less than seven points in an undulation.
    """
    points = profile.shape[-1]
    if not 0.0 < cutoff <= points / _PER_UNDULATION:
        raise InputError(
            f"filter cut-off {cutoff:g} UPR for {points} points; allowed: above 0 and up to a seventh of the points"
        )
    order = np.arange(points // 2 + 1)
    kept = np.exp(-np.log(2.0) * (order / cutoff) ** 2)
    return np.fft.irfft(np.fft.rfft(profile, axis=-1) * kept, n=points, axis=-1)


@dataclass(frozen=True)
class Roundness:
    """Least-squares circle of each profile and the deviation from it, shape (revolutions,).

    Attributes:
        radius: of the circle, as deviation from the radius that the profile is measured from [m].
        x, y: its centre [m], x at angle 0 and y at π/2.
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
    """Least-squares circle (LSCI of ISO 12181-1) and roundness deviations from it.

    The circle is R + x·cos φ + y·sin φ, its form for a centre near the axis. An eccentric true circle of radius R
    seems out of round by e²/2R.

    Args:
        profile: radius deviations at even angles [m], shape (revolutions, points).
        cutoff: the deviations are those of the long waves up to this [UPR], see `gaussian`; None: all.

    Raises:
        InputError: see `gaussian`.
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
    """Roughness around the part, shape (revolutions,).

    Attributes:
        ra: arithmetic mean deviation [m].
        rq: root mean square deviation [m].
    """

    ra: Array
    rq: Array


def roughness(profile: Array, cutoff: float) -> Roughness:
    """Ra and Rq of what the Gaussian filter takes away: undulations above ``cutoff`` UPR, half of those at it.

    A revolution that does not end where it began has a step there, whose sharp part counts as roughness.

    Args:
        profile: at even angles [m], shape (revolutions, points).
        cutoff: [UPR].

    Raises:
        InputError: see `gaussian`.
    """
    short = profile - gaussian(profile, cutoff)
    return Roughness(np.abs(short).mean(axis=-1), np.sqrt((short**2).mean(axis=-1)))


def feed_mark(feed: float, nose_radius: float) -> float:
    """Height of what a nose leaves standing between revolutions, r - √(r² - f²/4), nearly f²/(8r) [m].

    Its mean deviation Ra is nearly f²/(18·√3·r).

    Args:
        feed: f [m/rev].
        nose_radius: r, in the plane of the feed [m].

    Raises:
        InputError: a nose that would leave material between revolutions, or none.
    """
    # Where noses only just touch, rounding decides if a place between them is cut.
    if not 0.0 < abs(feed) < 2.0 * nose_radius * (1.0 - 1e-9) < np.inf:
        raise InputError(
            f"feed of {feed:g} m/rev and a nose of {nose_radius:g} m; allowed: a feed other than 0 and below twice "
            "the nose's radius"
        )
    return float(nose_radius - np.sqrt(nose_radius**2 - feed**2 / 4.0))


@dataclass(frozen=True)
class Lay:
    """The surface along the part: what the nose leaves of revolution beside revolution.

    Attributes:
        height: places along the part [m], even, shape (places,).
        surface: deviation of the radius from the desired form [m], shape (angles, places); angles are even, from 0 on.
        revolutions: that it is made of.
        feed: mean [m/rev].
        errorless: height of the marks of an errorless path at this feed, see `feed_mark` [m].
    """

    height: Array
    surface: Array
    revolutions: int
    feed: float
    errorless: float

    @property
    def ra(self) -> Array:
        """Ra of each trace, from its mean [m], shape (angles,)."""
        return np.asarray(np.abs(self.surface - self.surface.mean(axis=-1, keepdims=True)).mean(axis=-1))

    @property
    def rt(self) -> Array:
        """Rt of each trace, its total height [m], shape (angles,)."""
        return np.asarray(np.ptp(self.surface, axis=-1))


def lay(profile: Array, height: Array, nose_radius: float, *, revolutions: int = 8, angles: int = 64) -> Lay:
    """The surface that a round nose leaves, along the part.

    A nose at the height h, whose foremost point deviates by e, cuts down to e + r - √(r² - (z - h)²) at the place z; of
    all revolutions the deepest cut remains. Noses further than their radius from a place do not reach it.

    Args:
        profile: deviation of each revolution [m], shape (revolutions, points), see `Measurement`.
        height: of the nose [m], the same shape.
        nose_radius: r, in the plane of the feed [m].
        revolutions: the last so many are looked at, as far as the height moves one way.
        angles: at which traces are taken; of the points every so many-th.

    Raises:
        InputError: see `feed_mark`; or less than three revolutions that were fed one way.
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
    """The workshop's figures of each complete revolution.

    Attributes:
        profile: deviation of the part's radius from the desired form at even angles [m], shape (revolutions, points).
        form: its RMS and extremes, from the samples themselves.
        undulations, roundness, roughness: of the profile.
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
    """Measure the part that a run has turned.

    The form error is desired less actual, so the part's radius deviates by its opposite: where the error is
    positive, material is missing.

    Args:
        angle: true spindle angle [rad], not falling, shape (n,).
        error: form error [m], shape (n,).
        points: even angles in a revolution.
        highest: of the undulations [UPR].
        roundness_cutoff: see `roundness`.
        roughness_cutoff: see `roughness` [UPR].

    Raises:
        InputError: too few points for the undulations or for a cut-off, or an angle that falls.
    """
    profile = -evenly(angle, error, points)
    return Measurement(
        profile,
        form_errors(angle, error),
        undulations(profile, highest),
        roundness(profile, roundness_cutoff),
        roughness(profile, roughness_cutoff),
    )
