# SPDX-License-Identifier: Apache-2.0
"""The verdict on a run by its form error: whether the part is in tolerance, and whether the form error grows.

The tolerance ±t is that of a line profile (ISO 1101) whose zone is 2t wide, t to each side of the desired form. A
revolution is in tolerance if its form error is nowhere larger than t; a run, from the revolution on from which all are,
to its end. The margin is that of its last revolutions: the first that is in tolerance hardly is.

The form error has settled from the first revolution on in which it is at most twice its least, to the last such one.
It grows if it ends above twice the largest of these, after a rise over several revolutions. It diverges if it rises
faster and faster, as learning without a margin does; wear and drift make it grow in proportion to time. A step, as by a
fault or by another form along the part, is no growth.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

LAST = 10  #: revolutions at the end of a run that its spare and its budget speak of, at most
_FEWEST = 4  # revolutions of a rise
_FACTOR = 2.0  # see above
_BENT = 1.2  # rise of the last third by that of the middle one, from which on it is faster and faster
_NOTHING = 1e-12  # [m] a form error below which a rise is rounding


@dataclass(frozen=True)
class Verdict:
    """The verdict on a run.

    Attributes:
        tolerance: form error that is allowed to each side [m].
        revolutions: complete ones that were judged.
        since: revolution, counted from 1, from which on all are in tolerance; 0: the last is not.
        over: first and last of the revolutions that `largest` is of: the last that are in tolerance, `LAST` of them at
            most, or the last alone if that is not; (0, 0) without a revolution.
        largest: largest magnitude of the form error in these; NaN without a revolution [m].
    """

    tolerance: float
    revolutions: int
    since: int
    over: tuple[int, int]
    largest: float

    @property
    def in_tolerance(self) -> bool:
        """Whether the run ends in tolerance."""
        return self.since > 0

    @property
    def spare(self) -> float:
        """The margin to the tolerance; negative: it is exceeded by so much; NaN without a revolution [m]."""
        return self.tolerance - self.largest

    def told(self) -> str:
        """In words, lengths in µm."""
        allowed = f"±{self.tolerance * 1e6:.4g} µm"
        if not self.revolutions:
            return f"not in tolerance ({allowed}): no complete revolution"
        if not self.in_tolerance:
            return f"not in tolerance ({allowed}): {self.largest * 1e6:.4g} µm in the last revolution"
        first, last = self.over
        over = f"the last {last - first + 1}" if first < last else "the last"
        return f"in tolerance ({allowed}) from revolution {self.since} on, {self.spare * 1e6:.3g} µm to spare in {over}"

    def summary(self) -> dict[str, object]:
        """The same for JSON, lengths in µm."""
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
    """A form error that grows beyond all that it was once it had settled.

    Attributes:
        diverges: faster and faster; False: in proportion to time, as by wear or drift.
        since: revolution, counted from 1, from which on it grows.
        before: largest magnitude in the settled revolutions before [m].
        last: largest magnitude in the last revolution [m].
    """

    diverges: bool
    since: int
    before: float
    last: float

    def told(self) -> str:
        """In words, lengths in µm."""
        what = "diverges" if self.diverges else "grows"
        sizes = f"{self.before * 1e6:.4g} µm before, {self.last * 1e6:.4g} µm at the end"
        return f"form error {what} from revolution {self.since} on: {sizes}"

    def summary(self) -> dict[str, object]:
        """The same for JSON, lengths in µm."""
        lengths = {"before": self.before * 1e6, "last": self.last * 1e6}
        return {"diverges": self.diverges, "from_revolution": self.since, **lengths}


def judge(largest: Array, tolerance: float, before: int = 0) -> Verdict:
    """Judge a run by a tolerance.

    Args:
        largest: largest magnitude of the form error of each complete revolution [m], shape (revolutions,).
        tolerance: form error that is allowed to each side [m].
        before: revolutions before the first of these, as of a snapshot.
    """
    count = largest.size
    if not count:
        return Verdict(tolerance, 0, 0, (0, 0), np.nan)
    outside = np.flatnonzero(~(largest <= tolerance))  # what is not a number is not in tolerance
    inside = int(outside[-1]) + 1 if outside.size else 0  # the first from which on all are
    start = max(inside, count - LAST) if inside < count else count - 1
    since = inside + 1 + before if inside < count else 0
    return Verdict(tolerance, count, since, (start + 1 + before, count + before), float(largest[start:].max()))


def growth(largest: Array, before: int = 0) -> Growth | None:
    """Growth of the form error of a run; None if there is none, if it is a step, or in too few revolutions.

    Args:
        largest: largest magnitude of the form error of each complete revolution [m], shape (revolutions,).
        before: revolutions before the first of these, as of a snapshot.
    """
    finite = largest[np.isfinite(largest)]
    if finite.size <= _FEWEST:
        return None
    sizes = np.fmax(np.where(np.isfinite(largest), largest, _FACTOR * finite.max()), _NOTHING)
    near = np.flatnonzero(sizes <= _FACTOR * sizes.min())
    settled = sizes[near[0] : near[-1] + 1]
    start = int(near[0] + np.flatnonzero(settled <= np.median(settled))[-1])  # the last that is as small as usual
    while start > near[0] and sizes[start - 1] < sizes[start]:
        start -= 1
    rise = sizes[start + 1 :]
    if not rise.size or rise[-1] <= _FACTOR * settled.max():
        return None
    # To half of the largest: a drive at its limits grows no further.
    climb = sizes[start : start + 2 + int(np.argmax(rise >= rise.max() / _FACTOR))]
    steps = np.diff(np.log(climb))
    if climb.size <= _FEWEST or steps.max() > steps.sum() / 2.0:
        return None
    first, middle, last = (float(third.mean()) for third in np.array_split(climb, 3))
    diverges = last - middle > _BENT * (middle - first)
    return Growth(diverges, start + 2 + before, float(settled.max()), float(largest[-1]))
