# SPDX-License-Identifier: Apache-2.0
"""Part profile through measured points, read from a CSV file."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import scipy

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError

_TURN = 2.0 * np.pi
_FLATTEST = 0.01  # [µm] smallest peak-to-valley height other than 0: no lathe turns a flatter form
_MILLIMETRES = 2.0  # [µm] a form with a smaller height may be in mm: few forms have 2 mm
_METRES = 0.1  # [mm] a smaller range of heights may be in m
_WIDE, _WIDER = 3.0, 15.0  # [median steps] and [°]: a gap is wider than both
_WIDEST = 120.0  # [°] widest gap of a valid form
_SAME = 1e-3  # [µm] tolerance between the radii at 360° and at 0°
_FARTHEST = 10_000.0  # [µm] largest offset of a complete form from the mean radius
_TURN_OF_RADIANS = 6.3  # [°] a column with a smaller range is in another unit
_CLOSEST = 1e-6  # [°, mm] smallest distance between two points: closer ones are errors, and their slope would overflow


@dataclass(frozen=True)
class Measured:
    """Profile through measured points: a periodic cubic spline through each row, and linear between rows.

    Args:
        angle: increasing angles [rad] in [0, 2π), shape (n,).
        heights: increasing positions [m], shape (m,).
        radius: deviations [m], shape (m, n).
    """

    angle: Array
    heights: Array
    radius: Array

    def deviation(self, angle: Array, height: float) -> Array:
        """Return the radius deviation [m] on the spline through the points (implements `Profile.deviation`)."""
        rows = [np.interp(height, self.heights, column) for column in self.radius.T]
        closed = np.append(rows, rows[0])
        spline = scipy.interpolate.CubicSpline(np.append(self.angle, self.angle[0] + _TURN), closed, bc_type="periodic")
        return np.asarray(spline(self.angle[0] + np.mod(angle - self.angle[0], _TURN)))


def _check_distances(path: Path, what: str, unit: str, places: Array) -> None:
    """Check that no two positions are nearly the same."""
    near = np.flatnonzero(np.diff(places) < _CLOSEST)
    if near.size:
        a, b = places[near[0]], places[near[0] + 1]
        raise InputError(
            f"{path}: {what} {a:.10g} and {b:.10g}{unit} are too close; allowed: {_CLOSEST:g}{unit} apart or more"
        )


def _check_units(path: Path, angle_deg: Array, radius_um: Array) -> None:
    """Check that the columns are not in units other than their names state."""
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


def _gap(angle_deg: Array) -> tuple[float, float, float]:
    """Return the start and width of the widest step between two angles of a revolution, and the median step [°]."""
    steps = np.diff(np.append(angle_deg, angle_deg[0] + 360.0))
    place = int(np.argmax(steps))
    return float(angle_deg[place]), float(steps[place]), float(np.median(steps))


def _closed(path: Path, rows: Array) -> Array:
    """Move the points at 360° to 0°, or drop them if 0° has the same value.

    Raises:
        InputError: the values at 0° and 360° differ.
    """
    start = {height: radius for angle, height, radius in rows.tolist() if angle == 0.0}
    kept = []
    for angle, height, radius in rows.tolist():
        if angle != 360.0:
            kept.append((angle, height, radius))
        elif height not in start:
            kept.append((0.0, height, radius))
        elif abs(radius - start[height]) > _SAME:
            raise InputError(
                f"{path}: radius_um = {start[height]:.10g} at 0° and {radius:.10g} at 360°, height {height:g} mm; "
                "allowed: the same, or one of the two rows"
            )
    return np.array(kept)


def doubts(form: Measured) -> list[str]:
    """List suspicious properties of a form, one line each: a gap in its angles, or values that suggest another unit."""
    said = []
    start, width, median = _gap(np.rad2deg(form.angle))
    if width > max(_WIDE * median, _WIDER):
        said.append(
            f"no point from {start:.5g}° to {(start + width) % 360.0:.5g}°, {width:.4g}° wide, while others are "
            f"{median:.4g}° apart: a spline fills the gap"
        )
    low, high = form.radius.min() * 1e6, form.radius.max() * 1e6
    if 0.0 < high - low < _MILLIMETRES:
        said.append(
            f"radius_um goes from {low:.4g} to {high:.4g} µm; if these are millimetres, multiply by 1000 (deviations "
            "from the mean radius)"
        )
    along = float(np.ptp(form.heights)) * 1e3
    if 0.0 < along < _METRES:
        said.append(f"height_mm goes over {along:.4g} mm; if these are metres, multiply by 1000")
    return said


def read_csv(path: Path) -> Measured:
    """Read a part profile from a file with ``angle``, ``radius`` (deviation) and optionally ``height``, with units.

    Rows are in any order. Every height must have the same angles. A row at 360° may repeat the row at 0°.

    Raises:
        InputError: the file is missing, is malformed, has other units, contains a number that is not finite, repeats an
            angle, or covers only part of a revolution.
    """
    status = path.stat() if path.exists() else None
    return _measured(path, status and (status.st_mtime_ns, status.st_size, status.st_ino))


@lru_cache(maxsize=8)
def _measured(path: Path, _: tuple[int, int, int] | None) -> Measured:
    """Read a profile; cached, since reading takes longer than some cells run."""
    from lathe_rc.signals import measurement_file  # which a cell without files need not import

    found = measurement_file.read(path)
    if "revolution" in found:
        raise InputError(f"{path}: a column of revolutions; allowed: one revolution, or one for each height")
    units = {"angle": "deg", "radius": "um"} | ({"height": "mm"} if "height" in found else {})
    angle_deg, radius_um, *along = found.read(*units, units=units)
    rows = np.stack([angle_deg, *(along or [np.zeros(angle_deg.size)]), radius_um], axis=1)
    wrong = rows[(rows[:, 0] < 0.0) | (rows[:, 0] > 360.0), 0]
    if wrong.size:
        raise InputError(f"{path}: angle {wrong[0]:.10g}°; allowed: 0 up to 360, where 360 is 0 again")
    rows = _closed(path, rows)
    angle_deg, heights_mm = np.unique(rows[:, 0]), np.unique(rows[:, 1])
    if angle_deg.size < 3:
        raise InputError(f"{path}: {angle_deg.size} different angles; allowed: 3 or more")
    _check_units(path, angle_deg, rows[:, 2])
    _check_distances(path, "angles", "°", np.append(angle_deg, angle_deg[0] + 360.0))
    _check_distances(path, "heights", " mm", heights_mm)
    start, width, median = _gap(angle_deg)
    if width > max(_WIDE * median, _WIDEST):
        raise InputError(
            f"{path}: no point from {start:.5g}° to {(start + width) % 360.0:.5g}°, while others are {median:.4g}° "
            f"apart; allowed: points all round, gaps up to {_WIDEST:g}°"
        )
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
