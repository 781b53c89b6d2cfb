# SPDX-License-Identifier: Apache-2.0
"""Verdict on a run by its form error: whether the part is in tolerance, and whether the form error grows.

The tolerance ±t is that of a line profile (ISO 1101) whose zone is 2t wide, t on either side of the desired form. A
revolution is in tolerance if its form error nowhere exceeds t; a run is in tolerance from the first revolution of the
final sequence of revolutions in tolerance. The margin is computed from the last revolutions, since the first one in
tolerance has hardly any margin.

The form error is settled from the first to the last revolution in which it is at most twice its minimum. It grows if
its final value exceeds twice the largest settled value after a rise over several revolutions. It diverges if the rise
accelerates, as in an unstable learning loop; wear and drift cause growth proportional to time. A step, caused by a
fault or by a change of form along the part, is not growth.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

LAST = 10  #: largest number of revolutions at the end of a run that margin and budget cover
_FEWEST = 4  # smallest number of revolutions in a rise
_FACTOR = 2.0  # factor in the definitions of settled error and growth, see the module docstring
_BENT = 1.2  # ratio of the rise in the last third to that in the middle third above which the rise accelerates
_NOTHING = 1e-12  # [m] form error below which a rise is rounding error


@dataclass(frozen=True)
class Verdict:
    """Tolerance verdict on a run.

    Attributes:
        tolerance: allowed form error to each side [m].
        revolutions: number of complete revolutions judged.
        since: first revolution, counted from 1, of the final sequence in tolerance; 0 if the last one is not.
        over: first and last revolution used for `largest`: at most the last `LAST` in tolerance, or only the last
            revolution if it is out of tolerance; (0, 0) without a revolution.
        largest: largest magnitude of the form error in these revolutions [m]; NaN without a revolution.
    """

    tolerance: float
    revolutions: int
    since: int
    over: tuple[int, int]
    largest: float

    @property
    def in_tolerance(self) -> bool:
        """Whether the part is in tolerance at the end of the run."""
        return self.since > 0

    @property
    def spare(self) -> float:
        """Margin to the tolerance [m]; negative if the tolerance is exceeded, NaN without a revolution."""
        return self.tolerance - self.largest

    def told(self) -> str:
        """Describe the result as text, lengths in µm."""
        allowed = f"±{self.tolerance * 1e6:.4g} µm"
        if not self.revolutions:
            return f"not in tolerance ({allowed}): no complete revolution"
        if not self.in_tolerance:
            return f"not in tolerance ({allowed}): {self.largest * 1e6:.4g} µm in the last revolution"
        first, last = self.over
        over = f"the last {last - first + 1}" if first < last else "the last"
        return f"in tolerance ({allowed}) from revolution {self.since} on, {self.spare * 1e6:.3g} µm to spare in {over}"

    def summary(self) -> dict[str, object]:
        """Return the result for JSON, lengths in µm."""
        return {
            "allowed": self.tolerance * 1e6,
            "in_tolerance": self.in_tolerance,
            "from_revolution": self.since or None,
            "largest": self.largest * 1e6 if self.revolutions else None,
            "spare": self.spare * 1e6 if self.revolutions else None,
            "over_revolutions": list(self.over) if self.revolutions else None,
        }


@dataclass(frozen=True)
class Growth:
    """Growth of the form error beyond its settled range.

    Attributes:
        diverges: True for an accelerating rise; False for a rise proportional to time, as caused by wear or drift.
        since: revolution, counted from 1, in which the growth begins.
        before: largest magnitude in the settled revolutions before the growth [m].
        last: largest magnitude in the last revolution [m].
    """

    diverges: bool
    since: int
    before: float
    last: float

    def told(self) -> str:
        """Describe the result as text, lengths in µm."""
        what = "diverges" if self.diverges else "grows"
        sizes = f"{self.before * 1e6:.4g} µm before, {self.last * 1e6:.4g} µm at the end"
        return f"form error {what} from revolution {self.since} on: {sizes}"

    def summary(self) -> dict[str, object]:
        """Return the result for JSON, lengths in µm."""
        lengths = {"before": self.before * 1e6, "last": self.last * 1e6}
        return {"diverges": self.diverges, "from_revolution": self.since, **lengths}


def judge(largest: Array, tolerance: float, before: int = 0) -> Verdict:
    """Judge whether a run is in tolerance.

    Args:
        largest: largest magnitude of the form error of each complete revolution [m], shape (revolutions,).
        tolerance: allowed form error to each side [m].
        before: number of revolutions before the first of these, for a snapshot.
    """
    count = largest.size
    if not count:
        return Verdict(tolerance, 0, 0, (0, 0), np.nan)
    outside = np.flatnonzero(~(largest <= tolerance))  # NaN counts as out of tolerance
    inside = int(outside[-1]) + 1 if outside.size else 0  # first of the final sequence in tolerance
    start = max(inside, count - LAST) if inside < count else count - 1
    since = inside + 1 + before if inside < count else 0
    return Verdict(tolerance, count, since, (start + 1 + before, count + before), float(largest[start:].max()))


def growth(largest: Array, before: int = 0) -> Growth | None:
    """Detect growth of the form error of a run; None without growth, for a step, or with too few revolutions.

    Args:
        largest: largest magnitude of the form error of each complete revolution [m], shape (revolutions,).
        before: number of revolutions before the first of these, for a snapshot.
    """
    finite = largest[np.isfinite(largest)]
    if finite.size <= _FEWEST:
        return None
    sizes = np.fmax(np.where(np.isfinite(largest), largest, _FACTOR * finite.max()), _NOTHING)
    near = np.flatnonzero(sizes <= _FACTOR * sizes.min())
    settled = sizes[near[0] : near[-1] + 1]
    start = int(near[0] + np.flatnonzero(settled <= np.median(settled))[-1])  # last at or below the median
    while start > near[0] and sizes[start - 1] < sizes[start]:
        start -= 1
    rise = sizes[start + 1 :]
    if not rise.size or rise[-1] <= _FACTOR * settled.max():
        return None
    # Only up to half of the largest rise, because the error stops growing at the limits of a drive.
    climb = sizes[start : start + 2 + int(np.argmax(rise >= rise.max() / _FACTOR))]
    steps = np.diff(np.log(climb))
    if climb.size <= _FEWEST or steps.max() > steps.sum() / 2.0:
        return None
    first, middle, last = (float(third.mean()) for third in np.array_split(climb, 3))
    diverges = last - middle > _BENT * (middle - first)
    return Growth(diverges, start + 2 + before, float(settled.max()), float(largest[-1]))
