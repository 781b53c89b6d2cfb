# SPDX-License-Identifier: Apache-2.0
"""Part profiles tabulated for the control cell, and the demands they place on a drive.

The table is a periodic cubic spline in the angle with linear interpolation along the part, which also gives the
derivatives for the feasibility check. The table of a profile file is always the same, so it is cached on disk beside
the compiled code: loading SciPy's interpolation, needed only to compute the table, takes a sixth of the time that
`lathe run` needs until its first block.
"""

import hashlib
import io
import pickle
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache, partial

import llvmlite.binding
import numpy as np
import scipy

from lathe_machine.signals.measured_profile import Measured
from lathe_machine.signals.profile import Profile
from lathe_rc.arrays import Array
from lathe_rc.files import replacing, sealed
from lathe_rc.jit import cache_folder, inlined, kernel, read_kept

_MOST = 32  # maximum number of cached tables


def kept(content: bytes, make: Callable[[], Array]) -> Array:
    """Return the array that ``make`` computes from ``content``, or a copy cached on disk by the same libraries.

    Results are valid only for this type of processor, since the instructions that the libraries select for it affect
    the last bits. A damaged file is reported and its content computed again; if the disk cannot be written,
    nothing is cached.
    """
    made_by = f"{np.__version__} {scipy.__version__} {llvmlite.binding.get_host_cpu_name()}".encode()
    path = cache_folder() / "tables" / f"{hashlib.sha256(made_by + content).hexdigest()}.npy"
    if (found := read_kept(path)) is not None:
        read: Array = np.load(io.BytesIO(found))
        return read
    table = make()
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(written := io.BytesIO(), table)
        with replacing(path) as file:
            file.write(sealed(written.getvalue()))
        for old in sorted(path.parent.glob("*.npy"), key=lambda file: file.stat().st_mtime)[:-_MOST]:
            old.unlink(missing_ok=True)
    return table


_TURN = 2.0 * np.pi


@inlined
def _height(feed: float, start: float, part: int, angle: float) -> float:
    """Return the position along the part [m] at a spindle angle [rad] (see `height_along`)."""
    turns = angle / _TURN
    if part > 0:
        turns -= part * np.floor(turns / part)
    return start + feed * turns


@kernel
def height_along(feed: float, start: float, part: int, angle: Array, height: Array) -> None:
    """Fill the position along the part [m] at spindle angles [rad], shape (n,).

    Args:
        feed: feed along the part [m/rev].
        start: position where the part begins [m].
        part: revolutions after which the next part begins; 0 for one endless part.
        angle: spindle angles [rad].
        height: output array [m].
    """
    for k in range(angle.size):
        height[k] = _height(feed, start, part, angle[k])


@inlined
def _cubic(row: Array, place: float) -> float:
    """Evaluate a row of a table, shape (n, 4), at ``place`` [intervals]; n is a power of two."""
    whole = np.floor(place)
    # Unsigned, since Numba checks signed indices for negative values.
    j = np.uint64(np.int64(whole)) & np.uint64(row.shape[0] - 1)
    u = place - whole
    return float(((row[j, 0] * u + row[j, 1]) * u + row[j, 2]) * u + row[j, 3])


@inlined
def _cubic_derivatives(c: Array, u: float) -> tuple[float, float, float]:
    """Evaluate a cubic polynomial, highest power first, and its first two derivatives at ``u``."""
    return (
        ((c[0] * u + c[1]) * u + c[2]) * u + c[3],
        (3.0 * c[0] * u + 2.0 * c[1]) * u + c[2],
        6.0 * c[0] * u + 2.0 * c[1],
    )


@kernel
def deviation_along(heights: Array, table: Array, angle: Array, height: Array, deviation: Array) -> None:
    """Fill the radius deviation [m] at angles [rad] and heights [m], shape (n,), from the arrays of a `ProfileTable`.

    The deviation is cubic in the angle and linear in the height; beyond the ends of the part it is that at the ends.
    """
    per_radian = table.shape[1] / _TURN
    last = heights.size - 1
    row = start = 0
    while start < angle.size:
        # Neighbouring samples are mostly between the same two rows, so they are processed together.
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
    """Return the radius deviation [m] at an angle [rad] and its first two derivatives along the tool's path.

    Args:
        heights: see `deviation_along`.
        table: see `deviation_along`.
        feed: see `height_along`.
        start: see `height_along`.
        part: see `height_along`.
        angle: spindle angle [rad].

    Returns:
        r [m], dr/dφ [m/rad], d²r/dφ² [m/rad²]. The first derivative includes the slope along the part.
    """
    height = _height(feed, start, part, angle)
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
    """Demands of a profile on a drive, as maxima over the part."""

    stroke: float  #: largest displacement from the middle [m]
    velocity: float  #: largest velocity [m/s]
    acceleration: float  #: largest acceleration [m/s²]


class ByContent:
    """Cache key of a profile, equal for profiles with equal content.

    Args:
        profile: profile to look up.
    """

    def __init__(self, profile: Profile) -> None:
        self.profile = profile
        self.content = pickle.dumps(profile)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ByContent) and self.content == other.content

    def __hash__(self) -> int:
        return hash(self.content)


@lru_cache(maxsize=8)
def _table(given: ByContent) -> "ProfileTable":
    """Return the table of a profile; the table of a file is also cached on disk."""
    if isinstance(given.profile, Measured):  # others vary with parameters, and a sweep would cache thousands
        return ProfileTable(given.profile, made=partial(kept, given.content))
    return ProfileTable(given.profile)


def tabulated(profile: Profile) -> "ProfileTable":
    """Return the read-only table of a profile, shared by equal profiles, since computing it takes 20 ms or more."""
    return _table(ByContent(profile))


class ProfileTable:
    """Part profile as a table of cubic splines, for the control cell.

    Args:
        profile: desired form.
        points: intervals of the periodic cubic spline per revolution, a power of two.
        made: function that returns the array of a given function, possibly from a cache; None to call that function.

    Attributes:
        heights: positions along the part [m], shape (m,).
        table: polynomial coefficients of each interval, highest power first, shape (m, points, 4); read-only.
    """

    def __init__(
        self, profile: Profile, points: int = 4096, made: Callable[[Callable[[], Array]], Array] | None = None
    ) -> None:
        self.heights = np.ascontiguousarray(profile.heights)
        make = partial(_splines, profile, points)
        self.table = made(make) if made else make()
        self.table.flags.writeable = False

    def demand(self, speed: float, acceleration: float, feed: float) -> Demand:
        """Return the demands at a spindle ``speed`` [rad/s] and ``acceleration`` [rad/s²], with ``feed`` in m/rev."""
        return _demand(self, speed, acceleration, feed)


def _splines(profile: Profile, points: int) -> Array:
    """Return the coefficients of the splines of a profile (see `ProfileTable.table`)."""
    angle = np.linspace(0.0, _TURN, points + 1)
    table = np.empty((profile.heights.size, points, 4))
    for row, height in zip(table, profile.heights, strict=True):
        values = profile.deviation(angle, float(height))
        values[-1] = values[0]
        spline = scipy.interpolate.CubicSpline(np.arange(points + 1.0), values, bc_type="periodic")
        row[:] = spline.c.T
    return table


@lru_cache(maxsize=8)
def _demand(form: ProfileTable, speed: float, acceleration: float, feed: float) -> Demand:
    """Return the demands of a table (implements `ProfileTable.demand`), cached for the checks of similar cells."""
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
