# SPDX-License-Identifier: Apache-2.0
"""Predistortion: the path of the cross feed that turns a shaft which gives way to the wanted form.

    y(z) = x(z) + C(z)·F(ap(z)),  ap = D(z) - y(z)

y is the radius that comes out and x the set point of the cross feed, both against the nominal radius; D is the depth of
cut there; C the compliance along the shaft (`lathe_rc.analysis.shaft`) and F the force on it by the depth of cut. Both
x and the deflection change the depth and so the force: y is the root of this equation. Of the path that cancels the
deflection, y = w, the depth is known, D - w, and so is the path: x = w - C·F(D - w). Taking off the deflection that a
part without predistortion shows falls short, because cutting deeper bends more.

Where C, F or D are not known well enough the last part tells (iterative learning from part to part):

    x ← x - γ·(y - w)

The error then shrinks by 1 - γ/(1 + C·F') a part, a contraction for any 0 < γ < 2 as long as a deeper cut takes no less
force.

Source: paper 004, whose upper level gives the path by a model of the deformation and corrects it by the deviation of
the profile; neither is printed there.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.control.interpolation import linear
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel
from lathe_rc.signals.table import read_table, write_table

Array = npt.NDArray[np.float64]
ForceLaw = Callable[[Array], Array]  #: force [N] by depth of cut [m], at each height; never falling with the depth

_COLUMNS = ("height_mm", "offset_um")
_CLOSEST = 1e-9  # [m] between two heights


def proportional(stiffness: float | Array) -> ForceLaw:
    """F = K·ap where there is a chip; ``stiffness`` K [N/m], of any shape that fits the heights."""

    def law(depth_of_cut: Array) -> Array:
        return np.asarray(stiffness * np.maximum(depth_of_cut, 0.0))

    return law


def turned(compliance: Array, law: ForceLaw, depth: float | Array, path: Array) -> Array:
    """Radius y that a path leaves, by bisection [m], shape (m,).

    Args:
        compliance: C at each height [m/N], shape (m,).
        law: force by depth of cut.
        depth: D [m], one or at each height.
        path: x [m], shape (m,).
    """
    # F never falls with the depth: there is one root, and the deflection is at most that of a rigid shaft's cut.
    low, high = path, path + compliance * law(depth - path)
    # To the last bit of the radius, which takes some fifty halvings.
    least = np.spacing(np.maximum(np.abs(low), np.abs(high)))
    while np.any(high - low > least):
        middle = (low + high) / 2.0
        above = middle >= path + compliance * law(depth - middle)
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    return np.asarray(high)


def cancelling(compliance: Array, law: ForceLaw, depth: float | Array, wanted: float | Array = 0.0) -> Array:
    """Path x [m] whose deflection leaves the ``wanted`` radius w [m], shape (m,); other arguments as of `turned`."""
    target = np.broadcast_to(wanted, compliance.shape)
    return np.asarray(target - compliance * law(depth - target))


def contraction(compliance: Array, stiffness: float | Array, gain: float) -> float:
    """Largest factor of the error from part to part; ``stiffness`` is dF/dap [N/m], ``gain`` γ."""
    return float(np.abs(1.0 - gain / (1.0 + compliance * stiffness)).max())


class PathTable(NamedTuple):
    """A `Predistortion` for kernels.

    Attributes:
        heights, offsets: see there.
        beyond: samples so far beyond the ends, shape (1,).
    """

    heights: Array
    offsets: Array
    beyond: npt.NDArray[np.int64]


@kernel
def offset_along(path: PathTable, height: Array, set_point: Array) -> None:
    """Fill ``set_point`` [m] at each ``height`` [m], see `Predistortion.block`."""
    for k in range(height.size):
        path.beyond[0] += height[k] < path.heights[0] or height[k] > path.heights[-1]
        set_point[k] = linear(path.heights, path.offsets, height[k])


class Predistortion:
    """A path of the cross feed along the part.

    Args:
        heights: rising, at least 1 nm apart [m], shape (m,).
        offsets: x, out of the part [m], shape (m,).

    Attributes:
        heights, offsets: as given.
        table: for `offset_along`.

    Raises:
        InputError: no path: no points, not as many of each, heights that do not rise, a number that is not finite.
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
        """Samples so far beyond the ends, where the offset is that of the end."""
        return int(self.table.beyond[0])

    def block(self, height: Array, set_point: Array) -> None:
        """Fill ``set_point`` [m] at each ``height`` [m], linear between those of the path; both of shape (n,)."""
        offset_along(self.table, height, set_point)

    def corrected(self, heights: Array, error: Array, gain: float = 1.0) -> "Predistortion":
        """Path for the next part.

        Args:
            heights: at which the last part was measured, rising [m], shape (k,); linear between them, and beyond
                their ends the error of the end.
            error: its radius less the wanted one, y - w [m], shape (k,): the mean of a revolution's profile.
            gain: γ; below 1 it averages over parts.

        Raises:
            InputError: a gain with which the parts get worse, or a profile that is none.
        """
        if not 0.0 < gain < 2.0:
            raise InputError(f"predistortion: gain {gain:g} from part to part; allowed: above 0 and below 2")
        measured = Predistortion(heights, error)
        at = np.empty_like(self.heights)
        measured.block(self.heights, at)
        return Predistortion(self.heights, self.offsets - gain * at)

    def save(self, path: Path, comment: str = "") -> None:
        """Write a CSV file with the columns ``height_mm,offset_um``, whole or not at all.

        Args:
            path: of the file; an existing one is replaced.
            comment: a line at the top.

        Raises:
            InputError: a place that cannot be written to.
        """
        write_table(path, ",".join(_COLUMNS), np.stack((self.heights * 1e3, self.offsets * 1e6), axis=1), comment)

    @classmethod
    def load(cls, path: Path) -> "Predistortion":
        """Read what `save` wrote, or a file with the same columns.

        Raises:
            InputError: the file is missing, malformed, or holds no path.
        """
        _, rows = read_table(path, [_COLUMNS], "predistortion")
        try:
            return cls(rows[:, 0] * 1e-3, rows[:, 1] * 1e-6)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
