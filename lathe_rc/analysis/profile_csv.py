# SPDX-License-Identifier: Apache-2.0
"""Profiles as CSV files, with the columns of `lathe_machine.signals.measured_profile.read_csv`."""

from pathlib import Path

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.signals.table import write_table

_CLOSEST = 1e-9  # [m] between two heights, required by the reader


def _columns(radius: Array, heights: Array | None) -> tuple[str, Array]:
    """Return the header and the rows of a profile table."""
    points = radius.shape[-1]
    angle = 360.0 * np.arange(points) / points
    if radius.ndim == 1:
        return "angle_deg,radius_um", np.stack((angle, radius * 1e6), axis=1)
    revolutions = radius.shape[0]
    if heights is None:
        name, places = "revolution", np.arange(1.0, revolutions + 1.0)
    else:
        if heights.size != revolutions:
            raise InputError(f"profile of {revolutions} revolutions and {heights.size} heights; give as many of each")
        if np.any(np.diff(np.sort(heights)) < _CLOSEST):
            raise InputError(
                f"heights of a profile less than {_CLOSEST:g} m apart (no feed?); give none, or write one revolution"
            )
        name, places = "height_mm", heights * 1e3
    rows = (np.tile(angle, revolutions), np.repeat(places, points), radius.ravel() * 1e6)
    return f"angle_deg,{name},radius_um", np.stack(rows, axis=1)


def write(path: Path, radius: Array, *, heights: Array | None = None, comment: str = "") -> None:
    """Write profiles at equidistant angles to a CSV file atomically; an existing file is replaced.

    The columns are ``angle_deg,radius_um`` for one profile, ``angle_deg,height_mm,radius_um`` for several with
    heights (both can be read back as a profile), and ``angle_deg,revolution,radius_um`` for several without, the
    first being revolution 1.

    Args:
        path: CSV file.
        radius: radius deviations or form errors [m], shape (points,) or (revolutions, points).
        heights: position along the part of each revolution [m], shape (revolutions,).
        comment: comment line at the top of the file.

    Raises:
        InputError: a value is not finite, two heights coincide, or the file cannot be written.
    """
    if not np.all(np.isfinite(radius)):
        raise InputError(f"{path}: the profile holds numbers that are not finite; write revolutions without them")
    header, rows = _columns(radius, heights)
    write_table(path, header, rows, comment, digits=12)
