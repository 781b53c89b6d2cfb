# SPDX-License-Identifier: Apache-2.0
"""Whether a part is in tolerance: the form error against what is allowed to each side.

The tolerance ±t is that of a line profile (ISO 1101) whose zone is 2t wide, t to each side of the desired form. A
revolution is in tolerance if its form error is nowhere larger than t; a run, from the revolution on from which all are,
to its end. The margin is that of its last revolutions: the first that is in tolerance hardly is.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

LAST = 10  #: revolutions at the end of a run that its spare and its budget speak of, at most


@dataclass(frozen=True)
class Verdict:
    """The verdict on a run.

    Attributes:
        tolerance: form error that is allowed to each side [m].
        revolutions: complete ones that were judged.
        since: revolution, counted from 1, from which on all are in tolerance; 0: the last is not.
        largest: largest magnitude of the form error in the last revolutions that are in tolerance, in `LAST` of them
            at most; of the last, if that is not; NaN without a revolution [m].
    """

    tolerance: float
    revolutions: int
    since: int
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
        return (
            f"in tolerance ({allowed}) from revolution {self.since} on, {self.spare * 1e6:.3g} µm to spare at the end"
        )

    def summary(self) -> dict[str, object]:
        """The same for JSON, lengths in µm."""
        return {
            "allowed": self.tolerance * 1e6,
            "in_tolerance": self.in_tolerance,
            "from_revolution": self.since or None,
            "largest": self.largest * 1e6 if self.revolutions else None,
            "spare": self.spare * 1e6 if self.revolutions else None,
        }


class Judge:
    """Judges a run revolution by revolution, in memory that does not grow with it.

    Args:
        tolerance: form error that is allowed to each side [m].
        before: revolutions before the first that it hears of, as of a snapshot.
    """

    def __init__(self, tolerance: float, before: int = 0) -> None:
        self._tolerance, self._before = tolerance, before
        self._count = self._since = 0
        self._newest: deque[float] = deque(maxlen=LAST)

    def add(self, largest: Array) -> None:
        """Take the largest magnitude of the form error of the next revolutions [m], shape (n,)."""
        for value in largest.tolist():
            self._count += 1
            inside = value <= self._tolerance  # what is not a number is not
            if not (inside and self._since):
                self._newest.clear()
                self._since = self._count if inside else 0
            self._newest.append(value)

    def verdict(self) -> Verdict:
        """Of the revolutions so far."""
        since = self._since + self._before if self._since else 0
        return Verdict(self._tolerance, self._count, since, max(self._newest, default=np.nan))


def judge(largest: Array, tolerance: float) -> Verdict:
    """Judge a whole run.

    Args:
        largest: largest magnitude of the form error of each complete revolution [m], shape (revolutions,).
        tolerance: form error that is allowed to each side [m].
    """
    judging = Judge(tolerance)
    judging.add(largest)
    return judging.verdict()
