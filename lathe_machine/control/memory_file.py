# SPDX-License-Identifier: Apache-2.0
"""Crash-safe file for a controller's memory."""

from pathlib import Path
from typing import Any

import numpy as np

from lathe_rc import data_file
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError, LatheError
from lathe_rc.files import replacing

_KIND = "memory"
_ROOM = 1 << 16  # space for everything but the memory [B]


def save(path: Path, points: Array, grid: int) -> None:
    """Write a memory to a file atomically, through a temporary file that is synced to disk and renamed.

    Args:
        path: file to write (see `lathe_rc.data_file`).
        points: one value per grid point of the cycle [m], starting at angle 0, shape (cycle,).
        grid: points per revolution.

    Raises:
        LatheError: the file cannot be written.
    """
    try:
        with replacing(path) as file:
            file.write(data_file.packed(_KIND, {"grid": grid, "points": points}))
    except OSError as error:
        raise LatheError(f"{path}: the memory cannot be saved ({error.strerror or error})") from None


def load(path: Path, cycle: int, grid: int) -> Array:
    """Read a memory from an untrusted file and validate it.

    Args:
        path: file written by `save`.
        cycle: grid points in a cycle of the controller.
        grid: points per revolution of the controller.

    Raises:
        InputError: the file is missing, is not a saved memory, or has a different grid or cycle.
    """
    return data_file.read(path, _KIND, lambda told: _checked(path, told, cycle, grid), 16 * cycle + _ROOM)


def _checked(path: Path, told: Any, cycle: int, grid: int) -> Array:
    points, own_grid = told["points"], int(told["grid"])
    if points.shape != (cycle,) or own_grid != grid:
        raise InputError(
            f"{path} holds {points.size} points with {own_grid} per revolution; allowed: {cycle} with {grid}"
        )
    if points.dtype != np.float64 or not np.isfinite(points).all():
        raise InputError(f"{path}: a value in the memory is not a finite number; save it again")
    return np.asarray(points)
