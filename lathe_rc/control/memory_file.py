# SPDX-License-Identifier: Apache-2.0
"""Crash-safe file for a controller's memory."""

import errno
import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lathe_rc.errors import InputError, LatheError
from lathe_rc.files import contents, replacing

Array = npt.NDArray[np.float64]

_FORMAT = 1
_NAMES = {"format.npy", "grid.npy", "points.npy"}
_ROOM = 1 << 16  # space for headers, other numbers and archive overhead, in addition to the memory [B]


def save(path: Path, points: Array, grid: int) -> None:
    """Write a memory to a file atomically, through a temporary file that is synced to disk and renamed.

    Args:
        path: NumPy archive (.npz) to write.
        points: one value per grid point of the cycle [m], starting at angle 0, shape (cycle,).
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
    """Read a memory from an untrusted file and validate it.

    Args:
        path: file written by `save`.
        cycle: grid points in a cycle of the controller.
        grid: points per revolution of the controller.

    Raises:
        InputError: the file is missing, is not a saved memory, or has a different grid or cycle.
    """
    try:
        version, own_grid, points = _read(path, cycle, grid)
    except LatheError:
        raise
    except Exception as error:  # noqa: BLE001 - zipfile and NumPy raise various exceptions for corrupt data
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "not a saved memory"
        raise InputError(f"{path}: the memory cannot be loaded ({reason}); name a file that `save` wrote") from None
    if version != _FORMAT:
        raise InputError(f"{path}: its format is {version}; allowed: {_FORMAT}")
    if points.shape != (cycle,) or own_grid != grid:
        raise InputError(
            f"{path} holds {points.size} points with {own_grid} per revolution; allowed: {cycle} with {grid}"
        )
    if points.dtype != np.float64 or not np.isfinite(points).all():
        raise InputError(f"{path}: a value in the memory is not a finite number; save it again")
    return np.asarray(points)


def _read(path: Path, cycle: int, grid: int) -> tuple[int, int, npt.NDArray[Any]]:
    """Read the format, the points per revolution and the points from a file of limited size.

    Raises:
        InputError: the file is too large, or is not an archive with the expected arrays.
        ValueError: an array is malformed; zipfile and NumPy raise further exceptions.
    """
    largest = 8 * cycle + _ROOM
    try:
        found = contents(path, largest)
    except OSError as error:
        if error.errno == errno.EFBIG:
            size = f"allowed: up to {largest} B for {cycle} points with {grid} per revolution"
            raise InputError(f"{path}: larger than any memory; {size}") from None
        raise
    with zipfile.ZipFile(io.BytesIO(found)) as archive:
        sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
        if set(sizes) != _NAMES:
            raise InputError(f"{path} is not a saved memory; name a file that `save` wrote")
        if max(sizes.values()) > largest:
            raise InputError(f"{path} holds another cycle; allowed: {cycle} points with {grid} per revolution")
        version, own_grid = (_number(_array(archive, name)) for name in ("format.npy", "grid.npy"))
        return version, own_grid, _array(archive, "points.npy")


def _array(archive: zipfile.ZipFile, name: str) -> npt.NDArray[Any]:
    """Read an array of an archive and check its header against the size of its data.

    Raises:
        ValueError: the array is malformed; zipfile and NumPy raise further exceptions.
    """
    # Not np.load: it would allocate the size given in the header before reading any data.
    with archive.open(name) as stream:
        if np.lib.format.read_magic(stream) != (1, 0):
            raise ValueError("another format of arrays than `save` writes")
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
        data = stream.read()
    found: npt.NDArray[Any] = np.frombuffer(data, dtype).reshape(shape).copy()
    return found


def _number(array: npt.NDArray[Any]) -> int:
    """Return the integer that is the only element of an array.

    Raises:
        ValueError: the array is not a single integer.
    """
    if array.size != 1 or array.dtype.kind not in "iu":
        raise ValueError("not a whole number")
    return int(array.item())
