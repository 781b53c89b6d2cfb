# SPDX-License-Identifier: Apache-2.0
"""Part profiles: radius deviation against spindle angle and position along the part.

A profile is a formula; what the cell runs is its table, a periodic cubic spline in the angle with linear
interpolation along the part, which also gives the derivatives for the feasibility check.
"""

import math
import pickle
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt
import scipy

from lathe_rc.errors import InputError
from lathe_rc.jit import inlined, kernel
from lathe_rc.signals.table import parse_table, read_text

Array = npt.NDArray[np.float64]

_TURN = 2.0 * np.pi


class Profile(Protocol):
    """A desired form."""

    @property
    def heights(self) -> Array:
        """Positions along the part [m], increasing, between which linear interpolation is good; shape (m,)."""

    def deviation(self, angle: Array, height: float) -> Array:
        """Radius deviation [m] at ``angle`` [rad] (shape (n,)) and ``height`` [m]; 2π-periodic."""


@dataclass(frozen=True)
class Harmonics:
    """Sum of harmonics, Σ A_i·sin(i·φ + φ_i) (paper 000, eq. 5)."""

    order: Array
    amplitude: Array
    phase: Array

    def __post_init__(self) -> None:
        if not self.order.size == self.amplitude.size == self.phase.size:
            raise InputError(
                f"harmonic profile: {self.order.size} orders, {self.amplitude.size} amplitudes and "
                f"{self.phase.size} phases; give as many of each"
            )

    @property
    def heights(self) -> Array:
        """One height: the form is the same all along the part."""
        return np.zeros(1)

    def deviation(self, angle: Array, height: float) -> Array:
        """See `Profile`."""
        waves = self.amplitude[:, None] * np.sin(np.outer(self.order, angle) + self.phase[:, None])
        return np.asarray(waves.sum(axis=0))


@dataclass(frozen=True)
class Piston:
    """Oval-barrel piston skirt.

    Args:
        ovality: difference of the two diameters at the ends of the skirt [m].
        ovality_middle: the same at the widest place [m].
        barrel: radius lost at the ends of the skirt against the widest place [m].
        length: length of the skirt [m].
        widest: widest place from the start of the skirt [m].
    """

    ovality: float
    ovality_middle: float
    barrel: float
    length: float
    widest: float

    @property
    def heights(self) -> Array:
        """65 places along the skirt: linear interpolation between them errs by less than 3e-4 barrel."""
        return np.linspace(0.0, self.length, 65)

    def deviation(self, angle: Array, height: float) -> Array:
        """-barrel·z² - (ovality(z)/4)·(1 - cos 2φ), z = 0 at the widest place and 1 at the farther end."""
        z = (height - self.widest) / max(self.widest, self.length - self.widest)
        ovality = self.ovality_middle + (self.ovality - self.ovality_middle) * z * z
        return np.asarray(-self.barrel * z * z - ovality / 4.0 * (1.0 - np.cos(2.0 * angle)))


@dataclass(frozen=True)
class Polygon:
    """Regular polygon with rounded corners, as the deviation from the middle between its circles.

    Args:
        sides: number of sides, 3 or more.
        inscribed_radius: radius of the inscribed circle [m].
        corner_radius: radius of the corners [m], above 0 and at most the inscribed radius.
    """

    sides: int
    inscribed_radius: float
    corner_radius: float

    def __post_init__(self) -> None:
        if self.sides < 3:
            raise InputError(f"polygon: {self.sides} sides; allowed: 3 or more")
        if not 0.0 < self.corner_radius <= self.inscribed_radius:
            raise InputError(
                f"polygon: corner radius {self.corner_radius:g} m; allowed: above 0 and at most the inscribed "
                f"radius {self.inscribed_radius:g} m"
            )

    @property
    def heights(self) -> Array:
        """One height: a prism."""
        return np.zeros(1)

    def deviation(self, angle: Array, height: float) -> Array:
        """Distance of the outline from the axis less the mean of its extremes; a side faces angle 0."""
        half = math.pi / self.sides
        from_side = np.abs(np.mod(angle + half, 2 * half) - half)
        # The corner's circle touches the side where the normal through its centre meets it.
        centre = (self.inscribed_radius - self.corner_radius) / math.cos(half)
        touch = math.atan2((self.inscribed_radius - self.corner_radius) * math.tan(half), self.inscribed_radius)
        from_corner = half - from_side
        across = np.sqrt(np.maximum(self.corner_radius**2 - (centre * np.sin(from_corner)) ** 2, 0.0))
        corner = centre * np.cos(from_corner) + across
        side = self.inscribed_radius / np.cos(np.minimum(from_side, touch))
        radius = np.where(from_side <= touch, side, corner)
        return np.asarray(radius - (self.inscribed_radius + centre + self.corner_radius) / 2.0)


@dataclass(frozen=True)
class Measured:
    """A profile from points: a periodic cubic spline through each row, linear between rows.

    Args:
        angle: increasing angles [rad] in [0, 2π), shape (n,).
        heights: increasing positions [m], shape (m,).
        radius: deviations [m], shape (m, n).
    """

    angle: Array
    heights: Array
    radius: Array

    def deviation(self, angle: Array, height: float) -> Array:
        """See `Profile`."""
        rows = [np.interp(height, self.heights, column) for column in self.radius.T]
        closed = np.append(rows, rows[0])
        spline = scipy.interpolate.CubicSpline(np.append(self.angle, self.angle[0] + _TURN), closed, bc_type="periodic")
        return np.asarray(spline(self.angle[0] + np.mod(angle - self.angle[0], _TURN)))


_HEADERS = (("angle_deg", "radius_um"), ("angle_deg", "height_mm", "radius_um"))
_FLATTEST = 0.01  # [µm] peak to valley of a form: nobody turns less
_FARTHEST = 10_000.0  # [µm] that all of a form may be away from the middle
_TURN_OF_RADIANS = 6.3  # [°] a column that spans no more is in another unit
_CLOSEST = 1e-6  # [°, mm] between two points: closer ones are a slip, and their slope overflows


def _check_distances(path: Path, what: str, unit: str, places: Array) -> None:
    near = np.flatnonzero(np.diff(places) < _CLOSEST)
    if near.size:
        a, b = places[near[0]], places[near[0] + 1]
        raise InputError(
            f"{path}: {what} {a:.10g} and {b:.10g}{unit} are too close; allowed: {_CLOSEST:g}{unit} apart or more"
        )


def _check_units(path: Path, angle_deg: Array, radius_um: Array) -> None:
    """Refuse columns that are most likely in another unit than their names say."""
    low, high = angle_deg[0], angle_deg[-1]
    if high - low <= _TURN_OF_RADIANS:
        unit = "radians" if high > 1.0 else "revolutions"
        raise InputError(
            f"{path}: angle_deg spans {low:.4g} to {high:.4g}, which looks like {unit}; allowed: degrees all round, 0 "
            "up to 360"
        )
    height = float(np.ptp(radius_um))
    if 0.0 < height < _FLATTEST:
        raise InputError(
            f"{path}: radius_um is {height:.3g} µm from peak to valley, which looks like metres or millimetres; "
            f"allowed: micrometres, 0 or {_FLATTEST:g} and above"
        )
    nearest = float(np.abs(radius_um).min())
    if nearest > _FARTHEST:
        raise InputError(
            f"{path}: radius_um is {nearest:.4g} µm or more everywhere, which looks like radii, or nanometres; "
            f"allowed: deviations from the mean radius in micrometres, up to {_FARTHEST:g}"
        )


def read_csv(path: Path) -> Measured:
    """Read a profile from a CSV file.

    Columns ``angle_deg`` [°], optionally ``height_mm`` [mm], ``radius_um`` (radius deviation) [µm], in any
    order of rows. Every height must have the same angles.

    Raises:
        InputError: the file is missing, malformed, in other units, holds a number that is not finite, or repeats an
            angle.
    """
    return _measured(read_text(path, "profile"), path)


@lru_cache(maxsize=8)
def _measured(text: str, path: Path) -> Measured:
    """The profile in a text: to make it takes longer than some cells run, and nobody changes it."""
    header, rows = parse_table(text, path, _HEADERS)
    if not rows.size:
        raise InputError(f"{path}: no points; give at least three angles")
    if len(header) == 2:
        rows = np.insert(rows, 1, 0.0, axis=1)
    angle_deg, heights_mm = np.unique(rows[:, 0]), np.unique(rows[:, 1])
    if angle_deg[0] < 0.0 or angle_deg[-1] >= 360.0:
        wrong = angle_deg[0] if angle_deg[0] < 0.0 else angle_deg[-1]
        raise InputError(f"{path}: angle {wrong:g}°; allowed: 0 up to but not including 360")
    if angle_deg.size < 3:
        raise InputError(f"{path}: {angle_deg.size} different angles; allowed: 3 or more")
    _check_units(path, angle_deg, rows[:, 2])
    _check_distances(path, "angles", "°", np.append(angle_deg, angle_deg[0] + 360.0))
    _check_distances(path, "heights", " mm", heights_mm)
    radius = np.full((heights_mm.size, angle_deg.size), np.nan)
    at = np.searchsorted(heights_mm, rows[:, 1]), np.searchsorted(angle_deg, rows[:, 0])
    cells, counts = np.unique(np.stack(at), axis=1, return_counts=True)
    if np.any(counts > 1):
        height, angle = cells[:, np.argmax(counts > 1)]
        raise InputError(
            f"{path}: angle {angle_deg[angle]:g}° at height {heights_mm[height]:g} mm appears more than once; keep one"
        )
    radius[at] = rows[:, 2] * 1e-6
    if np.any(np.isnan(radius)):
        height, angle = np.argwhere(np.isnan(radius))[0]
        raise InputError(
            f"{path}: no point at angle {angle_deg[angle]:g}°, height {heights_mm[height]:g} mm; "
            "every height needs the same angles"
        )
    return Measured(np.deg2rad(angle_deg), heights_mm * 1e-3, radius)


@kernel
def height_along(feed: float, start: float, part: int, angle: Array, height: Array) -> None:
    """Fill the place along the part [m] at a spindle angle [rad], shape (n,).

    Args:
        feed: [m/rev].
        start: where the part begins [m].
        part: revolutions after which the next part begins; 0 for one endless part.
        angle: see above.
        height: see above.
    """
    for k in range(angle.size):
        turns = angle[k] / _TURN
        if part > 0:
            turns -= part * np.floor(turns / part)
        height[k] = start + feed * turns


@inlined
def _cubic(row: Array, place: float) -> float:
    """A row of a table, shape (n, 4), at ``place`` [interval]; n is a power of two."""
    whole = np.floor(place)
    j = np.uint64(np.int64(whole)) & np.uint64(row.shape[0] - 1)
    u = place - whole
    return float(((row[j, 0] * u + row[j, 1]) * u + row[j, 2]) * u + row[j, 3])


@inlined
def _cubic_derivatives(c: Array, u: float) -> tuple[float, float, float]:
    """A cubic, highest power first, and its first two derivatives at ``u``."""
    return (
        ((c[0] * u + c[1]) * u + c[2]) * u + c[3],
        (3.0 * c[0] * u + 2.0 * c[1]) * u + c[2],
        6.0 * c[0] * u + 2.0 * c[1],
    )


@kernel
def deviation_along(heights: Array, table: Array, angle: Array, height: Array, deviation: Array) -> None:
    """Fill the radius deviation [m] at angles [rad] and heights [m], shape (n,), from a `ProfileTable`.

    Cubic in the angle, linear in the height, and beyond the ends of the part as at its ends.
    """
    per_radian = table.shape[1] / _TURN
    last = heights.size - 1
    row = start = 0
    while start < angle.size:
        # Neighbours are mostly between the same two rows: take them together.
        while row > 0 and not height[start] >= heights[row]:
            row -= 1
        while row < last and height[start] >= heights[row + 1]:
            row += 1
        stop = start + 1
        while (
            stop < angle.size
            and (row == 0 or height[stop] >= heights[row])
            and (row == last or height[stop] < heights[row + 1])
        ):
            stop += 1
        below = table[row]
        if row == last:
            for k in range(start, stop):
                deviation[k] = _cubic(below, angle[k] * per_radian)
        else:
            above, low, high = table[row + 1], heights[row], heights[row + 1]
            for k in range(start, stop):
                place = angle[k] * per_radian
                v = (height[k] - low) / (high - low)
                value = _cubic(below, place)
                deviation[k] = value + v * (_cubic(above, place) - value) if v > 0.0 else value
        start = stop


@kernel
def derivatives_at(
    heights: Array, table: Array, feed: float, start: float, part: int, angle: float
) -> tuple[float, float, float]:
    """Radius deviation [m] at an angle [rad], and its first two derivatives over the angle along the tool's path.

    Args:
        heights: see `deviation_along`.
        table: see `deviation_along`.
        feed: see `height_along`.
        start: see `height_along`.
        part: see `height_along`.
        angle: [rad].

    Returns:
        r [m], dr/dφ [m/rad], d²r/dφ² [m/rad²]. The slope along the part counts in the first derivative.
    """
    turns = angle / _TURN
    if part > 0:
        turns -= part * np.floor(turns / part)
    height = start + feed * turns
    row, last = 0, heights.size - 1
    while row < last and height >= heights[row + 1]:
        row += 1
    per_radian = table.shape[1] / _TURN
    place = angle * per_radian
    whole = np.floor(place)
    j, u = np.int64(whole) & (table.shape[1] - 1), place - whole
    value, slope, bow = _cubic_derivatives(table[row, j], u)
    if row < last and height > heights[row]:
        apart = heights[row + 1] - heights[row]
        v = (height - heights[row]) / apart
        above, steeper, rounder = _cubic_derivatives(table[row + 1, j], u)
        along = (above - value) / apart * feed / _TURN
        value += v * (above - value)
        slope += v * (steeper - slope)
        bow += v * (rounder - bow)
        return value, slope * per_radian + along, bow * per_radian**2
    return value, slope * per_radian, bow * per_radian**2


@dataclass(frozen=True)
class Demand:
    """What a profile asks of a drive at its worst place."""

    stroke: float  #: largest displacement from the middle [m]
    velocity: float  #: [m/s]
    acceleration: float  #: [m/s²]


class _ByContent:
    """A profile that is equal to others of the same content.

    Args:
        profile: what it stands for.
    """

    def __init__(self, profile: Profile) -> None:
        self.profile = profile
        self._content = pickle.dumps(profile)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByContent) and self._content == other._content

    def __hash__(self) -> int:
        return hash(self._content)


@lru_cache(maxsize=8)
def _table(profile: _ByContent) -> "ProfileTable":
    return ProfileTable(profile.profile)


def tabulated(profile: Profile) -> "ProfileTable":
    """The table of a profile; equal profiles share one, which nobody changes: to make it takes 20 ms and more."""
    return _table(_ByContent(profile))


class ProfileTable:
    """A profile as the cell runs it.

    Args:
        profile: the form.
        points: intervals of the periodic cubic spline per revolution, a power of two.

    Attributes:
        heights: [m], shape (m,).
        table: polynomial coefficients of each interval, highest power first, shape (m, points, 4); not to be written.
    """

    def __init__(self, profile: Profile, points: int = 4096) -> None:
        angle = np.linspace(0.0, _TURN, points + 1)
        self.heights = np.ascontiguousarray(profile.heights)
        self.table = np.empty((self.heights.size, points, 4))
        for row, height in zip(self.table, self.heights, strict=True):
            values = profile.deviation(angle, float(height))
            values[-1] = values[0]
            spline = scipy.interpolate.CubicSpline(np.arange(points + 1.0), values, bc_type="periodic")
            row[:] = spline.c.T
        self.table.flags.writeable = False

    def demand(self, speed: float, acceleration: float, feed: float) -> Demand:
        """What the profile asks at spindle ``speed`` [rad/s] and ``acceleration`` [rad/s²], ``feed`` in m/rev."""
        return _demand(self, speed, acceleration, feed)


@lru_cache(maxsize=8)
def _demand(form: ProfileTable, speed: float, acceleration: float, feed: float) -> Demand:
    per_radian = form.table.shape[1] / _TURN
    value, slope = form.table[..., 3], form.table[..., 2] * per_radian
    curvature = 2.0 * form.table[..., 1] * per_radian**2
    along = np.zeros_like(value)
    if form.heights.size > 1:
        steepest = np.abs(np.diff(value, axis=0) / np.diff(form.heights)[:, None])
        along[:-1] = steepest
        along[1:] = np.maximum(along[1:], steepest)
    return Demand(
        stroke=float(np.abs(value).max()),
        velocity=float(speed * (np.abs(slope) + along * feed / _TURN).max()),
        acceleration=float((speed**2 * np.abs(curvature) + acceleration * np.abs(slope)).max()),
    )
