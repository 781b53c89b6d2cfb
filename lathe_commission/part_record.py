# SPDX-License-Identifier: Apache-2.0
"""Roundness and profile records of finished parts, from files of columns and from X3P (ISO 25178-72)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lathe_commission.form_correction import MeasuredRevolution
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError, shown
from lathe_rc.signals import measurement_file
from lathe_rc.signals.quantities import Mapped

_TURN = 2.0 * np.pi
_WHOLE = 0.75  # least part of a revolution that a record has to cover


def read_columns(path: Path, mapping: Mapping[str, Mapped]) -> list[MeasuredRevolution]:
    """Read the revolutions of a record from a file of columns (see `lathe_rc.signals.measurement_file`).

    Args:
        path: file with the quantities ``angle`` and ``radius``, optionally ``height`` and ``revolution``; the first
            three need a unit. A radius that is empty or NaN is a gap.
        mapping: columns that are named otherwise.

    Raises:
        InputError: the file is missing or malformed, a column or unit is missing, or a revolution is incomplete.
    """
    measured = measurement_file.read(path, mapping)
    if "angle" not in measured or "radius" not in measured:
        raise measured.lacking("angle and radius, with units, optionally height and revolution")
    quantities = [each for each in ("angle", "radius", "height", "revolution") if each in measured]
    values = dict(zip(quantities, measured.read(*quantities, gaps=("radius",)), strict=True))
    there = np.isfinite(values["radius"])
    return _split(path, {quantity: array[there] for quantity, array in values.items()})


def _split(path: Path, values: Mapping[str, Array]) -> list[MeasuredRevolution]:
    """Split rows into revolutions: by their number, by height, or after each turn from the first row, either way."""
    angle = values["angle"]
    known = "height" in values
    heights = values.get("height", np.zeros(angle.size))
    if "revolution" in values:
        number = values["revolution"]
    elif np.unique(heights).size > 1:
        number = heights
    else:
        goes_on = angle.size and np.ptp(angle) > 1.01 * _TURN
        turned = (angle if goes_on else np.unwrap(angle)) - angle[:1]
        number = np.floor(np.abs(turned) / _TURN + 1e-9)
    found = []
    for each in dict.fromkeys(number.tolist()):
        rows = number == each
        revolution = MeasuredRevolution(
            np.mod(angle[rows], _TURN), values["radius"][rows], float(heights[rows].mean()) if known else None
        )
        if _covered(revolution.angle) >= _WHOLE:
            found.append(revolution)
    if not found:
        span = np.degrees(np.ptp(angle)) if angle.size else 0.0
        raise InputError(
            f"{path}: no complete revolution: {angle.size} points over {span:.4g}°; allowed: a record of one "
            "revolution or more, and the right unit of the angle"
        )
    return found


def _covered(angle: Array) -> float:
    """Return the part of a revolution that angles cover, all gaps above 15° left out."""
    if angle.size < 3:
        return 0.0
    around = np.sort(angle)
    steps = np.diff(np.append(around, around[0] + _TURN))
    return float(steps[steps < np.radians(15.0)].sum() / _TURN)


def read_x3p(path: Path) -> list[MeasuredRevolution]:
    """Read the revolutions of a record from an X3P file: layers of a profile, or rows of a surface.

    The points of a revolution are even, its first is at angle 0; points that are not measured are left out.

    Raises:
        InputError: the file is no X3P file, or has no such grid.
    """
    import x3pio

    try:
        file: Any = x3pio.read(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path of the record") from None
    except x3pio.X3pError as error:
        raise InputError(f"{path}: no X3P file ({shown(error)})") from None
    if (
        not isinstance(file, (x3pio.Profile, x3pio.Surface))
        or file.header.x.axis_type is not x3pio.AxisType.INCREMENTAL
    ):
        raise InputError(
            f"{path}: {type(file).__name__} with coordinates of its own; allowed: a profile or surface of even points, "
            "or a CSV file with an angle column"
        )
    rows = [row for layer in file.layers for row in np.atleast_2d(np.asarray(layer.z, dtype=np.float64))]
    found = []
    for row in rows:
        there = np.isfinite(row)
        angle = _TURN * np.arange(row.size) / row.size
        if _covered(angle[there]) >= _WHOLE:
            found.append(MeasuredRevolution(angle[there], row[there]))
    if not found:
        raise InputError(f"{path}: no complete revolution; allowed: measured points over {_WHOLE:.0%} of it")
    return found


def read(path: Path, mapping: Mapping[str, Mapped]) -> list[MeasuredRevolution]:
    """Read a record by its ending: ``.x3p``, otherwise columns (see `read_columns`).

    Raises:
        InputError: see `read_columns` and `read_x3p`; or columns are given for an X3P file.
    """
    if path.suffix.lower() != ".x3p":
        return read_columns(path, mapping)
    if mapping:
        raise InputError(f"{path}: --column with an X3P file; allowed: none, its radius is in metres")
    return read_x3p(path)
