# SPDX-License-Identifier: Apache-2.0
"""Predistortion: path of the cross feed that turns a compliant shaft to the desired form.

    y(z) = x(z) + C(z)·F(ap(z)),  ap = D(z) - y(z)

y is the resulting radius and x the set point of the cross feed, both relative to the nominal radius; D is the depth of
cut at that radius, C the compliance along the shaft (`lathe_machine.analysis.shaft`), and F the force as a function of
the depth of cut. Both x and the deflection change the depth and thus the force, so y is the root of this equation. The
path that cancels the deflection gives y = w; its depth of cut is therefore D - w, and the path is x = w - C·F(D - w).
Subtracting the deflection measured on a part without predistortion is not sufficient, because a deeper cut deflects the
shaft more.

If C, F or D are not known accurately, the error of the last part corrects the path (iterative learning control):

    x ← x - γ·(y - w)

The error then changes by the factor 1 - γ/(1 + C·F') per part, a contraction for any 0 < γ < 2 as long as the force
does not decrease with the depth of cut.

Source: paper 004, whose upper control level computes the path from a model of the deformation and corrects it by the
deviation of the profile; the paper prints neither.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lathe_machine.control.interpolation import linear
from lathe_rc.arrays import Array, Integers
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel
from lathe_rc.signals.table import write_table

ForceLaw = Callable[[Array], Array]  #: force [N] for a depth of cut [m] at each height, not decreasing with it

_COLUMNS = ("height_mm", "offset_um")
_CLOSEST = 1e-9  # smallest distance between two heights [m]


def proportional(stiffness: float | Array) -> ForceLaw:
    """Create the force law F = K·ap for positive depths of cut, 0 otherwise.

    Args:
        stiffness: K [N/m], of any shape that broadcasts to the heights.
    """

    def law(depth_of_cut: Array) -> Array:
        return np.asarray(stiffness * np.maximum(depth_of_cut, 0.0))

    return law


def turned(compliance: Array, law: ForceLaw, depth: float | Array, path: Array) -> Array:
    """Compute the radius y that results from a path, by bisection [m], shape (m,).

    Args:
        compliance: C at each height [m/N], shape (m,).
        law: force as a function of the depth of cut.
        depth: D [m], a scalar or one value per height.
        path: x [m], shape (m,).
    """
    # F never decreases with the depth: there is one root, and the deflection is at most that at a rigid shaft's depth.
    low, high = path, path + compliance * law(depth - path)
    # Down to the last bit of the radius, which takes about fifty bisections.
    least = np.spacing(np.maximum(np.abs(low), np.abs(high)))
    while np.any(high - low > least):
        middle = (low + high) / 2.0
        above = middle >= path + compliance * law(depth - middle)
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    return np.asarray(high)


def cancelling(compliance: Array, law: ForceLaw, depth: float | Array, wanted: float | Array = 0.0) -> Array:
    """Compute the path x [m] for the ``wanted`` radius w [m], shape (m,); other arguments as for `turned`."""
    target = np.broadcast_to(wanted, compliance.shape)
    return np.asarray(target - compliance * law(depth - target))


def contraction(compliance: Array, stiffness: float | Array, gain: float) -> float:
    """Compute the largest error factor from part to part; ``stiffness`` is dF/dap [N/m], ``gain`` is γ."""
    return float(np.abs(1.0 - gain / (1.0 + compliance * stiffness)).max())


class PathTable(NamedTuple):
    """Path of a `Predistortion` for kernels.

    Attributes:
        heights, offsets: heights along the part and offsets of the cross feed [m], shape (m,).
        beyond: number of samples so far beyond the ends of the path, shape (1,).
    """

    heights: Array
    offsets: Array
    beyond: Integers


@kernel
def offset_along(path: PathTable, height: Array, set_point: Array) -> None:
    """Fill ``set_point`` [m] with the offset of the path at each ``height`` [m] (implements `Predistortion.block`)."""
    for k in range(height.size):
        path.beyond[0] += height[k] < path.heights[0] or height[k] > path.heights[-1]
        set_point[k] = linear(path.heights, path.offsets, height[k])


class Predistortion:
    """Predistorted path of the cross feed along the part.

    Args:
        heights: increasing heights, at least 1 nm apart [m], shape (m,).
        offsets: x, positive out of the part [m], shape (m,).

    Attributes:
        heights, offsets: as given.
        table: path for `offset_along`.

    Raises:
        InputError: there are no points, the numbers of heights and offsets differ, the heights do not increase, or a
            value is not finite.
    """

    def __init__(self, heights: Array, offsets: Array) -> None:
        if heights.size != offsets.size or not heights.size:
            raise InputError(
                f"predistortion: {heights.size} heights and {offsets.size} offsets; give as many of each, 1 or more"
            )
        if not (np.all(np.isfinite(heights)) and np.all(np.isfinite(offsets))):
            raise InputError("predistortion: not all numbers are finite; remove those that are not")
        near = np.flatnonzero(np.diff(heights) < _CLOSEST)
        if near.size:
            a, b = heights[near[0]], heights[near[0] + 1]
            raise InputError(f"predistortion: height {a:g} m is followed by {b:g} m; allowed: rising by {_CLOSEST:g} m")
        self.heights = np.array(heights, dtype=np.float64)
        self.offsets = np.array(offsets, dtype=np.float64)
        self.table = PathTable(self.heights, self.offsets, np.zeros(1, np.int64))

    @property
    def beyond(self) -> int:
        """Number of samples so far beyond the ends of the path, where the offset is that of the nearer end."""
        return int(self.table.beyond[0])

    def block(self, height: Array, set_point: Array) -> None:
        """Fill ``set_point`` [m] with the linearly interpolated offset at each ``height`` [m]; both of shape (n,)."""
        offset_along(self.table, height, set_point)

    def corrected(self, heights: Array, error: Array, gain: float = 1.0) -> "Predistortion":
        """Compute the path for the next part from the measured error of the last one.

        Args:
            heights: increasing heights of the measurements [m], shape (k,); the error is interpolated linearly between
                these heights, and constant beyond their ends.
            error: radius of the last part minus the desired radius, y - w [m], averaged over a revolution, shape (k,).
            gain: γ; values below 1 average over parts.

        Raises:
            InputError: the gain is not between 0 and 2, or the heights and errors are malformed.
        """
        if not 0.0 < gain < 2.0:
            raise InputError(f"predistortion: gain {gain:g} from part to part; allowed: above 0 and below 2")
        measured = Predistortion(heights, error)
        at = np.empty_like(self.heights)
        measured.block(self.heights, at)
        return Predistortion(self.heights, self.offsets - gain * at)

    def save(self, path: Path, comment: str = "") -> None:
        """Write the path to a CSV file with the columns ``height_mm,offset_um``, atomically.

        Args:
            path: CSV file; an existing one is replaced.
            comment: comment line at the top of the file.

        Raises:
            InputError: the file cannot be written.
        """
        write_table(path, ",".join(_COLUMNS), np.stack((self.heights * 1e3, self.offsets * 1e6), axis=1), comment)

    @classmethod
    def load(cls, path: Path) -> "Predistortion":
        """Read a path from a file with ``height`` and ``offset``, such as `save` writes.

        Raises:
            InputError: the file is missing or malformed, or its values are not a valid path.
        """
        from lathe_rc.signals import measurement_file  # which a cell without files need not import

        heights, offsets = measurement_file.read(path).read("height", "offset")
        try:
            return cls(heights, offsets)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
