# SPDX-License-Identifier: Apache-2.0
"""What a controller has learned, in a file that survives a crash."""

import zipfile
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lathe_rc.errors import InputError, LatheError
from lathe_rc.files import replacing

Array = npt.NDArray[np.float64]

_FORMAT = 1
_HEADERS = 4096  # [B] of an array's own header, at most
_LARGEST = 1 << 16  # [B] for the numbers beside the memory


def save(path: Path, points: Array, grid: int) -> None:
    """Write a memory: to the side, to the disk, then renamed over what was there.

    Args:
        path: NumPy archive (.npz) to write.
        points: one value a grid point of the cycle [m], from angle 0 on, shape (cycle,).
        grid: points per revolution.

    Raises:
        LatheError: the file cannot be written.
    """
    try:
        with replacing(path) as file:
            np.savez(file, format=np.int64(_FORMAT), grid=np.int64(grid), points=points)
    except OSError as error:
        raise LatheError(f"{path}: the memory cannot be saved ({error.strerror or error})") from None


def load(path: Path, cycle: int, grid: int) -> Array:
    """Read a memory; nothing in the file is trusted.

    Args:
        path: what `save` wrote.
        cycle: grid points in the cycle of the controller that will use it.
        grid: its points per revolution.

    Raises:
        InputError: there is no such file, it is something else, or it is of another grid or cycle.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
        if set(sizes) != {"format.npy", "grid.npy", "points.npy"}:
            raise InputError(f"{path} is not a saved memory; name a file that `save` wrote")
        points_size = sizes.pop("points.npy")
        if max(sizes.values()) > _LARGEST or points_size > 8 * cycle + _HEADERS:
            raise InputError(f"{path} holds another cycle; allowed: {cycle} points with {grid} per revolution")
        with np.load(path, allow_pickle=False) as archive:
            version, own_grid, points = archive["format"], archive["grid"], archive["points"]
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, NotImplementedError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "not a saved memory"
        raise InputError(f"{path}: the memory cannot be loaded ({reason}); name a file that `save` wrote") from None
    if version.size != 1 or int(version) != _FORMAT:
        raise InputError(f"{path}: its format is {version}; allowed: {_FORMAT}")
    if points.shape != (cycle,) or own_grid.size != 1 or int(own_grid) != grid:
        raise InputError(
            f"{path} holds {points.size} points with {own_grid} per revolution; allowed: {cycle} with {grid}"
        )
    if points.dtype != np.float64 or not np.isfinite(points).all():
        raise InputError(f"{path}: a value in the memory is not a finite number; save it again")
    return np.asarray(points)
